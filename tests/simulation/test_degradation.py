"""What the camera does to light is what it was told to do."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np

from overfly.simulation.degradation import CLEAN, ImageQuality, Sensor
from overfly.simulation.radio import RadioLink, receive

GREY = np.full((240, 320, 1), 0.12, dtype=np.float32)


def linear(image: np.ndarray) -> np.ndarray:
    """sRGB codes back to linear light."""
    code = image.astype(float) / 255.0
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def test_a_clean_camera_is_right_to_half_a_code() -> None:
    ramp = np.linspace(0.02, 0.5, 320, dtype=np.float32)[None, :, None].repeat(240, axis=0)
    shot = Sensor(CLEAN, 320, 240, 0).picture(ramp, 0.0, np.random.default_rng(0))
    expected = ramp[..., 0] * shot.gain
    visible = expected < 0.98
    codes = 255.0 * np.where(expected <= 0.0031308, 12.92 * expected, 1.055 * expected ** (1 / 2.4) - 0.055)
    assert np.abs(shot.image - codes)[visible].max() < 0.75
    assert shot.suffix == ".png"


def test_noise_is_shot_and_read_noise() -> None:
    quality = dataclasses.replace(CLEAN, full_well_e=4000.0, read_noise_e=30.0, brightness=0.3)
    shot = Sensor(quality, 320, 240, 0).picture(GREY, 0.0, np.random.default_rng(0))
    light = linear(shot.image)
    level = light.mean()
    expected = math.sqrt(level / 4000.0 + (30.0 / 4000.0) ** 2)
    assert math.isclose(light.std(), expected, rel_tol=0.06)


def test_development_equals_its_twin() -> None:
    generator = np.random.default_rng(5)
    radiance = generator.uniform(0.0, 0.6, (60, 80, 3)).astype(np.float32)
    quality = dataclasses.replace(CLEAN, full_well_e=5000.0, read_noise_e=20.0, vignetting=0.3)
    shot = Sensor(quality, 80, 60, 0).picture(radiance, 0.1, np.random.default_rng(7))
    y, x = np.mgrid[0:60, 0:80]
    shading = 1.0 - 0.3 * ((x - 39.5) ** 2 + (y - 29.5) ** 2) / (0.25 * (80**2 + 60**2))
    light = radiance * shading[..., None] * shot.gain
    sigma = np.sqrt(light / 5000.0 + (20.0 / 5000.0) ** 2)
    light += sigma * np.random.default_rng(7).standard_normal(light.shape, dtype=np.float32)
    light = np.clip(light, 0.0, 1.0)
    codes = 255.0 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    assert np.abs(shot.image - codes).max() < 1.2  # rounded, and light is taken in 4096 steps
    assert np.abs(shot.image - codes).mean() < 0.3


def test_auto_exposure_evens_out_and_drift_shows() -> None:
    sensor = Sensor(dataclasses.replace(CLEAN, auto_exposure=1.0), 320, 240, 0)
    dark, bright = (sensor.picture(GREY * k, 0.0, np.random.default_rng(0)).image.mean() for k in (0.3, 3.0))
    assert abs(dark - bright) < 2.0
    brighter = sensor.picture(GREY, 0.3, np.random.default_rng(0)).image.mean()
    assert brighter > bright + 10.0
    fixed = Sensor(dataclasses.replace(CLEAN, auto_exposure=0.0), 320, 240, 0)
    dark, bright = (fixed.picture(GREY * k, 0.0, np.random.default_rng(0)) for k in (0.3, 3.0))
    assert dark.gain == bright.gain
    assert bright.image.mean() > 2.0 * dark.image.mean()


def test_vignetting_takes_its_share_from_the_corners() -> None:
    quality = dataclasses.replace(CLEAN, vignetting=0.4)
    light = linear(Sensor(quality, 320, 240, 0).picture(GREY, 0.0, np.random.default_rng(0)).image)
    assert math.isclose(light[0, 0] / light[120, 160], 0.6, abs_tol=0.02)


def test_dirt_stays_on_the_lens() -> None:
    sensor = Sensor(dataclasses.replace(CLEAN, dirt=0.5), 320, 240, 3)
    one, two = (sensor.picture(GREY, 0.0, np.random.default_rng(k)).image for k in (0, 1))
    assert np.array_equal(one, two)
    assert int(one.max()) - int(one.min()) > 15


def test_jpeg_frames_are_what_the_file_says() -> None:
    quality = ImageQuality(jpeg_quality=70)
    color = np.random.default_rng(1).uniform(0.05, 0.3, (60, 80, 3)).astype(np.float32)
    shot = Sensor(quality, 80, 60, 0).picture(color, 0.0, np.random.default_rng(0))
    read = cv2.imdecode(np.frombuffer(shot.encoded, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.array_equal(shot.image, read)
    assert shot.suffix == ".jpg"


def test_colours_keep_their_order() -> None:
    red = np.broadcast_to(np.array([0.3, 0.1, 0.02], dtype=np.float32), (30, 40, 3)).copy()
    for quality in (CLEAN, ImageQuality()):
        image = Sensor(quality, 40, 30, 0).picture(red, 0.0, np.random.default_rng(0)).image.mean(axis=(0, 1))
        assert image[0] > image[1] > image[2]


def test_black_frames_hold_read_noise_only() -> None:
    shot = Sensor(ImageQuality(read_noise_e=20.0), 320, 240, 0).black(1, np.random.default_rng(0))
    assert shot.image.shape == (240, 320)
    assert shot.image.max() < 30


def test_radio_snow_tears_and_echo() -> None:
    generator = np.random.default_rng(2)
    stripe = np.full((120, 160, 1), 60, dtype=np.uint8)
    stripe[:, 80:84] = 220
    clean = receive(stripe, RadioLink(0.0, 0.0, 0.0, 7, 0.0), generator)
    assert np.abs(clean.astype(int) - cv2.GaussianBlur(stripe, (5, 1), 0.8)[..., None].astype(int)).max() <= 1
    ghosted = receive(stripe, RadioLink(0.0, 0.0, 0.3, 20, 0.0), generator)
    assert ghosted[:, 102].mean() > ghosted[:, 115].mean() + 20
    snowy = receive(stripe, RadioLink(8.0, 0.0, 0.0, 7, 0.0), generator)
    assert 3.0 < snowy[:, :60].std() < 9.0
    burst = receive(stripe, RadioLink(2.0, 0.0, 0.0, 7, 1.0), generator)
    rows = burst[:, :60, 0].astype(float).std(axis=1)
    assert rows.max() > 3.0 * np.median(rows)
