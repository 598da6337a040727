"""What commands share at the terminal: progress, and how an interrupted run ends."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from overfly.frame_result import FrameResult

INTERRUPTED = 130
PLAIN_LINE_EVERY_S = 5.0
PATIENCE_S = 2.0  # without a frame; then a first start says why


def say(text: str) -> None:
    """A line on stderr, at once."""
    print(text, file=sys.stderr, flush=True)


def exit_interrupted() -> int:
    """Say that the run was ended early and what was kept; the exit code of an interrupted program."""
    say("overfly: interrupted; what was finished is kept")
    return INTERRUPTED


def announce_page(url: str) -> None:
    """Say where the live page is, and open it for a person."""
    say(f"watch it at {url}")
    if sys.stdout.isatty():
        typer.launch(url)


def announce_compiling() -> None:
    """Say on stderr that a first start compiles; nothing when an earlier start did."""
    from overfly.threads import is_compiled

    if not is_compiled():
        say("first start: compiling, once, about a minute")


class FrameProgress:
    """Counts frames on stderr: one line that rewrites itself on a terminal, a plain line now and then
    elsewhere.
    """

    def __init__(self) -> None:
        self._begin = time.monotonic()
        self._shown = self._begin
        self._why_waiting = threading.Timer(PATIENCE_S, announce_compiling)
        self._why_waiting.daemon = True
        self._located = 0
        self._on_terminal = sys.stderr.isatty()

    def __enter__(self) -> FrameProgress:
        self._why_waiting.start()
        return self

    def __call__(self, n_frames: int, result: FrameResult) -> None:
        self._why_waiting.cancel()
        self._located += result.pose is not None
        now = time.monotonic()
        if now - self._shown < (0.1 if self._on_terminal else PLAIN_LINE_EVERY_S):
            return
        self._shown = now
        rate = n_frames / max(now - self._begin, 1e-9)
        text = f"{n_frames} frames, {self._located} located, {rate:.1f} frames/s"
        print(
            f"\r{text}   " if self._on_terminal else text,
            end="" if self._on_terminal else "\n",
            file=sys.stderr,
        )
        sys.stderr.flush()

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._why_waiting.cancel()
        if self._on_terminal and self._shown != self._begin:
            print(file=sys.stderr)
