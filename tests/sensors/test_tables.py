"""Tables: columns by name, units by bracket, bad rows named and passed over."""

from __future__ import annotations

import math
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.errors import SourceError
from overfly.sensors.flight import Problems
from overfly.sensors.tables import TIME, Column, increasing_rows, longest_increasing, read_table

ROLL = Column("roll", (), "rad")
RANGE = Column("range", ("distance",), "m")


def write(tmp_path: Path, content: str | bytes) -> Path:
    path = tmp_path / "attitude0" / "data.csv"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_columns_by_name_in_any_order_with_units(tmp_path: Path) -> None:
    path = write(tmp_path, "#other,Roll [deg], distance [cm],timestamp [s]\nx,90,250,1700000000.123456789\n")
    table = read_table(path, (TIME, ROLL, RANGE), Problems())
    assert table.t_ns.tolist() == [1_700_000_000_123_456_789]
    assert table.numbers["roll"][0] == pytest.approx(math.pi / 2)
    assert table.numbers["range"][0] == pytest.approx(2.5)


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbf#timestamp [ns],roll [rad]\r\n5,0.25\r\n6,0.5\r\n",
        b"timestamp,roll\n5,0.25\n6,0.5",
        "# Höhe über Grund\n#timestamp [ns],roll [rad]\n5,0.25\n\n# Lücke\n6,0.5\n".encode("latin-1"),
        b"#timestamp [ns],roll [rad],\n5, 0.25,\n6.0, 0.5,\n",
    ],
)
def test_byte_order_mark_line_ends_latin_1_and_comments(tmp_path: Path, content: bytes) -> None:
    problems = Problems()
    table = read_table(write(tmp_path, content), (TIME, ROLL), problems)
    assert table.t_ns.tolist() == [5, 6]
    assert table.numbers["roll"].tolist() == [0.25, 0.5]
    assert not problems


def test_bad_rows_are_named_and_passed_over(tmp_path: Path) -> None:
    rows = [
        "#timestamp [ns],roll [rad]",
        "1,0.1",
        "2",
        "3,",
        "4,nan",
        "5,inf",
        "six,0.1",
        "7,0.7x",
        "8,0.8",
        "9e999999999,0.9",
    ]
    problems = Problems()
    table = read_table(write(tmp_path, "\n".join(rows)), (TIME, ROLL), problems)
    assert table.t_ns.tolist() == [1, 8]
    assert [problem.where for problem in problems] == [
        f"attitude0/data.csv, row {n}" for n in (3, 4, 5, 6, 7, 8, 10)
    ]


def test_a_flood_of_bad_rows_is_counted(tmp_path: Path) -> None:
    problems = Problems()
    read_table(write(tmp_path, "#timestamp [ns],roll [rad]\n" + "1,bad\n" * 50), (TIME, ROLL), problems)
    assert len(problems) == 21
    assert "30 further" in problems[-1].what


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("#timestamp [ns],roll [m]\n1,2\n", "[m]"),
        ("#timestamp [parsec],roll [rad]\n1,2\n", "[parsec]"),
        ("#timestamp [ns],pitch [rad]\n1,2\n", "roll"),
        ("1,2\n", "header"),
        ("\n\n", "empty"),
    ],
)
def test_a_file_that_cannot_be_meant_is_refused_in_one_line(tmp_path: Path, content: str, words: str) -> None:
    path = write(tmp_path, content)
    with pytest.raises(SourceError) as refusal:
        read_table(path, (TIME, ROLL), Problems())
    assert str(path) in str(refusal.value)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_time_that_repeats_or_goes_back_is_passed_over(tmp_path: Path) -> None:
    path = write(tmp_path, "#timestamp [ns],roll [rad]\n10,0\n20,1\n20,2\n15,3\n900,4\n30,5\n40,6\n")
    problems = Problems()
    table = increasing_rows(path, read_table(path, (TIME, ROLL), problems), problems)
    assert table.t_ns.tolist() == [10, 15, 30, 40] or table.t_ns.tolist() == [10, 20, 30, 40]
    assert len(table) + len(problems) == 7


@given(st.lists(st.integers(-9, 9), max_size=9))
def test_longest_increasing_drops_the_fewest(values: list[int]) -> None:
    array = np.array(values, dtype=np.int64)
    kept = longest_increasing(array)
    assert np.all(np.diff(array[kept]) > 0)
    assert np.all(np.diff(kept) > 0)
    best = max(
        size
        for size in range(len(values) + 1)
        for chosen in combinations(values, size)
        if all(a < b for a, b in pairwise(chosen))
    )
    assert len(kept) == best
