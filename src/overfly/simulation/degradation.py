"""What a cheap camera does to light: vignetting, dirt, exposure, noise, gamma, compression. Linear radiance
in, codes out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from overfly.errors import OverflyError
from overfly.simulation.radio import RadioLink, receive
from overfly.types import Float32Array, UInt8Array

_GAMMA_STEPS = 4096


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """How bad the pictures are.

    vignetting: share of light lost in the corners. gain_drift: RMS of the slow change of exposure (log).
    brightness: mean level aimed at, linear share of full scale. auto_exposure: share of brightness changes
    that the camera compensates. full_well_e, read_noise_e: electrons, for shot and read noise. dirt: share of
    light that the dirtiest specks on the lens take. jpeg_quality: None stores the picture as it is. radio: an
    analogue video link.
    """

    vignetting: float = 0.25
    gain_drift: float = 0.06
    brightness: float = 0.17
    auto_exposure: float = 0.75
    full_well_e: float = 9000.0
    read_noise_e: float = 12.0
    dirt: float = 0.0
    jpeg_quality: int | None = 90
    radio: RadioLink | None = None


CLEAN = ImageQuality(vignetting=0.0, gain_drift=0.0, full_well_e=1e9, read_noise_e=0.0, jpeg_quality=None)


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One picture as the camera hands it over: image (h, w) or (h, w, 3) RGB; encoded: the file's bytes and
    its suffix.
    """

    image: UInt8Array
    encoded: bytes
    suffix: str
    gain: float


class Sensor:
    """Turns linear radiance into pictures, with the fixed pattern (vignetting, dirt) of one camera."""

    def __init__(self, quality: ImageQuality, width: int, height: int, seed: int) -> None:
        self.quality = quality
        self._shading = _vignetting(quality, width, height)
        if quality.dirt:
            self._shading = self._shading * _dirt(quality.dirt, width, height, seed)

    def picture(
        self, radiance: Float32Array, log_gain: float, generator: np.random.Generator, *, store: bool = True
    ) -> Shot:
        """radiance (h, w, 1 or 3) -> picture. log_gain: drift of the exposure. store: encode for the disk,
        too.
        """
        quality = self.quality
        mean = max(float(radiance.mean()), 1e-4)
        usual = 0.12  # mean reflectance of ground at large
        gain = quality.brightness / (mean**quality.auto_exposure * usual ** (1.0 - quality.auto_exposure))
        gain *= math.exp(log_gain)
        image = _developed(radiance, self._shading, np.float32(gain), quality, generator)
        if quality.radio is not None:
            image = receive(image, quality.radio, generator)
        if image.shape[2] == 1:
            image = image[..., 0]
        return _encode(image, quality.jpeg_quality, gain, store)

    def black(self, channels: int, generator: np.random.Generator) -> Shot:
        """A picture taken with the lens covered: noise of the read-out only."""
        empty = np.zeros((*self._shading.shape, channels), dtype=np.float32)
        image = _developed(empty, self._shading, np.float32(1.0), self.quality, generator)
        return _encode(image[..., 0] if channels == 1 else image, self.quality.jpeg_quality, 1.0, True)


def _gamma_table() -> UInt8Array:
    """sRGB transfer curve (IEC 61966-2-1) from linear steps to 8-bit codes."""
    linear = np.arange(_GAMMA_STEPS) / (_GAMMA_STEPS - 1)
    codes = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255.0 * codes).astype(np.uint8)


_GAMMA = _gamma_table()


def _developed(
    radiance: Float32Array,
    shading: Float32Array,
    gain: np.float32,
    quality: ImageQuality,
    generator: np.random.Generator,
) -> UInt8Array:
    """Codes (h, w, channels) of radiance: shaded by (h, w), amplified, with shot noise (Gaussian
    approximation of Poisson) and read noise."""
    codes = np.empty(radiance.shape, np.uint8)
    noisy = quality.full_well_e < 1e9
    size = radiance.shape if noisy else (0, 0, 0)
    normal = generator.standard_normal(size, dtype=np.float32)
    read = np.float32((quality.read_noise_e / quality.full_well_e) ** 2)
    _expose(codes, radiance, shading, gain, normal, np.float32(quality.full_well_e), read, _GAMMA)
    return codes


@njit(cache=True, nogil=True, error_model="numpy")
def _expose(codes, radiance, shading, gain, normal, full_well, read, gamma):  # type: ignore[no-untyped-def]
    """In shares of full scale, float32 throughout. Without normal numbers there is no noise."""
    noisy = normal.size > 0
    most = np.float32(len(gamma) - 1)
    for r in range(codes.shape[0]):
        for c in range(codes.shape[1]):
            for k in range(codes.shape[2]):
                value = radiance[r, c, k] * shading[r, c] * gain
                if noisy:
                    variance = max(value, np.float32(0.0)) / full_well + read
                    value += np.float32(math.sqrt(variance)) * normal[r, c, k]
                step = min(max(value * most + np.float32(0.5), np.float32(0.0)), most)
                codes[r, c, k] = gamma[np.int64(step)]


def _vignetting(quality: ImageQuality, width: int, height: int) -> Float32Array:
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    r2 = ((x - 0.5 * (width - 1)) ** 2 + (y - 0.5 * (height - 1)) ** 2) / (0.25 * (width**2 + height**2))
    return np.asarray(1.0 - quality.vignetting * r2, dtype=np.float32)


def _dirt(share: float, width: int, height: int, seed: int) -> Float32Array:
    """Out-of-focus specks and a smear: share of light that passes."""
    generator = np.random.default_rng([seed, 71])
    mask = np.zeros((height, width), dtype=np.float32)
    for _ in range(9):
        centre = (int(generator.uniform(0, width)), int(generator.uniform(0, height)))
        radius = int(generator.uniform(0.01, 0.05) * width) + 1
        cv2.circle(mask, centre, radius, float(generator.uniform(0.3, 1.0)), -1)
    soft = cv2.GaussianBlur(mask, (0, 0), 0.012 * width)
    return np.asarray(1.0 - share * np.clip(soft, 0.0, 1.0), dtype=np.float32)


def _encode(image: UInt8Array, jpeg_quality: int | None, gain: float, store: bool) -> Shot:
    bgr = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    if jpeg_quality is None:
        if not store:
            return Shot(image, b"", ".png", gain)
        return Shot(image, _file_bytes(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 3]), ".png", gain)
    data = _file_bytes(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
    flag = cv2.IMREAD_GRAYSCALE if image.ndim == 2 else cv2.IMREAD_COLOR
    seen = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flag)
    if seen is None:
        raise OverflyError("the simulated picture could not be compressed: check the OpenCV installation")
    decoded: UInt8Array = np.asarray(seen, dtype=np.uint8)
    if decoded.ndim == 3:
        decoded = np.ascontiguousarray(decoded[..., ::-1])
    return Shot(decoded, data, ".jpg", gain)


def _file_bytes(suffix: str, image: UInt8Array, settings: list[int]) -> bytes:
    done, data = cv2.imencode(suffix, image, settings)
    if not done:
        raise OverflyError("the simulated picture could not be compressed: check the OpenCV installation")
    return data.tobytes()
