"""Long work in steps: a generator that pauses after each bounded piece, so that work for a whole graph can be
done beside a flight, the same for the same input whatever the clock says.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")

Steps = Generator[None, None, T]


def to_the_end(steps: Steps[T]) -> T:
    """Do all the work at once; what it returns."""
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            return stop.value  # type: ignore[no-any-return]
