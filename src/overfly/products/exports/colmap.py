"""The map as a COLMAP model: nodes are images, ground points that were measured are 3D points.

Text form, which every version of COLMAP reads. COLMAP has pixel (0.5, 0.5) in the centre of the top-left
pixel and writes cam_from_world with the quaternion's w first.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from overfly.errors import OutputError
from overfly.files import atomic_path
from overfly.geometry.cameras import Camera, Distortion
from overfly.geometry.poses import FloatArray
from overfly.products.exports.content import NodeImage, Reconstruction
from overfly.products.exports.point_clouds import PLAIN_RGB
from overfly.types import IntArray

HALF_PIXEL = 0.5


def write_colmap(folder: Path, model: Reconstruction) -> None:
    """cameras.txt, images.txt and points3D.txt in a folder, which is made. Raises OutputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write into {folder}: {error.strerror or error}") from error
    for name, lines in (
        ("cameras.txt", _camera_lines(model)),
        ("images.txt", _image_lines(model)),
        ("points3D.txt", _point_lines(model)),
    ):
        with atomic_path(folder / name) as temporary, temporary.open("w", encoding="utf-8") as file:
            file.writelines(line + "\n" for line in lines)


def _camera_lines(model: Reconstruction) -> Iterator[str]:
    yield "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
    for number, camera in enumerate(model.cameras, start=1):
        name, numbers = _parameters(camera)
        yield f"{number} {name} {camera.width} {camera.height} {_text(numbers)}"


def _parameters(camera: Camera) -> tuple[str, tuple[float, ...]]:
    """COLMAP's name of the camera model and its parameters."""
    pinhole = (camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL)
    if camera.distortion is Distortion.EQUIDISTANT:
        return "OPENCV_FISHEYE", (*pinhole, *camera.coefficients[:4])
    if len(camera.coefficients) == 4:
        return "OPENCV", (*pinhole, *camera.coefficients)
    return "FULL_OPENCV", (*pinhole, *camera.coefficients, 0.0, 0.0, 0.0)


def _image_lines(model: Reconstruction) -> Iterator[str]:
    yield "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    yield "# POINTS2D[] as (X, Y, POINT3D_ID)"
    for number, image in enumerate(model.images, start=1):
        cam_from_world = image.world_from_cam.inverse()
        x, y, z, w = cam_from_world.quaternion()
        yield f"{number} {_text((w, x, y, z, *cam_from_world.translation))} {image.camera + 1} {image.name}"
        yield " ".join(
            f"{u + HALF_PIXEL:.3f} {v + HALF_PIXEL:.3f} {point + 1 if point >= 0 else -1}"
            for (u, v), point in zip(image.px.tolist(), image.point.tolist(), strict=True)
        )


def _point_lines(model: Reconstruction) -> Iterator[str]:
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    points = model.points
    rgb = np.full((len(points), 3), PLAIN_RGB, np.uint8) if points.rgb is None else points.rgb
    tracks: list[list[str]] = [[] for _ in range(len(points))]
    squared = np.zeros(len(points))
    for number, image in enumerate(model.images, start=1):
        seen = np.flatnonzero(image.point >= 0)
        np.add.at(squared, image.point[seen], _squared_errors(model, image, seen))
        for row in seen.tolist():
            tracks[image.point[row]].append(f"{number} {row}")
    for point, (position, colour, track) in enumerate(zip(points.positions, rgb, tracks, strict=True)):
        error = float(np.sqrt(squared[point] / max(len(track), 1)))
        red, green, blue = colour.tolist()
        yield f"{point + 1} {_text(position.tolist())} {red} {green} {blue} {error:.4f} {' '.join(track)}"


def _squared_errors(model: Reconstruction, image: NodeImage, seen: IntArray) -> FloatArray:
    """(k,) squared reprojection errors, px², of the points seen in an image; 0 where one is behind it."""
    world = model.points.positions[image.point[seen]]
    px = model.cameras[image.camera].project(image.world_from_cam.inverse().transform(world))
    return np.asarray(np.nan_to_num(((px - image.px[seen]) ** 2).sum(axis=1)))


def _text(numbers: tuple[float, ...] | list[float]) -> str:
    return " ".join(f"{number:.12g}" for number in numbers)
