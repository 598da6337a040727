"""A simulated vehicle behind a camera and an autopilot: what the autopilot is told, by its own rules."""

from __future__ import annotations

import functools
import json
import math
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from overfly.cli import main
from overfly.errors import CalibrationError, SourceError, UsageError
from overfly.geometry.geodesy import enu_from_geodetic
from overfly.geometry.poses import Pose, euler_from_rotation
from overfly.mapstore import Map
from overfly.navigation.mavlink import Autopilot, VehicleState
from overfly.navigation.safety import Fence
from overfly.pipeline.autopilot import AutopilotRequest, Itinerary, placement_of, run
from overfly.pipeline.live_frames import live_rig
from overfly.products.georeference import GeoReference, transform_points
from overfly.sensors import open_flight
from overfly.sensors.live_camera import LiveCamera, is_live
from overfly.simulation import LiveFlight, VelocityCommand
from overfly.simulation.scenario import Scenario, declared
from overfly.types import Frame

from . import rules
from .fake_autopilot import FakeAutopilot

RATE_HZ = 10.0


@functools.cache
def hold_scenario() -> Scenario:
    return declared("hold").build(1)


class SimulatedCamera:
    """Takes pictures of a simulated flight by the wall clock, and tells the autopilot its
    attitude and range.
    """

    def __init__(
        self, autopilot: FakeAutopilot, ends_after: int = 10_000, darkens_after: int = 10_000
    ) -> None:
        """ends_after, darkens_after: so many fixes have reached the autopilot, however slow the machine is;
        the dark lasts until nothing has reached it for a second.
        """
        self.flight = LiveFlight(hold_scenario(), 1)
        self.truth: list[tuple[int, np.ndarray]] = []  # (ns, place)
        self._autopilot, self._ends_after, self._darkens_after = autopilot, ends_after, darkens_after
        self.pictures = 10_000  # and then it ends
        self.was_dark = False
        self._sense()  # an autopilot knows its attitude and range before the first picture
        self._begin = time.monotonic()
        self._next = self._begin
        self.released = threading.Event()

    def _sense(self) -> Frame:
        """The flight's frame of now; the autopilot has its attitude and range."""
        roll, pitch, yaw = euler_from_rotation(self.flight.truth.rotation)
        self._autopilot.roll, self._autopilot.pitch = roll, -pitch
        self._autopilot.yaw = 0.5 * math.pi - yaw
        frame = self.flight.frame()
        if frame.altitude is not None:
            self._autopilot.range_cm = round(100.0 * frame.altitude.value_m)
        return frame

    def read(self) -> tuple[bool, Any]:
        self._next = max(self._next + 1.0 / RATE_HZ, time.monotonic())
        time.sleep(max(0.0, self._next - time.monotonic()))
        ahead_s = time.monotonic() - self._begin - self.flight.time_s
        self.flight.step(VelocityCommand(forward_m_s=0.2), max(ahead_s, 0.01))
        frame = self._sense()
        self.truth.append((time.monotonic_ns(), self.flight.truth.translation.copy()))
        image = frame.images[0]
        sent = self._autopilot.of_type("ODOMETRY")
        n_fixes = sum(message.quality >= 40 for _, message in sent)
        is_late = time.monotonic() - self._begin > 60.0
        if n_fixes >= self._ends_after or len(self.truth) > self.pictures or is_late:
            return False, None
        if n_fixes >= self._darkens_after and not self.was_dark:
            image = np.zeros_like(image)
            self.was_dark = time.monotonic_ns() - sent[-1][0] > 1_000_000_000
        return True, image if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])

    def release(self) -> None:
        self.released.set()


def calibration(folder: Path) -> Path:
    mounted = LiveFlight(hold_scenario(), 1).rig.cam0
    camera = mounted.camera
    text = (
        f"camera_model: pinhole\nresolution: [{camera.width}, {camera.height}]\n"
        f"intrinsics: [{camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}]\n"
        f"distortion_model: radtan\ndistortion_coefficients: {list(camera.coefficients)}\n"
        f"T_BS: {mounted.body_from_cam.matrix().reshape(-1).tolist()}\n"
    )
    (folder / "camera.yaml").write_text(text)
    return folder / "camera.yaml"


def test_a_vehicle_is_told_where_it_is_and_goes_silent_in_the_dark(tmp_path: Path) -> None:
    with FakeAutopilot(Autopilot.PX4) as autopilot:
        world = SimulatedCamera(autopilot, ends_after=24, darkens_after=12)
        request = AutopilotRequest(
            tmp_path / "none.overfly", autopilot.url, "camera:0", tmp_path / "out", calibration(tmp_path),
            holds=True,
        )  # fmt: skip
        outcome = run(request, camera=LiveCamera(world))
        arrived = autopilot.of_type("ODOMETRY")
        targets = autopilot.of_type("SET_POSITION_TARGET_LOCAL_NED")
    assert world.released.is_set()
    fixes = [(t_ns, message) for t_ns, message in arrived if message.quality >= 40]
    assert world.was_dark
    assert len(fixes) >= 24
    # straight on, at the speed and height of the truth
    first, last = fixes[0], fixes[-1]
    flown = np.array([last[1].x - first[1].x, last[1].y - first[1].y])
    times, places = np.array([t for t, _ in world.truth]), np.array([place for _, place in world.truth])
    at = [np.argmin(np.abs(times - 1000 * message.time_usec)) for _, message in (first, last)]
    wanted = places[at[1]] - places[at[0]]
    assert np.linalg.norm(flown) == pytest.approx(np.linalg.norm(wanted[:2]), abs=0.15)
    assert -last[1].z == pytest.approx(places[at[1], 2], abs=0.15)
    # in the dark: guesses of low quality for a second, then nothing
    gaps_s = np.diff([t_ns for t_ns, _ in arrived]) * 1e-9
    silence = int(np.argmax(gaps_s))
    assert gaps_s[silence] > 0.9
    assert arrived[silence][1].quality <= 10
    assert arrived[silence + 1][1].quality >= 40
    assert arrived[silence + 1][1].reset_counter == arrived[silence][1].reset_counter + 1
    decoder = rules.Px4(quality_min=20)
    assert sum(decoder.take(message) is not None for _, message in arrived) > 10
    assert outcome.numbers["silences"] >= 1
    assert outcome.numbers["autopilot"] == "PX4"
    assert targets and len(targets) <= len(fixes)  # it was asked to hold, and never by a guess
    assert len(Map.open(tmp_path / "out" / "map.overfly")) >= 1
    assert json.loads((tmp_path / "out" / "fly.json").read_text())["images"] == outcome.numbers["images"]


def test_nothing_is_commanded_unless_asked(tmp_path: Path) -> None:
    with FakeAutopilot() as autopilot:
        request = AutopilotRequest(
            tmp_path / "none.overfly", autopilot.url, "camera:0", tmp_path / "out", calibration(tmp_path),
            minutes=1.0,
        )  # fmt: skip
        run(request, camera=LiveCamera(SimulatedCamera(autopilot, ends_after=5)))
        assert autopilot.of_type("ODOMETRY")
        assert not autopilot.of_type("SET_POSITION_TARGET_LOCAL_NED")
        commands = {message.command for _, message in autopilot.of_type("COMMAND_LONG")}
        assert commands <= {511}  # SET_MESSAGE_INTERVAL: no mode, no arming


@pytest.mark.parametrize("turn", [0.0, 0.7, -2.0])
def test_the_map_lies_where_its_georeference_says(turn: float) -> None:
    """Against the projection itself, at a place far from its middle, where its north is not the true one."""
    from pyproj import Transformer

    reference = GeoReference("EPSG:32632", 1.0, turn, (260_000.0, 5_250_000.0, 410.0))
    placement = placement_of(reference)
    assert placement.origin is not None
    places = np.array([[0.0, 0.0, 5.0], [40.0, -25.0, 0.0], [-60.0, 10.0, 12.0]])
    crs = transform_points(reference.crs_from_world(), places[:, :2])
    longitude, latitude = Transformer.from_crs("EPSG:32632", 4326, always_xy=True).transform(*crs.T)
    heights = reference.height_in_crs(places[:, 2])
    expected = enu_from_geodetic(np.column_stack([latitude, longitude, heights]), placement.origin)
    for place, enu in zip(places, expected, strict=True):
        got = placement.local(place)
        np.testing.assert_allclose([got[1], got[0], -got[2]], enu, atol=0.02)
        found = placement.geodetic(place)
        assert found is not None
        np.testing.assert_allclose(enu_from_geodetic(found[None, :], placement.origin)[0], enu, atol=0.02)


def state_at(x: float, y: float, z: float, t_s: float) -> VehicleState:
    pose = Pose(np.eye(3), np.array([x, y, z]))
    return VehicleState(round(t_s * 1e9), pose, np.eye(6) * 1e-4, None, None, 80, 0)


def test_places_are_visited_in_order_at_the_height_of_the_first_fix() -> None:
    one = Itinerary(((3.0, 0.0), (3.0, 4.0)), holds=False, fence=Fence(-5, -5, 5, 3.0, 1.0, 9.0))
    first = one.target(state_at(0.0, 0.0, 2.0, 0.0))
    assert first is not None
    np.testing.assert_array_equal(first, [3.0, 0.0, 2.0])
    for t_s in (1.0, 2.0, 3.5):  # there for two seconds
        one.target(state_at(2.9, 0.1, 2.2, t_s))
    second = one.target(state_at(2.9, 0.1, 2.2, 3.6))
    assert second is not None
    np.testing.assert_array_equal(second, [3.0, 3.0, 2.0])  # the fence ends there
    assert not one.is_over
    for t_s in (5.0, 8.0):
        one.target(state_at(3.0, 2.9, 2.0, t_s))
    assert one.is_over
    low = Itinerary((), holds=True, fence=Fence(-5, -5, 5, 5, 1.0, 9.0)).target(state_at(0, 0, 0.2, 0.0))
    assert low is not None and low[2] == 1.0  # never below the floor
    assert Itinerary((), holds=False).target(state_at(0, 0, 1, 0.0)) is None


def test_what_is_missing_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    request = AutopilotRequest(tmp_path / "none.overfly", "udpout:127.0.0.1:9", "camera:0", tmp_path / "out")
    with pytest.raises(UsageError, match="calibration"):
        run(request)
    with pytest.raises(CalibrationError, match="camera:0"):
        live_rig("camera:0", (320, 240), None)
    with pytest.raises(UsageError, match="overfly map"):
        open_flight("camera:0")
    with pytest.raises(SourceError, match="camera:99"):
        LiveCamera.open("camera:99")
    assert [is_live(name) for name in ("camera:0", "rtsp:/host/a", "rtsp://host/a", "a.mp4", "camera")] == [
        True, True, True, False, False,
    ]  # fmt: skip
    assert main(["fly", str(tmp_path / "none.overfly"), "--sim", "hold", "--mavlink", "udpout:h:1"]) == 2
    assert "--sim" in capsys.readouterr().err


class FewPictures:
    """Five pictures, faster than anybody reads them, then nothing."""

    def __init__(self) -> None:
        self.count = 0

    def read(self) -> tuple[bool, Any]:
        self.count += 1
        if self.count > 5:
            return False, None
        image = np.zeros((4, 6, 3), np.uint8)
        image[:, :, 0] = self.count  # blue, as OpenCV has it
        return True, image

    def release(self) -> None:
        self.count = -1


def test_the_newest_picture_is_seen_and_the_end_is_noticed() -> None:
    capture = FewPictures()
    with LiveCamera(capture, delay_s=0.5) as camera:
        time.sleep(0.3)
        picture = camera.next()
        assert picture is not None
        assert (picture.number, int(picture.image[0, 0, 2])) == (4, 5)
        assert 0.5 < (time.monotonic_ns() - picture.t_ns) * 1e-9 < 2.0
        assert camera.next(picture, timeout_s=3.0) is None
    assert capture.count == -1
