"""The live map with controls: click a place, the vehicle goes there; hold, stop, return to start.

The page asks, the control loop decides: orders go into a queue, and what is drawn as the target is what the
loop says it is heading for.
"""

from __future__ import annotations

from dataclasses import dataclass
from queue import SimpleQueue

import numpy as np
import viser

from overfly.frame_result import FrameResult
from overfly.localizer import Fix
from overfly.navigation.commands import Command, GoTo, Hold, ReturnToStart, Stop
from overfly.types import Frame
from overfly.viewer.live import LiveViewer
from overfly.viewer.measuring import Measurement
from overfly.viewer.moment import Moment
from overfly.viewer.panel import badge, length, table

TARGET = (255, 196, 0)
GOOD, POOR, NONE = "#1b8a4b", "#b26a00", "#c62828"
POOR_SHARE = 0.05  # of the flying height: a standard deviation larger than this is no good fix


@dataclass(frozen=True, slots=True)
class FlightReport:
    """What the control loop says of the flight. status: in words; target (x, y) metres, world; lost_s: time
    without a fix; refused: why the last order was not obeyed.
    """

    status: str
    target: tuple[float, float] | None = None
    lost_s: float = 0.0
    refused: str = ""


class GroundStation:
    """orders: what the operator asked for, to be taken out by the control loop."""

    def __init__(self, live: LiveViewer, orders: SimpleQueue[Command]) -> None:
        """Adds its controls to the page of a live view."""
        self.live = live
        self.orders = orders
        self._report: FlightReport | None = None
        self._label = ""
        self._target: tuple[float, float] | None = None
        server = live.page.server
        with live.top:
            self._state = server.gui.add_html(badge("waiting for the vehicle", "#777"))
            for text, order, colour, icon in (
                ("Hold", Hold(), None, viser.Icon.ANCHOR),
                ("Return to start", ReturnToStart(), None, viser.Icon.HOME),
                ("Stop", Stop(), "red", viser.Icon.HAND_STOP),
            ):
                self._add_button(text, order, colour, icon)
            self._asked = server.gui.add_markdown("Click on the ground: the vehicle goes there.")
        live.on_place = self._go_to
        live.tells_state = False  # that stands above the buttons
        live.on_tick.append(self._draw)

    def show(self, frame: Frame, result: FrameResult | Fix, report: FlightReport) -> None:
        """A frame was processed and answered with a command. Called in the loop's thread, returns at once."""
        self._report = report
        self.live.show_frame(frame, result)

    def close(self) -> None:
        self.live.close()

    def _add_button(self, text: str, order: Command, colour: str | None, icon: viser.IconName) -> None:
        gui = self.live.page.server.gui
        button = gui.add_button(text, color=colour, icon=icon)  # type: ignore[arg-type]
        button.on_click(lambda _event: self._ask(order, text))

    def _go_to(self, measurement: Measurement) -> None:
        x, y = (float(value) for value in measurement.place[:2])
        self._ask(GoTo(x, y), f"Go to x {x:.2f} m, y {y:.2f} m")

    def _ask(self, order: Command, words: str) -> None:
        self.orders.put(order)
        self._asked.content = f"Asked: **{words}**"

    def _draw(self, moment: Moment) -> None:
        """In the drawing thread."""
        report = self._report
        if report is None:
            return
        quality, colour = fix_quality(moment, report, self.live.unit_m)
        rows = [("status", report.status)]
        if report.target is not None and moment.pose is not None:
            away = float(np.hypot(*(np.array(report.target) - moment.pose.translation[:2])))
            rows.append(
                ("target", f"x {report.target[0]:.2f}, y {report.target[1]:.2f} m; {away:.2f} m away")
            )
        if report.refused:
            rows.append(("refused", report.refused))
        self._state.content = badge(quality, colour) + table(rows)
        label = f"Overfly: {quality}"  # the title stays when the panel is folded
        if label != self._label:
            self._label = label
            self.live.page.server.gui.set_panel_label(label)
        self._draw_target(report.target)

    def _draw_target(self, target: tuple[float, float] | None) -> None:
        if target == self._target or self.live.unit_m is None:
            return
        self._target = target
        scene, unit_m = self.live.page.server.scene, self.live.unit_m
        if target is None:
            scene.remove_by_name("/target")
            return
        place = np.array([*target, self.live.ground_m])
        scene.add_cylinder(
            "/target", radius=0.06 * unit_m, height=0.02 * unit_m, color=TARGET, position=place,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip


def fix_quality(moment: Moment, report: FlightReport, unit_m: float | None) -> tuple[str, str]:
    """In words, and the colour that goes with it."""
    if moment.pose is None or report.lost_s > 0.0:
        return f"no fix for {report.lost_s:.1f} s: {moment.reason or report.status}", NONE
    poor = moment.sigma_m is None or (unit_m is not None and moment.sigma_m > POOR_SHARE * unit_m)
    return f"fix \u00b1 {length(moment.sigma_m)}", POOR if poor else GOOD
