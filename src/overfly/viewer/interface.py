"""What a loop over frames tells whoever watches; nobody, mostly."""

from __future__ import annotations

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
