"""Patches are found again to a small part of a pixel, or not at all."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from overfly.geometry.poses import FloatArray
from overfly.types import BoolArray, UInt8Array
from overfly.vision.alignment import (
    HALF_PX,
    LARGEST_SHIFT_PX,
    MOST_REFERENCES,
    NOISELESS_SIGMA_PX,
    PATCH_NOISE,
    Pyramid,
    align_patches,
    build_pyramid,
)

from .scenes import sampled, smooth_texture

MIDDLE = np.array([159.5, 119.5])


def grid() -> FloatArray:
    """Places (n, 2) well inside a picture of 320 x 240."""
    u, v = np.meshgrid(np.linspace(60, 260, 9), np.linspace(50, 190, 7))
    return np.column_stack([u.ravel(), v.ravel()]) + 0.37


def warped(image: UInt8Array, reference_from_current: FloatArray, shift: FloatArray) -> UInt8Array:
    """The picture in which pixel x shows what ``image`` shows at A (x - middle) + middle + shift."""
    columns, rows = np.meshgrid(np.arange(320.0), np.arange(240.0))
    there = np.stack([columns, rows], axis=-1) - MIDDLE
    there = there @ reference_from_current.T + MIDDLE + shift
    return sampled(image, there[..., 0], there[..., 1])


def turned(angle_rad: float, scale: float) -> FloatArray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return scale * np.array([[c, -s], [s, c]])


def aligned(
    reference: Pyramid, current: Pyramid, reference_px: FloatArray, warp: FloatArray, start_px: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """With a single reference."""
    first = np.zeros(len(reference_px), np.int64)
    found = align_patches([reference], first, current, reference_px, warp, start_px)
    return found.px, found.found


def errors_px(
    reference: UInt8Array, current: UInt8Array, warp: FloatArray, shift: FloatArray, off: FloatArray
) -> FloatArray:
    """(n,) distances of found patches from the truth, NaN where not found; starts are ``off`` the truth."""
    reference_px = grid()
    truth = (reference_px - MIDDLE - shift) @ np.linalg.inv(warp).T + MIDDLE
    inside = ((truth > 20) & (truth < np.array([300, 220]))).all(axis=1)
    assert inside.sum() > 20
    reference_px, truth = reference_px[inside], truth[inside]
    px, found = aligned(
        build_pyramid(reference),
        build_pyramid(current),
        reference_px,
        np.broadcast_to(warp, (len(truth), 2, 2)).copy(),
        truth + off,
    )
    return np.where(found, np.linalg.norm(px - truth, axis=1), np.nan)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.25, -0.4), (3.5, 2.2), (-7.3, 5.6)])
@pytest.mark.parametrize(
    "warp",
    [np.eye(2), turned(0.6, 1.0), turned(-2.5, 1.15), turned(0.2, 0.8), np.array([[1.1, 0.1], [-0.05, 0.9]])],
    ids=["shift", "turned", "turned larger", "turned smaller", "sheared"],
)
def test_warped_patches_are_found_to_a_twentieth_of_a_pixel(
    shift: tuple[float, float], warp: FloatArray
) -> None:
    image = smooth_texture(1)
    current = warped(image, warp, np.array(shift))
    errors = errors_px(image, current, warp, np.array(shift), np.array([1.3, -0.9]))
    assert np.isfinite(errors).mean() > 0.95
    assert np.nanmedian(errors) < 0.02
    assert np.nanpercentile(errors, 95) < 0.05


def test_a_wrong_shift_would_be_noticed() -> None:
    """The measure itself can fail: a tenth of a pixel of untold shift shows."""
    image = smooth_texture(1)
    current = warped(image, np.eye(2), np.array([0.1, 0.0]))
    errors = errors_px(image, current, np.eye(2), np.zeros(2), np.zeros(2))
    assert 0.08 < np.nanmedian(errors) < 0.12


@pytest.mark.parametrize(("gain", "brightness"), [(0.6, 30.0), (1.3, -20.0), (0.3, 90.0)])
def test_brightness_and_contrast_do_not_matter(gain: float, brightness: float) -> None:
    image = smooth_texture(2)
    moved = warped(image, np.eye(2), np.array([0.4, 0.3])).astype(np.float64)
    lit = np.clip(np.rint(moved * gain + brightness), 0, 255).astype(np.uint8)
    errors = errors_px(image, lit, np.eye(2), np.array([0.4, 0.3]), np.array([1.0, 1.0]))
    assert np.isfinite(errors).mean() > 0.9
    assert np.nanmedian(errors) < 0.05


def test_a_picture_twice_as_near_is_read_from_a_coarser_level() -> None:
    """The reference saw the ground at twice the scale; without its halved picture fine texture aliases."""
    image = smooth_texture(3, sigma_px=1.2)
    warp = turned(0.1, 2.0)
    # a pixel of the current picture averages four of the reference
    soft = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.9), np.uint8)
    current = warped(soft, warp, np.zeros(2))
    errors = errors_px(image, current, warp, np.zeros(2), np.array([0.6, -0.4]))
    assert np.isfinite(errors).mean() > 0.8
    assert np.nanmedian(errors) < 0.1


def test_flat_patches_and_edges_are_refused() -> None:
    flat = np.full((240, 320), 90, np.uint8)
    edge = flat.copy()
    edge[:, 160:] = 160
    edge = np.asarray(cv2.GaussianBlur(edge, (0, 0), 1.5), np.uint8)
    place = np.array([[160.0, 120.0]])
    eye = np.eye(2)[None]
    for image in (flat, edge):
        _, found = aligned(build_pyramid(image), build_pyramid(image), place, eye, place.copy())
        assert not found.any()
    corner = smooth_texture(4)
    _, found = aligned(build_pyramid(corner), build_pyramid(corner), place, eye, place.copy())
    assert found.all()


def test_another_ground_is_not_taken_for_this_one() -> None:
    errors = errors_px(smooth_texture(5), smooth_texture(6), np.eye(2), np.zeros(2), np.zeros(2))
    assert np.isfinite(errors).mean() < 0.1


def test_patches_at_the_border_or_without_a_place_are_refused() -> None:
    pyramid = build_pyramid(smooth_texture(7))
    places = np.array([[1.0, 120.0], [160.0, 238.0], [np.nan, 50.0], [160.0, 120.0], [160.0, 120.0]])
    warps = np.broadcast_to(np.eye(2), (5, 2, 2)).copy()
    warps[3] = np.nan
    _, found = aligned(pyramid, pyramid, np.nan_to_num(places, nan=50.0), warps, places)
    assert not found[:4].any()
    assert found[4]


def test_starts_too_far_away_are_not_followed() -> None:
    """At the coarsest of two levels a patch may shift by twice its largest step, and no further."""
    image = smooth_texture(8)
    reach = 2.0 * LARGEST_SHIFT_PX + LARGEST_SHIFT_PX
    errors = errors_px(image, image, np.eye(2), np.zeros(2), np.array([reach + 8.0, 0.0]))
    assert not (errors < 1.0).any()


def test_pyramid_halves_with_even_pixels_in_place() -> None:
    """A spot at (2x, 2y) is at (x, y) one level up: alignment counts on it."""
    image = np.zeros((64, 64), np.uint8)
    image[30:33, 42:45] = 255  # centred at (43, 31)
    levels = build_pyramid(image, 2)
    weight = levels[1].astype(float)
    rows, columns = np.mgrid[:32, :32]
    assert (weight * columns).sum() / weight.sum() == pytest.approx(21.5, abs=0.02)
    assert (weight * rows).sum() / weight.sum() == pytest.approx(15.5, abs=0.02)
    assert [level.shape for level in build_pyramid(image)] == [(64, 64), (32, 32), (16, 16)]


def test_no_patches() -> None:
    pyramid = build_pyramid(smooth_texture(1))
    px, found = aligned(pyramid, pyramid, np.empty((0, 2)), np.empty((0, 2, 2)), np.empty((0, 2)))
    assert px.shape == (0, 2) and found.shape == (0,)
    assert HALF_PX > 0


def test_each_patch_is_sought_as_its_own_reference_shows_it() -> None:
    """References shifted differently: every patch lies where the shift of its own says, not of another."""
    shifts = np.random.default_rng(5).uniform(-3, 3, (MOST_REFERENCES, 2))
    references = [build_pyramid(warped(smooth_texture(3), np.eye(2), shift)) for shift in shifts]
    current = build_pyramid(smooth_texture(3))
    places = grid()
    which = np.arange(len(places)) % MOST_REFERENCES
    eye = np.broadcast_to(np.eye(2), (len(places), 2, 2)).copy()
    aligned = align_patches(references, which, current, places, eye, places)
    errors = np.linalg.norm(aligned.px - (places + shifts[which]), axis=1)[aligned.found]
    assert aligned.found.mean() > 0.5
    assert 1e-6 < np.median(errors) < 0.05


def test_deviations_tell_what_noise_does() -> None:
    """White noise in the second picture alone, and whole pixels, since interpolation makes noise look
    smaller: errors are what the fit says, of strong and of weak patches.
    """
    image = smooth_texture(9)
    generator = np.random.default_rng(11)
    places = np.rint(grid())
    eye = np.broadcast_to(np.eye(2), (len(places), 2, 2)).copy()
    errors, sigmas = [], []
    for _ in range(40):
        noisy = np.clip(np.rint(image + generator.normal(0.0, 6.0, image.shape)), 0, 255).astype(np.uint8)
        first = np.zeros(len(places), np.int64)
        found = align_patches(
            [build_pyramid(image)], first, build_pyramid(noisy), places, eye, places.copy(), coarsest=0
        )
        errors.append(np.where(found.found[:, None], found.px - places, np.nan))
        sigmas.append(np.where(found.found, found.sigma_px, np.nan))
    often = np.isfinite(sigmas).mean(axis=0) > 0.9
    seen = np.sqrt(np.nanmean(np.square(errors), axis=(0, 2)))[often]
    said = np.sqrt(np.nanmedian(sigmas, axis=0)[often] ** 2 - NOISELESS_SIGMA_PX**2) / PATCH_NOISE
    assert often.sum() > 30
    assert said.max() > 1.5 * said.min()
    assert 0.75 < np.median(seen / said) < 1.33
    assert np.corrcoef(np.log(seen), np.log(said))[0, 1] > 0.8


def test_noise_is_averaged_over_more_ground() -> None:
    """Fine texture drowned in noise, broad texture left: the coarser level finds it more exactly and says so;
    in a clear picture the finer one does."""
    fine, broad = smooth_texture(12, sigma_px=1.5).astype(np.float64), smooth_texture(13, sigma_px=6.0)
    places = grid()
    eye = np.broadcast_to(np.eye(2), (len(places), 2, 2)).copy()
    generator = np.random.default_rng(3)

    def coarser(texture: FloatArray, noise: float) -> tuple[float, FloatArray]:
        first, second = (
            np.clip(np.rint(texture + generator.normal(0.0, noise, texture.shape)), 0, 255).astype(np.uint8)
            for _ in range(2)
        )
        which = np.zeros(len(places), np.int64)
        pyramids = build_pyramid(first), build_pyramid(second)
        by_both = align_patches([pyramids[0]], which, pyramids[1], places, eye, places.copy())
        by_fine = align_patches([pyramids[0]], which, pyramids[1], places, eye, places.copy(), coarsest=0)
        lengths = [np.linalg.norm((one.px - places)[one.found], axis=1) for one in (by_fine, by_both)]
        is_coarse = by_both.spread_px2[by_both.found] > 2.0 * by_fine.spread_px2.min()
        return float(is_coarse.mean()), np.array([np.median(length) for length in lengths])

    share, errors = coarser(128.0 + 0.5 * (broad.astype(np.float64) - 128.0), 8.0)
    assert share > 0.6
    assert errors[1] < 0.7 * errors[0]
    share, _ = coarser(fine, 0.5)
    assert share < 0.1
