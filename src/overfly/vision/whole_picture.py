"""The motion between two pictures of ground that shows next to nothing, from all of their pixels at once.

Where a patch of a point is lost in the noise, thousands of pixels together still tell: a homography of the
ground plane, which the camera's pose determines, is fitted to the whole picture, from coarse to fine, by
Gauss-Newton with brightness and contrast taken out (Baker and Matthews 2004, "Lucas-Kanade 20 years on";
Irani and Anandan 1999, "About direct methods").
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import BoolArray, Float32Array, UInt8Array
from overfly.vision.alignment import Pyramid, halved

WIDTHS_PX = (40, 80, 160)  # of the reduced pictures, coarsest first
ITERATIONS = 8  # at each
CONVERGED_PX = 0.01
# Lens shading stays where it is while the ground moves: what is as wide as this part of the picture is left
# out.
SHADING_SHARE = 0.15
FEWEST_PICTURES = 8  # that tell the lens from the ground
# Until then: where the camera should have moved or turned by more than this, pictures that are this much
# alike as they lie, as a part of how alike they are when laid on each other, show the lens.
MOVED_RAD, LENS_SHARE = 0.06, 0.65
LEAST_OVERLAP = 0.3  # of the picture
LEAST_CORRELATION = 0.35  # of thousands of pixels
CLIP_SIGMAS = 2.5  # residuals beyond count no more than these: papers that move, torn lines
# Deviation of the start: along the ground and in height, in distances to the ground, and radians. Errors of
# height stay where there is one camera, and over bare ground one picture hardly shows them.
START_SHARE, START_HEIGHT_SHARE, START_RAD = 0.05, 0.01, 0.02
MISPLACED_PX = (
    0.3  # how exactly an edge is where it should be, whatever its contrast: lens, relief, interpolation
)
FURTHEST_SIGMAS = 4.0  # from the start
TOGETHER = 50.0  # times that errors of neighbouring pixels go together instead of averaging out


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """Points X of the world with normal . X = offset; normal (3,)."""

    normal: FloatArray
    offset: float


@dataclass(frozen=True, slots=True, eq=False)
class PictureFit:
    """world_from_cam, its covariance (6, 6) of (translation, rotation) against the reference, and how well
    both pictures then correlate."""

    world_from_cam: Pose
    covariance: FloatArray
    correlation: float


@dataclass(frozen=True, slots=True, eq=False)
class _Level:
    """Pictures of one width without distortion: maps for cv2.remap, focal length and middle in pixels, rays
    (h, w, 2) of its pixels and which of them the camera sees (h, w)."""

    maps: tuple[np.ndarray, np.ndarray]
    matrix: FloatArray
    rays: Float32Array
    seen: BoolArray


class WholePicture:
    """Compares whole pictures of one camera."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._levels: list[_Level] = []
        self._shading = Shading(camera)
        self._prepared: dict[int, tuple[Pyramid, list[Float32Array]]] = {}

    def learn(self, pyramid: Pyramid) -> None:
        """A picture of other ground than those before: what all of them have in common is the lens."""
        self._shading.learn(pyramid[-1])

    def fit(
        self, reference: Pyramid, world_from_reference: Pose, current: Pyramid, start: Pose, ground: Plane
    ) -> PictureFit | None:
        """The pose from which the ground of the reference picture looks like the current one, sought from a
        start; None where none does."""
        if not self._levels:
            self._levels = [_level(self._camera, width) for width in WIDTHS_PX]
        there, here = self._straightened(reference, keep=True), self._straightened(current, keep=False)
        fit: PictureFit | None = None
        for one, a, b in zip(self._levels, there, here, strict=True):
            pose = start if fit is None else fit.world_from_cam
            fit = _fit_level(one, a, world_from_reference, b, pose, ground)
            if fit is None:
                return None
        assert fit is not None
        moved = (start.inverse() @ fit.world_from_cam).log()
        height = abs(ground.offset - float(ground.normal @ start.translation))
        far = max(np.linalg.norm(moved[:3]) / (START_SHARE * height), np.linalg.norm(moved[3:]) / START_RAD)
        if fit.correlation < LEAST_CORRELATION or far > FURTHEST_SIGMAS:
            return None
        if not self._shading.is_known:
            motion = (world_from_reference.inverse() @ start).log()
            shift = np.linalg.norm(motion[:3]) / height + np.linalg.norm(motion[3:])
            unmoved = _correlation_unmoved(self._levels[-1], there[-1], here[-1])
            if shift > MOVED_RAD and unmoved > LENS_SHARE * fit.correlation:
                return None
        return fit

    def _straightened(self, pyramid: Pyramid, *, keep: bool) -> list[Float32Array]:
        """The picture at all widths, without distortion; those of references are kept."""
        known = self._prepared.get(id(pyramid))
        if known is not None and known[0] is pyramid:
            return known[1]
        finest = pyramid[0]
        for picture in pyramid[1:]:
            finest = picture if picture.shape[1] >= WIDTHS_PX[-1] else finest
        while finest.shape[1] >= 2 * WIDTHS_PX[-1]:
            finest = halved(finest)
        pictures = []
        for level, width in zip(self._levels, WIDTHS_PX, strict=True):
            size = (width, level.seen.shape[0])
            reduced = cv2.resize(finest, size, interpolation=cv2.INTER_AREA).astype(np.float32)
            reduced /= self._shading.over(size)
            straight = cv2.remap(reduced, *level.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            pictures.append(np.asarray(straight, np.float32))
        if keep:
            self._prepared = {id(pyramid): (pyramid, pictures)}
        return pictures


def _correlation_unmoved(level: _Level, one: Float32Array, other: Float32Array) -> float:
    """How well two pictures correlate as they lie."""
    a, b = (_without_shading(picture, level.seen)[level.seen] for picture in (one, other))
    return _difference(a, b)[3]


class Shading:
    """How a lens darkens its picture towards the corners, learnt from pictures of different ground: the
    logarithm of their mean, as an even polynomial of the distance from the middle."""

    def __init__(self, camera: Camera) -> None:
        self._size = (WIDTHS_PX[0], round(camera.height * WIDTHS_PX[0] / camera.width))
        self._total = np.zeros(self._size[::-1])
        self._count = 0

    def learn(self, picture: UInt8Array) -> None:
        """Take one more picture (h, w) into account."""
        reduced = cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA).astype(np.float64)
        logarithm = np.log(np.maximum(reduced, 1.0))
        self._total += logarithm - logarithm.mean()
        self._count += 1

    @property
    def is_known(self) -> bool:
        """Whether the lens can be told from the ground."""
        return self._count >= FEWEST_PICTURES

    def over(self, size: tuple[int, int]) -> Float32Array:
        """(h, w) of a picture of this size (w, h): brightness as a part of that in the middle; 1 as long as
        too few pictures are known."""
        if not self.is_known:
            return np.ones(size[::-1], np.float32)
        square = _from_middle(self._size)
        design = np.stack([np.ones_like(square), square, square**2], axis=-1).reshape(-1, 3)
        _, first, second = np.linalg.lstsq(design, self._total.ravel() / self._count, rcond=1e-9)[0]
        square = _from_middle(size)
        return np.asarray(np.exp(first * square + second * square**2), np.float32)


def _from_middle(size: tuple[int, int]) -> FloatArray:
    """(h, w) squared distances of pixels from the middle of a picture (w, h), 1 in the corners."""
    x, y = (np.linspace(-1.0, 1.0, count) for count in size)
    return np.asarray(0.5 * (x**2 + y[:, None] ** 2))


def ground_plane(points: FloatArray) -> Plane:
    """The plane z = a x + b y + c through most of the points (n, 3), n >= 3."""
    middle = np.median(points, axis=0)
    design = np.column_stack([points[:, :2] - middle[:2], np.ones(len(points))])
    kept, slope = np.ones(len(points), np.bool_), np.array([0.0, 0.0, middle[2]])
    for _ in range(5):
        residual = np.abs(design @ slope - points[:, 2])
        kept = residual <= 3.0 * 1.4826 * max(float(np.median(residual)), 1e-9)
        slope = np.linalg.lstsq(design[kept], points[kept, 2], rcond=1e-6)[0]
    normal = np.array([-slope[0], -slope[1], 1.0])
    length = float(np.linalg.norm(normal))
    return Plane(normal / length, float(slope[2] - slope[:2] @ middle[:2]) / length)


def _level(camera: Camera, width: int) -> _Level:
    scaled = camera.scaled(width, round(camera.height * width / camera.width))
    columns, rows = np.meshgrid(np.arange(scaled.width), np.arange(scaled.height))
    focal = scaled.focal_px
    rays = np.stack([(columns - scaled.cx) / focal, (rows - scaled.cy) / focal], axis=-1)
    directions = np.concatenate([rays, np.ones((*columns.shape, 1))], axis=-1)
    px = scaled.project(directions.reshape(-1, 3)).reshape(*columns.shape, 2)
    size = (scaled.width - 1.0, scaled.height - 1.0)
    seen = np.asarray(np.isfinite(px).all(axis=-1) & ((px >= 0.0) & (px <= size)).all(axis=-1))
    u, v = np.nan_to_num(px, nan=-1.0).astype(np.float32).transpose(2, 0, 1)
    matrix = np.array([[focal, 0.0, scaled.cx], [0.0, focal, scaled.cy], [0.0, 0.0, 1.0]])
    return _Level((np.ascontiguousarray(u), np.ascontiguousarray(v)), matrix, rays.astype(np.float32), seen)


def _fit_level(
    level: _Level,
    reference: Float32Array,
    world_from_reference: Pose,
    current: Float32Array,
    start: Pose,
    ground: Plane,
) -> PictureFit | None:
    pose, focal = start, float(level.matrix[0, 0])
    away = abs(ground.offset - float(ground.normal @ start.translation))
    up = start.rotation.T @ ground.normal
    believed = np.diag([START_SHARE**-2.0] * 3 + [START_RAD**-2.0] * 3)
    believed[:3, :3] += (START_HEIGHT_SHARE**-2.0 - START_SHARE**-2.0) * np.outer(up, up)
    believed[:3, :3] /= away**2
    information, correlation, contrast = np.eye(6), -1.0, 1.0
    for _ in range(ITERATIONS):
        seen = _looks(level, reference, world_from_reference, pose, ground)
        if seen is None:
            return None
        warped, inside, depth = seen
        warped = _without_shading(warped, inside)
        gradient, steepness = _gradient(level, warped, inside, depth)
        here = _without_shading(current, inside)[inside]
        contrast, residual, sigma, correlation = _difference(here, warped[inside])
        expected = np.hypot(sigma, contrast * MISPLACED_PX * steepness)
        weight = np.minimum(1.0, CLIP_SIGMAS * expected / np.maximum(np.abs(residual), 1e-6))
        weight = weight * (sigma / expected) ** 2
        weighted = gradient * weight[:, None]
        information = contrast**2 * (weighted.T @ gradient) / (sigma**2 * TOGETHER) + believed
        slope = contrast * (weighted.T @ residual) / (sigma**2 * TOGETHER)
        slope += believed @ (pose.inverse() @ start).log()
        try:
            step = np.asarray(np.linalg.solve(information, slope), np.float64)
        except np.linalg.LinAlgError:
            return None
        pose = pose @ Pose.exp(step)
        moved = np.linalg.norm(step[:3]) / float(np.median(depth)) + np.linalg.norm(step[3:])
        if moved * focal < CONVERGED_PX:
            break
    return PictureFit(pose, np.asarray(np.linalg.inv(information), np.float64), correlation)


def _looks(
    level: _Level, reference: Float32Array, world_from_reference: Pose, pose: Pose, ground: Plane
) -> tuple[Float32Array, BoolArray, FloatArray] | None:
    """The reference picture as it should look from the pose, where it shows something, and the depth of the
    ground there (n,); None where both hardly overlap."""
    reference_from_cam = world_from_reference.inverse() @ pose
    normal = pose.rotation.T @ ground.normal
    distance = ground.offset - float(ground.normal @ pose.translation)
    if abs(distance) < 1e-9:
        return None
    bend = np.outer(reference_from_cam.translation, normal) / distance
    homography = level.matrix @ (reference_from_cam.rotation + bend) @ np.linalg.inv(level.matrix)
    size = level.seen.shape[::-1]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(reference, homography, size, flags=flags)
    shown = cv2.warpPerspective(level.seen.astype(np.uint8), homography, size, flags=flags)
    both = (np.asarray(shown, np.bool_) & level.seen).astype(np.uint8)
    inside = np.asarray(cv2.erode(both, np.ones((3, 3), np.uint8), borderValue=0), np.bool_)
    slant = level.rays @ normal[:2].astype(np.float32) + np.float32(normal[2])
    inside &= slant * distance > 1e-6
    if inside.sum() < LEAST_OVERLAP * inside.size:
        return None
    return np.asarray(warped, np.float32), inside, np.asarray(distance / slant[inside], np.float64)


def _gradient(
    level: _Level, warped: Float32Array, inside: BoolArray, depth: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(n, 6) by how much the picture gets brighter at a pixel for a motion (translation, rotation) of the
    camera: minus its slope times the motion of the ground there, less the mean, since brightness is a free
    parameter. And how steep it is (n,), per pixel."""
    focal = float(level.matrix[0, 0])
    gx = 0.5 * focal * (np.roll(warped, -1, 1) - np.roll(warped, 1, 1))[inside]
    gy = 0.5 * focal * (np.roll(warped, -1, 0) - np.roll(warped, 1, 0))[inside]
    u, v = level.rays[inside].T
    along = gx * u + gy * v
    by_turn = [-along * v - gy, along * u + gx, gy * u - gx * v]
    gradient = np.column_stack([gx / depth, gy / depth, -along / depth, *by_turn]).astype(np.float64)
    return gradient - gradient.mean(axis=0), np.hypot(gx, gy) / focal


def _without_shading(picture: Float32Array, inside: BoolArray) -> Float32Array:
    """The picture less its mean about each pixel, of the part that counts: the same part of both pictures,
    so that what only one of them shows makes no difference."""
    counts = inside.astype(np.float32)
    wide = (0, 0), SHADING_SHARE * picture.shape[1]
    mean = cv2.GaussianBlur(picture * counts, *wide) / (cv2.GaussianBlur(counts, *wide) + 1e-6)
    return np.asarray(picture - mean, np.float32)


def _difference(here: Float32Array, there: Float32Array) -> tuple[float, FloatArray, float, float]:
    """Contrast of the current picture against the other, residuals with both taken out, their robust
    deviation, and the correlation."""
    a, b = here - here.mean(), there - there.mean()
    correlation = float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-9))
    contrast = float(np.sqrt((a * a).sum() / ((b * b).sum() + 1e-9)))
    residual = a - contrast * b
    sigma = 1.4826 * float(np.median(np.abs(residual))) + 1e-3
    return contrast, residual, sigma, correlation
