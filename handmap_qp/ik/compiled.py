"""The compiled core of a hand: built from what Pinocchio loaded, and called once a sample.

The core (`handmap_qp/core`, C++) does what `handmap_qp.ik.qp`, `limits` and `collision` do, up to
rounding: they are its readable reference. It has kinematics, distances and a QP solver of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache, partial
from typing import Any, get_args

import numpy as np

from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.core import core
from handmap_qp.ik.limits import Gate, Motion
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import IkResult, Status
from handmap_qp.ik.tasks import Goal, PointDistances, Task
from handmap_qp.se3 import frozen

_STATUSES = get_args(Status)


class CompiledIk:
    """The core of one hand; see `compile_ik`. It moves the hand, and the gate with it."""

    def __init__(self, hand: Hand, core_ik: Any, gate: Gate) -> None:
        self._hand = hand
        self.core = core_ik
        self._gate = gate
        self._pose: Any = getattr(core, "HumanPose", None)

    def solve(
        self, goal: Goal, dt: float, margins: np.ndarray | None, speed: float
    ) -> IkResult:
        """Move the hand for one sample; arguments as of `PointIk.solve`."""
        tasks = goal.tasks
        distances = aims = weights = None
        first = tasks[0] if tasks else None
        if isinstance(first, PointDistances) and first.core is not None:
            distances, aims, weights = first.core, first.distances, first.weights
            tasks = tasks[1:]
        step = self._moved(
            self.core.solve,
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
        return self.result(step, goal.points)

    def follow(self, target_map: Any, pose: Any, dt: float, speed: float) -> Any:
        """Move the hand for one sample of a human, whose targets the core computes too.

        Args:
            target_map: The core of a `mapping.method.TargetMap`.
            pose: A `mapping.method.HumanPose`, or one of the core.
            dt: As of `PointIk.solve`.
            speed: Likewise.

        Returns:
            The core's step; `result` reads it.
        """
        kind = self._pose
        pose = pose if isinstance(pose, kind) else kind(pose.points, pose.wrist)
        return self._moved(self.core.follow, target_map, pose, dt, speed)

    def run(self, *arguments: Any) -> tuple[int, Any, Any]:
        """Move the hand for samples of a recording; see `stream.follower` and `core/run.hpp`.

        Returns:
            The index of the first sample that was left out, the core's verdict if it has judged
            that one, and the pose that was mapped last, if any.
        """
        self._push_motion()
        index, verdict, step, seen = self.core.run(*arguments)
        if step is not None:
            self._gate.leave_to(partial(_motion_of, step))
        return index, verdict, seen

    def _moved(self, move: Callable[..., Any], *arguments: Any) -> Any:
        """Move from where the gate is, which reads its new motion from the step when asked."""
        self._push_motion()
        step = move(*arguments)
        self._gate.leave_to(partial(_motion_of, step))
        return step

    def _push_motion(self) -> None:
        if self._gate.was_set:
            self.core.set_motion(*self._gate.motion)

    def result(self, step: Any, targets: np.ndarray) -> IkResult:
        """Return the result of a step of the core, whose points had these targets (m, 3) [m]."""
        return IkResult(
            _STATUSES[step.status],
            step.points,
            targets,
            step.configuration,
            step.wrist,
            frozen(step.displacement),
            frozen(step.active.astype(np.int8)),
            self._hand.joint_columns,
            step.iterations,
            step.last_step,
        )

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


def _motion_of(step: Any) -> Motion:
    arrays = step.configuration, step.displacement, step.stop_times
    q, displacement, stop_times = map(frozen, arrays)
    return Motion(q, displacement, step.dt, stop_times)


@lru_cache(maxsize=16)
def core_tree(hand: Hand) -> Any | None:
    """Return the core's kinematics of a hand; None without a core, or if it lacks a joint."""
    if hand.unscaled is not None:
        standard = core_tree(hand.unscaled)
        return standard and standard.moved(hand.moves)
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
        return CompiledIk(hand, core.Ik(tree, hand, options, gate), gate)
    except ValueError:
        # A kind of shape that the core does not have.
        return None
