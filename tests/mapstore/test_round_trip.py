"""What is written is read; a file that grew is the same as one that was written at once."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.mapstore.format_1 import write_format_1
from tests.mapstore.maps import assert_same, frame_of, grow, make_flight, make_map

from overfly.errors import MapFileError, OutputError
from overfly.mapstore import FrameLog, Map, MapWriter, database, migrations
from overfly.products.georeference import GeoReference
from overfly.visual_map import VisualMap


def write(path: Path, known: Map) -> Path:
    writer = MapWriter.begin(path, known.flights[0])
    writer.save(known.visual, known.frames, known.flights[0].progress, georeference=known.georeference)
    writer.close()
    return path


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 1000), n_nodes=st.integers(0, 6), count=st.integers(0, 20), binary=st.booleans())
def test_everything_comes_back_to_the_last_bit(
    tmp_path: Path, seed: int, n_nodes: int, count: int, binary: bool
) -> None:
    known = make_map(seed, n_nodes, count, binary)
    path = tmp_path / "map.overfly"
    path.unlink(missing_ok=True)
    assert_same(Map.open(write(path, known)), known)


def test_it_knows_where_it_lies(tmp_path: Path) -> None:
    known = make_map()
    known.georeference = GeoReference("EPSG:32632", 1.01, 0.3, (413000.5, 5317000.25, 278.0))
    assert Map.open(write(tmp_path / "map.overfly", known)).georeference == known.georeference


def test_the_file_is_one_file_when_closed(tmp_path: Path) -> None:
    write(tmp_path / "map.overfly", make_map())
    assert [path.name for path in tmp_path.iterdir()] == ["map.overfly"]


def test_a_map_that_grew_is_the_map_written_at_once(tmp_path: Path) -> None:
    """On the way the window is adjusted, poses optimised, lengths rescaled, constraints voted out."""
    generator = np.random.default_rng(3)
    visual_map = VisualMap()
    writer = MapWriter.begin(tmp_path / "grown.overfly", make_flight())
    frames = FrameLog()
    for number in range(200):
        if number % 2 == 0 and number < 60:
            grow(generator, visual_map)
        frames.append(frame_of(visual_map, number, generator))
        for node in visual_map.nodes[-8:]:
            node.points_in_cam[1:3] += 0.01
            node.tracks[0] = visual_map.new_tracks(1)[0]
            node.n_continued += 1
        if number % 7 == 0:
            visual_map.graph.positions[:] += 0.001
        if number % 11 == 10:
            visual_map.graph.states[number % visual_map.graph.n_constraints] = 1
            visual_map.graph.information[-1] *= 1.1
        if number == 31:
            visual_map.rescale(1.3)
        writer.save(visual_map, frames, make_flight().progress)
        while_flying = Map.open(tmp_path / "grown.overfly")  # another process looks at it
        assert len(while_flying.frames) == number + 1
    writer.close()
    grown = Map.open(tmp_path / "grown.overfly")
    assert_same(grown, Map(visual_map, [make_flight()], [0] * len(visual_map), frames))


def test_carrying_on_is_as_if_it_had_never_stopped(tmp_path: Path) -> None:
    generator = np.random.default_rng(4)
    visual_map = VisualMap()
    path = tmp_path / "map.overfly"
    writer = MapWriter.begin(path, make_flight())
    frames = FrameLog()
    for number in range(10):
        grow(generator, visual_map)
        frames.append(frame_of(visual_map, number, generator))
        writer.save(visual_map, frames, make_flight().progress)
        if number % 3 == 0:
            writer.close()
            known = Map.open(path)
            visual_map, frames = known.visual, FrameLog.of(known.frames)
            writer = MapWriter.carry_on(path, known)
    writer.close()
    assert len(Map.open(path)) == 10
    assert len(Map.open(path).frames) == 10


def test_reading_changes_nothing(tmp_path: Path) -> None:
    path = write(tmp_path / "map.overfly", make_map())
    before = path.read_bytes()
    Map.open(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_new_map_never_replaces_one_that_is_there(tmp_path: Path) -> None:
    path = write(tmp_path / "map.overfly", make_map())
    with pytest.raises(OutputError, match="exists already"):
        MapWriter.begin(path, make_flight())


def test_a_full_disk_leaves_what_was_saved(tmp_path: Path) -> None:
    """SQLite is told that no page more may be had, which is what it finds on a full disk."""
    generator = np.random.default_rng(5)
    visual_map = VisualMap()
    path = tmp_path / "map.overfly"
    writer = MapWriter.begin(path, make_flight())
    grow(generator, visual_map)
    writer.save(visual_map, [frame_of(visual_map, 0, generator)], make_flight().progress)
    saved = Map.open(path)
    pages = writer._connection.execute("PRAGMA page_count").fetchone()[0]
    writer._connection.execute(f"PRAGMA max_page_count = {pages}")
    for _ in range(10):
        grow(generator, visual_map, 200)
    with pytest.raises(OutputError, match=r"map\.overfly.*full"):
        writer.save(visual_map, [frame_of(visual_map, 1, generator)], make_flight().progress)
    writer.close()
    assert_same(Map.open(path), saved)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(OutputError, match="cannot write"):
        MapWriter.begin(tmp_path / "file" / "map.overfly", make_flight())


def test_older_maps_are_brought_up_to_date(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A migration that fails leaves the older map; one that works is not needed a second time."""
    path, known = tmp_path / "map.overfly", make_map(n_nodes=70)
    write_format_1(path, known)
    before = path.read_bytes()
    seen = []
    step = migrations.MIGRATIONS[1]

    def watched(connection: sqlite3.Connection) -> None:
        seen.append(connection.execute("SELECT count(*) FROM frames").fetchone()[0])
        step(connection)
        if len(seen) == 1:
            raise sqlite3.OperationalError("out of luck")

    monkeypatch.setitem(migrations.MIGRATIONS, 1, watched)
    with pytest.raises(MapFileError, match="out of luck"):
        Map.open(path)
    assert_same(Map.open(path), known)
    assert path.read_bytes() == before, "reading migrates in memory"
    database.connect_to_write(path).close()
    assert seen == [140, 140, 140]
    assert_same(Map.open(path), known)
    assert seen == [140, 140, 140]


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE frames SET inliers = inliers + 1 WHERE time_ns = 0",
        "UPDATE frames SET report = '{' WHERE time_ns = 0",
        "CREATE VIEW everything AS SELECT * FROM nodes",
        "ALTER TABLE frames ADD COLUMN more INTEGER",
    ],
)
def test_older_maps_are_trusted_no_more_than_new_ones(tmp_path: Path, statement: str) -> None:
    path = tmp_path / "map.overfly"
    write_format_1(path, make_map())
    with sqlite3.connect(path) as connection:
        connection.execute(statement)
    connection.close()
    before = path.read_bytes()
    for use in (Map.open, database.connect_to_write):
        with pytest.raises(MapFileError, match=r"map\.overfly"):
            use(path)
    assert path.read_bytes() == before


def test_a_frame_takes_little_room(tmp_path: Path) -> None:
    """Hours over one place: what a frame adds is small, in the file as in memory."""
    known = make_map(n_nodes=1)
    generator = np.random.default_rng(8)
    size = []
    for count in (1000, 2000):
        known.frames = FrameLog(
            replace(frame_of(known.visual, 3 * number, generator), position=None, revisit=None)
            for number in range(count)
        )
        path = write(tmp_path / f"{count}.overfly", known)
        size.append((path.stat().st_size, sum(len(block.numbers) for block in known.frames.blocks)))
    in_file, in_memory = ((after - before) / 1000 for before, after in zip(*size, strict=True))
    assert 45 < in_file < 100
    assert 45 < in_memory < 100


def test_the_file_is_a_map_from_its_first_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed just after the file appeared: it opens, and holds nothing yet."""

    def killed(path: Path) -> sqlite3.Connection:
        raise KeyboardInterrupt(path)

    monkeypatch.setattr("overfly.mapstore.writer.connect_to_write", killed)
    with pytest.raises(KeyboardInterrupt):
        MapWriter.begin(tmp_path / "map.overfly", make_flight())
    assert len(Map.open(tmp_path / "map.overfly")) == 0
