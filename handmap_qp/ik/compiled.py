"""The compiled core of a hand: built from what Pinocchio loaded, and called once a sample.

The core (`handmap_qp/core`, C++) does what `handmap_qp.ik.qp`, `limits` and `collision` do, up to
rounding: they are its readable reference. It has kinematics, distances and a QP solver of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache, partial
from typing import Any, get_args

import numpy as np

from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.core import Parts, core
from handmap_qp.ik.limits import SHORTEST_DT, Gate, Motion
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import IkResult, PointIk, Status
from handmap_qp.ik.tasks import Goal, PointDistances, Task
from handmap_qp.se3 import frozen

_STATUSES = get_args(Status)


class CompiledIk:
    """The core of one hand; see `compile_ik`."""

    def __init__(self, hand: Hand, core_ik: Any) -> None:
        self._hand = hand
        self._core = core_ik
        self._motion: Motion | None = None
        n = len(hand.active_columns)
        m = len(hand.reference_points)
        self._parts = Parts(hand.model.nq, n, n, n, (m, 3), (4, 4))

    def solve(
        self,
        gate: Gate,
        goal: Goal,
        dt: float,
        margins: np.ndarray | None,
        speed: float,
    ) -> IkResult:
        """Move the hand for one sample, and the gate with it; arguments as of `PointIk.solve`."""
        self._take(gate)
        tasks = goal.tasks
        distances = aims = weights = None
        first = tasks[0] if tasks else None
        if isinstance(first, PointDistances) and first.core is not None:
            distances, aims, weights = first.core, first.distances, first.weights
            tasks = tasks[1:]
        found = self._core.solve(
            goal.points,
            goal.wrist,
            dt,
            speed,
            margins,
            goal.postures,
            distances,
            aims,
            weights,
            partial(self._linearise, tasks) if tasks else None,
        )
        return self._result(gate, goal.points, dt, *found)

    def follow(
        self, ik: PointIk, target_map: Any, sample: Any, dt: float, speed: float
    ) -> tuple[Any, IkResult]:
        """Move the hand for one sample of a human, whose targets the core computes too.

        Args:
            ik: What this is the core of.
            target_map: A `mapping.method.TargetMap` that has a `core`.
            sample: A `mapping.method.HumanPose`.
            dt: As of `PointIk.solve`.
            speed: Likewise.

        Returns:
            The targets (`mapping.method.Targets`), and the result.
        """
        dt = max(dt, SHORTEST_DT)
        self._take(ik.gate)
        postures = ik.postures(dt, target_map.rest)
        arguments = target_map.core, sample.points, sample.wrist, dt, speed, postures
        asked, found = self._core.follow(*arguments)
        targets = target_map.asked(*asked)
        return targets, self._result(ik.gate, targets.points, dt, *found)

    def approach(
        self, ik: PointIk, task: PointDistances, dt: float, samples: int, near: float
    ) -> np.ndarray:
        """Move the hand from rest for a task; see `hand_pair.approach`."""
        self._motion = None
        return self._core.approach(ik, task, dt, samples, near)

    def _take(self, gate: Gate) -> None:
        """Continue from the gate's motion, unless it is the core's own."""
        if gate.motion is not self._motion:
            self._core.set_motion(*gate.motion)

    def _linearise(
        self, tasks: Sequence[Task], q: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the rows of tasks that are written in Python, at a configuration."""
        placed = self._placed
        placed.place(q)
        rows = [task.linearise(placed) for task in tasks]
        damping = np.zeros(placed.nv)
        for each in rows:
            damping += each.damping
        return (
            np.concatenate([each.residual for each in rows]),
            np.concatenate([each.jacobian for each in rows]),
            damping,
        )

    @cached_property
    def _placed(self) -> Configuration:
        return self._hand.configuration()

    def _result(
        self,
        gate: Gate,
        targets: np.ndarray,
        dt: float,
        numbers: np.ndarray,
        status: int,
        iterations: int,
        last_step: float,
    ) -> IkResult:
        frozen(numbers)
        q, displacement, stop_times, active, points, wrist = self._parts.of(numbers)
        gate.motion = self._motion = Motion(q, displacement, dt, stop_times)
        return IkResult(
            _STATUSES[status],
            points,
            targets,
            q,
            wrist,
            displacement,
            active.astype(np.int8),
            self._hand.joint_columns,
            iterations,
            last_step,
        )


@lru_cache(maxsize=16)
def core_tree(hand: Hand) -> Any | None:
    """Return the core's kinematics of a hand; None without a core, or if it lacks a joint."""
    try:
        return core and core.Tree(hand)
    except ValueError:
        return None


def compile_ik(hand: Hand, options: IkOptions, gate: Gate) -> CompiledIk | None:
    """Return the core of a hand; None where it is not built, not asked for, or not able.

    Args:
        hand: The hand.
        options: Weights and settings.
        gate: Its limits and pairs.
    """
    is_asked = options.formulation == "compiled" and options.solver == "daqp"
    tree = core_tree(hand)
    if core is None or tree is None or not is_asked:
        return None
    try:
        return CompiledIk(hand, core.Ik(tree, hand, options, gate))
    except ValueError:
        # A kind of shape that the core does not have.
        return None
