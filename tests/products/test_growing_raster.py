"""What is drawn while flying, as a file: tiles where they belong, whole at any moment; and the pictures that
are set aside for it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.products.level_ground import CAMERA, above, seen_from

from overfly.errors import OutputError
from overfly.products import picture_spool
from overfly.products.cog import TILE_PX
from overfly.products.growing_raster import GrowingRaster
from overfly.products.picture_spool import PictureSpool

places = st.tuples(st.integers(-9, 9), st.integers(-9, 9))


@settings(max_examples=12)
@given(st.lists(places, min_size=1, max_size=5, unique=True), st.lists(places, max_size=2), st.booleans())
def test_the_file_holds_the_tiles_where_they_belong(
    tmp_path_factory: pytest.TempPathFactory,
    drawn: list[tuple[int, int]],
    gone: list[tuple[int, int]],
    is_coarser: bool,
) -> None:
    raster, path = GrowingRaster(0.5), tmp_path_factory.mktemp("raster") / "a.tif"
    for place in [*gone, *drawn]:
        raster.put(place, plain_tile((0, 0)))
    for place in gone:
        raster.put(place, None)
    for number, place in enumerate(drawn, start=1):
        raster.put(place, plain_tile((number, 3 * number)))
    if is_coarser:
        raster.coarsen()
    raster.save(path)
    with rasterio.open(path) as file:
        rgba, transform, factors = file.read(), file.transform, file.overviews(1)
    assert transform.a == raster.px_m == (1.0 if is_coarser else 0.5)
    assert np.count_nonzero(rgba[3]) == len(set(drawn)) * TILE_PX**2 // (4 if is_coarser else 1)
    half_m = 0.25 * TILE_PX
    for number, (row, column) in enumerate(drawn, start=1):
        x, y = 2 * half_m * column + half_m, -2 * half_m * row - half_m
        for level in range(len(factors) + 1):
            with rasterio.open(path, **({"overview_level": level - 1} if level else {})) as file:
                across, down = ~file.transform @ (x, y)
                found = file.read()[:, int(down), int(across)]
            np.testing.assert_array_equal(found, [number, 3 * number, 7, 255])


def plain_tile(colour: tuple[int, int]) -> NDArray[np.uint8]:
    return np.broadcast_to(np.array([*colour, 7, 255], np.uint8), (TILE_PX, TILE_PX, 4))


KILLED = """
import sys
import numpy as np
from overfly.products.growing_raster import GrowingRaster
raster, tile = GrowingRaster(0.1), np.random.default_rng(0).integers(0, 255, (512, 512, 4), np.uint8)
number = 0
while True:
    raster.put((number % 7 - 3, number % 5), tile)
    raster.save(sys.argv[1])
    number += 1
"""


def test_a_process_that_is_killed_leaves_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "mosaic.tif"
    for wait_s in (0.0, 0.15, 0.31):
        process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)])
        try:
            end = time.monotonic() + 60.0
            while not path.exists() and time.monotonic() < end:
                time.sleep(0.02)
            time.sleep(wait_s)
        finally:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
        with rasterio.open(path) as raster:
            assert raster.read().any()
        path.unlink()


# -- pictures set aside


def test_pictures_come_back_and_few_stay_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(picture_spool, "CACHE_BYTES", 3 * CAMERA.width * CAMERA.height)
    spool = PictureSpool(tmp_path)
    gray = [seen_from(above(k, 0.0)) for k in range(8)]
    for number, picture in enumerate(gray):
        spool.add(2 * number, picture)
        spool.add(2 * number + 1, np.stack([picture, picture // 2, picture // 3], axis=2))
    for number, picture in enumerate(gray):
        assert np.abs(spool.get(2 * number).astype(int) - picture).max() <= 8
        assert spool.get(2 * number) is spool.get(2 * number)
        colours = spool.get(2 * number + 1)
        away = np.abs(colours.astype(int) - np.stack([picture, picture // 2, picture // 3], axis=2))
        assert np.median(away, axis=(0, 1)).max() <= 3
        assert sum(kept.nbytes for kept in spool._cache.values()) <= 3 * CAMERA.width * CAMERA.height
    assert not list(tmp_path.iterdir())  # nobody has to clear it away
    spool.close()


def test_a_folder_without_room_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="nowhere"):
        PictureSpool(tmp_path / "nowhere")
