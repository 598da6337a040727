"""What a loop over frames tells whoever watches; nobody, mostly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from overfly.frame_result import FrameResult
from overfly.localizer import Fix
from overfly.types import Frame


class Viewer(Protocol):
    """Watches a loop without holding it up."""

    def show_frame(self, frame: Frame, result: FrameResult | Fix) -> None:
        """A frame was processed."""

    def close(self) -> None:
        """The loop is over."""


class NullViewer:
    """Nobody watches."""

    def show_frame(self, frame: Frame, result: FrameResult | Fix) -> None:
        pass

    def close(self) -> None:
        pass


@dataclass(frozen=True, slots=True)
class Viewers:
    """Several that watch the same loop."""

    watching: Sequence[Viewer]

    def show_frame(self, frame: Frame, result: FrameResult | Fix) -> None:
        for viewer in self.watching:
            viewer.show_frame(frame, result)

    def close(self) -> None:
        for viewer in self.watching:
            viewer.close()
