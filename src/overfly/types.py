"""The values that flow through Overfly: sensors -> vision -> graph -> products. Frozen, without behaviour of
their own.

Frames and units as in docs/conventions.md: SI and radians, poses ``b_from_a``, quaternions xyzw, pixel (0, 0)
is the centre of the top-left pixel, times are integer nanoseconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose

UInt8Array = NDArray[np.uint8]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


class AltitudeKind(StrEnum):
    """What an altitude in metres is measured from."""

    RANGE = "range"  # distance along the body's down axis to the ground (sonar, lidar, radar)
    ABOVE_START = "above_start"  # height above the place of take-off (barometer, DJI RelativeAltitude)


@dataclass(frozen=True, slots=True)
class Attitude:
    """Attitude of the body at a frame's time, R_world_body = Rz(yaw) Ry(pitch) Rx(roll), body FLU, world z
    up.

    sigma_rad: standard deviation of roll and of pitch. yaw_rad is None when the sensor gives no heading.
    """

    roll_rad: float
    pitch_rad: float
    sigma_rad: float
    yaw_rad: float | None = None
    yaw_sigma_rad: float | None = None


@dataclass(frozen=True, slots=True)
class Altitude:
    """Height measurement at a frame's time. half_angle_rad: of the cone in which a range sensor takes the
    nearest echo; 0 for a beam.
    """

    value_m: float
    sigma_m: float
    kind: AltitudeKind
    half_angle_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class GeoPosition:
    """WGS 84 position at a frame's time; altitude as the source gives it (see the reader)."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    sigma_horizontal_m: float
    sigma_vertical_m: float


@dataclass(frozen=True, slots=True, eq=False)
class ImuRecord:
    """Inertial samples in the body frame: t_ns (n,), gyro (n, 3) rad/s, accel (n, 3) specific force m/s²."""

    t_ns: IntArray
    gyro: FloatArray
    accel: FloatArray


@dataclass(frozen=True, slots=True)
class Frame:
    """What was recorded at one instant.

    images: one per camera of the rig, uint8, (H, W) gray or (H, W, 3) RGB, distorted as recorded, all of one
    instant. The other sensors are interpolated to t_ns; None where there is none near enough.
    """

    index: int
    t_ns: int
    name: str
    images: tuple[UInt8Array, ...]
    attitude: Attitude | None = None
    altitude: Altitude | None = None
    position: GeoPosition | None = None


@dataclass(frozen=True, slots=True)
class MountedCamera:
    """A camera and its place on the body: body_from_cam takes optical axes (x right, y down, z forward) to
    body FLU.
    """

    name: str
    camera: Camera
    body_from_cam: Pose


@dataclass(frozen=True, slots=True)
class ScaleLandmark:
    """A flat object of known size, seen at the start: corners_m (n, 2) in its own plane, corners_px (n, 2) in
    a frame.
    """

    name: str
    t_ns: int
    camera: str
    corners_m: FloatArray
    corners_px: FloatArray


@dataclass(frozen=True, slots=True)
class LandmarkClick:
    """A named point as somebody clicked it in one frame."""

    name: str
    t_ns: int
    camera: str
    px: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Rig:
    """The cameras on the body; cam0 is the camera whose poses are estimated. Two cameras make
    a stereo rig.
    """

    cameras: tuple[MountedCamera, ...]
    calibration_source: str = (
        "given"  # given | refined | exif | default: how far the intrinsics can be trusted
    )
    level_sigma_rad: float | None = None  # of a mount that is level itself (gimbal), with no attitude sensor

    @property
    def cam0(self) -> MountedCamera:
        return self.cameras[0]

    @property
    def is_stereo(self) -> bool:
        return len(self.cameras) > 1

    @property
    def cam1_from_cam0(self) -> Pose:
        return self.cameras[1].body_from_cam.inverse() @ self.cameras[0].body_from_cam


@dataclass(frozen=True, slots=True)
class Problem:
    """One bad file or row that was passed over, in words for a person."""

    where: str  # file name, with row number where it has rows
    what: str


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Features of one image, n of them.

    px (n, 2) float32 pixels; descriptors (n, d) uint8 (binary, Hamming) or float32 (Euclidean);
    size_px (n,) diameter of the described patch's core; angle_rad (n,) orientation, image x axis towards y;
    response (n,) detector strength, larger is better.
    """

    px: Float32Array
    descriptors: NDArray[np.uint8] | NDArray[np.float32]
    size_px: Float32Array
    angle_rad: Float32Array
    response: Float32Array

    def __len__(self) -> int:
        return len(self.px)

    def at(self, chosen: BoolArray | IntArray) -> Features:
        """These of the features, in this order."""
        return Features(
            self.px[chosen],
            self.descriptors[chosen],
            self.size_px[chosen],
            self.angle_rad[chosen],
            self.response[chosen],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Map points and where the current camera sees them, n of them, sorted by descriptor distance (Eq. 2).

    points (n, 3) metres, in the frame of the map piece (world); rays (n, 2) undistorted image coordinates
    (x/z, y/z) in the current camera's optical frame; distance (n,) descriptor distance, in the extractor's
    own unit; map_index (n,) row of the feature in the node it came from; frame_index (n,) row of the feature
    in the current frame; spread (n, 3) metres, in the same frame: how far each point may lie off along the
    ray it was seen by, one standard deviation (None: not at all).
    """

    points: FloatArray
    rays: FloatArray
    distance: FloatArray
    map_index: IntArray
    frame_index: IntArray
    spread: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.points)


class Reason(StrEnum):
    """Why a pose was not found. Values are what metrics, reports and fixes print."""

    NO_IMAGE = "no usable image"
    FEW_FEATURES = "too few features"
    FEW_MATCHES = "too few matches"
    NO_HYPOTHESIS = "no pose agrees with the matches"
    FEW_INLIERS = "too few inliers"
    POOR_SPREAD = "inliers too close together"
    IMPLAUSIBLE = "pose not plausible"
    OUTSIDE_GATE = "outside the three-sigma region"
    INCONSISTENT = "disagrees with its neighbours"
    OTHER_PIECE = "in another piece of the map"


@dataclass(frozen=True, slots=True)
class NotFound:
    """A pose that was not found, and why; never an identity pose and never a stale one."""

    reason: Reason
    detail: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """A camera pose found from correspondences.

    covariance (6, 6) of the perturbation world_from_cam @ Pose.exp(x), x = (translation, rotation) in the
    camera frame; inliers (m,) indices into the correspondences; score of Eq. 3; rms_px reprojection RMS over
    the inliers.
    """

    world_from_cam: Pose
    covariance: FloatArray
    inliers: IntArray
    score: float
    rms_px: float


class ConstraintKind(StrEnum):
    ODOMETRY = "odometry"
    REVISIT = "revisit"
    DEAD_RECKONING = "dead reckoning"  # from where the camera was lost to where a new piece of map begins
    BRIDGE = "bridge"  # across a gap between frames that dead reckoning spans well
    POSITIONS = "positions"  # from one piece of the map to another, which GPS placed


@dataclass(frozen=True, slots=True, eq=False)
class Constraint:
    """Relative pose of node j seen from node i, <delta_ji, Omega_ji> of the paper's Eq. 1.

    i_from_j: pose of camera j in camera i's frame. information (6, 6) of e = (translation, vector part of the
    quaternion) of i_from_j^-1 @ predicted, the convention of g2o files, so that graphs go to and from files
    unchanged.
    """

    i: int
    j: int
    i_from_j: Pose
    information: FloatArray
    kind: ConstraintKind = ConstraintKind.ODOMETRY


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """What an autopilot takes: velocity in the vehicle's heading frame (forward, left, up) and yaw rate."""

    forward_m_s: float = 0.0
    left_m_s: float = 0.0
    up_m_s: float = 0.0
    yaw_rate_rad_s: float = 0.0
