"""Maps of public flights, cut short, against their truth. Bounds follow from the sensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from overfly.evaluation import Align, evaluate
from overfly.sensors import open_flight
from overfly.slam import Slam
from overfly.trajectory import Trajectory, read_tum

pytestmark = pytest.mark.data


@pytest.mark.parametrize(
    ("name", "frames", "scale", "scale_source"),
    [
        # stereo: 0.15 px of 27 px disparity is half a percent of depth for one point, far less for all
        ("corridor", 120, 0.02, "stereo"),
        # a sonar of 2 cm at 2 m is one percent for one reading
        ("blimp", 120, 0.02, "range"),
        # corners clicked to a pixel or two on an object some hundred pixels large
        ("helicopter", 120, 0.05, "landmark"),
    ],
)
def test_all_frames_are_found_near_the_truth(
    data_dir: Path, name: str, frames: int, scale: float, scale_source: str
) -> None:
    """Odometry drifts by a percent of the path or two; what agrees to 0.1 mm would be the truth itself."""
    folder = data_dir / "flights" / name
    flight = open_flight(folder)
    slam = Slam(flight.rig, None, flight.scale_landmark)
    results = []
    for index in range(frames):
        frame = flight.read_frame(index)
        assert frame is not None
        results.append(slam.process(frame))
    assert [result.reason for result in results if result.pose is None] == []
    assert slam.start is not None and slam.start.source == scale_source
    found = evaluate(
        Trajectory.from_poses([r.t_ns for r in slam.records], [slam.pose_of(r) for r in slam.records]),
        read_tum(folder / "truth" / "groundtruth_cam0.tum"),
        Align.SE3,
    )
    assert found.n_frames == frames
    assert 1e-4 < found.ate_m.rmse < 0.02 * max(found.path_m, 1.0)
    assert found.scale_error is not None
    assert abs(found.scale_error) < scale
    # a node is a frame that shows something new: neither every frame nor a handful
    assert 3 <= len(slam.map) < frames / 3
    rms = np.array([result.rms_px for result in results[1:]])
    assert 0.05 < np.median(rms) < 1.0


def test_a_dark_lens_is_not_taken_for_ground_that_stays(data_dir: Path) -> None:
    """One pass of 131 m at 80 m, by pictures with a dark middle. Heights are a terrain model's, good to some
    per cent, and so is the way.
    """
    flight = open_flight(data_dir / "real" / "cuav")
    slam = Slam(flight.rig, None, flight.scale_landmark)
    for frame in flight:
        slam.process(frame)
    places = np.array([slam.pose_of(record).translation for record in slam.placed()])
    assert len(places) == 18
    assert 131.0 * 0.9 < np.linalg.norm(places[-1] - places[0]) < 131.0 * 1.1
