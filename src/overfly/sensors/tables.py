"""Comma-separated tables with named columns and units in brackets, the files of the EuRoC layout.

Columns are found by the name before the bracket, in any order; the unit in the bracket is checked and
converted to SI.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from overfly.errors import SourceError
from overfly.geometry.poses import FloatArray
from overfly.sensors.flight import Problems
from overfly.sensors.text_files import read_text
from overfly.types import IntArray

TEXT = "text"
ROWS_NAMED = 20  # bad rows named one by one; the rest of a file are counted

_DEGREE = math.pi / 180.0
# unit we keep -> units that may stand in the file and what to multiply them by
_UNITS: dict[str, dict[str, float]] = {
    "ns": {"ns": 1, "us": 1e3, "µs": 1e3, "ms": 1e6, "s": 1e9},
    "rad": {"rad": 1.0, "radians": 1.0, "deg": _DEGREE, "degree": _DEGREE, "degrees": _DEGREE, "°": _DEGREE},
    "deg": {"deg": 1.0, "degree": 1.0, "degrees": 1.0, "°": 1.0, "rad": 1.0 / _DEGREE},
    "m": {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0},
    "px": {"px": 1.0, "pixel": 1.0, "pixels": 1.0},
    "rad/s": {"rad s^-1": 1.0, "rad/s": 1.0, "deg/s": _DEGREE, "deg s^-1": _DEGREE},
    "m/s^2": {"m s^-2": 1.0, "m/s^2": 1.0, "m/s²": 1.0, "m/s/s": 1.0, "g": 9.80665},
}


@dataclass(frozen=True, slots=True)
class Column:
    """A column we look for: our name, the names it may carry in the file, and the unit we keep it in.

    may_be_empty: a cell without a value is NaN, and its row is good all the same.
    """

    name: str
    aliases: tuple[str, ...]
    unit: str
    required: bool = True
    may_be_empty: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """Good rows of a file, n of them.

    t_ns (n,) zeros where there is no time column; numbers: columns (n,) by our names, in the unit we keep;
    texts: text columns; row_numbers (n,) line numbers in the file, from 1.
    """

    t_ns: IntArray
    numbers: dict[str, FloatArray]
    texts: dict[str, list[str]]
    row_numbers: IntArray

    def __len__(self) -> int:
        return len(self.row_numbers)

    def stack(self, *names: str) -> FloatArray:
        """(n, len(names)) of number columns."""
        return np.column_stack([self.numbers[name] for name in names])

    def take(self, rows: IntArray) -> Table:
        """The table with these rows only."""
        numbers = {name: values[rows] for name, values in self.numbers.items()}
        texts = {name: [values[row] for row in rows] for name, values in self.texts.items()}
        return Table(self.t_ns[rows], numbers, texts, self.row_numbers[rows])


TIME = Column("timestamp", ("time", "stamp", "t"), "ns")


@dataclass(frozen=True, slots=True)
class _Place:
    column: Column
    index: int
    factor: float


def read_table(path: Path, columns: tuple[Column, ...], problems: Problems) -> Table:
    """Good rows of the file; bad ones are reported to ``problems`` and passed over.

    Raises SourceError when the file cannot be read, lacks a column or states a unit that does not fit.
    """
    name = f"{path.parent.name}/{path.name}"
    lines = read_text(path).splitlines()
    header, places = _read_header(path, lines, columns)
    rows: list[list[float | int | str]] = []
    numbers: list[int] = []
    bad = 0
    for number, line in enumerate(lines[header + 1 :], start=header + 2):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        row = _read_row(line.split(","), places)
        if isinstance(row, str):
            bad += 1
            if bad <= ROWS_NAMED:
                problems.report(f"{name}, row {number}", row)
            continue
        rows.append(row)
        numbers.append(number)
    if bad > ROWS_NAMED:
        problems.report(name, f"{bad - ROWS_NAMED} further bad rows passed over")
    return _as_table(places, rows, numbers)


def increasing_rows(path: Path, table: Table, problems: Problems) -> Table:
    """The most rows whose time strictly increases; the others, which repeat or go back, are reported."""
    keep = longest_increasing(table.t_ns)
    if len(keep) == len(table):
        return table
    dropped = np.setdiff1d(np.arange(len(table)), keep)
    name = f"{path.parent.name}/{path.name}"
    for row in dropped[:ROWS_NAMED]:
        repeated = bool(np.any(table.t_ns[keep] == table.t_ns[row]))
        what = "same time as another row" if repeated else "time does not fit the rows around it"
        problems.report(f"{name}, row {table.row_numbers[row]}", f"{what}; passed over")
    if len(dropped) > ROWS_NAMED:
        problems.report(name, f"{len(dropped) - ROWS_NAMED} further rows out of order in time passed over")
    return table.take(keep)


def longest_increasing(values: IntArray) -> IntArray:
    """Indices of a longest strictly increasing subsequence of values (n,): the fewest are dropped."""
    if len(values) == 0 or bool(np.all(values[1:] > values[:-1])):
        return np.arange(len(values), dtype=np.int64)
    tails: list[int] = []  # tails[k]: smallest value that ends an increasing chain of length k + 1
    ends: list[int] = []  # its index
    previous = np.full(len(values), -1, dtype=np.int64)
    for n, value in enumerate(values.tolist()):
        low, high = 0, len(tails)
        while low < high:
            middle = (low + high) // 2
            low, high = (middle + 1, high) if tails[middle] < value else (low, middle)
        previous[n] = ends[low - 1] if low else -1
        if low == len(tails):
            tails.append(value)
            ends.append(n)
        elif value < tails[low]:
            tails[low], ends[low] = value, n
    chain = [ends[-1]]
    while previous[chain[-1]] >= 0:
        chain.append(int(previous[chain[-1]]))
    return np.array(chain[::-1], dtype=np.int64)


def _read_header(path: Path, lines: list[str], columns: tuple[Column, ...]) -> tuple[int, list[_Place]]:
    """Line index of the header and where our columns stand; comments may come before the header."""
    candidates = []
    for index, line in enumerate(lines):
        text = line.strip()
        if text.startswith("#") or (text and text[0].isalpha()):
            candidates.append((index, [cell.strip() for cell in text.lstrip("# ").split(",")]))
        elif text:
            break
        if text and not text.startswith("#"):
            break
    if not candidates:
        wanted = ",".join(column.name for column in columns if column.required)
        what = "no header line" if any(line.strip() for line in lines) else "empty file"
        raise SourceError(f"{path}: {what}; the first line must name the columns, as #{wanted}")
    missing: list[str] = []
    for index, cells in candidates:
        names = [re.sub(r"\[.*", "", cell).strip().lower() for cell in cells]
        found = {column: _find(names, column) for column in columns}
        missing = [column.name for column, at in found.items() if at is None and column.required]
        if not missing:
            places = [_place(path, column, cells[at], at) for column, at in found.items() if at is not None]
            return index, places
    raise SourceError(f"{path}: no column named {' or '.join(missing)}; name the columns in the first line")


def _find(names: list[str], column: Column) -> int | None:
    for name in (column.name, *column.aliases):
        if name.lower() in names:
            return names.index(name.lower())
    return None


def _place(path: Path, column: Column, cell: str, index: int) -> _Place:
    bracket = re.search(r"\[(.*?)\]", cell)
    if bracket is None or column.unit == TEXT:
        return _Place(column, index, 1.0)
    unit = bracket.group(1).strip()
    factor = _UNITS[column.unit].get(unit)
    if factor is None:
        known = ", ".join(_UNITS[column.unit])
        raise SourceError(f"{path}: column {column.name} is in [{unit}]; one of these is needed: {known}")
    return _Place(column, index, factor)


def _read_row(cells: list[str], places: list[_Place]) -> list[float | int | str] | str:
    """Values of one row in the order of places, or what is wrong with it."""
    row: list[float | int | str] = []
    for place in places:
        cell = cells[place.index].strip() if place.index < len(cells) else ""
        if not cell and place.column.may_be_empty:
            row.append(math.nan)
            continue
        if not cell:
            return f"no value for {place.column.name}; passed over"
        try:
            if place.column.unit == TEXT:
                row.append(cell)
            elif place.column.unit == "ns":
                row.append(_nanoseconds(cell, place.factor))
            else:
                value = float(cell) * place.factor
                if not math.isfinite(value):
                    return f"{place.column.name} is {cell}; passed over"
                row.append(value)
        except ValueError:
            return f"{place.column.name} is '{cell[:40]}', not a number; passed over"
    return row


def _nanoseconds(cell: str, factor: float) -> int:
    if factor == 1 and cell.isdigit():
        stamp = int(cell)
    else:
        try:  # decimals keep all digits of a Unix time in seconds, which a float does not
            stamp = int((Decimal(cell) * Decimal(factor)).to_integral_value())
        except (ArithmeticError, ValueError) as error:
            raise ValueError(cell) from error
    if not -(2**63) < stamp < 2**63:
        raise ValueError(cell)
    return stamp


def _as_table(places: list[_Place], rows: list[list[float | int | str]], row_numbers: list[int]) -> Table:
    t_ns = np.zeros(len(rows), dtype=np.int64)
    numbers: dict[str, FloatArray] = {}
    texts: dict[str, list[str]] = {}
    for k, place in enumerate(places):
        values = [row[k] for row in rows]
        if place.column.unit == TEXT:
            texts[place.column.name] = [str(value) for value in values]
        elif place.column.unit == "ns":
            t_ns = np.array(values, dtype=np.int64)
        else:
            numbers[place.column.name] = np.array(values, dtype=np.float64)
    return Table(t_ns, numbers, texts, np.array(row_numbers, dtype=np.int64))
