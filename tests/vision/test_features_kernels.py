"""The compiled parts of the extractors against known shapes and plain NumPy twins."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.vision.features import hessian, selection, surf, surf_descriptor
from overfly.vision.features.hessian import detect_hessian
from overfly.vision.features.interface import angles_from_degrees, stretch_contrast
from overfly.vision.features.peaks import find_peaks
from overfly.vision.features.selection import select_spread


def blob(centre, sigma, amplitude=120.0, shape=(120, 140), level=40.0):
    """A Gaussian hill of exactly known place and width, as uint8."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    square = (x - centre[0]) ** 2 + (y - centre[1]) ** 2
    return np.rint(level + amplitude * np.exp(-square / (2 * sigma**2))).astype(np.uint8)


@settings(max_examples=25, deadline=None)
@given(
    x=st.floats(50, 90),
    y=st.floats(50, 70),
    sigma=st.floats(2.2, 7.0),
    amplitude=st.sampled_from([120.0, 200.0, -35.0]),
)
def test_hessian_finds_a_blob_where_it_is(x, y, sigma, amplitude):
    found = detect_hessian(blob((x, y), sigma, amplitude), 5)
    best = int(np.argmax(found.response))
    assert np.hypot(*(found.px[best] - [x, y])) < 0.08 * sigma
    # sigma^2 times the determinant's root is b^2 s^2 / (b^2 + s^2)^2 of the amplitude: largest, a quarter, at
    # s = b.
    assert found.sigma_px[best] == pytest.approx(sigma, rel=0.12)
    assert found.response[best] == pytest.approx((amplitude / 4) ** 2, rel=0.3)


@settings(max_examples=20, deadline=None)
@given(x=st.floats(60, 80), y=st.floats(50, 70), sigma=st.floats(3.0, 7.0))
def test_surf_finds_a_blob_where_it_is(x, y, sigma):
    features = surf.Surf(5).extract(blob((x, y), sigma))
    best = int(np.argmax(features.response))
    assert np.hypot(*(features.px[best] - [x, y])) < 0.15
    # Boxes are no Gaussians: the nominal scale of the strongest filter is about three quarters of the blob's.
    assert 0.65 < features.size_px[best] / 2 / sigma < 0.85


def blob_on_slope(degrees, shape=(160, 160)):
    """A hill on ground that rises in the given direction (image x towards y)."""
    y, x = np.mgrid[: shape[0], : shape[1]] - 80.0
    rise = x * math.cos(math.radians(degrees)) + y * math.sin(math.radians(degrees))
    return np.clip(blob((80, 80), 4, 60.0, shape, 0.0) + 80 + 3.0 * np.clip(rise, -20, 20), 0, 255).astype(
        np.uint8
    )


@pytest.mark.parametrize("detector", ["hessian", "surf"])
@pytest.mark.parametrize("degrees", [0, 33, 90, 147, 180, -101])
def test_orientation_turns_with_the_picture(detector, degrees):
    def angle(picture):
        found = detect_hessian(picture, 1) if detector == "hessian" else surf.Surf(1).extract(picture)
        return float(found.angle_rad[0])

    turned = math.degrees(angle(blob_on_slope(degrees)) - angle(blob_on_slope(0)))
    assert abs((turned - degrees + 180) % 360 - 180) < 12


def test_the_centroid_is_on_the_bright_side():
    picture = np.tile(np.linspace(0, 255, 64, dtype=np.float32), (64, 1))
    keypoint = np.array([[32, 32, 2.0, 1.0]], np.float32)
    for turns, wanted in ((0, 0.0), (1, -math.pi / 2), (2, math.pi), (3, math.pi / 2)):
        angle = hessian._centroid_angle(
            np.ascontiguousarray(np.rot90(picture, turns)), keypoint, hessian._DISC
        )
        assert math.cos(float(angle[0]) - wanted) > 0.999


def test_determinant_is_that_of_the_twin():
    level = np.random.default_rng(0).normal(size=(17, 23)).astype(np.float32)
    out = np.zeros_like(level)
    hessian._determinant(level, np.float32(3.0), out)
    rows, columns = np.gradient(level.astype(float))
    xx = level[1:-1, 2:] + level[1:-1, :-2] - 2 * level[1:-1, 1:-1]
    yy = level[2:, 1:-1] + level[:-2, 1:-1] - 2 * level[1:-1, 1:-1]
    xy = np.gradient(columns, axis=0)[1:-1, 1:-1]
    assert rows.shape == level.shape
    np.testing.assert_allclose(out[1:-1, 1:-1], 3.0 * (xx * yy - xy**2), rtol=1e-4, atol=1e-4)
    assert not out[[0, -1]].any()
    assert not out[:, [0, -1]].any()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_peaks_are_those_of_the_twin(seed):
    rng = np.random.default_rng(seed)
    responses = rng.integers(0, 40, (4, 14, 15)).astype(np.float32)  # with ties
    sigmas = np.array([1.0, 1.5, 2.0, 3.0])
    margins = np.array([1, 1, 2, 2])
    found = find_peaks(responses, sigmas, margins, 20.0)
    places = set()
    for m in (1, 2):
        for i in range(margins[m], 14 - margins[m]):
            for j in range(margins[m], 15 - margins[m]):
                v = responses[m, i, j]
                around = responses[m, i - 1 : i + 2, j - 1 : j + 2].ravel()
                is_peak = (v > around[:4]).all() and (v >= around[5:]).all() and v >= 20.0
                if is_peak and v > responses[m - 1, i, j] and v >= responses[m + 1, i, j]:
                    places.add((j, i, m))
    assert len(found) <= len(places)
    for x, y, sigma, response in found:
        near = [
            p
            for p in places
            if abs(p[0] - x) <= 1 and abs(p[1] - y) <= 1 and responses[p[2], p[1], p[0]] == response
        ]
        assert near
        assert any(sigmas[m - 1] - 1e-6 <= sigma <= sigmas[m + 1] + 1e-6 for _, _, m in near)


def test_a_quadratic_peak_is_found_exactly():
    m, i, j = np.mgrid[:4, :11, :12].astype(float)
    truth = (1.3, 5.2, 6.4)
    responses = 100 - 2 * (m - truth[0]) ** 2 - (i - truth[1]) ** 2 - 1.5 * (j - truth[2]) ** 2
    responses += 0.5 * (i - truth[1]) * (j - truth[2])
    found = find_peaks(responses.astype(np.float32), np.arange(1.0, 5.0), np.ones(4, np.int64), 1.0)
    assert len(found) == 1
    np.testing.assert_allclose(found[0, :3], [truth[2], truth[1], 1.0 + truth[0]], atol=1e-4)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 300), count=st.integers(1, 200))
def test_selection_gives_each_cell_its_best_round_by_round(seed, n, count):
    rng = np.random.default_rng(seed)
    px = rng.uniform([0, 0], [319, 239], (n, 2)).astype(np.float32)
    octave = rng.integers(0, 3, n)
    response = rng.uniform(0.5, 1.0, n).astype(np.float32)
    chosen = select_spread(px, octave, response, (240, 320), count, 2)
    assert len(chosen) == min(n, count)  # half the strongest is far above the floor
    assert len(set(chosen.tolist())) == len(chosen)
    if n == 0:
        return
    order = np.argsort(-response, kind="stable")
    side = math.sqrt(240 * 320 * 2.0 * selection.FEATURES_PER_CELL / count)
    taken: dict[tuple[int, int, int], int] = {}
    rounds = np.empty(n, int)
    for k in order:
        cell = side * math.sqrt(2.0) ** int(octave[k])
        columns, rows = max(1, round(320 / cell)), max(1, round(240 / cell))
        key = (int(octave[k]), int(float(px[k, 1]) * rows / 240), int(float(px[k, 0]) * columns / 320))
        rounds[k] = taken.get(key, 0)
        taken[key] = rounds[k] + 1
    assert sorted(rounds[chosen].tolist()) == sorted(rounds.tolist())[: len(chosen)]


def test_selection_drops_what_is_noise_beside_the_rest():
    rng = np.random.default_rng(0)
    px = rng.uniform([0, 0], [319, 239], (200, 2)).astype(np.float32)
    response = np.where(np.arange(200) < 100, 1.0, 0.009).astype(np.float32)
    assert set(select_spread(px, np.zeros(200, int), response, (240, 320), 100, 2)) == set(range(100))
    assert len(select_spread(px, np.zeros(200, int), response, (240, 320), 150, 2)) == 150
    assert len(select_spread(px, np.zeros(200, int), response, (240, 320), 150, 4)) == 150


def box_determinant(gray, side):
    """Convolution with the filters of Bay et al. written out as pictures."""
    lobe, half, middle = side // 3, side // 2, side // 6
    yy = np.zeros((side, side))
    yy[:, half - lobe + 1 : half + lobe] = 1
    yy[half - middle : half + middle + 1, half - lobe + 1 : half + lobe] = -2
    xy = np.zeros((side, side))
    xy[half - lobe : half, half - lobe : half] = xy[
        half + 1 : half + 1 + lobe, half + 1 : half + 1 + lobe
    ] = 1
    xy[half - lobe : half, half + 1 : half + 1 + lobe] = xy[
        half + 1 : half + 1 + lobe, half - lobe : half
    ] = -1
    dxx, dyy, dxy = (cv2.filter2D(gray.astype(float), -1, kernel) / side**2 for kernel in (yy.T, yy, xy))
    return dxx * dyy - (0.9 * dxy) ** 2


@pytest.mark.parametrize("step", [1, 2, 4])
@pytest.mark.parametrize("side", [9, 15, 21, 27, 39])
@pytest.mark.parametrize("shape", [(60, 71), (47, 40)])
def test_box_determinant_is_that_of_the_twin(step, side, shape):
    gray = np.random.default_rng(side).integers(0, 256, shape, dtype=np.uint8)
    response = np.zeros((-(-shape[0] // step), -(-shape[1] // step)), np.float32)
    surf._determinant(surf._planes(cv2.integral(gray), step), *shape, side, response)
    wanted = box_determinant(gray, side)
    half = side // 2
    inside = np.zeros(shape, bool)
    inside[half : shape[0] - half, half : shape[1] - half] = True
    wanted[~inside] = 0.0
    np.testing.assert_allclose(response, wanted[::step, ::step], rtol=1e-3, atol=1e-2)
    assert np.count_nonzero(response) > 0


def test_box_filters_survive_an_integral_image_that_wrapped_round():
    gray = np.random.default_rng(3).integers(0, 256, (50, 60), dtype=np.uint8)
    integral = cv2.integral(gray)
    wrapped = (integral.astype(np.int64) + 2**31 - 2000).astype(np.uint64).astype(np.uint32).view(np.int32)
    assert wrapped.min() < 0 < wrapped.max()
    responses = []
    for each in (integral, wrapped):
        responses.append(np.zeros(gray.shape, np.float32))
        surf._determinant(surf._planes(each, 1), *gray.shape, 15, responses[-1])
    np.testing.assert_array_equal(*responses)
    px, sigma = np.array([[25.3, 24.1], [30.0, 20.0]], np.float32), np.array([2.0, 3.1], np.float32)
    angles = [surf_descriptor.orient(each, px, sigma) for each in (integral, wrapped)]
    np.testing.assert_array_equal(*angles)
    np.testing.assert_array_equal(
        *(surf_descriptor.describe(each, px, sigma, angles[0]) for each in (integral, wrapped))
    )


def test_surf_descriptors_have_length_one_and_tell_bright_from_dark():
    rng = np.random.default_rng(1)
    gray = cv2.GaussianBlur(rng.normal(size=(120, 160)), (0, 0), 3)
    gray = np.rint(128 + 100 * gray / np.abs(gray).max()).astype(np.uint8)
    bright, dark = (
        surf.Surf(100, upright=True).extract(gray),
        surf.Surf(100, upright=True).extract(255 - gray),
    )
    np.testing.assert_allclose(np.linalg.norm(bright.descriptors, axis=1), 1.0, rtol=1e-5)
    # The same places, seen as negatives, are as far from each other as two blobs of unlike sign must be.
    np.testing.assert_allclose(bright.px, dark.px, atol=1e-3)
    apart = np.linalg.norm(bright.descriptors - dark.descriptors, axis=1)
    assert apart.min() > 1.0
    signs = np.sign(bright.descriptors[:, 2::4].sum(axis=1))
    assert {-1.0, 1.0} == set(signs.tolist())
    like = np.linalg.norm(bright.descriptors[:, None] - bright.descriptors[None], axis=2)
    assert like[signs[:, None] != signs[None]].min() > 1.0
    assert like[signs[:, None] == signs[None]].min() < 1.0


def test_surf_gradients_point_the_right_way():
    ramp = np.tile(np.arange(0, 200, 2, dtype=np.uint8), (100, 1))  # brighter along x
    px, sigma = np.array([[50.0, 50.0]], np.float32), np.array([2.0], np.float32)
    assert float(surf_descriptor.orient(cv2.integral(ramp), px, sigma)[0]) == pytest.approx(0.0, abs=0.1)
    upward = np.ascontiguousarray(ramp.T)  # brighter along y
    assert float(surf_descriptor.orient(cv2.integral(upward), px, sigma)[0]) == pytest.approx(
        math.pi / 2, abs=0.1
    )
    parts = surf_descriptor.describe(cv2.integral(ramp), px, sigma, np.zeros(1, np.float32)).reshape(16, 4)
    assert (parts[:, 0] > 0.005).all()
    np.testing.assert_allclose(parts[:, 0], np.abs(parts[:, 2]), rtol=1e-4)
    assert np.abs(parts[:, 1]).max() < 0.02


def test_angles_from_degrees_are_in_one_turn():
    degrees = np.array([0, 90, 180, 270, 359], np.float32)
    angles = angles_from_degrees(degrees)
    np.testing.assert_allclose(np.cos(angles), np.cos(np.deg2rad(degrees)), atol=1e-6)
    np.testing.assert_allclose(np.sin(angles), np.sin(np.deg2rad(degrees)), atol=1e-6)
    assert (np.abs(angles) <= math.pi + 1e-6).all()


def test_stretching_makes_contrast_and_brightness_irrelevant():
    gray = np.clip(np.random.default_rng(0).normal(128, 40, (80, 90)), 0, 255)
    full = stretch_contrast(np.rint(gray).astype(np.uint8))
    faint = stretch_contrast(np.rint(30 + 0.5 * gray).astype(np.uint8))
    assert np.abs(full.astype(int) - faint.astype(int)).mean() < 2.0
    assert full.min() == 0
    assert full.max() == 255
    flat = np.full((20, 20), 77, np.uint8)
    np.testing.assert_array_equal(stretch_contrast(flat), flat)
