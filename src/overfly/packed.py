"""Sequences of thousands of small objects that fly past: the newest as they are, older ones packed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, MutableSequence
from typing import Any, Protocol, TypeVar, overload

T = TypeVar("T")
BLOCK_SIZE = 64


class Block(Protocol[T]):
    """Some entries one after the other, packed."""

    def __len__(self) -> int: ...

    def unpack(self) -> list[T]:
        """The entries."""
        ...


class Packed(MutableSequence[T]):
    """A list whose older entries take little memory. Appending, and changes among the newest 64, are cheap;
    any other change unpacks everything.
    """

    def __init__(self, pack: Callable[[list[T]], Any], entries: Iterable[T] = ()) -> None:
        """pack: makes a Block of entries."""
        self._pack = pack
        self.blocks: list[Any] = []
        self.newest: list[T] = []
        self._n_packed = 0
        self.extend(entries)

    def __len__(self) -> int:
        return self._n_packed + len(self.newest)

    def __iter__(self) -> Iterator[T]:
        for block in self.blocks:
            yield from block.unpack()
        yield from self.newest

    @overload
    def __getitem__(self, at: int) -> T: ...
    @overload
    def __getitem__(self, at: slice) -> list[T]: ...
    def __getitem__(self, at: int | slice) -> T | list[T]:
        if isinstance(at, slice):
            return [self[k] for k in range(*at.indices(len(self)))]
        place = self._place(at)
        if place >= 0:
            return self.newest[place]
        place += self._n_packed
        for block in self.blocks:
            if place < len(block):
                unpacked: list[T] = block.unpack()
                return unpacked[place]
            place -= len(block)
        raise AssertionError("blocks and their sizes disagree")

    def __setitem__(self, at: Any, value: Any) -> None:
        self._unpack_for(at)
        self.newest[at if isinstance(at, slice) else self._place(at)] = value

    def __delitem__(self, at: Any) -> None:
        self._unpack_for(at)
        del self.newest[at if isinstance(at, slice) else self._place(at)]

    def insert(self, index: int, value: T) -> None:
        if index >= len(self):
            self.newest.append(value)
            if len(self.newest) >= 2 * BLOCK_SIZE:
                self.add_block(self._pack(self.newest[:BLOCK_SIZE]))
                del self.newest[:BLOCK_SIZE]
            return
        self._unpack_for(index)
        self.newest.insert(index if self._n_packed == 0 else self._place(index), value)

    def clear(self) -> None:
        self.blocks, self.newest, self._n_packed = [], [], 0

    def add_block(self, block: Any) -> None:
        """Take in a block after those that are there, before the newest entries."""
        self.blocks.append(block)
        self._n_packed += len(block)

    def _place(self, at: int) -> int:
        """Place among the newest entries, negative for packed ones."""
        index = at + len(self) if at < 0 else at
        if not 0 <= index < len(self):
            raise IndexError(at)
        return index - self._n_packed

    def _unpack_for(self, at: int | slice) -> None:
        """Unpack everything, unless it is one of the newest entries that is to change."""
        if self._n_packed and (isinstance(at, slice) or self._place(at) < 0):
            everything = list(self)
            self.clear()
            self.newest = everything
