"""Further terms of the QP's cost: a small protocol, and the distances of pairs of points.

A task adds `|J dq + e|^2 + dq^T diag(d) dq` to the cost, with its weights already multiplied in.
Give tasks of your own to `HandMapper(..., tasks=[...])`:

    class KeepTipUp:
        def linearise(self, hand):
            height = hand.points[0, 2] - 0.05
            return TaskRows(np.array([100.0 * height]), 100.0 * hand.point_jacobian()[2:3])

Lengths count in units of 10 mm (`LENGTH_UNIT`), so a weight of 100 per metre is that of a reference
point.

Other packages add tasks by entry points of the group `handmap_qp.tasks`, each of which names a
function from a hand to a task; `IkOptions.tasks` takes them by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.core import core, without_core
from handmap_core.errors import InvalidOptionsError, expect
from handmap_core.hands import AttachedPoints, Configuration, Hand
from handmap_core.models import DistancesModel, encode
from handmap_core.plugins import Plugins
from handmap_core.se3 import Array, as_floats

if TYPE_CHECKING:
    from handmap_core import _core
    from .motion import When


class TaskRows(NamedTuple):
    """A task at one configuration: `|jacobian dq + residual|^2 + dq^T diag(damping) dq`.

    Here nv counts the active coordinates (`Configuration.nv`): the wrist's, and joints that follow
    no other. In `HandModel` it counts all tangent coordinates of the Pinocchio model.

    Attributes:
        residual: Weighted error, value minus target, shape (k,).
        jacobian: Weighted derivative of the error in the active coordinates, shape (k, nv).
        damping: Squared cost of moving each coordinate, shape (nv,) or one number: bounds the step
            where the error is far from linear (Levenberg-Marquardt).
    """

    residual: Array
    jacobian: Array
    damping: Array | float = 0.0


class Task(Protocol):
    """One more term of the QP's cost."""

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return the task's rows at the hand's present configuration.

        Args:
            hand: The robot hand, placed with Jacobians; not to be changed.
        """
        ...


class Goal(NamedTuple):
    """What one sample asks for.

    Attributes:
        points: Targets of the reference points in the world [m], shape (m, 3).
        wrists: Target of the wrist frame of each hand, shape (h, 4, 4); None leaves them free.
        rest: Joint positions that the rest term pulls to, in the order of `Hand.joint_names`
            [rad or m], shape (n,).
        tasks: Further terms.
        dt: Time since the robot's last command [s], or the instant of this one.
        margins: Distance that each pair of shapes keeps [m], shape (k,); the hand's own if omitted.
        speed: Share of the speed limits to use.
        regularisation: Share of the weights of the rest term and of the damping of each joint,
            shape (n,); all of both if omitted.
    """

    points: Array
    wrists: Array | None
    rest: Array
    tasks: Sequence[Task]
    dt: When = 1.0
    margins: Array | None = None
    speed: float = 1.0
    regularisation: Array | None = None


TASKS: Mapping[str, Callable[[Hand], Task]] = Plugins(
    "handmap_qp.tasks", dict, "collections.abc:Callable"
)
"""Tasks of other packages by name: functions from a hand to its task."""


def tasks_named(names: Sequence[str], hand: Hand) -> list[Task]:
    """Make tasks of other packages for a hand.

    Raises:
        InvalidOptionsError: If there is no such task.
    """
    if unknown := [name for name in names if name not in TASKS]:
        known = ", ".join(TASKS) or "none, because no installed package has any"
        raise InvalidOptionsError(option="tasks", expected=known, value=unknown[0])
    return [TASKS[name](hand) for name in names]


class PointDistances:
    """Keep pairs of points at given distances.

    What a pair asks for may stay out of reach, and the hand must be free to move in other
    directions all the same. So the cost has the distance's own curvature, its two parts each where
    they are convex: points that are too far apart resist moving past each other, and damping is
    left for the joints that turn them towards each other. For coupled joints that is an estimate.

    Args:
        points: The points, such as `AttachedPoints.reference_points(hand)`.
        pairs: Indices of both points of each pair, shape (p, 2).
        distances: Wanted distance of each pair [m], shape (p,).
        weights: Weight of each pair per 10 mm of error, shape (p,); 1 if omitted.

    Raises:
        InvalidInputError: On wrong shapes, numbers that are not finite, or negative ones.
    """

    def __init__(
        self,
        points: AttachedPoints,
        pairs: Sequence[tuple[int, int]],
        distances: ArrayLike,
        weights: ArrayLike = 1.0,
    ) -> None:
        indices = as_floats(pairs, "pairs").reshape(-1, 2).astype(int)
        is_known = ((indices >= 0) & (indices < len(points))).all()
        expect(
            is_known and (indices[:, 0] != indices[:, 1]).all(),
            "pairs",
            f"two different points below {len(points)}",
            value=pairs,
        )
        self.points = points
        self.first, self.second = indices.T
        self.distances = _check_numbers(distances, len(indices), "distances")
        self.weights = _check_numbers(weights, len(indices), "weights")

    @cached_property
    def core(self) -> _core.PointDistances:
        """The core's own, without distances and weights."""
        return core.PointDistances(encode(self.model()))

    def __getstate__(self) -> dict[str, object]:
        """Return the state of a copy."""
        return without_core(self)

    def model(self) -> DistancesModel:
        """Return its points and pairs, as the core has them."""
        return DistancesModel(
            joints=np.asarray(self.points.joints) - 1,
            offsets=self.points.offsets,
            first=self.first,
            second=self.second,
        )

    def aimed_at(self, distances: Array, weights: Array) -> PointDistances:
        """Return the same task with other targets, unchecked: for use sample by sample.

        Args:
            distances: Wanted distance of each pair [m], shape (p,).
            weights: Weight of each pair per 10 mm of error, shape (p,).
        """
        task = object.__new__(type(self))
        vars(task).update(vars(self), distances=distances, weights=weights)
        return task

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return a row a pair, then three a pair of its curvature; see `Task.linearise`."""
        task = self.core, self.distances, self.weights
        return TaskRows(*core.task_rows(hand.tree, hand.q, task))


class PointOffset(NamedTuple):
    """Keeps a point of a robot at an offset from another one, in world axes.

    Attributes:
        points: The first point and the other one.
        aim: Offset of the other point from the first one [m], shape (3,).
        weight: Weight per 10 mm of error.
    """

    points: AttachedPoints
    aim: Array
    weight: float

    @property
    def core_offset(self) -> _core.Offset:
        """The task as the core takes it."""
        return self.points.joints, self.points.offsets, self.aim, self.weight

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return a row an axis; see `Task.linearise`."""
        return TaskRows(*core.task_rows(hand.tree, hand.q, self.core_offset))


class JointPositions(NamedTuple):
    """Pulls joints to positions.

    Attributes:
        hand: The hand.
        columns: Which of the joints in `Hand.joint_names`: indices, shape (k,), or a slice.
        positions: Positions of all joints, of which theirs are wanted [rad or m], shape (n,).
        weight: Weight of all, or of each of them, shape (k,) [1/rad or 1/m].
    """

    hand: Hand
    columns: Array | slice
    positions: Array
    weight: Array | float

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return a row a joint; see `Task.linearise`."""
        off = hand.q[self.hand.q_indices] - self.positions
        rows = np.eye(hand.nv)[self.hand.joint_columns[self.columns]]
        scale = np.reshape(self.weight, (-1, 1))
        return TaskRows(self.weight * off[self.columns], scale * rows)


def _check_numbers(values: ArrayLike, count: int, name: str) -> Array:
    array = as_floats(values, name, is_finite=True)
    expect(
        array.shape in ((), (count,)) and (array >= 0.0).all(),
        name,
        f"{count} finite numbers >= 0, or one for all",
        value=values,
    )
    return np.full(count, array)
