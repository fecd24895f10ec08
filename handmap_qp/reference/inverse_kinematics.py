"""The QP of `handmap_qp.ik.qp` over Pinocchio: posed here or by mink, solved by any solver.

Every displacement passes the gate of the robot (`handmap_core.ik.gate`), which also gives the
bounds of the QP, and the rows that keep links apart. This way takes no detours (`IkOptions`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from handmap_core.ik.gate import IkGate, Rows
from handmap_core.ik.tasks import Goal
from handmap_core.se3 import Array, frozen, lengths
from handmap_qp.hands import Hand
from handmap_qp.ik import WRIST_LEVERS, IkOptions, IkResult, Status, wrist_error
from .daqp_solver import solve_by_daqp
from .problem import direct_cost, moved_along

if TYPE_CHECKING:
    from handmap_core import _core

# Count a hand as at rest if its last step is shorter than this [rad or m].
_AT_REST = 1e-3
# Count a displacement as at its bound within this tolerance, relative to min(bound width, 1 rad or
# 1 m): the sum of iterations meets a bound up to rounding, clarabel and piqp up to 1e-7.
_AT_BOUND = 1e-7
# How often the step is solved again with the points that come too near where it ends.
_MAX_RESOLVES = 3
# A coordinate is free if its step is farther from its bounds [rad or m].
_FREE = 1e-7


class ReferenceIk:
    """Moves a hand towards its targets by QPs that are posed over Pinocchio.

    Args:
        hand: The hand.
        gate: Its gate, which owns its motion. Of its options, `formulation` says how
            the cost is posed.

    Attributes:
        options: Weights and settings.
        configuration: Where the QP is posed.
        solver: Solves it, as `solve_by_daqp` does.

    Raises:
        InvalidOptionsError: If no such solver is installed.
    """

    def __init__(self, hand: Hand, gate: IkGate) -> None:
        self.hand = hand
        self.gate = gate
        self.options: IkOptions = gate.options
        self.configuration = hand.configuration()
        self.solver = solve_by_daqp
        if self.options.solver != "daqp":
            # qpsolvers takes a second to import.
            from .solvers import make_solver

            self.solver = make_solver(self.options.solver)

    def solve(self, goal: Goal) -> IkResult:
        """Move the hand straight towards the targets of one sample; see `PointIk.solve`."""
        gate = self.gate
        lower, upper = gate.bounds(goal.dt, goal.speed)
        posed = gate.rows(goal.dt, lower, upper, goal.margins)
        sample = _Iterations(self, goal, lower, upper, posed)
        sample.run()
        displacement = gate.admit(
            sample.total, sample.first, goal.dt, posed, sample.solve_again
        )
        configuration = self.configuration
        configuration.place(gate.motion.q)
        points = configuration.points.copy()
        targets, wrist_off = self._targets(goal)
        farthest = max(wrist_off, *lengths(points - targets))
        active = _at_bounds(displacement, lower, upper)
        status: Status = "failed"
        if sample.has_solution:
            status = self._status(farthest, active, sample.last_step)
        held_by = gate.held_by if gate.held_by >= 0 else sample.pressed
        return IkResult(
            status,
            points,
            targets,
            configuration.q.copy(),
            np.array([wrist.homogeneous for wrist in configuration.wrists]),
            frozen(displacement),
            frozen(active),
            self.hand,
            sample.count,
            sample.last_step,
            gate.links[held_by],
        )

    def step(
        self, goal: Goal, lower: Array, upper: Array, rows: Rows | None
    ) -> tuple[Array | None, Array]:
        """Pose the QP at the present configuration, and solve it.

        Args:
            goal: What the cost asks for.
            lower: Lower bounds, shape (k,).
            upper: Upper bounds, likewise.
            rows: Rows that keep links apart; None for none.

        Returns:
            The step, shape (k,), None if the solver fails; and the slope of the cost there, 0 at
            bounds, likewise.
        """
        H, c = self._cost(goal)
        step = self.solver(H, c, lower, upper, rows)
        # Catch NaN too, which solvers return where extreme weights or targets overflow.
        if step is None or not math.isfinite(step.dot(step)):
            return None, c
        is_free = np.minimum(step - lower, upper - step) > _FREE
        return step, is_free * (H.dot(step) + c)

    def _cost(self, goal: Goal) -> tuple[Array, Array]:
        """Return H, shape (k, k), and c, shape (k,), at the present configuration."""
        if self.options.formulation != "mink":
            return direct_cost(self.gate, self.configuration, goal)
        # mink imports MuJoCo.
        from .mink_problem import build_problem

        problem = build_problem(self.gate, self.configuration, goal)
        return np.asarray(problem.P), problem.q

    def _targets(self, goal: Goal) -> tuple[Array, float]:
        """Return the targets of the points where the hand is now, and how far its wrists are off.

        Both differ from the goal, and from 0, only where the points go with the wrist.
        """
        targets = goal.points.copy()
        if not self.options.points_follow_wrist or goal.wrists is None:
            return targets, 0.0
        wrist_off = 0.0
        placed = self.configuration
        for own, here, wrist in zip(
            placed.parts, placed.wrists, goal.wrists, strict=True
        ):
            targets[own] = moved_along(here, targets[own], pin.SE3(wrist))
            error = wrist_error(here.homogeneous, wrist)
            wrist_off = max(wrist_off, *(error * WRIST_LEVERS))
        return targets, wrist_off

    def _status(self, farthest: float, active: Array, last_step: float) -> Status:
        """Return how a sample ended whose QPs were solved; see `IkResult.status`."""
        if farthest <= self.options.point_tolerance:
            return "converged"
        if active.any():
            return "limited"
        return "unreachable" if last_step <= _AT_REST else "unsettled"


class _Iterations:
    """The QPs of one sample: each continues from where the one before ended.

    Args:
        ik: Poses and solves them.
        goal: What the cost asks for.
        lower: Lower bounds of the whole displacement, shape (k,).
        upper: Upper bounds, likewise.
        posed: Rows that keep links apart; None for none.

    Attributes:
        total: Displacement from the start, shape (k,).
        first: Displacement of the first QP, or of the last that was solved from the start again.
        count: QPs solved.
        last_step: Euclidean norm of the last iteration's step [rad or m].
        has_solution: Whether the solver found an answer to the last QP.
        pressed: The pair of shapes that the last QP was pressed against; -1 for none.
    """

    def __init__(
        self,
        ik: ReferenceIk,
        goal: Goal,
        lower: Array,
        upper: Array,
        posed: _core.PosedRows | None,
    ) -> None:
        self._ik = ik
        self._goal = goal
        self._lower = lower
        self._upper = upper
        self._posed = posed
        self._start = ik.gate.motion.q
        self.total = np.zeros(len(lower))
        self.first = self.total
        self.count = 0
        self.last_step = math.inf
        self.has_solution = True
        self.pressed = -1

    def run(self) -> None:
        """Iterate until the step is short; then keep apart what meets where it ends."""
        ik = self._ik
        ik.configuration.place(self._start)
        while (
            self.last_step > ik.options.step_tolerance
            and self.count < ik.options.max_iterations
        ):
            rows = self._posed.behind(self.total) if self._posed else None
            self.total, step = self._advance(self.total, rows)
            self.last_step = 0.0 if step is None else math.sqrt(step.dot(step))
            if self.count == 1:
                self.first = self.total
            # Displace from the start rather than step by step, so that a floating wrist's twist
            # keeps its limits exactly.
            ik.configuration.displace(self._start, self.total)
        for _ in range(_MAX_RESOLVES):
            rows = self._posed.at_end(self.total) if self._posed else None
            if rows is None:
                return
            self.total = self.first = self.solve_again(rows)

    def solve_again(self, rows: Rows) -> Array:
        """Return the displacement, shape (k,), from the start with rows of the points that met."""
        self._ik.configuration.place(self._start)
        return self._advance(np.zeros(len(self._lower)), rows)[0]

    def _advance(self, so_far: Array, rows: Rows | None) -> tuple[Array, Array | None]:
        """Solve one QP behind a displacement.

        Returns:
            The whole displacement, shape (k,); and the step, None if the solver fails.
        """
        self.count += 1
        lower = self._lower
        upper = self._upper
        # Leave later iterations the rest of the bounds, which hold for the whole sample.
        step, slope = self._ik.step(self._goal, lower - so_far, upper - so_far, rows)
        self.has_solution = step is not None
        self.pressed = -1
        if self._posed and step is not None:
            self.pressed = self._posed.pressed_pair(slope, step)
        # Clip exactly: solvers hold the box up to their tolerance. On failure, bring joints
        # outside their limits back all the same: the box excludes zero there.
        total = np.zeros(len(lower)) if step is None else so_far + step
        return np.clip(total, lower, upper), step


def _at_bounds(displacement: Array, lower: Array, upper: Array) -> Array:
    """Return -1 where a displacement is at its lower bound, +1 at the upper, 0 between."""
    tolerance = _AT_BOUND * np.minimum(upper - lower, 1.0)
    is_high = upper - displacement <= tolerance
    is_low = displacement - lower <= tolerance
    return is_high.astype(np.int8) - is_low
