"""Inverse kinematics as one box-constrained QP per iteration, in place of eq. (8).

    min   sum_j w_j^2 |J_j dq - e_j|^2 + |W_w (J_w dq - e_w)|^2 + |E dq + e|^2
          + w_q^2 |q + dq - q_rest|^2 + w_d^2 |dq|^2
    s.t.  np.clip(q_min - q, -v dt, v dt) <= dq <= np.clip(q_max - q, -v dt, v dt)

Wrist and fingers are solved together. `w_d^2` is the damping plus a share of the weighted error
(Levenberg-Marquardt). `E` and `e` are the rows of further tasks (`ik.tasks`). The box
never contradicts itself: where `q` starts outside its limits, the joint comes back as fast as its
speed limit allows. Lengths are in units of 10 mm and angles of the wrist in units of 0.1 rad, which
keeps the Hessian near one, where solvers work best.

The compiled core poses and solves it (`handmap/qp.hpp`). `handmap_qp.reference` poses the same QP
over Pinocchio, for other solvers and to compare with.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial
from typing import Any, Generic

from handmap_core.core import core
from handmap_core.hands import Configuration, Hand
from handmap_core.se3 import Array
from .gate import IkGate, Kept
from .motion import When
from .options import IkOptions
from .result import IkResult, result_of
from .tasks import Goal, PointDistances, PointOffset, Task, TaskRows


class PointIk(Generic[Kept]):
    """Moves a hand's reference points and wrist towards their targets, within its limits.

    Args:
        gate: Admits the displacements, and knows how the hand moves.
        tasks: Further terms of the cost, in every sample.

    Attributes:
        gate: As given.
        options: Weights and settings.
        core: The compiled core of this hand.
    """

    def __init__(self, gate: IkGate[Kept], tasks: Sequence[Task] = ()) -> None:
        self.gate = gate
        self.options: IkOptions = gate.options
        self.core = gate.core
        self._tasks = tuple(tasks)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy goes on from, with a workspace of its own."""
        state = {**vars(self), "detours": self.core.detours}
        del state["core"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on as a copy."""
        detours = state.pop("detours")
        vars(self).update(state)
        self.core = self.gate.core
        if detours:
            self.core.go_on(detours)

    @property
    def hand(self) -> Hand:
        """The hand."""
        return self.gate.hand

    @property
    def is_compiled(self) -> bool:
        """Whether the core solves the QP."""
        return True

    @cached_property
    def _placed(self) -> Configuration:
        return self.hand.configuration()

    @property
    def configuration(self) -> Configuration:
        """The present posture; `place` puts the hand somewhere else."""
        self._placed.place(self.gate.motion.q)
        return self._placed

    def place(self, q: Array) -> None:
        """Put the hand at a configuration, at rest.

        Args:
            q: Pinocchio configuration, shape (nq,).
        """
        self.gate.place(q)

    def solve(
        self,
        point_targets: Array,
        wrist_target: Array | None,
        dt: When,
        *,
        rest: Array | None = None,
        regularisation: Array | None = None,
        tasks: Sequence[Task] = (),
        margins: Array | None = None,
        speed: float = 1.0,
    ) -> IkResult:
        """Move the hand towards its targets for one sample.

        Args:
            point_targets: Targets of the reference points in the world [m], shape (m, 3).
            wrist_target: Target of the wrist frame, shape (4, 4), or of each hand's of a robot, (h,
                4, 4). None leaves it free; fixed hands need none.
            dt: Time since the robot's last command [s], or the instant of this one; bounds the
                displacement through the limits of speed and acceleration.
            rest: Joint positions that the rest term pulls to, in the order of `Hand.joint_names`
                [rad or m], shape (n,); the hand's rest posture if omitted.
            regularisation: Share of the weights of the rest term and of the damping of each of
                them, shape (n,); all of both if omitted.
            tasks: Further terms of the cost.
            margins: Distance that each pair of shapes keeps [m]; the hand's own if omitted.
            speed: Share of the speed limits to use. Braking from a higher speed takes the time that
                the acceleration limit asks for.

        Returns:
            The result. On `failed`, the configuration is the one before the call, except for
            joints outside their limits.
        """
        wrists = None if wrist_target is None else wrist_target.reshape(-1, 4, 4)
        return self._solved(
            Goal(
                point_targets,
                wrists,
                self.hand.rest if rest is None else rest,
                (*tasks, *self._tasks),
                dt,
                margins,
                speed,
                regularisation,
            )
        )

    def _solved(self, goal: Goal) -> IkResult:
        """Move the hand towards the targets of one sample."""
        distances = []
        offsets = []
        others = []
        for task in goal.tasks:
            # Subclasses may have other rows.
            if type(task) is PointDistances:
                distances.append((task.core, task.distances, task.weights))
            elif type(task) is PointOffset:
                offsets.append(task.core_offset)
            else:
                others.append(task)
        step = self.core.solve(
            goal.points,
            goal.wrists,
            goal.rest,
            goal.dt,
            goal.margins,
            goal.speed,
            goal.regularisation,
            distances,
            offsets,
            partial(self._linearise, others) if others else None,
        )
        return self.result_of(step)

    def _linearise(self, tasks: Sequence[Task], q: Array) -> list[TaskRows]:
        """Return the rows of tasks that the core does not have, at a configuration, (nq,)."""
        self._placed.place(q)
        return [task.linearise(self._placed) for task in tasks]

    def result_of(self, step: core.Step) -> IkResult:
        """Return the result of a step of the core."""
        return result_of(step, self.hand, self.gate.links)

    def hold(self, dt: When) -> IkResult:
        """Bring the hand to a stop within its acceleration limit, without targets.

        Args:
            dt: Time since the robot's last command [s], or the instant of this one.
        """
        return self.result_of(self.core.hold(dt))
