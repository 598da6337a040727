"""A packed sequence is the list that it stands for, and what frames saw is bounded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly import frame_records
from overfly.frame_records import FrameRecord, FrameRecords, Seen
from overfly.geometry.poses import Pose
from overfly.packed import BLOCK_SIZE, Packed


@dataclass(frozen=True)
class Numbers:
    """A block of whole numbers."""

    values: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.values)

    def unpack(self) -> list[int]:
        return list(self.values)


CHANGES = st.one_of(
    st.tuples(st.just("append"), st.integers(1, 100), st.just(0)),
    st.tuples(st.sampled_from(["insert", "set", "delete", "pop"]), st.integers(-300, 300), st.integers()),
)


@given(st.lists(CHANGES, max_size=20))
def test_it_is_the_list_that_it_stands_for(changes: list[tuple[str, int, int]]) -> None:
    packed: Packed[int] = Packed(lambda values: Numbers(tuple(values)), range(150))
    twin = list(range(150))
    assert packed.blocks
    for what, at, value in changes:
        if what == "append":
            packed.extend(range(at))
            twin.extend(range(at))
        elif what == "insert":
            packed.insert(min(abs(at), len(twin)), value)
            twin.insert(min(abs(at), len(twin)), value)
        elif not -len(twin) <= at < len(twin):
            with pytest.raises(IndexError):
                _ = packed[at]
        elif what == "set":
            packed[at] = twin[at] = value
        elif what == "delete":
            del packed[at], twin[at]
        else:
            assert packed.pop(at) == twin.pop(at)
    assert list(packed) == twin
    assert len(packed) == len(twin)
    assert packed[-3:] == twin[-3:]
    assert packed[10:300:7] == twin[10:300:7]
    assert [packed[k] for k in range(-len(twin), len(twin))] == twin + twin
    packed[:] = twin[::2]
    assert list(packed) == twin[::2]


def record(generator: np.random.Generator, number: int, n_seen: int | None) -> FrameRecord:
    seen = None
    if n_seen is not None:
        node = np.full(n_seen, number, np.int32)
        rays = generator.normal(size=(n_seen, 2)).astype(np.float32)
        seen = Seen(node, np.arange(n_seen, dtype=np.int32), rays)
    poses = [Pose.exp(generator.normal(size=6)) for _ in range(2)]
    return FrameRecord(number, 10 * number, number // 3, poses[0], poses[1], number // 100, seen)


def test_records_come_back_to_the_last_bit() -> None:
    generator = np.random.default_rng(0)
    counts = [None if k % 5 == 0 else int(generator.integers(0, 80)) for k in range(3 * BLOCK_SIZE)]
    known = [record(generator, number, count) for number, count in enumerate(counts)]
    records = FrameRecords(known)
    assert len(records.blocks) == 2
    for one, other in zip(records, known, strict=True):
        for name in ("frame_index", "t_ns", "node", "piece"):
            assert getattr(one, name) == getattr(other, name)
        for name in ("node_from_cam", "online"):
            assert getattr(one, name).matrix().tobytes() == getattr(other, name).matrix().tobytes()
        assert (one.seen is None) == (other.seen is None)
        if one.seen is not None and other.seen is not None:
            for name in ("node", "row", "rays"):
                np.testing.assert_array_equal(getattr(one.seen, name), getattr(other.seen, name))


def test_what_frames_saw_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each frame keeps fewer points, spread over all it saw, until they would not find it again."""
    monkeypatch.setattr(frame_records, "MOST_SEEN_OF_ALL", 20_000)
    generator = np.random.default_rng(0)
    records = FrameRecords()
    for number in range(3000):
        records.append(record(generator, number, 80))
        held = sum(len(block.seen.row) for block in records.blocks)
        assert held <= 20_000
        if number == 700:
            counts = {len(one.seen.row) for one in records[:500] if one.seen is not None}
            assert counts == {20}
            rows = records[100].seen.row  # type: ignore[union-attr]
            assert rows[0] == 0
            assert rows[-1] == 79
            assert np.diff(rows).max() < 3 * 80 / 20
    assert all(one.seen is not None and len(one.seen.row) == 0 for one in records[:1000])
    assert all(one.seen is not None and len(one.seen.row) == 80 for one in records[-BLOCK_SIZE:])
