"""Place revisiting (paper, section IV): has the camera been here before, and what does the map gain by knowing it?

For every new node: the nodes inside the three-sigma region of its pose, by the covariance of the graph and a spatial index; of those
the ones whose descriptors the best-matched features vote for; a registration against them; its verification; and a
constraint, if the map does not know as much already.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from overfly.config import RevisitSettings
from overfly.geometry.poses import FloatArray
from overfly.graph.covariance import tangent_covariance
from overfly.graph.online import Decision, OnlineOptimiser, gate_bound
from overfly.revisit.descriptors import DescriptorBlocks, comparable
from overfly.revisit.outcome import Revisit, RevisitStatus
from overfly.revisit.region import (
    FootprintIndex,
    footprint_radius,
    ground_places,
    ground_sigma,
    on_ground,
    pixel_sigma,
)
from overfly.revisit.verification import Query, Verifier
from overfly.types import Constraint, IntArray, NotFound, Reason
from overfly.vision.odometry import Reference
from overfly.visual_map import Node, VisualMap

RELATIVE_REACH = 0.5  # of both views' radii: footprints nearer than that share a third of their area


@dataclass(frozen=True, slots=True, eq=False)
class Waiting:
    """A revisit that no second one has confirmed yet."""

    constraint: Constraint
    inliers: int


class Places:
    """Finds again what the map holds. Nodes enter when they are no longer among the newest."""

    def __init__(
        self, visual_map: VisualMap, optimiser: OnlineOptimiser, verifier: Verifier, settings: RevisitSettings
    ) -> None:
        self._map = visual_map
        self._optimiser = optimiser
        self._verifier = verifier
        self._settings = settings
        self._blocks = DescriptorBlocks(verifier.extractor.metric)
        self._footprints = FootprintIndex()
        self._heights: list[float] = []  # of the indexed nodes above their ground
        self._waiting: list[Waiting] = []
        self._bound = gate_bound(settings.sigmas, 6)

    def seek(self, index: int, query: Query, first_rows: IntArray) -> Revisit:
        """Look for the place that the new node ``index`` shows; tie it to an older node if that helps.

        first_rows: the query's features to search with, best first.
        """
        began = time.perf_counter()
        self._index(index - self._settings.away)
        outcome = self._seek(index, query, first_rows)
        return replace(outcome, seconds=time.perf_counter() - began)

    # -- the steps of seek

    def _seek(self, index: int, query: Query, first_rows: IntArray) -> Revisit:
        candidates = self._candidates(index)
        if len(candidates) == 0:
            return Revisit(RevisitStatus.NONE_NEAR)
        group = self._shortlist(candidates, query, first_rows)
        if len(group) == 0:
            return Revisit(
                RevisitStatus.REJECTED,
                len(candidates),
                reason=Reason.FEW_MATCHES,
                detail="no node looks alike",
            )
        pose = self._map.graph.pose(index)
        height = self._height(index)
        radius_px = self._radius_px(group, index, height)
        guided = radius_px < self._settings.guided_share * self._verifier.camera.width
        located, n_matches = self._verifier.register(
            query, self._references(group), pose if guided else None, radius_px, self._height_range(group)
        )
        found = Revisit(RevisitStatus.REJECTED, len(candidates), matches=n_matches)
        if isinstance(located, NotFound):
            return replace(found, reason=located.reason, detail=located.detail)
        main = located.main_node
        found = replace(found, node=main, inliers=len(located.estimate.inliers))
        constraint = self._verifier.constraint_of(located, self._map.graph.pose(main), index, query, height)
        innovation = self._optimiser.innovation(constraint)
        if innovation > self._bound:
            return replace(found, reason=Reason.OUTSIDE_GATE, detail=f"innovation {innovation:.0f}")
        if not guided:
            return self._wait_or_confirm(found, constraint)
        return self._accept(found, constraint)

    def _accept(self, found: Revisit, constraint: Constraint) -> Revisit:
        if not self._is_useful(constraint):
            return replace(found, status=RevisitStatus.ACCEPTED)
        outcome = self._optimiser.add(constraint)
        self._follow(outcome.moved)
        if outcome.decision is Decision.REJECTED:
            return replace(found, reason=outcome.reason)
        return replace(
            found, status=RevisitStatus.ACCEPTED, constraint=outcome.constraint, moved=len(outcome.moved) > 0
        )

    def _wait_or_confirm(self, found: Revisit, constraint: Constraint) -> Revisit:
        """A revisit in a wide region counts when another one from a different node says the same."""
        for waiting in reversed(self._waiting):
            if self._agree(waiting.constraint, constraint):
                self._waiting.remove(waiting)
                first = self._optimiser.add(waiting.constraint)
                self._follow(first.moved)
                accepted = self._accept(found, constraint)
                if first.decision is Decision.REJECTED:
                    return accepted
                pair = (waiting.constraint.i, waiting.constraint.j)
                return replace(accepted, confirmed=(pair,), moved=accepted.moved or len(first.moved) > 0)
        self._waiting.append(Waiting(constraint, found.inliers))
        del self._waiting[: -self._settings.most_waiting]
        return replace(
            found, status=RevisitStatus.WAITING, reason=Reason.INCONSISTENT, detail="waits for a second one"
        )

    def _agree(self, a: Constraint, b: Constraint) -> bool:
        """Whether two revisits fit each other: around the loop i_a, j_a, j_b, i_b nothing is left over (Mangelsson 2018)."""
        graph = self._map.graph
        ib_from_ia = graph.pose(b.i).inverse() @ graph.pose(a.i)
        ja_from_jb = graph.pose(a.j).inverse() @ graph.pose(b.j)
        predicted = ib_from_ia @ a.i_from_j @ ja_from_jb  # ib_from_jb
        residual = (b.i_from_j.inverse() @ predicted).log()
        carry = ja_from_jb.inverse().adjoint()
        covariance = tangent_covariance(b.information, False)
        covariance = covariance + carry @ tangent_covariance(a.information, False) @ carry.T
        if a.j != b.j:
            covariance = covariance + self._optimiser.relative_covariance(a.j, b.j)
        if a.i != b.i:
            carry = (predicted.inverse() @ ib_from_ia).adjoint()
            covariance = covariance + carry @ self._optimiser.relative_covariance(b.i, a.i) @ carry.T
        return float(residual @ np.linalg.solve(covariance, residual)) <= self._bound

    def _is_useful(self, constraint: Constraint) -> bool:
        """Whether the constraint knows some direction much better than the map does already."""
        relative = self._optimiser.relative_covariance(constraint.i, constraint.j)
        gain = np.linalg.eigvals(
            relative @ (constraint.information / np.outer(HALF_ANGLE, HALF_ANGLE))
        ).real.max()
        return bool(gain > self._settings.least_gain**2)

    def _follow(self, moved: IntArray) -> None:
        """Nodes moved: their footprints go with them."""
        inside = moved[moved < len(self._footprints)]
        if len(inside):
            heights = np.array(self._heights)[inside]
            self._footprints.move(inside, ground_places(self._map.graph, inside, heights))

    # -- where to look

    def _index(self, count: int) -> None:
        """Take in nodes until ``count`` are known."""
        for index in range(len(self._blocks), count):
            node = self._map.nodes[index]
            height = self._height(index)
            pose = self._map.graph.pose(index)
            sigma = ground_sigma(self._optimiser.covariance(index), pose.rotation, height)
            self._blocks.add(node.features)
            self._heights.append(height)
            radius = RELATIVE_REACH * footprint_radius(self._verifier.camera, height)
            self._footprints.add(on_ground(pose, height), radius, sigma)

    def _height(self, index: int) -> float:
        """Height of a node above its ground: median depth of its points."""
        node = self._map.nodes[index]
        depth = node.points_in_cam[node.has_point, 2]
        return float(np.median(depth)) if len(depth) else float(self._map.graph.positions[index, 2])

    def _candidates(self, index: int) -> IntArray:
        """Older nodes, nearest first, that may show the same ground."""
        pose, height = self._map.graph.pose(index), self._height(index)
        sigma = ground_sigma(self._optimiser.covariance(index), pose.rotation, height)
        radius = RELATIVE_REACH * footprint_radius(self._verifier.camera, height)
        return self._footprints.within(on_ground(pose, height), radius, sigma, self._settings.sigmas)

    def _shortlist(self, candidates: IntArray, query: Query, first_rows: IntArray) -> IntArray:
        """The node that looks most like the view, and its neighbours that do as well."""
        settings = self._settings
        near = candidates[: settings.most_candidates]
        rows = first_rows[: settings.query_features]
        words = comparable(query.features.descriptors[rows], self._blocks.metric)
        votes = self._blocks.votes(words, near, self._verifier.extractor.max_distance)
        best = int(np.argmax(votes))
        if votes[best] < settings.least_votes:
            return np.empty(0, np.int64)
        graph, heights = self._map.graph, np.array(self._heights)
        places = ground_places(graph, near, heights[near])
        beside = np.linalg.norm(places - places[best], axis=1) < heights[near[best]]
        order = np.argsort(-votes, kind="stable")
        chosen = order[beside[order] & (votes[order] >= max(settings.least_votes, 0.5 * votes[best]))]
        return near[chosen[: settings.group]]

    def _radius_px(self, group: IntArray, index: int, height: float) -> float:
        """How far from their prediction features may be: three sigma by the covariances between the nodes."""
        sigma = max(
            pixel_sigma(self._optimiser.relative_covariance(int(node), index), self._verifier.camera, height)
            for node in group
        )
        return self._settings.sigmas * sigma + self._verifier.registrar.config.registration.image_limit_px * 2

    def _references(self, group: IntArray) -> list[Reference]:
        nodes: list[Node] = [self._map.nodes[int(index)] for index in group]
        return [
            Reference(
                node.index, node.features, self._map.points_in_world(node), self._map.spread_in_world(node)
            )
            for node in nodes
        ]

    def _height_range(self, group: IntArray) -> tuple[float, float]:
        change = self._verifier.registrar.config.registration.height_change
        z = self._map.graph.positions[group, 2]
        return float(z.min()) / change, float(z.max()) * change


HALF_ANGLE: FloatArray = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])  # see odometry.information_of_constraint
