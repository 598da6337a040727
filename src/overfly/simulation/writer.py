"""Store a simulated flight: EuRoC layout under mav0/, everything that only a simulator knows under truth/."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from overfly.errors import OutputError
from overfly.geometry.poses import FloatArray, Pose
from overfly.simulation import layout
from overfly.simulation.flight import SimulatedFlight, SimulatedFrame, geographic
from overfly.simulation.scene import write_scene
from overfly.types import IntArray

CLICKS_PER_LANDMARK = 12
CLICK_SIGMA_PX = 0.5


def write_flight(
    flight: SimulatedFlight, out: Path, progress: Callable[[int, int], None] | None = None
) -> int:
    """Render and store the flight in the folder ``out``, which must be new or empty; returns the number of
    frames.

    Interrupted, it finishes the frame, writes what belongs to it and passes the KeyboardInterrupt on. Raises
    OutputError when the folder holds something already or cannot be written.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise OutputError(
            f"{out} exists already and is not an empty folder: choose another one, or remove it"
        )
    try:
        return _write(flight, out, progress or (lambda _done, _of: None))
    except OSError as error:
        raise OutputError(f"{out}: the flight cannot be written: {error.strerror or error}") from error


def _write(flight: SimulatedFlight, out: Path, progress: Callable[[int, int], None]) -> int:
    names = [setup.name for setup in flight.scenario.cameras]
    for name in names:
        (out / "mav0" / name / "data").mkdir(parents=True, exist_ok=True)
    rows: list[str] = []
    suffixes: list[str] = []
    interrupted: KeyboardInterrupt | None = None
    try:
        for index in range(len(flight)):
            made = flight.render(index)
            for name, shot in zip(names, made.shots, strict=True):
                layout.write_bytes(
                    out / "mav0" / name / "data" / f"{made.frame.t_ns}{shot.suffix}", shot.encoded
                )
            suffixes.append(made.shots[0].suffix)
            rows.append(_frame_row(made))
            progress(index + 1, len(flight))
    except KeyboardInterrupt as stop:
        interrupted = stop
    count = len(rows)
    if count:
        _write_cameras(flight, out / "mav0", suffixes)
        _write_sensors(flight, out / "mav0", count)
        _write_clicks(flight, out / "mav0", count)
        gains = ",".join(f"gain_{name}" for name in names)
        layout.write_lines(out / "truth" / "frames_gt.csv", [f"#timestamp [ns],state,{gains}", *rows])
        _write_truth(flight, out / "truth", count)
        write_scene(flight.scenario, out / "truth" / "scene")
    if interrupted is not None:
        raise interrupted
    return count


def _frame_row(made: SimulatedFrame) -> str:
    return ",".join([str(made.frame.t_ns), made.state, *(f"{shot.gain:.4f}" for shot in made.shots)])


def _write_cameras(flight: SimulatedFlight, mav0: Path, suffixes: list[str]) -> None:
    for setup in flight.scenario.cameras:
        stamps = flight.stamps_ns[: len(suffixes)]
        rows = [f"{t},{t}{suffix}" for t, suffix in zip(stamps, suffixes, strict=True)]
        layout.write_lines(mav0 / setup.name / "data.csv", ["#timestamp [ns],filename", *rows])
        text = layout.camera_yaml(setup, flight.scenario.rate_hz)
        layout.write_text(mav0 / setup.name / "sensor.yaml", text)


def _write_sensors(flight: SimulatedFlight, mav0: Path, count: int) -> None:
    suite, recorded = flight.scenario.sensors, flight.recorded
    last_ns = int(flight.stamps_ns[count - 1]) + 500_000_000

    def store(
        folder: str, kind: str, header: str, stamps: IntArray, values: FloatArray, **facts: object
    ) -> None:
        kept = stamps <= last_ns
        rows = [
            f"{t},{','.join(f'{value:.10g}' for value in row)}"
            for t, row in zip(stamps[kept], values[kept].tolist(), strict=True)
        ]
        layout.write_lines(mav0 / folder / "data.csv", [f"#timestamp [ns],{header}", *rows])
        layout.write_text(mav0 / folder / "sensor.yaml", layout.sensor_yaml(kind, facts))

    if suite.attitude is not None and recorded.attitude is not None:
        columns = 2 if suite.attitude.yaw_sigma_rad is None else 3
        header = ",".join(["roll [rad]", "pitch [rad]", "yaw [rad]"][:columns])
        facts: dict[str, object] = {
            "rate_hz": suite.attitude.rate_hz,
            "sigma_rad": suite.attitude.sigma_rad,
            "bias_sigma_rad": suite.attitude.bias_sigma_rad,
        }
        if suite.attitude.yaw_sigma_rad is not None:
            facts["yaw_sigma_rad"] = suite.attitude.yaw_sigma_rad
        values = recorded.attitude.values[:, :columns]
        store("attitude0", "attitude", header, recorded.attitude.stamps_ns, values, **facts)
    if suite.sonar is not None and recorded.sonar is not None:
        facts = {
            "rate_hz": suite.sonar.rate_hz,
            "sigma_m": suite.sonar.sigma_m,
            "cone_half_angle_rad": suite.sonar.cone_half_angle_rad,
        }
        store("altitude0", "sonar", "range [m]", recorded.sonar.stamps_ns, recorded.sonar.values, **facts)
    if suite.barometer is not None and recorded.barometer is not None:
        facts = {"rate_hz": suite.barometer.rate_hz, "sigma_m": suite.barometer.sigma_m}
        readings = recorded.barometer
        store("barometer0", "barometer", "above_start [m]", readings.stamps_ns, readings.values, **facts)
    if suite.imu is not None and recorded.imu is not None:
        header = ",".join([f"w_RS_S_{a} [rad s^-1]" for a in "xyz"] + [f"a_RS_S_{a} [m s^-2]" for a in "xyz"])
        facts = {
            "rate_hz": suite.imu.rate_hz,
            "gyroscope_noise_density": suite.imu.gyroscope_noise,
            "gyroscope_random_walk": suite.imu.gyroscope_walk,
            "accelerometer_noise_density": suite.imu.accelerometer_noise,
            "accelerometer_random_walk": suite.imu.accelerometer_walk,
        }
        store("imu0", "imu", header, recorded.imu.stamps_ns, recorded.imu.values, **facts)
    if suite.gps is not None and recorded.gps is not None:
        origin = flight.scenario.origin_lat_lon_alt
        facts = {
            "rate_hz": suite.gps.rate_hz,
            "sigma_horizontal_m": suite.gps.sigma_horizontal_m,
            "sigma_vertical_m": suite.gps.sigma_vertical_m,
            "origin_lat_lon_alt": list(origin),
        }
        header = "latitude [deg],longitude [deg],altitude [m]"
        store("gps0", "gps", header, recorded.gps.stamps_ns, geographic(recorded.gps.values, origin), **facts)


def _write_clicks(flight: SimulatedFlight, mav0: Path, count: int) -> None:
    """Landmarks as a person would click them: in a few frames each, to half a pixel; and the object of known
    size.
    """
    generator = np.random.default_rng([flight.seed, 61])
    rows = []
    for name, point in flight.landmarks.items():
        seen = _sightings(flight, point, count, 0)
        chosen = seen[:: max(1, -(-len(seen) // CLICKS_PER_LANDMARK))]
        for index, px in chosen:
            u, v = px + generator.normal(0.0, CLICK_SIGMA_PX, 2)
            camera = flight.scenario.cameras[0].name
            rows.append(f"{name},{flight.stamps_ns[index]},{camera},{u:.2f},{v:.2f}")
    if rows:
        layout.write_lines(
            mav0 / "landmarks0" / "data.csv", ["#name,timestamp [ns],camera,u [px],v [px]", *rows]
        )
    thing = flight.scale_landmark
    if thing is not None:
        header = "#name,corner,x_local [m],y_local [m],timestamp [ns],camera,u [px],v [px]"
        corners = [
            f"{thing.name},{k},{local[0]:g},{local[1]:g},{thing.t_ns},{thing.camera},{px[0]:.2f},{px[1]:.2f}"
            for k, (local, px) in enumerate(zip(thing.corners_m, thing.corners_px, strict=True))
        ]
        layout.write_lines(mav0 / "landmark0" / "data.csv", [header, *corners])


def _sightings(
    flight: SimulatedFlight, point: FloatArray, count: int, camera: int
) -> list[tuple[int, FloatArray]]:
    """Frames (index, pixel) of a camera in which a world point (3,) is seen and the picture is good."""
    found = []
    for index in flight.near(point, count):
        px = flight.project(index, point[None], camera)[0]
        if np.isfinite(px).all() and not flight.is_black(index):
            found.append((index, px))
    return found


def _write_truth(flight: SimulatedFlight, truth: Path, count: int) -> None:
    stamps = flight.stamps_ns[:count]
    layout.write_lines(truth / "groundtruth_cam0.tum", tum_lines(stamps, flight.truth))
    layout.write_lines(truth / "groundtruth.tum", tum_lines(stamps, flight.body_truth))
    rows = []
    for name, point in flight.landmarks.items():
        place = ",".join(f"{value:.6f}" for value in point)
        for number, setup in enumerate(flight.scenario.cameras):
            for index, px in _sightings(flight, point, count, number):
                rows.append(f"{name},{place},{stamps[index]},{setup.name},{px[0]:.4f},{px[1]:.4f}")
    header = "#name,x [m],y [m],z [m],timestamp [ns],camera,u [px],v [px]"
    layout.write_lines(truth / "landmarks_gt.csv", [header, *rows])


def tum_lines(stamps_ns: IntArray, poses: Iterable[Pose]) -> list[str]:
    """Lines of a TUM file; stamps in seconds with nine decimals."""
    lines = ["# timestamp [s] tx ty tz qx qy qz qw"]
    for t_ns, pose in zip(stamps_ns.tolist(), poses, strict=False):
        numbers = " ".join(f"{value:.9f}" for value in pose.translation)
        turn = " ".join(f"{value:.12f}" for value in pose.quaternion())
        lines.append(f"{t_ns // 10**9}.{t_ns % 10**9:09d} {numbers} {turn}")
    return lines
