"""Videos and flight logs as cameras and autopilots write them, with known contents."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 160, 120


BITS = 8  # vertical stripes of a picture, which tell its number through any compression


def striped(n: int) -> NDArray[np.uint8]:
    """(H, W, 3) BGR picture of a number: bright stripes, without blue, are ones."""
    bits = (n >> np.arange(BITS)) & 1
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, :, 1:] = np.repeat(bits * 200 + 20, WIDTH // BITS)[None, :, None]
    return image


def write_video(path: Path, frames: int = 40, rate_hz: float = 25.0, code: str = "mp4v") -> Path:
    """Frames with their numbers in stripes."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), rate_hz, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for n in range(frames):
        writer.write(striped(n))
    writer.release()
    return path


def number_of(image: NDArray[np.uint8]) -> int:
    """Which frame a picture is, RGB or gray."""
    gray = image[:, :, :2].mean(axis=2) if image.ndim == 3 else image
    stripes = gray.mean(axis=0).reshape(BITS, -1).mean(axis=1)
    return int(((stripes > 0.5 * float(stripes.max() + 40.0)) << np.arange(BITS)).sum())


def write_dataflash(path: Path, tables: dict[str, tuple[str, str, list[tuple[float, ...]]]]) -> Path:
    """An ArduPilot log; tables: message -> (format letters, column names, rows)."""
    packing = {"Q": "Q", "f": "f", "c": "h", "C": "H", "B": "B", "L": "i", "e": "i"}
    head = b"\xa3\x95"
    body = [
        head + struct.pack("<BBB4s16s64s", 128, 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    ]
    for number, (name, (letters, columns, _)) in enumerate(tables.items()):
        layout = "<" + "".join(packing[letter] for letter in letters)
        body.append(
            head
            + struct.pack(
                "<BBB4s16s64s",
                128, 130 + number, 3 + struct.calcsize(layout),
                name.encode(), letters.encode(), columns.encode(),
            )
        )  # fmt: skip
    for number, (letters, _, rows) in enumerate(tables.values()):
        layout = "<" + "".join(packing[letter] for letter in letters)
        for row in rows:
            cells = [
                value
                if letter == "f"
                else round(value * {"c": 100, "C": 100, "L": 1e7, "e": 100}.get(letter, 1))
                for letter, value in zip(letters, row, strict=True)
            ]
            body.append(head + bytes([130 + number]) + struct.pack(layout, *cells))
    path.write_bytes(b"".join(body))
    return path


def write_ulog(path: Path, topics: dict[str, tuple[str, list[tuple[float, ...]]]]) -> Path:
    """A PX4 log; topics: name -> ("type name;type name;...", rows); the first field is uint64_t timestamp."""
    packing = {
        "uint64_t": "Q",
        "float": "f",
        "double": "d",
        "uint8_t": "B",
        "int8_t": "b",
        "int32_t": "i",
        "bool": "?",
    }

    def message(kind: str, payload: bytes) -> bytes:
        return struct.pack("<HB", len(payload), ord(kind)) + payload

    data = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    layouts = []
    for name, (fields, _) in topics.items():
        data.append(message("F", f"{name}:{fields};".encode()))
        letters = ""
        for entry in fields.split(";"):
            kind, _, count = entry.split(" ")[0].partition("[")
            letters += packing[kind] * (int(count.rstrip("]")) if count else 1)
        layouts.append("<" + letters)
    for number, name in enumerate(topics):
        data.append(message("A", struct.pack("<BH", 0, number) + name.encode()))
    for number, (layout, (_, rows)) in enumerate(zip(layouts, topics.values(), strict=True)):
        data += [message("D", struct.pack("<H", number) + struct.pack(layout, *row)) for row in rows]
    path.write_bytes(b"".join(data))
    return path
