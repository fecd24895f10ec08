"""Displacements towards a posture, without an overlap on the way.

A slew has no targets for points: a robot goes back to rest, or to where its mapper is. The wanted
displacement is taken if it and a stop behind it are clear. Otherwise the hand takes the nearest
displacement that the rows of self-collision avoidance allow,

    min |x - wanted|^2   s.t.   lower <= x <= upper,   G x <= h,

so that links slide along each other instead of meeting, or a part of it, or it brakes.
"""

from __future__ import annotations

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.ik.distances import NearPairs
from handmap_qp.ik.limits import BoxLimits
from handmap_qp.ik.solvers import DaqpSolver
from handmap_qp.ik.stopping import Start, StopGuard

# Displacements of a sample are near this size [rad]; the solver is exact near one.
_SCALE = 0.05


class ClearSlew:
    """Admits displacements of one hand towards postures.

    Args:
        hand: The hand.
        collisions: Pairs of shapes to keep apart.
        max_acceleration: Limit of every coordinate [rad/s^2, m/s^2]; None for none.

    Attributes:
        columns: Which of the model's velocity coordinates move the shapes against each other, shape
            (model.nv,). They must stop together, in proportion to their speeds.
    """

    def __init__(
        self, hand: Hand, collisions: CollisionLimit, max_acceleration: float | None
    ) -> None:
        self._hand, self._collisions = hand, collisions
        self._limits = BoxLimits(hand, max_acceleration=max_acceleration)
        self._guard = StopGuard(self._limits, collisions.path)
        self._configuration = hand.configuration()
        self._solver = DaqpSolver(self._limits.size)
        self._identity = np.eye(self._limits.size)
        self._near: NearPairs | None = None
        self.columns = np.zeros(hand.model.nv, dtype=bool)
        self.columns[hand.active_columns] = collisions.path.columns

    def admit(
        self, q: np.ndarray, velocity: np.ndarray, wanted: np.ndarray, dt: float
    ) -> np.ndarray:
        """Return a displacement near the wanted one that is clear.

        Args:
            q: Pinocchio configuration at the start, shape (nq,).
            velocity: Velocity of the last sample, shape (model.nv,).
            wanted: Wanted displacement within the limits of speed and acceleration, shape
                (model.nv,).
            dt: Time for it [s].

        Returns:
            `wanted` itself, or another displacement, shape (model.nv,).
        """
        active = self._hand.active_columns
        state = _Motion(velocity[active])
        state.stop_time = self._limits.stop_time(state.velocity, self._collisions.path.columns)
        configuration = self._configuration
        configuration.place_with_jacobians(q)
        lower, upper = self._guard.bounds(q, state.velocity, dt)
        stopping = 0.5 * self._guard.longest_stop(state.velocity, dt) / dt
        near = self._near = self._collisions.measure(configuration, dt=dt, before=self._near)
        G, h = self._collisions.feasible_rows(
            configuration, lower, upper, near=near, stopping=stopping
        )
        start, goal = Start(q, near), wanted[active]
        nearest = np.minimum(np.maximum(goal, lower), upper)
        if (G.dot(nearest) > h).any():
            c, box, rows = -goal / _SCALE, (lower / _SCALE, upper / _SCALE), (G, h / _SCALE)
            found = self._solver.solve(self._identity, c, *box, rows)
            # Without a solution, only the brake is left.
            first = np.minimum(np.maximum(0.0, lower), upper) if found is None else found * _SCALE
            nearest = np.minimum(np.maximum(first, lower), upper)
        admitted = self._guard.admit(start, goal, nearest, dt, state)
        if admitted is goal:
            return wanted
        expansion = self._hand.expansion
        return admitted if expansion is None else expansion.matrix.dot(admitted)


class _Motion:
    """How a hand moves; see `stopping.Moving`."""

    def __init__(self, velocity: np.ndarray) -> None:
        self.velocity = velocity
        self.stop_time = 0.0
