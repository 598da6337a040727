"""ROS bags of both generations, written without ROS."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from overfly.cli import info_command
from overfly.errors import SourceError
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import Pose
from overfly.sensors import Quantity, ReadOptions, SourceKind, open_flight
from overfly.sensors.ros_images import decode_image

from .recordings import HEIGHT, WIDTH, number_of, striped

START_NS = 1_700_000_000_000_000_000
LATE_NS = 30_000_000  # a bag has its messages when they arrived
FORMATS = ("ros1", "sqlite", "mcap")
Message = tuple[str, str, int, Callable[[Any], Any]]  # topic, type, header stamp, of a type store


class Types:
    """Messages of either generation by short names."""

    def __init__(self, is_ros1: bool) -> None:
        self.store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
        self.is_ros1 = is_ros1
        if is_ros1:  # not among the types that every ROS 1 has
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp_ns: int) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        more = {"seq": 0} if self.is_ros1 else {}
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="camera", **more)


def write_bag(folder: Path, kind: str, messages: list[Message]) -> Path:
    """A bag with these messages, each recorded LATE_NS after its stamp."""
    types = Types(kind == "ros1")
    connections: dict[str, Any] = {}
    ordered = sorted(messages, key=lambda message: message[2])
    if kind == "ros1":
        path = folder / "flight.bag"
        with Writer1(path) as bag1:
            for topic, name, stamp, build in ordered:
                if topic not in connections:
                    connections[topic] = bag1.add_connection(topic, name, typestore=types.store)
                raw = types.store.serialize_ros1(build(types), name)
                bag1.write(connections[topic], stamp + LATE_NS, raw)
        return path
    path = folder / "flight"
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer2(path, version=9, storage_plugin=plugin) as bag2:
        for topic, name, stamp, build in ordered:
            if topic not in connections:
                connections[topic] = bag2.add_connection(topic, name, typestore=types.store)
            bag2.write(connections[topic], stamp + LATE_NS, types.store.serialize_cdr(build(types), name))
    return path


def image(n: int, topic: str = "/camera/image_raw", encoding: str = "bgr8") -> Message:
    def build(types: Types) -> Any:
        picture = striped(n)
        data = picture if encoding == "bgr8" else picture[:, :, 1]
        return types.make(
            "sensor_msgs/msg/Image", header=types.header(at(n)), height=HEIGHT, width=WIDTH,
            encoding=encoding, is_bigendian=0,
            step=data.nbytes // HEIGHT, data=np.ascontiguousarray(data).reshape(-1),
        )  # fmt: skip

    return topic, "sensor_msgs/msg/Image", at(n), build


def compressed(n: int, topic: str) -> Message:
    def build(types: Types) -> Any:
        data = cv2.imencode(".png", striped(n))[1].reshape(-1)
        return types.make(
            "sensor_msgs/msg/CompressedImage", header=types.header(at(n)), format="bgr8; png", data=data
        )

    return topic, "sensor_msgs/msg/CompressedImage", at(n), build


def camera_info(topic: str = "/camera/camera_info", shift: float = 0.0) -> Message:
    def build(types: Types) -> Any:
        names = "DKRP" if types.is_ros1 else "dkrp"
        k = np.array([100.0, 0, 80.5, 0, 101.0, 59.5, 0, 0, 1])
        p = np.array([100.0, 0, 80.5, shift, 0, 100.0, 59.5, 0, 0, 0, 1, 0])
        values = (np.array([-0.1, 0.02, 0.001, -0.002, 0.0]), k, np.eye(3).reshape(-1), p)
        region = types.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return types.make(
            "sensor_msgs/msg/CameraInfo", header=types.header(START_NS), height=HEIGHT, width=WIDTH,
            distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=region,
            **dict(zip(names, values, strict=True)),
        )  # fmt: skip

    return topic, "sensor_msgs/msg/CameraInfo", START_NS, build


def imu(n: int, yaw_rad: float, unknown: float = 0.0) -> Message:
    """unknown: -1 in the first covariance says that the orientation is not known."""
    stamp = START_NS + n * 10_000_000

    def build(types: Types) -> Any:
        q = types.make(
            "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(0.5 * yaw_rad), w=math.cos(0.5 * yaw_rad)
        )
        rate = types.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=1.0 + 0.01 * (n % 3))
        force = types.make("geometry_msgs/msg/Vector3", x=0.0, y=0.01 * (n % 2), z=9.81)
        nine = np.zeros(9)
        stated = np.append(unknown, np.zeros(8))
        return types.make(
            "sensor_msgs/msg/Imu", header=types.header(stamp), orientation=q, orientation_covariance=stated,
            angular_velocity=rate, angular_velocity_covariance=nine,
            linear_acceleration=force, linear_acceleration_covariance=nine,
        )  # fmt: skip

    return "/imu/data", "sensor_msgs/msg/Imu", stamp, build


def distance(n: int, metres: float) -> Message:
    def build(types: Types) -> Any:
        return types.make(
            "sensor_msgs/msg/Range", header=types.header(at(n)), radiation_type=0, field_of_view=0.1,
            min_range=0.2, max_range=30.0, range=metres,
        )  # fmt: skip

    return "/sonar", "sensor_msgs/msg/Range", at(n), build


def gps(n: int) -> Message:
    def build(types: Types) -> Any:
        status = types.make("sensor_msgs/msg/NavSatStatus", status=0, service=1)
        return types.make(
            "sensor_msgs/msg/NavSatFix", header=types.header(at(n)), status=status, latitude=47.0 + 1e-6 * n,
            longitude=8.5, altitude=430.0, position_covariance=np.diag([0.5**2, 0.5**2, 0.9**2]).reshape(-1),
            position_covariance_type=2,
        )  # fmt: skip

    return "/gps/fix", "sensor_msgs/msg/NavSatFix", at(n), build


def at(n: int) -> int:
    return START_NS + n * 100_000_000


def whole_flight() -> list[Message]:
    return [
        camera_info(),
        *(image(n) for n in range(12)),
        *(imu(n, 0.01 * n) for n in range(130)),
        *(distance(n, 5.0 + 0.1 * n) for n in range(12)),
        *(gps(n) for n in range(12)),
    ]


@pytest.mark.parametrize("kind", FORMATS)
def test_a_whole_flight(tmp_path: Path, kind: str) -> None:
    flight = open_flight(write_bag(tmp_path, kind, whole_flight()))
    assert flight.kind is SourceKind.ROS_BAG
    frames = list(flight)
    assert [number_of(frame.images[0]) for frame in frames] == list(range(12))
    assert [frame.t_ns for frame in frames] == [at(n) for n in range(12)]
    assert frames[3].images[0][0, 0, 2] < 60 < frames[3].images[0][0, 0, 0]  # RGB: blue is dark
    camera = flight.rig.cam0.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (100.0, 101.0, 80.5, 59.5)
    assert camera.coefficients == (-0.1, 0.02, 0.001, -0.002, 0.0)
    assert flight.rig.calibration_source == "given"
    attitude, altitude, position = frames[5].attitude, frames[5].altitude, frames[5].position
    assert attitude is not None and altitude is not None and position is not None
    assert attitude.yaw_rad == pytest.approx(0.5)
    assert altitude.value_m == pytest.approx(5.5, abs=1e-6)
    assert altitude.half_angle_rad == pytest.approx(0.05)  # ultrasound over 0.1 rad in all
    assert position.latitude_deg == pytest.approx(47.0 + 5e-6, abs=1e-10)
    assert position.sigma_horizontal_m == pytest.approx(0.5)
    quantities = {Quantity.ATTITUDE, Quantity.RANGE, Quantity.POSITION}
    assert {sensor.quantity for sensor in flight.sensors} == quantities
    assert flight.imu is not None
    np.testing.assert_allclose(flight.imu.accel[0], [0.0, 0.0, 9.81])
    assert not flight.problems


@pytest.mark.parametrize("kind", FORMATS)
def test_an_imu_without_orientation_tells_the_tilt_by_its_rates_and_forces(tmp_path: Path, kind: str) -> None:
    messages = [camera_info(), *(image(n) for n in range(12)), *(imu(n, 0.7, -1.0) for n in range(650))]
    flight = open_flight(write_bag(tmp_path, kind, messages))
    assert not flight.problems
    (sensor,) = flight.sensors
    assert (sensor.name, sensor.quantity, sensor.samples) == ("/imu/data", Quantity.ATTITUDE, 650)
    assert "from rate and force" in sensor.sigma
    for frame in flight:
        assert frame.attitude is not None
        assert frame.attitude.yaw_rad is None
        assert abs(frame.attitude.roll_rad) < 0.02
        assert abs(frame.attitude.pitch_rad) < 0.02


@pytest.mark.parametrize("kind", FORMATS)
def test_frames_come_in_any_order(tmp_path: Path, kind: str) -> None:
    flight = open_flight(write_bag(tmp_path, kind, whole_flight()), ReadOptions(every=2))
    for index in (4, 1, 1, 2, 5, 0):
        frame = flight.read_frame(index)
        assert frame is not None
        assert number_of(frame.images[0]) == 2 * index


def test_a_bare_mcap_file(tmp_path: Path) -> None:
    folder = write_bag(tmp_path, "mcap", whole_flight())
    (file,) = folder.glob("*.mcap")
    bare = file.rename(tmp_path / "alone.mcap")
    assert [number_of(frame.images[0]) for frame in open_flight(bare)] == list(range(12))


def test_stereo_by_the_projection_of_the_right_camera(tmp_path: Path) -> None:
    messages = [
        *(image(n, "/stereo/left/image_rect", "mono8") for n in range(5)),
        *(image(n, "/stereo/right/image_rect", "mono8") for n in range(1, 5)),
        camera_info("/stereo/left/camera_info"),
        camera_info("/stereo/right/camera_info", shift=-12.0),
    ]
    path = write_bag(tmp_path, "ros1", messages)
    flight = open_flight(path)
    assert flight.rig.is_stereo
    np.testing.assert_allclose(flight.rig.cam1_from_cam0.translation, [-0.12, 0.0, 0.0], atol=1e-12)
    assert flight.rig.cam0.camera.coefficients == (0.0,) * 4  # rectified
    pairs = [[number_of(picture) for picture in frame.images] for frame in flight]
    assert pairs == [[n, n] for n in range(1, 5)]
    assert not open_flight(path, ReadOptions(stereo=False)).rig.is_stereo


def transform(parent: str, child: str, rotation: np.ndarray, shift: tuple[float, float, float]) -> Message:
    def build(types: Types) -> Any:
        q = Pose(rotation, np.zeros(3)).quaternion()
        header = types.header(START_NS)
        header.frame_id = parent
        moved = types.make("geometry_msgs/msg/Vector3", x=shift[0], y=shift[1], z=shift[2])
        turned = types.make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3])
        both = types.make("geometry_msgs/msg/Transform", translation=moved, rotation=turned)
        one = types.make(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=both
        )
        return types.make("tf2_msgs/msg/TFMessage", transforms=[one])

    return "/tf_static", "tf2_msgs/msg/TFMessage", START_NS, build


@pytest.mark.parametrize("kind", FORMATS)
def test_mounts_by_static_transforms(tmp_path: Path, kind: str) -> None:
    """The camera hangs on the body, backwards and behind its middle."""
    backwards = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # top of the picture aft
    messages = [
        *(image(n) for n in range(3)),
        *(imu(n, 0.0) for n in range(30)),
        transform("base_link", "camera", backwards, (-0.4, 0.0, 0.0)),
    ]
    flight = open_flight(write_bag(tmp_path, kind, messages))  # the IMU says "camera", too: means nothing
    np.testing.assert_array_equal(flight.rig.cam0.body_from_cam.rotation, NADIR_BODY_FROM_CAM)
    (tmp_path / "more").mkdir()
    without_imu = [messages[n] for n in (0, 1, 2, -1)]
    flight = open_flight(write_bag(tmp_path / "more", kind, without_imu))
    np.testing.assert_allclose(flight.rig.cam0.body_from_cam.rotation, backwards, atol=1e-9)
    np.testing.assert_allclose(flight.rig.cam0.body_from_cam.translation, [-0.4, 0.0, 0.0], atol=1e-9)


def test_the_likeliest_topic_or_the_one_that_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    messages = [
        camera_info("/down/camera_info"),
        *(compressed(n, "/down/image_raw/compressed") for n in range(4)),
        *(image(n, "/front/image_raw", "mono8") for n in range(9)),
        *(image(n, "/front/depth/image", "mono8") for n in range(20)),
    ]
    path = write_bag(tmp_path, "sqlite", messages)
    flight = open_flight(path)
    assert flight.rig.cam0.name == "/down/image_raw/compressed"  # it is calibrated
    assert [number_of(frame.images[0]) for frame in flight] == list(range(4))
    assert "/front/image_raw" in flight.problems[0].what
    asked = open_flight(path, ReadOptions(topic="/front/image_raw"))
    assert len(asked) == 9
    assert asked.rig.calibration_source == "default"
    with pytest.raises(SourceError, match="/front/image_raw"):
        open_flight(path, ReadOptions(topic="/up"))
    with pytest.raises(SourceError, match="stereo"):
        open_flight(path, ReadOptions(stereo=True))
    info_command.command(path)
    assert "/down/image_raw/compressed" in capsys.readouterr().out


def test_a_damaged_picture_is_passed_over(tmp_path: Path) -> None:
    topic, name, stamp, _ = compressed(2, "/c/image/compressed")

    def damaged(types: Types) -> Any:
        data = np.frombuffer(b"\xff\xd8 no more", np.uint8)
        return types.make(name, header=types.header(stamp), format="jpeg", data=data)

    messages = [compressed(n, topic) for n in range(5) if n != 2] + [(topic, name, stamp, damaged)]
    flight = open_flight(write_bag(tmp_path, "ros1", messages))
    assert [number_of(frame.images[0]) for frame in flight] == [0, 1, 3, 4]
    assert "damaged" in flight.problems[0].what


def test_pictures_without_a_time_have_that_of_recording(tmp_path: Path) -> None:
    def timeless(n: int) -> Message:
        topic, name, stamp, _ = image(n)

        def build(types: Types) -> Any:
            made = image(n)[3](types)
            made.header.stamp.sec = made.header.stamp.nanosec = 0
            return made

        return topic, name, stamp, build

    flight = open_flight(write_bag(tmp_path, "mcap", [timeless(n) for n in range(4)]))
    assert [frame.t_ns for frame in flight] == [at(n) + LATE_NS for n in range(4)]
    assert [number_of(frame.images[0]) for frame in flight] == list(range(4))


def test_what_cannot_be_used_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "no_pictures").mkdir()
    path = write_bag(tmp_path / "no_pictures", "ros1", [imu(n, 0.0) for n in range(5)])
    with pytest.raises(SourceError, match="no pictures in this bag, only"):
        open_flight(path)
    for name in ("a.bag", "a.mcap", "a.db3"):
        for content in (b"", b"#ROSBAG V2.0\nnonsense", b"\x89MCAP0\r\nnonsense"):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(SourceError, match=name) as failure:
                open_flight(tmp_path / name)
            assert "\n" not in str(failure.value)
    folder = tmp_path / "broken"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("nothing: here")
    with pytest.raises(SourceError, match="broken"):
        open_flight(folder)


class Raw:
    """An Image message as far as it is looked at."""

    def __init__(self, encoding: str, data: np.ndarray, step: int, height: int = 4, width: int = 6) -> None:
        self.encoding, self.data, self.step, self.height, self.width = encoding, data, step, height, width
        self.is_bigendian = 0


def test_encodings() -> None:
    rgb = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)
    np.testing.assert_array_equal(decode_image(Raw("rgb8", rgb.reshape(-1), 18)), rgb)
    bgra = np.dstack([rgb[:, :, ::-1], np.full((4, 6, 1), 255, np.uint8)])
    np.testing.assert_array_equal(decode_image(Raw("bgra8", bgra.reshape(-1), 24)), rgb)
    padded = np.hstack([rgb[:, :, 0], np.zeros((4, 2), np.uint8)])
    np.testing.assert_array_equal(decode_image(Raw("mono8", padded.reshape(-1), 8)), rgb[:, :, 0])
    deep = (rgb[:, :, 0].astype(np.uint16) << 8) + 17
    np.testing.assert_array_equal(
        decode_image(Raw("mono16", deep.view(np.uint8).reshape(-1), 12)), rgb[:, :, 0]
    )
    assert decode_image(Raw("mono8", rgb.reshape(-1)[:10], 6)) == "damaged picture"
    assert "not known" in str(decode_image(Raw("32FC1", rgb.reshape(-1), 24)))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics_have_the_colours_that_they_name(pattern: str) -> None:
    """A picture of one colour: the letters name the pixels of a square, row by row."""
    colour = {"r": 200, "g": 120, "b": 40}
    square = np.array([colour[letter] for letter in pattern], np.uint8).reshape(2, 2)
    mosaic = np.tile(square, (4, 4))
    picture = decode_image(Raw(f"bayer_{pattern}8", mosaic.reshape(-1), 8, 8, 8))
    assert not isinstance(picture, str)
    np.testing.assert_array_equal(picture[3, 3], [200, 120, 40])
