"""Place revisiting (paper, section IV): has the camera been here before, and what does the map gain by
knowing it?

For every new node: the nodes inside the three-sigma region of its pose, by the covariance of the graph and
a spatial index; of those the ones whose descriptors the best-matched features vote for; a registration
against them; its verification; and a constraint, if the map does not know as much already. When the camera
is lost the region is the whole map, and the same verification decides.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np

from overfly.config import RevisitSettings
from overfly.graph.online import Decision, OnlineOptimiser
from overfly.pieces import lay_onto
from overfly.revisit.agreement import Waiting, WaitingRoom
from overfly.revisit.doubts import Doubts
from overfly.revisit.drift import believe_more_drift, map_bend
from overfly.revisit.evidence import Evidence
from overfly.revisit.found import Doubt, Found, Sighting
from overfly.revisit.index import PlaceIndex
from overfly.revisit.outcome import Revisit, RevisitStatus
from overfly.revisit.pool import Expectation, Pool, widest
from overfly.revisit.region import on_ground
from overfly.revisit.uncertainty import Uncertainty, pixel_sigmas, region_bound
from overfly.revisit.verification import (
    Query,
    Verifier,
    n_distinct,
    pool_of_nodes,
    surroundings_at,
)
from overfly.types import BoolArray, Constraint, IntArray, NotFound, Reason
from overfly.vision.odometry import Located
from overfly.visual_map import VisualMap

NS_PER_S = 1e9
NOTHING_ALIKE = "no node looks alike"
SURPRISE = 3.0  # how many times larger than believed the drift may be, if several views of the place say so
NOT_THERE = (Reason.FEW_MATCHES, Reason.NO_HYPOTHESIS, Reason.FEW_INLIERS, Reason.OUTSIDE_GATE)
LONGEST_WAIT_S = 3.0  # between two sightings of a lost camera that are to confirm each other


class Places:
    """Finds again what the map holds."""

    def __init__(
        self, visual_map: VisualMap, optimiser: OnlineOptimiser, verifier: Verifier, settings: RevisitSettings
    ) -> None:
        self._map = visual_map
        self._optimiser = optimiser
        self._verifier = verifier
        self._settings = settings
        self._uncertainty = Uncertainty(visual_map.graph, optimiser)
        self._index = PlaceIndex(visual_map, self._uncertainty, verifier.camera, verifier.extractor, settings)
        self._sighting: Sighting | None = None
        self._bound = region_bound(settings.sigmas)
        self._waiting = WaitingRoom(visual_map, self._uncertainty, self._index, settings)
        self._doubts = Doubts(visual_map, self._uncertainty, self._index, verifier, settings)
        self._evidence = Evidence(visual_map, self._index, verifier)

    def rescale(self, factor: float) -> None:
        """All lengths of the map were multiplied: what waits to be confirmed was measured in the old ones."""
        self._uncertainty.refresh()
        self._index.rescale(factor)
        self._waiting.clear()
        self._evidence.clear()
        self._sighting = None

    def seek(self, index: int, query: Query, first_rows: IntArray) -> Revisit:
        """Look for the place that the new node ``index`` shows; tie it to an older node if that helps.

        first_rows: rows of the query's features to search with, best first.
        """
        began = time.perf_counter()
        outcome = self._seek(index, query, first_rows)
        return replace(outcome, seconds=time.perf_counter() - began)

    def prepare(self) -> None:
        """Take in the whole map, so that no search has to wait for it."""
        self._uncertainty.refresh()
        self._index.take_in(len(self._map))
        self._index.grow_trees()

    def tend(self) -> None:
        """A frame in which nothing is sought does its share of the work that nodes leave behind."""
        self._uncertainty.refresh()
        self._index.take_in(len(self._map) - self._settings.away)  # as the next node will at least
        self._index.tend()

    def enter(self, tie: Constraint) -> Revisit:
        """A constraint between two nodes that both see what the camera sees now: entered if the map gains by
        it and it lies inside the gate."""
        self._uncertainty.refresh()
        innovation = self._uncertainty.innovation(tie)
        report = Revisit(RevisitStatus.REJECTED, 1, node=tie.i)
        if innovation > self._bound:
            return replace(report, reason=Reason.OUTSIDE_GATE, detail=f"innovation {innovation:.0f}")
        return self._accept(report, tie)

    def relocalise(
        self, query: Query, t_ns: int, among: IntArray | None = None
    ) -> tuple[Located | NotFound, Revisit]:
        """Find a lost camera anywhere in the map: its pose, or why there is none yet. among: the only nodes
        that count."""
        began = time.perf_counter()
        self._uncertainty.refresh()
        self._index.take_in(len(self._map))
        located, outcome = self._search_everywhere(query, t_ns, among)
        return located, replace(outcome, seconds=time.perf_counter() - began)

    # -- a new node

    def _seek(self, index: int, query: Query, first_rows: IntArray) -> Revisit:
        self._uncertainty.refresh()
        piece = self._map.pieces()
        oldest_tied = max(0, index - self._settings.away)
        if gap := self._map.after_gap(index):  # only a bridge ties what is older
            oldest_tied = max(oldest_tied, gap)
        self._index.take_in(max(oldest_tied, int(piece[index])))
        may_be = piece[:oldest_tied] == piece[index]
        outcome = self._seek_in_region(index, query, first_rows, may_be)
        if outcome.status is RevisitStatus.NONE_NEAR or outcome.reason in NOT_THERE:
            beyond = self._seek_beyond(index, query, first_rows, may_be)
            outcome = outcome if beyond is None else beyond
        others = np.flatnonzero(piece[: len(self._index)] != piece[index])
        if len(others) == 0 or outcome.status is RevisitStatus.ACCEPTED:
            return outcome
        elsewhere = self._seek_in_pieces(index, query, others)
        return outcome if elsewhere.status is RevisitStatus.REJECTED else elsewhere

    def _seek_in_region(self, index: int, query: Query, first_rows: IntArray, may_be: BoolArray) -> Revisit:
        """Among the nodes that may be it (m,) those inside the three-sigma region."""
        candidates = self._index.near(index)
        candidates = candidates[candidates < len(may_be)]
        candidates = candidates[may_be[candidates]]
        if len(candidates) == 0:
            return Revisit(RevisitStatus.NONE_NEAR)
        rows = first_rows[: self._settings.query_features]
        groups = self._index.groups(query.features, rows, candidates)
        report = Revisit(
            RevisitStatus.REJECTED, len(candidates), reason=Reason.FEW_MATCHES, detail=NOTHING_ALIKE
        )
        found, report = self._register(groups, index, query, report)
        if not found:
            return report
        best = max(found, key=lambda one: n_distinct(one.located))
        main = best.located.main_node
        report = replace(report, node=main, inliers=n_distinct(best.located), reason=None, detail="")
        constraint = self._constraint_of(best.located, index, query)
        innovation = self._uncertainty.innovation(constraint)
        if innovation > self._bound:
            return replace(report, reason=Reason.OUTSIDE_GATE, detail=f"innovation {innovation:.0f}")
        return self._enter(report, constraint, self._doubts.of(best, found, query, constraint))

    def _seek_beyond(
        self, index: int, query: Query, first_rows: IntArray, may_be: BoolArray
    ) -> Revisit | None:
        """Outside the region, when nothing inside it is the place: odometry may have drifted further than its
        covariance says, as over ground with little texture.

        That takes what a lost camera needs to be found at once, and others that agree. None where there is
        nothing like it.
        """
        candidates = self._index.near(index, SURPRISE)
        candidates = candidates[candidates < len(may_be)]
        candidates = candidates[may_be[candidates]]
        if len(candidates) == 0:
            return None
        rows = first_rows[: self._settings.query_features]
        groups = self._index.groups(query.features, rows, candidates)
        report = Revisit(RevisitStatus.REJECTED, len(candidates))
        found, report = self._register(groups, None, query, report)
        if not found:
            return None
        best = max(found, key=lambda one: n_distinct(one.located))
        constraint = self._constraint_of(best.located, index, query)
        surprising = self._uncertainty.innovation(constraint) > SURPRISE**2 * self._bound
        if surprising or self._doubts.of(best, found, query, constraint) is not Doubt.NONE:
            return None
        report = replace(report, node=constraint.i, inliers=n_distinct(best.located), reason=None, detail="")
        return self._wait_or_confirm(report, constraint)

    def _seek_in_pieces(self, index: int, query: Query, others: IntArray) -> Revisit:
        """Dead reckoning does not tell where pieces of the map are against each other: the place may be
        anywhere in the others."""
        rows = np.arange(min(len(query.features), self._settings.lost_features))
        groups = self._index.groups(query.features, rows, others)
        report = Revisit(RevisitStatus.REJECTED, len(others), reason=Reason.FEW_MATCHES, detail=NOTHING_ALIKE)
        found, report = self._register(groups, None, query, report)
        if found:
            best = max(found, key=lambda one: n_distinct(one.located))
            report = replace(report, node=best.located.main_node, inliers=n_distinct(best.located))
            constraint = self._constraint_of(best.located, index, query)
            report = self._enter(report, constraint, self._doubts.of(best, found, query, None))
            if report.status is RevisitStatus.ACCEPTED:
                return report
        return self._weigh(report, index, query, found)

    def _weigh(self, report: Revisit, index: int, query: Query, found: list[Found]) -> Revisit:
        """Where one view does not tell, many may, each place that they fit compared with each other."""
        places = [one.located for one in found]
        for one in found:
            rival = self._doubts.rival(one, query)
            if rival is not None and n_distinct(rival) >= self._settings.min_inliers:
                places.append(rival)
        self._evidence.add(index, query, sorted(places, key=n_distinct, reverse=True))
        believed = self._evidence.believed(self._settings.least_apart)
        if believed is None:
            return report
        report = replace(report, node=believed.located.main_node, inliers=n_distinct(believed.located))
        constraint = self._constraint_of(believed.located, believed.node, believed.query)
        innovation = self._uncertainty.innovation(constraint)
        if innovation > self._bound:  # ground can repeat itself over longer ways than one piece shows
            detail = f"not where dead reckoning can be: innovation {innovation:.0f}"
            return replace(report, reason=Reason.OUTSIDE_GATE, detail=detail)
        return self._accept(report, constraint)

    def _enter(self, report: Revisit, constraint: Constraint, doubt: Doubt) -> Revisit:
        """Believe the revisit, keep it until others agree, or reject it."""
        if doubt not in (Doubt.NONE, Doubt.WEAK):
            return replace(report, reason=Reason.IMPLAUSIBLE, detail=str(doubt))
        if doubt is Doubt.NONE:
            return self._accept(report, constraint)
        return self._wait_or_confirm(report, constraint)

    def _register(
        self, groups: list[IntArray], index: int | None, query: Query, report: Revisit
    ) -> tuple[list[Found], Revisit]:
        """Register with one group after the other; in a narrow region the first that fits is the only one."""
        found = []
        height_change = self._verifier.registrar.config.registration.height_change
        for group in groups:
            pool = pool_of_nodes(self._map, group, self._verifier.extractor.metric)
            around = surroundings_at(self._map, group, height_change)
            expected = None if index is None else self._expected(pool, index)
            located, n_matches = self._verifier.register(query, pool, expected, around)
            report = replace(report, matches=max(report.matches, n_matches))
            if isinstance(located, NotFound):
                report = replace(report, reason=located.reason, detail=located.detail)
                continue
            reach_px = math.inf if expected is None else widest(pool, expected)
            found.append(Found(group, pool, around, expected, reach_px, located))
            if expected is not None and not self._doubts.is_wide(found[-1]):
                break
        return found, report

    def _constraint_of(self, located: Located, index: int, query: Query) -> Constraint:
        main = located.main_node
        return self._verifier.constraint_of(
            located,
            self._map.graph.pose(main),
            index,
            query,
            self._index.height(index),
            map_bend(self._map),
            bool(np.isfinite(self._map.nodes[main].inverse_depth).any()),
        )

    def _accept(self, report: Revisit, constraint: Constraint) -> Revisit:
        """Enter the constraint if the map gains by it."""
        if self._joins(constraint):
            report = replace(report, moved=True)
        accepted = replace(report, status=RevisitStatus.ACCEPTED, reason=None, detail="")
        if self._uncertainty.gain(constraint) < self._settings.least_gain:
            return accepted
        outcome = self._optimiser.add(constraint)
        self._uncertainty.refresh()
        self._index.follow(outcome.moved)
        moved = report.moved or len(outcome.moved) > 0
        if outcome.decision is Decision.REJECTED:
            return replace(report, reason=outcome.reason, moved=moved)
        return replace(accepted, constraint=outcome.constraint, moved=moved)

    def _joins(self, constraint: Constraint) -> bool:
        """Where the constraint ties two pieces of the map, lay the newer one onto the older."""
        piece, graph = self._map.pieces(), self._map.graph
        i, j = constraint.i, constraint.j
        if piece[i] == piece[j]:
            return False
        newer, found = j, graph.pose(i) @ constraint.i_from_j
        if piece[i] > piece[j]:
            newer, found = i, graph.pose(j) @ constraint.i_from_j.inverse()
        nodes = np.flatnonzero(piece == piece[newer])
        lay_onto(graph, nodes, found, graph.pose(newer))
        self._evidence.clear()
        self._optimiser.refresh()
        self._uncertainty.refresh()
        self._index.follow(nodes)
        return True

    def _wait_or_confirm(self, report: Revisit, constraint: Constraint) -> Revisit:
        """In a region where another place might look alike, a revisit counts when others, over other ground,
        say the same; until then it waits for them."""
        confirming = self._waiting.confirming(Waiting(constraint, report.inliers))
        if confirming is None:
            return replace(
                report, status=RevisitStatus.WAITING, reason=Reason.INCONSISTENT, detail="waits for others"
            )
        innovation = self._uncertainty.innovation(constraint)
        if self._map.pieces()[constraint.i] == self._map.pieces()[constraint.j] and innovation > self._bound:
            believe_more_drift(self._map.graph, constraint, innovation)
            self._optimiser.refresh()
            self._uncertainty.refresh()
        confirmed: tuple[tuple[int, int], ...] = ()
        moved = False
        for waiting in confirming:
            earlier = self._accept(report, waiting.constraint)
            moved |= earlier.moved
            if earlier.status is RevisitStatus.ACCEPTED:
                confirmed += ((waiting.constraint.i, waiting.constraint.j),)
        return replace(self._accept(replace(report, moved=moved), constraint), confirmed=confirmed)

    def _expected(self, pool: Pool, index: int) -> Expectation:
        """Where the points of nodes should be seen from the new node: three sigma by the covariance between
        both."""
        pose = self._map.graph.pose(index)
        slack = self._verifier.registrar.config.registration.image_limit_px * self._verifier.px_scale
        points = pose.inverse().transform(pool.points)
        covariances = self._uncertainty.relatives(pool.nodes, index)
        sigmas = [
            pixel_sigmas(pool.of(points, number), covariance, self._verifier.camera)
            for number, covariance in enumerate(covariances)
        ]
        return Expectation(pose, self._settings.sigmas * np.concatenate(sigmas) + slack)

    # -- a lost camera

    def _search_everywhere(
        self, query: Query, t_ns: int, among: IntArray | None
    ) -> tuple[Located | NotFound, Revisit]:
        rows = np.arange(min(len(query.features), self._settings.lost_features))
        groups = self._index.groups(query.features, rows, among)
        report = Revisit(
            RevisitStatus.REJECTED, len(self._index), reason=Reason.FEW_MATCHES, detail=NOTHING_ALIKE
        )
        found, report = self._register(groups, None, query, report)
        if not found:
            return NotFound(report.reason or Reason.FEW_MATCHES, report.detail), report
        best = max(found, key=lambda one: n_distinct(one.located))
        located = best.located
        report = replace(report, node=located.main_node, inliers=n_distinct(located))
        doubt = self._doubts.of(best, found, query, None)
        if doubt not in (Doubt.NONE, Doubt.WEAK):
            return NotFound(Reason.IMPLAUSIBLE, doubt), replace(
                report, reason=Reason.IMPLAUSIBLE, detail=str(doubt)
            )
        confirmed = doubt is Doubt.NONE or self._was_near(located, t_ns)
        self._sighting = None if confirmed else Sighting(t_ns, located)
        if confirmed:
            return located, replace(report, status=RevisitStatus.ACCEPTED, reason=None, detail="")
        report = replace(
            report, status=RevisitStatus.WAITING, reason=Reason.INCONSISTENT, detail="waits for a second one"
        )
        return NotFound(Reason.INCONSISTENT, report.detail), report

    def _was_near(self, located: Located, t_ns: int) -> bool:
        """Whether the last sighting was of the same ground."""
        last = self._sighting
        if last is None or not 0 < t_ns - last.t_ns <= LONGEST_WAIT_S * NS_PER_S:
            return False
        height = self._index.height(located.main_node)
        apart = on_ground(located.pose, height) - on_ground(last.located.pose, height)
        return float(np.linalg.norm(apart)) < height
