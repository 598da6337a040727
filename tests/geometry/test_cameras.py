"""Camera models: against OpenCV, against differences, there and back."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.errors import CalibrationError
from overfly.geometry.cameras import Camera, Distortion, _bend
from overfly.geometry.poses import FloatArray

MILD = Camera(320, 240, 288.0, 290.0, 161.4, 116.6, coefficients=(-0.12, 0.05, 0.0006, -0.0004))
# As strong as a cheap wide lens: the corner is drawn in by a fifth of its distance.
BARREL = Camera(320, 240, 314.0, 314.0, 159.5, 119.5, coefficients=(-0.33, 0.11, 0.0, 0.0))
FIVE = Camera(640, 480, 500.0, 505.0, 330.0, 235.0, coefficients=(-0.30, 0.12, 1e-3, -2e-3, -0.02))
FISHEYE = Camera(320, 240, 150.0, 151.0, 158.0, 121.0, Distortion.EQUIDISTANT, (0.02, -0.01, 0.003, 0.001))
PINHOLE = Camera(320, 240, 300.0, 310.0, 160.0, 118.0)
CAMERAS = pytest.mark.parametrize(
    "camera", [MILD, BARREL, FIVE, FISHEYE, PINHOLE], ids=["mild", "barrel", "k3", "fisheye", "pinhole"]
)


def whole_picture(camera: Camera) -> FloatArray:
    """Pixels (n, 2) over all of the picture, corners included."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 23), np.linspace(0, camera.height - 1, 17))
    return np.column_stack([u.ravel(), v.ravel()])


@CAMERAS
def test_pixels_become_rays_and_pixels_again(camera: Camera) -> None:
    px = whole_picture(camera)
    rays = camera.rays_from_pixels(px)
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(camera.pixels_from_rays(rays), px, rtol=0, atol=1e-6)
    depth = np.linspace(0.2, 80.0, len(rays))
    points = np.column_stack([rays, np.ones(len(rays))]) * depth[:, None]
    np.testing.assert_allclose(camera.project(points), px, rtol=0, atol=1e-6)


@CAMERAS
def test_projection_agrees_with_opencv(camera: Camera) -> None:
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (60, 2)), np.ones(60)]) * rng.uniform(0.5, 20, (60, 1))
    zero = np.zeros(3)
    coefficients = np.array(camera.coefficients)
    if camera.distortion is Distortion.EQUIDISTANT:
        expected, _ = cv2.fisheye.projectPoints(points[None], zero, zero, camera.matrix(), coefficients)
        expected = expected[0]
    else:
        expected, _ = cv2.projectPoints(points, zero, zero, camera.matrix(), coefficients)
        expected = expected[:, 0]
    np.testing.assert_allclose(camera.project(points), expected, rtol=0, atol=1e-8)


@CAMERAS
@given(x=st.floats(-0.6, 0.6), y=st.floats(-0.5, 0.5))
def test_jacobian_of_the_distortion(camera: Camera, x: float, y: float) -> None:
    coefficients = np.zeros(5)
    coefficients[: len(camera.coefficients)] = camera.coefficients
    equidistant = camera.distortion is Distortion.EQUIDISTANT
    step = 1e-6
    _, _, ux, uy, vx, vy = _bend(x, y, coefficients, equidistant)
    right, left = _bend(x + step, y, coefficients, equidistant), _bend(x - step, y, coefficients, equidistant)
    down, up = _bend(x, y + step, coefficients, equidistant), _bend(x, y - step, coefficients, equidistant)
    numeric = [(a - b) / (2 * step) for a, b in ((right[0], left[0]), (down[0], up[0]))]
    numeric += [(a - b) / (2 * step) for a, b in ((right[1], left[1]), (down[1], up[1]))]
    np.testing.assert_allclose([ux, uy, vx, vy], numeric, rtol=0, atol=1e-7)


def test_fisheye_sees_more_than_a_right_angle() -> None:
    edge = math.radians(70)
    px = FISHEYE.project(np.array([[math.sin(edge), 0.0, math.cos(edge)]]))
    ray = FISHEYE.rays_from_pixels(px)[0]
    assert math.atan(ray[0]) == pytest.approx(edge, abs=1e-9)
    assert ray[1] == pytest.approx(0.0, abs=1e-9)


def test_centre_of_the_picture_is_the_optical_axis() -> None:
    for camera in (MILD, BARREL, FISHEYE):
        np.testing.assert_allclose(camera.project(np.array([[0.0, 0.0, 2.0]])), [[camera.cx, camera.cy]])
        np.testing.assert_allclose(
            camera.rays_from_pixels(np.array([[camera.cx, camera.cy]])), [[0, 0]], atol=1e-12
        )


def test_points_beside_or_behind_are_not_seen() -> None:
    points = np.array([[0.1, 0.1, -1.0], [1.0, 0.0, 0.0], [0.1, 0.1, 1.0]])
    px = MILD.project(points)
    assert np.isnan(px[:2]).all()
    assert np.isfinite(px[2]).all()


def test_pixels_beyond_the_fold_of_the_model_have_no_ray() -> None:
    """r (1 - 0.33 r^2) never exceeds 0.67: no ray ends beyond 210 pixels from the centre."""
    folded = Camera(320, 240, 314.0, 314.0, 159.5, 119.5, coefficients=(-0.33, 0.0, 0.0, 0.0))
    furthest = 314.0 * (2.0 / 3.0) / math.sqrt(3 * 0.33)
    rays = folded.rays_from_pixels(
        np.array([[159.5 + 0.99 * furthest, 119.5], [159.5 + 1.05 * furthest, 119.5]])
    )
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


@CAMERAS
def test_a_resized_picture_shows_the_same_place_under_the_same_ray(camera: Camera) -> None:
    """The centre of a 2x2 block of pixels is the centre of the pixel that it becomes."""
    half = camera.scaled(camera.width // 2, camera.height // 2)
    assert (half.width, half.height) == (camera.width // 2, camera.height // 2)
    block = np.array([[0.5, 0.5], [100.5, 50.5], [camera.width - 1.5, camera.height - 1.5]])
    np.testing.assert_allclose(
        half.rays_from_pixels((block - 0.5) / 2), camera.rays_from_pixels(block), rtol=0, atol=1e-9
    )
    assert half.coefficients == camera.coefficients


def test_uneven_resizing_scales_each_axis_by_itself() -> None:
    squeezed = MILD.scaled(160, 240)
    assert squeezed.fx == pytest.approx(144.0)
    assert squeezed.fy == pytest.approx(290.0)
    assert squeezed.cx == pytest.approx((161.4 + 0.5) / 2 - 0.5)
    assert squeezed.cy == pytest.approx(116.6)


def test_focal_length_is_the_geometric_mean() -> None:
    assert Camera(10, 10, 4.0, 9.0, 5, 5).focal_px == pytest.approx(6.0)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"fx": 0.0}, "positive"),
        ({"fy": -1.0}, "positive"),
        ({"width": 0}, "positive"),
        ({"fx": math.nan}, "finite"),
        ({"coefficients": (math.inf, 0.0, 0.0, 0.0)}, "finite"),
        ({"cx": 700.0}, "centre"),
        ({"cy": -300.0}, "centre"),
        ({"coefficients": (0.1, 0.2)}, "coefficients"),
        ({"coefficients": (0.1,) * 8}, "coefficients"),
    ],
)
def test_calibrations_that_cannot_be_true_are_refused(changes: dict[str, object], word: str) -> None:
    good: dict[str, object] = {
        "width": 320,
        "height": 240,
        "fx": 300.0,
        "fy": 300.0,
        "cx": 160.0,
        "cy": 120.0,
    }
    with pytest.raises(CalibrationError, match=word):
        Camera(**(good | changes))  # type: ignore[arg-type]


def test_no_points_give_no_pixels() -> None:
    assert MILD.project(np.empty((0, 3))).shape == (0, 2)
    assert MILD.rays_from_pixels(np.empty((0, 2))).shape == (0, 2)
