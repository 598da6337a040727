"""One textured mesh as binary glTF 2.0 (Khronos, ISO/IEC 12113), as it travels to the browser."""

from __future__ import annotations

import json
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from overfly.geometry.poses import FloatArray
from overfly.types import Float32Array, UInt8Array

FLOAT, UINT32 = 5126, 5125  # component types
VERTICES, INDICES = 34962, 34963  # targets of buffer views
JPEG_QUALITY, WEBP_QUALITY = 80, 82


def encode_picture(picture: UInt8Array) -> tuple[bytes, str]:
    """A picture (H, W), (H, W, 3) RGB or (H, W, 4) RGBA as a file in memory, and its media type."""
    if picture.ndim == 3 and picture.shape[2] == 4:
        ordered = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA)
        done, data = cv2.imencode(".webp", ordered, [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY])
        media = "image/webp"
    else:
        ordered = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
        done, data = cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        media = "image/jpeg"
    assert done
    return data.tobytes(), media


def textured_mesh(
    vertices: FloatArray, texture_places: FloatArray, faces: NDArray[np.uint32], picture: UInt8Array
) -> bytes:
    """vertices (n, 3) metres; texture_places (n, 2) in 0..1 from the picture's top-left corner; faces (m, 3).

    The picture is shown as it is, without light; where its fourth channel is below half, nothing is.
    """
    image, media = encode_picture(picture)
    points, places = vertices.astype("<f4"), texture_places.astype("<f4")
    parts = [points.tobytes(), places.tobytes(), faces.astype("<u4").tobytes(), image]
    tree = _tree(points, len(places), faces.size, [len(part) for part in parts], media)
    return _pack(tree, parts)


def grid_faces(rows: int, columns: int) -> NDArray[np.uint32]:
    """(2 (rows-1) (columns-1), 3) triangles over a grid of rows x columns vertices, numbered row by row; two
    per cell, the cells in the order of their top-left vertex.
    """
    corner = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)[:-1, :-1].reshape(-1, 1)
    below, right = np.uint32(columns), np.uint32(1)
    first = np.hstack([corner, corner + below, corner + right])
    second = np.hstack([corner + right, corner + below, corner + below + right])
    return np.stack([first, second], axis=1).reshape(-1, 3)


def _tree(
    points: Float32Array, n_places: int, n_indices: int, sizes: list[int], media: str
) -> dict[str, Any]:
    offsets = np.concatenate([[0], np.cumsum([size + _padding(size) for size in sizes])])
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": int(offset), "byteLength": size}
        for offset, size in zip(offsets, sizes, strict=False)
    ]
    for view, target in zip(views, (VERTICES, VERTICES, INDICES), strict=False):
        view["target"] = target
    webp = media == "image/webp"
    texture = {"extensions": {"EXT_texture_webp": {"source": 0}}} if webp else {"source": 0}
    material: dict[str, Any] = {
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        },
        "doubleSided": True,
        "extensions": {"KHR_materials_unlit": {}},
    }
    if webp:
        material |= {"alphaMode": "MASK", "alphaCutoff": 0.5}
    return {
        "asset": {"version": "2.0", "generator": "Overfly"},
        "extensionsUsed": ["KHR_materials_unlit", *(["EXT_texture_webp"] if webp else [])],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [material],
        "textures": [{"sampler": 0, **texture}],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": [{"bufferView": 3, "mimeType": media}],
        "accessors": [
            {
                "bufferView": 0, "componentType": FLOAT, "count": len(points), "type": "VEC3",
                "min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": FLOAT, "count": n_places, "type": "VEC2"},
            {"bufferView": 2, "componentType": UINT32, "count": n_indices, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": int(offsets[-1])}],
    }  # fmt: skip


def _pack(tree: dict[str, Any], parts: list[bytes]) -> bytes:
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * _padding(len(text))
    binary = b"".join(part + b"\0" * _padding(len(part)) for part in parts)
    total = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<4sII", b"glTF", 2, total)
    return b"".join(
        [head, struct.pack("<I4s", len(text), b"JSON"), text,
         struct.pack("<I4s", len(binary), b"BIN\0"), binary]
    )  # fmt: skip


def _padding(size: int) -> int:
    return -size % 4
