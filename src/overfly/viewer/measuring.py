"""Clicks on the ground: where they are, and how far it is from the last one to the next."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser

from overfly.geometry.poses import FloatArray
from overfly.products.georeference import GeoReference, transform_points
from overfly.viewer.ground import Surface

MARKS = ((255, 82, 82), (64, 196, 255))
LINE = (255, 255, 255)


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """The last click (3,) metres, world, and the one before it."""

    place: FloatArray
    before: FloatArray | None = None

    @property
    def distance_m(self) -> float | None:
        """In the plane."""
        if self.before is None:
            return None
        return math.hypot(*(self.place - self.before)[:2].tolist())


def describe(measurement: Measurement, reference: GeoReference | None = None) -> str:
    """A few lines of Markdown for a person."""
    lines = []
    if measurement.before is not None:
        lines.append(f"**A** {coordinates(measurement.before)}")
    lines.append(f"**{'A' if measurement.before is None else 'B'}** {coordinates(measurement.place)}")
    if reference is not None:
        east, north = transform_points(reference.crs_from_world(), measurement.place[:2])
        lines.append(f"{reference.crs}: {east:.2f} E, {north:.2f} N")
    if measurement.before is not None:
        rise = round(float(measurement.place[2] - measurement.before[2]), 2) + 0.0
        lines.append(f"**distance {measurement.distance_m:.2f} m**, height difference {rise:+.2f} m")
    else:
        lines.append("click a second place for the distance")
    return "\n\n".join(lines)


def coordinates(place: FloatArray) -> str:
    x, y, z = place.round(2) + 0.0  # no "-0.00"
    return f"x {x:.2f} m, y {y:.2f} m, z {z:.2f} m"


class GroundClicks:
    """Marks clicked places and hands them on. surface: a function, because the ground of a live map grows."""

    def __init__(
        self,
        server: viser.ViserServer,
        surface: Callable[[], Surface | None],
        mark_m: float,
        on_place: Callable[[Measurement], None],
        marks: bool = True,
    ) -> None:
        """mark_m: size of the marks; marks: draw them, and the line between two."""
        self._scene = server.scene
        self._surface = surface
        self._mark_m = mark_m
        self._on_place = on_place
        self._marks = marks
        self._last: Measurement | None = None
        server.scene.on_click()(self._clicked)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        surface = self._surface()
        if surface is None:
            return
        place = surface.meet(np.array(event.ray_origin), np.array(event.ray_direction))
        if place is None:
            return
        pair_is_full = self._last is not None and self._last.before is not None
        before = None if self._last is None or pair_is_full else self._last.place
        self._last = Measurement(place, before)
        if self._marks:
            self._draw(self._last)
        self._on_place(self._last)

    def _draw(self, measurement: Measurement) -> None:
        raised = np.array([0.0, 0.0, self._mark_m])
        self._mark(0 if measurement.before is None else 1, measurement.place + raised)
        if measurement.before is None:
            for name in ("/clicks/1", "/clicks/line", "/clicks/distance"):
                self._scene.remove_by_name(name)
            return
        ends = np.array([[measurement.before + raised, measurement.place + raised]], np.float32)
        self._scene.add_line_segments("/clicks/line", ends, LINE, thickness=2.0, thickness_units="screen")
        self._scene.add_label(
            "/clicks/distance", f"{measurement.distance_m:.2f} m", position=ends[0].mean(axis=0),
            anchor="bottom-center",
        )  # fmt: skip

    def _mark(self, number: int, place: FloatArray) -> None:
        self._scene.add_icosphere(
            f"/clicks/{number}", self._mark_m, color=MARKS[number], position=place, cast_shadow=False,
            receive_shadow=False,
        )  # fmt: skip
