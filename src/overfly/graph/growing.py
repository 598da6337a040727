"""Arrays that grow together, as rows of one table do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

T = TypeVar("T", bound=tuple[Any, ...])  # a named tuple of arrays


class Table(Generic[T]):
    """``view`` is the filled part of every column. New rows hold what ``empty`` puts there."""

    def __init__(self, empty: Callable[[int], T]) -> None:
        """empty: makes the columns with so many rows."""
        self._empty = empty
        self._columns = empty(64)
        self._length = 0
        self.view = self._filled()

    def __len__(self) -> int:
        return self._length

    def grow(self, length: int) -> None:
        """Have so many rows, at least as many as before."""
        if length == self._length:
            return
        if length > len(self._columns[0]):
            larger = self._empty(2 * length)
            for old, new in zip(self._columns, larger, strict=True):
                new[: self._length] = old[: self._length]
            self._columns = larger
        self._length = length
        self.view = self._filled()

    def _filled(self) -> T:
        filled: Any = type(self._columns)
        return filled._make(column[: self._length] for column in self._columns)  # type: ignore[no-any-return]
