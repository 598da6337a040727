"""Every frame of the flights in some 60 bytes each, in the file as in memory: hours over one place must fill
neither."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from overfly.frame_records import FrameRecord
from overfly.geometry.poses import FloatArray, Pose
from overfly.mapstore import blobs
from overfly.mapstore.content import FrameEntry
from overfly.packed import Packed
from overfly.revisit.outcome import Revisit, RevisitStatus
from overfly.types import GeoPosition, Reason

MOST_FRAMES = 4096  # of one block
MOST_STAGES = 64
# Of every frame: name, type, numbers. Times and frames are differences to the frame before, which are nearly
# always the same; poses are (translation in metres, rotation vector).
COLUMNS = (
    ("t_ns", "<i8", 1),
    ("frame_index", "<i4", 1),
    ("flight", "<i4", 1),
    ("node", "<i4", 1),  # -1 of a lost frame
    ("piece", "<i4", 1),
    ("made_node", "|u1", 1),
    ("n_matches", "<i4", 1),
    ("n_inliers", "<i4", 1),
    ("rms_px", "<f4", 1),
    ("node_from_cam", "<f4", 6),
    ("online", "<f4", 6),
)
FRAME_BYTES = sum(np.dtype(kind).itemsize * numbers for _, kind, numbers in COLUMNS)

# Columns of one number each, as entries have them.
_PLAIN = (
    "flight", "t_ns", "frame_index", "node", "made_node", "n_matches", "n_inliers", "rms_px", "piece",
)  # fmt: skip
POSITION_BYTES = 40
_NO_POSITION = np.full(5, np.nan, "<f8").tobytes()


@dataclass(frozen=True, slots=True, eq=False)
class FrameBlock:
    """Some frames as a row of the file holds them.

    stages: what the seconds are of; numbers: the columns above, then seconds (count, stages) as f2, NaN where
    a stage did not run; positions: (count, 5) f8, NaN where there is none, or None for no positions at all;
    notes: JSON, by place in the block what only few frames have: [reason, detail, revisit]. All but the
    stages are deflated.
    """

    count: int
    stages: str
    numbers: bytes
    positions: bytes | None
    notes: bytes

    def __len__(self) -> int:
        return self.count

    @staticmethod
    def pack(entries: list[FrameEntry]) -> FrameBlock:
        stages = list(dict.fromkeys(stage for entry in entries for stage in entry.seconds))
        table: dict[str, Any] = {
            name: [getattr(entry, name) for entry in entries]
            for name in ("flight", "made_node", "piece", "n_matches", "n_inliers", "rms_px")
        }
        table["t_ns"] = np.diff([entry.t_ns for entry in entries], prepend=0)
        table["frame_index"] = np.diff([entry.frame_index for entry in entries], prepend=0)
        table["node"] = [-1 if entry.node is None else entry.node for entry in entries]
        for name in ("node_from_cam", "online"):
            table[name] = _tangents([getattr(entry, name) for entry in entries])
        seconds = [[entry.seconds.get(stage, np.nan) for stage in stages] for entry in entries]
        columns = [blobs.pack(np.asarray(table[name]), kind) for name, kind, _ in COLUMNS]
        notes = {
            number: [entry.reason, entry.detail, None if entry.revisit is None else asdict(entry.revisit)]
            for number, entry in enumerate(entries)
            if entry.reason is not None or entry.detail or entry.revisit is not None
        }
        positions = None
        if any(entry.position is not None for entry in entries):
            rows = [blobs.pack_position(entry.position) or _NO_POSITION for entry in entries]
            positions = zlib.compress(b"".join(rows))
        return FrameBlock(
            len(entries),
            blobs.to_json(stages),
            zlib.compress(b"".join([*columns, blobs.pack(np.array(seconds), "<f2")])),
            positions,
            zlib.compress(blobs.to_json(notes).encode()),
        )

    def row(self, number: int) -> tuple[Any, ...]:
        """The block as a row of the file."""
        return number, self.count, self.stages, self.numbers, self.positions, self.notes

    def unpack(self) -> list[FrameEntry]:
        """Raises ValueError, KeyError or TypeError when the block makes no sense."""
        stages = self._stages()
        table, seconds = self._table(len(stages))
        notes, positions = self._notes(), self._positions()
        entries = []
        for k, row in enumerate(zip(*(table[name].tolist() for name in _PLAIN), strict=True)):
            flight, t_ns, frame, node, made, matches, inliers, rms, piece = row
            reason, detail, revisit = notes.get(k, (None, "", None))
            took = zip(stages, seconds[k].tolist(), strict=True)
            entries.append(
                FrameEntry(
                    flight, t_ns, frame, None if node < 0 else node, bool(made),
                    None if node < 0 else Pose.exp(table["node_from_cam"][k].astype(np.float64)),
                    None if node < 0 else Pose.exp(table["online"][k].astype(np.float64)),
                    reason, detail, matches, inliers, rms, piece, positions[k],
                    {stage: s for stage, s in took if not math.isnan(s)}, revisit,
                )
            )  # fmt: skip
        return entries

    def check(self, n_flights: int, n_nodes: int) -> None:
        """Raises ValueError, KeyError or TypeError when the block makes no sense in its map."""
        if not 0 < self.count <= MOST_FRAMES:
            raise ValueError(f"{self.count} frames in one block")
        table, _ = self._table(len(self._stages()))
        flight, node = table["flight"], table["node"]
        if flight.min() < 0 or flight.max() >= n_flights or node.min() < -1 or node.max() >= n_nodes:
            raise ValueError("a frame of a flight or on a node that does not exist")
        self._notes()
        self._positions()

    def _stages(self) -> list[str]:
        stages = blobs.from_json(self.stages)
        if not isinstance(stages, list) or len(stages) > MOST_STAGES:
            raise ValueError("stages that are none")
        return [str(stage) for stage in stages]

    def _table(self, n_stages: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Columns by name, and seconds (count, stages)."""
        content = _inflate(self.numbers, self.count * (FRAME_BYTES + 2 * n_stages))
        table, at = {}, 0
        for name, kind, numbers in COLUMNS:
            end = at + self.count * numbers * np.dtype(kind).itemsize
            shape = (self.count,) if numbers == 1 else (self.count, numbers)
            table[name] = blobs.unpack(content[at:end], kind, shape, unknown=name == "rms_px")
            at = end
        table["t_ns"], table["frame_index"] = np.cumsum(table["t_ns"]), np.cumsum(table["frame_index"])
        return table, blobs.unpack(content[at:], "<f2", (self.count, n_stages), unknown=True)

    def _positions(self) -> list[GeoPosition | None]:
        if self.positions is None:
            return [None] * self.count
        content = _inflate(self.positions, POSITION_BYTES * self.count)
        rows = [content[at : at + POSITION_BYTES] for at in range(0, len(content), POSITION_BYTES)]
        return [None if row == _NO_POSITION else blobs.unpack_position(row) for row in rows]

    def _notes(self) -> dict[int, tuple[Reason | None, str, Revisit | None]]:
        text = _inflate(self.notes, blobs.LONGEST_TEXT, at_most=True)
        found = {}
        for number, (reason, detail, revisit) in dict(blobs.from_json(text.decode())).items():
            found[int(number)] = (
                None if reason is None else Reason(reason),
                str(detail),
                None if revisit is None else revisit_from_tree(revisit),
            )
        return found


class FrameLog(Packed[FrameEntry]):
    """Frames of the flights in the order in which they were processed."""

    def __init__(self, entries: Iterable[FrameEntry] = ()) -> None:
        super().__init__(FrameBlock.pack, entries)

    @staticmethod
    def of(frames: Sequence[FrameEntry]) -> FrameLog:
        """The frames packed, unless they are."""
        return frames if isinstance(frames, FrameLog) else FrameLog(frames)

    def all_blocks(self) -> list[FrameBlock]:
        """The newest frames as one more block."""
        return [*self.blocks, *([FrameBlock.pack(self.newest)] if self.newest else [])]

    def rehang(self, records: Sequence[FrameRecord]) -> None:
        """Records, of the located frames of the newest flight, were renewed: frames hang by them now."""
        renewed = {record.t_ns: record.node_from_cam for record in records}
        flight = self[-1].flight if len(self) else 0
        entries = [
            replace(entry, node_from_cam=renewed[entry.t_ns])
            if entry.flight == flight and entry.t_ns in renewed
            else entry
            for entry in self
        ]
        self.clear()
        self.extend(entries)


def _tangents(poses: list[Pose | None]) -> FloatArray:
    return np.array([np.zeros(6) if pose is None else pose.log() for pose in poses])


def _inflate(content: bytes, size: int, *, at_most: bool = False) -> bytes:
    """Raises ValueError for what is no deflated text, or of another size: nothing larger is unpacked."""
    inflater = zlib.decompressobj()
    try:
        text = inflater.decompress(content, size + 1)
    except zlib.error as error:
        raise ValueError(f"cannot be inflated: {error}") from error
    if len(text) > size or (len(text) != size and not at_most) or not inflater.eof:
        raise ValueError(f"{len(text)} bytes where {size} belong")
    return text


def revisit_from_tree(tree: dict[str, Any]) -> Revisit:
    """Raises ValueError, KeyError or TypeError for what is none."""
    known = {name: value for name, value in tree.items() if name in Revisit.__dataclass_fields__}
    known["status"] = RevisitStatus(tree["status"])
    known["reason"] = None if tree["reason"] is None else Reason(tree["reason"])
    known["confirmed"] = tuple((int(older), int(newer)) for older, newer in tree["confirmed"])
    return Revisit(**known)
