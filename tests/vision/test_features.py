"""What every extractor must do, on pictures with exactly known truth."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from overfly.errors import ConfigError, UsageError
from overfly.vision.features import EXTRACTOR_NAMES, Metric, create_extractor
from overfly.vision.matching import match_mutual

FIELDS = ("px", "descriptors", "size_px", "angle_rad", "response")
TURNING = [name for name in EXTRACTOR_NAMES if not name.endswith("-upright")]


def ground(height=240, width=320, seed=0):
    """Random ground with structure at all scales, as natural pictures have: amplitude falls with
    frequency."""
    rng = np.random.default_rng(seed)
    picture = np.zeros((height, width))
    for sigma in (1.0, 2.0, 4.0, 8.0):
        layer = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), sigma)
        picture += layer / layer.std()
    return np.clip(128 + 25 * picture, 0, 255)


def to_uint8(picture):
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def similarity(shape, degrees, scale):
    """(3, 3) turn and scaling about the image centre."""
    height, width = shape
    c, s = scale * math.cos(math.radians(degrees)), scale * math.sin(math.radians(degrees))
    x, y = (width - 1) / 2, (height - 1) / 2
    return np.array([[c, -s, x - c * x + s * y], [s, c, y - s * x - c * y], [0, 0, 1.0]])


def right_matches(extractor, a, b, b_from_a):
    """(number of matches within 2 px of the truth, their median error in px, part of all matches that is
    right)."""
    one, other = extractor.extract(a), extractor.extract(b)
    index_a, index_b, _ = match_mutual(
        one.descriptors, other.descriptors, extractor.metric, extractor.max_distance
    )
    expected = np.column_stack([one.px[index_a], np.ones(len(index_a))]) @ b_from_a.T
    error = np.linalg.norm(expected[:, :2] - other.px[index_b], axis=1)
    right = error <= 2.0
    return int(right.sum()), float(np.median(error[right])), float(right.mean())


@pytest.mark.parametrize("name", EXTRACTOR_NAMES)
def test_features_have_the_promised_form(name):
    extractor = create_extractor(name, 300)
    features = extractor.extract(to_uint8(ground()))
    assert extractor.name == name
    assert 240 <= len(features) <= 300
    assert features.px.shape == (len(features), 2)
    assert features.px.dtype == features.size_px.dtype == features.response.dtype == np.float32
    assert features.angle_rad.dtype == np.float32
    assert features.descriptors.dtype == (np.uint8 if extractor.metric is Metric.HAMMING else np.float32)
    assert ((features.px >= 0) & (features.px <= [319, 239])).all()
    assert (features.size_px > 0).all()
    assert (features.response > 0).all()
    assert ((features.angle_rad >= -math.pi - 1e-6) & (features.angle_rad <= math.pi + 1e-6)).all()
    assert all(len(getattr(features, field)) == len(features) for field in FIELDS)
    assert all(np.isfinite(getattr(features, field)).all() for field in FIELDS)


@pytest.mark.parametrize("name", EXTRACTOR_NAMES)
@pytest.mark.parametrize("shape", [(240, 320), (1, 1), (7, 9), (40, 33)])
@pytest.mark.parametrize("level", [0, 117, 255])
def test_a_blank_picture_has_no_features(name, shape, level):
    features = create_extractor(name, 100).extract(np.full(shape, level, np.uint8))
    assert len(features) == 0
    full = create_extractor(name, 100).extract(to_uint8(ground()))
    assert features.descriptors.shape[1] == full.descriptors.shape[1]
    assert features.descriptors.dtype == full.descriptors.dtype


@pytest.mark.parametrize("name", EXTRACTOR_NAMES)
@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (24, 24), (61, 47), (120, 160), (375, 501)])
def test_any_size_of_picture_is_taken(name, shape):
    picture = np.random.default_rng(2).integers(0, 256, shape, dtype=np.uint8)
    features = create_extractor(name, 50).extract(picture)
    assert len(features) <= 50
    assert (len(features) > 20) or min(shape) < 100


@pytest.mark.parametrize("name", EXTRACTOR_NAMES)
def test_other_arrays_are_refused(name):
    extractor = create_extractor(name, 10)
    for wrong in (np.zeros((20, 20, 3), np.uint8), np.zeros((20, 20), np.float32)):
        with pytest.raises(ValueError, match="gray image"):
            extractor.extract(wrong)


def test_unknown_names_and_counts_are_refused():
    with pytest.raises(ConfigError, match="hessian-teblid"):
        create_extractor("harris", 100)
    with pytest.raises(ConfigError, match="at least 1"):
        create_extractor("orb", 0)


def test_an_opencv_without_contrib_is_named(monkeypatch):
    monkeypatch.delattr(cv2, "xfeatures2d")
    with pytest.raises(UsageError, match="opencv-contrib-python-headless"):
        create_extractor("hessian-teblid", 100)
    assert create_extractor("surf", 100).name == "surf"


@pytest.mark.parametrize("name", EXTRACTOR_NAMES)
def test_same_picture_same_features_whatever_came_before_and_from_any_thread(name):
    extractor = create_extractor(name, 200)
    pictures = [to_uint8(ground(seed=seed) * (0.2 + 0.2 * seed)) for seed in range(4)]
    alone = [create_extractor(name, 200).extract(picture) for picture in pictures]
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(extractor.extract, [pictures[k % 4] for k in range(16)]))
    for k, features in enumerate(together):
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(features, field), getattr(alone[k % 4], field))


@pytest.mark.parametrize("name", EXTRACTOR_NAMES)
def test_a_view_that_is_not_contiguous_gives_the_same(name):
    wide = to_uint8(ground(240, 640))
    one = create_extractor(name, 100).extract(wide[:, ::2])
    other = create_extractor(name, 100).extract(wide[:, ::2].copy())
    np.testing.assert_array_equal(one.descriptors, other.descriptors)


@pytest.mark.parametrize("name", TURNING)
@pytest.mark.parametrize("degrees", [37, 91, 135, 178, 260])
def test_features_are_found_again_after_a_turn(name, degrees):
    picture = ground(400, 400)
    b_from_a = similarity(picture.shape, degrees, 1.0)
    turned = cv2.warpPerspective(picture, b_from_a, (400, 400), flags=cv2.INTER_CUBIC)
    crop = similarity((400, 400), 0, 1)
    crop[:2, 2] = -80  # so that both views are full
    a, b = to_uint8(picture[80:320, 80:320]), to_uint8(turned[80:320, 80:320])
    count, error, _ = right_matches(create_extractor(name, 300), a, b, crop @ b_from_a @ np.linalg.inv(crop))
    assert count > 60
    assert 0.01 < error < 1.0


@pytest.mark.parametrize("name", TURNING)
@pytest.mark.parametrize("scale", [0.7, 1.5])
def test_features_are_found_again_at_another_scale(name, scale):
    picture = ground(480, 640)
    b_from_a = similarity(picture.shape, 20, scale)
    other = cv2.warpPerspective(
        cv2.GaussianBlur(picture, (0, 0), 0.8), b_from_a, (640, 480), flags=cv2.INTER_CUBIC
    )
    count, error, _ = right_matches(create_extractor(name, 500), to_uint8(picture), to_uint8(other), b_from_a)
    assert count > 40
    assert 0.02 < error < 1.2


@pytest.mark.parametrize("name", EXTRACTOR_NAMES)
@pytest.mark.parametrize(("contrast", "level"), [(0.2, 20), (0.25, 200)])
def test_dark_and_hazy_pictures_still_match(name, contrast, level):
    picture = ground()
    faint = to_uint8(level + contrast * (picture - 128))
    extractor = create_extractor(name, 300)
    assert len(extractor.extract(faint)) > 200
    count, error, part = right_matches(extractor, to_uint8(picture), faint, np.eye(3))
    assert count > 100
    assert error < 0.6
    assert part > 0.8


@pytest.mark.parametrize("name", EXTRACTOR_NAMES)
def test_weak_quarters_are_not_left_empty(name):
    picture = ground(seed=3)
    picture[:120, :160] = 128 + 4.0 * (picture[:120, :160] - 128)  # one loud quarter among quiet ones
    picture[120:, 160:] = 128 + 0.4 * (picture[120:, 160:] - 128)
    px = create_extractor(name, 400).extract(to_uint8(picture)).px
    counts = np.histogram2d(px[:, 1], px[:, 0], bins=2, range=((0, 240), (0, 320)))[0]
    assert counts.min() > 0.4 * len(px) / 4
    assert counts.max() < 2.0 * len(px) / 4


@pytest.mark.parametrize("name", EXTRACTOR_NAMES)
def test_a_blurred_picture_keeps_features_that_match(name):
    picture = ground(seed=4)
    kernel = np.full((1, 9), 1 / 9)
    blurred = to_uint8(cv2.filter2D(picture, -1, kernel))
    count, _, _ = right_matches(create_extractor(name, 300), to_uint8(picture), blurred, np.eye(3))
    assert count > 25


@pytest.mark.data
@pytest.mark.parametrize("name", EXTRACTOR_NAMES)
def test_real_pictures_give_features_everywhere(name, data_dir):
    for file in (
        "brighton_beach/images/DJI_0025.JPG",
        "caliterra/images/IMG_9400.jpg",
    ):
        picture = cv2.imread(str(data_dir / "real" / file), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        small = cv2.resize(picture, (320, 240), interpolation=cv2.INTER_AREA)
        px = create_extractor(name, 400).extract(small).px
        counts = np.histogram2d(px[:, 1], px[:, 0], bins=4, range=((0, 240), (0, 320)))[0]
        assert len(px) > 300
        assert (counts >= 3).all()
