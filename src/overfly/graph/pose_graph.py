"""The pose graph: nodes, relative constraints between them, absolute constraints on them. Plain growing
arrays.

A million nodes with two million constraints take about 800 MB. Nodes and constraints are numbered in the
order in which they were added and keep their numbers; a constraint that was voted out stays, marked in
``states``.
"""

from __future__ import annotations

from enum import IntEnum
from math import isnan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.errors import UsageError
from overfly.geometry.poses import FloatArray, Pose, rotation_from_quaternion
from overfly.types import BoolArray, Constraint, ConstraintKind, IntArray

UInt8Array = NDArray[np.uint8]

# As stored: the index into this tuple.
KINDS = (
    ConstraintKind.ODOMETRY,
    ConstraintKind.REVISIT,
    ConstraintKind.DEAD_RECKONING,
    ConstraintKind.POSITIONS,
    ConstraintKind.BRIDGE,
)
_NUMBER_OF_KIND = {kind: number for number, kind in enumerate(KINDS)}
_ZEROS = np.zeros((6, 6))


class State(IntEnum):
    """Whether a constraint takes part in the optimisation."""

    ACTIVE = 0
    REJECTED = 1  # voted out; kept, so that it can be tried again


class Column:
    """One array that grows at the end; ``view`` is its filled part."""

    def __init__(self, shape: tuple[int, ...] = (), dtype: type = np.float64) -> None:
        self._data: NDArray[Any] = np.empty((16, *shape), dtype)
        self._length = 0

    @property
    def view(self) -> NDArray[Any]:
        return self._data[: self._length]

    def __len__(self) -> int:
        return self._length

    def append(self, value: Any) -> None:
        self._reserve(self._length + 1)
        self._data[self._length] = value
        self._length += 1

    def extend(self, values: NDArray[Any]) -> None:
        """values: (k, *shape)."""
        end = self._length + len(values)
        self._reserve(end)
        self._data[self._length : end] = values
        self._length = end

    def _reserve(self, length: int) -> None:
        if length > len(self._data):
            grown = np.empty((max(length, 2 * len(self._data)), *self._data.shape[1:]), self._data.dtype)
            grown[: self._length] = self._data[: self._length]
            self._data = grown


class PoseGraph:
    """Nodes are poses world_from_node. ``planar`` graphs live in x, y and yaw; their angle error is the angle
    itself.

    Absolute constraints come in two forms: on the position (height alone is one with information in z only)
    and on the attitude (roll and pitch, and the heading if its sigma is finite).
    """

    def __init__(self, planar: bool = False) -> None:
        self.planar = planar
        self._positions = Column((3,))
        self._quaternions = Column((4,))
        self._i = Column(dtype=np.int64)
        self._j = Column(dtype=np.int64)
        self._measured_positions = Column((3,))
        self._measured_quaternions = Column((4,))
        self._information = Column((6, 6))
        self._kinds = Column(dtype=np.uint8)
        self._states = Column(dtype=np.uint8)
        self._position_prior_nodes = Column(dtype=np.int64)
        self._position_prior_values = Column((3,))
        self._position_prior_information = Column((3, 3))
        self._position_prior_robust = Column(dtype=np.bool_)
        self._attitude_prior_nodes = Column(dtype=np.int64)
        self._attitude_prior_rotations = Column((3, 3))
        self._attitude_prior_information = Column((3,))

    # -- nodes

    def add_node(self, world_from_node: Pose) -> int:
        """Append a node at this pose; returns its number."""
        self._positions.append(world_from_node.translation)
        self._quaternions.append(world_from_node.quaternion())
        return len(self) - 1

    def add_nodes(self, positions: FloatArray, quaternions: FloatArray) -> None:
        """Append many: positions (k, 3) metres, quaternions (k, 4) xyzw of unit length."""
        self._positions.extend(positions)
        self._quaternions.extend(quaternions)

    def __len__(self) -> int:
        return len(self._positions)

    @property
    def positions(self) -> FloatArray:
        """(n, 3) metres, world; a view that writes through, valid until the next node is added."""
        return self._positions.view

    @property
    def quaternions(self) -> FloatArray:
        """(n, 4) xyzw of world_from_node; a view that writes through, valid until the next node is added."""
        return self._quaternions.view

    def pose(self, node: int) -> Pose:
        """world_from_node."""
        return Pose(rotation_from_quaternion(self.quaternions[node]), self.positions[node].copy())

    def set_pose(self, node: int, world_from_node: Pose) -> None:
        self.positions[node] = world_from_node.translation
        self.quaternions[node] = world_from_node.quaternion()

    # -- constraints between nodes

    def add_constraint(self, constraint: Constraint) -> int:
        """Append an active constraint; returns its number.

        Raises UsageError for nodes that do not exist or an information matrix that is not finite.
        """
        n = len(self)
        for node in (constraint.i, constraint.j):
            if not 0 <= node < n:
                raise UsageError(f"constraint ({constraint.i}, {constraint.j}): there is no node {node}")
        if constraint.i == constraint.j:
            raise UsageError(f"a constraint cannot join node {constraint.i} to itself")
        if isnan(np.vdot(constraint.information, _ZEROS)):  # zero times what is not finite
            raise UsageError(f"constraint ({constraint.i}, {constraint.j}): information is not finite")
        self._i.append(constraint.i)
        self._j.append(constraint.j)
        self._measured_positions.append(constraint.i_from_j.translation)
        self._measured_quaternions.append(constraint.i_from_j.quaternion())
        self._information.append(constraint.information)
        self._kinds.append(_NUMBER_OF_KIND[constraint.kind])
        self._states.append(State.ACTIVE)
        return self.n_constraints - 1

    def add_constraints(
        self,
        i: IntArray,
        j: IntArray,
        positions: FloatArray,
        quaternions: FloatArray,
        information: FloatArray,
        kinds: UInt8Array,
        states: UInt8Array | None = None,
    ) -> None:
        """Append many: i, j (k,), measured positions (k, 3) and quaternions (k, 4), information (k, 6, 6)."""
        if len(i) and (min(i.min(), j.min()) < 0 or max(i.max(), j.max()) >= len(self)):
            raise UsageError("a constraint names a node that does not exist")
        self._i.extend(i)
        self._j.extend(j)
        self._measured_positions.extend(positions)
        self._measured_quaternions.extend(quaternions)
        self._information.extend(information)
        self._kinds.extend(kinds)
        self._states.extend(np.zeros(len(i), np.uint8) if states is None else states)

    @property
    def n_constraints(self) -> int:
        return len(self._i)

    @property
    def i(self) -> IntArray:
        """(m,) node each constraint is observed from."""
        return self._i.view

    @property
    def j(self) -> IntArray:
        """(m,) node each constraint observes."""
        return self._j.view

    @property
    def measured_positions(self) -> FloatArray:
        """(m, 3) translation of i_from_j."""
        return self._measured_positions.view

    @property
    def measured_quaternions(self) -> FloatArray:
        """(m, 4) xyzw of i_from_j."""
        return self._measured_quaternions.view

    @property
    def information(self) -> FloatArray:
        """(m, 6, 6); in planar graphs rows and columns x, y and yaw (0, 1, 5) count."""
        return self._information.view

    @property
    def kinds(self) -> UInt8Array:
        """(m,) index into KINDS."""
        return self._kinds.view

    @property
    def states(self) -> UInt8Array:
        """(m,) values of State; may be written."""
        return self._states.view

    @property
    def active(self) -> IntArray:
        """Numbers of the active constraints, ascending."""
        return np.flatnonzero(self.states == State.ACTIVE)

    def constraint(self, number: int) -> Constraint:
        return Constraint(
            int(self.i[number]),
            int(self.j[number]),
            Pose.from_quaternion(self.measured_quaternions[number], self.measured_positions[number]),
            self.information[number].copy(),
            KINDS[self.kinds[number]],
        )

    # -- absolute constraints

    def add_prior_position(
        self, node: int, position: FloatArray, covariance: FloatArray, robust: bool = False
    ) -> None:
        """Position (3,) metres, world, with covariance (3, 3), as from GPS. robust: under a Cauchy kernel."""
        self._add_position_prior(node, position, np.asarray(np.linalg.inv(covariance)), robust)

    def add_prior_height(self, node: int, z_m: float, sigma_m: float, robust: bool = False) -> None:
        """Height of the node in the world, as from a range sensor over flat ground or a barometer."""
        self._add_position_prior(node, np.array([0.0, 0.0, z_m]), np.diag([0.0, 0.0, sigma_m**-2]), robust)

    def _add_position_prior(
        self, node: int, position: FloatArray, information: FloatArray, robust: bool
    ) -> None:
        self._check_node(node)
        self._position_prior_nodes.append(node)
        self._position_prior_values.append(position)
        self._position_prior_information.append(information)
        self._position_prior_robust.append(robust)

    def add_prior_attitude(
        self, node: int, world_from_node: FloatArray, sigma_rad: float, heading_sigma_rad: float = np.inf
    ) -> None:
        """Measured rotation (3, 3) of the node, of which roll and pitch count, and the heading if its sigma
        is finite.

        sigma_rad: standard deviation of the tilt about any level axis.
        """
        self._check_node(node)
        self._attitude_prior_nodes.append(node)
        self._attitude_prior_rotations.append(world_from_node)
        self._attitude_prior_information.append([sigma_rad**-2, sigma_rad**-2, heading_sigma_rad**-2])

    def _check_node(self, node: int) -> None:
        if not 0 <= node < len(self):
            raise UsageError(f"there is no node {node}")

    @property
    def n_absolute(self) -> int:
        """How many absolute constraints there are."""
        return len(self._position_prior_nodes) + len(self._attitude_prior_nodes)

    @property
    def position_priors(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Nodes (k,), positions (k, 3), information (k, 3, 3) in world axes."""
        return (
            self._position_prior_nodes.view,
            self._position_prior_values.view,
            self._position_prior_information.view,
        )

    @property
    def robust_position_priors(self) -> BoolArray:
        """(k,) which position priors count through a robust kernel."""
        return self._position_prior_robust.view

    @property
    def attitude_priors(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Nodes (k,), rotations world_from_node (k, 3, 3), information (k, 3) of tilt about x, about y,
        heading.
        """
        return (
            self._attitude_prior_nodes.view,
            self._attitude_prior_rotations.view,
            self._attitude_prior_information.view,
        )

    def copy(self) -> PoseGraph:
        """An independent copy."""
        twin = PoseGraph(self.planar)
        for name, column in vars(self).items():
            if isinstance(column, Column):
                getattr(twin, name).extend(column.view)
        return twin


def predicted_pose(graph: PoseGraph, constraint: Constraint) -> Pose:
    """Where the constraint puts node j: world_from_j."""
    return graph.pose(constraint.i) @ constraint.i_from_j
