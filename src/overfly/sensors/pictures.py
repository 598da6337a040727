"""Pictures as arrays, as recorded: not rotated by metadata, and a damaged file is never half a picture."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from overfly.types import UInt8Array

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".pgm", ".ppm", ".bmp"})


def is_picture(path: Path) -> bool:
    """By its name; the hidden twins that some file systems leave beside a file ("._name") are not."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def read_picture(path: Path) -> UInt8Array | str:
    """(H, W) gray or (H, W, 3) RGB uint8, or what is wrong with the file in a few words."""
    try:
        if path.stat().st_size == 0:
            return "empty file"
        # Pillow rather than OpenCV: it refuses a truncated JPEG, where OpenCV returns it filled up with gray
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # large aerial pictures are no attack
            with Image.open(path) as picture:
                return _as_uint8(picture)
    except FileNotFoundError:
        return "file is missing"
    except UnidentifiedImageError:
        return "not a picture, or damaged from its first bytes"
    except (OSError, SyntaxError, ValueError, EOFError, MemoryError, Image.DecompressionBombError) as error:
        return f"damaged picture ({str(error).splitlines()[0][:80] if str(error) else type(error).__name__})"


def picture_size(path: Path) -> tuple[int, int] | None:
    """(width, height) from the file's header, or None when there is no picture in it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as picture:
                return picture.size
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError):
        return None


def _as_uint8(picture: Image.Image) -> UInt8Array:
    if picture.mode.startswith("I"):  # 16 bit gray: the upper byte
        return (np.clip(np.asarray(picture).astype(np.int64), 0, 65535) >> 8).astype(np.uint8)
    if picture.mode in ("1", "LA", "La"):
        picture = picture.convert("L")
    elif picture.mode not in ("L", "RGB"):
        picture = picture.convert("RGB")
    return np.ascontiguousarray(picture, dtype=np.uint8)
