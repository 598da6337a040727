"""Ground that looks the same in many places: no wrong place is ever told to an autopilot as a fix."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from overfly.config import Config
from overfly.geometry.poses import FloatArray
from overfly.geometry.similarity import align_about_vertical
from overfly.localizer import Localizer
from overfly.mapstore import Map
from overfly.mapstore.writer import write_whole
from overfly.navigation.mavlink import FixStream
from overfly.pipeline.flying import grown_map
from overfly.simulation.flight import SimulatedFlight
from overfly.simulation.scenario import declared
from overfly.slam import Slam

MAPPED = 120  # frames; the flight goes on over ground of the same look that the map does not have
FRAMES_EACH = 8


def test_a_floor_of_tiles(tmp_path: Path) -> None:
    flight = SimulatedFlight(declared("self-similar").build(1), 1)
    truth = np.array([pose.translation for pose in flight.truth])
    slam = Slam(flight.rig, Config())
    for index in range(MAPPED):
        slam.process(flight.frame(index))
    found = np.array([slam.pose_of(record).translation for record in slam.records])
    where = truth[[record.frame_index for record in slam.records]]
    fit = align_about_vertical(found, where, np.ones(len(found)))
    assert fit is not None

    def in_truth(place: FloatArray) -> FloatArray:
        c, s = np.cos(fit.rotation_rad), np.sin(fit.rotation_rad)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(fit.scale * turn @ place + fit.translation_m)

    write_whole(tmp_path / "map.overfly", grown_map(slam, None, "tiles"))
    localizer = Localizer(Map.open(tmp_path / "map.overfly"), flight.rig)
    mount = localizer.rig.cam0.body_from_cam
    generator = np.random.default_rng(0)
    starts = [
        *generator.integers(0, MAPPED - FRAMES_EACH, 4),
        *generator.integers(0, len(flight) - FRAMES_EACH, 6),
    ]
    errors_m = []
    for start in starts:
        localizer.forget()  # carried there in the dark
        stream = FixStream(mount)
        for index in range(start, start + FRAMES_EACH):
            frame = flight.frame(int(index))
            state = stream.observe(localizer.locate(frame), frame.attitude)
            if state is not None and not state.is_guess:
                place = in_truth((state.world_from_body @ mount).translation)
                errors_m.append(float(np.linalg.norm(place - truth[index])))
    assert len(errors_m) >= 8  # where the map is, places are found and told
    assert max(errors_m) < 0.15  # a tile is twice that wide
