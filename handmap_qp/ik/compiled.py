"""The compiled core of a hand: built from what Pinocchio loaded, and called once a sample.

The core (`handmap_qp/core`, C++) does what `handmap_qp.ik.qp`, `limits` and `collision` do, up to
rounding: they are its readable reference. It has kinematics, distances and a QP solver of its own.
"""

from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Any, get_args

import numpy as np

from handmap_qp.hands import Configuration, Hand
from handmap_qp.se3 import Array
from .core import core
from .limits import Gate
from .options import IkOptions
from .qp import IkResult, Status
from .tasks import Goal, Task

STATUSES = get_args(Status)
"""Outcomes in the order of the core's numbers."""


class CompiledIk:
    """The core of one hand; see `compile_ik`. It moves the hand, and the gate with it."""

    def __init__(self, hand: Hand, core_ik: Any, gate: Gate) -> None:
        self._hand = hand
        self.core = core_ik
        self._gate = gate

    def solve(self, goal: Goal) -> IkResult:
        """Move the hand for one sample."""
        return self.core.solve(self._gate, self._hand, goal, self._linearise)

    @property
    def detours(self) -> list[Any]:
        """The `Detour` of each hand; empty where something else has moved the robot since."""
        return [] if self._gate.was_set else self.core.detours

    def go_on(self, detours: list[Any]) -> None:
        """Continue the gate's motion on detours, as the hands do that these are copies of."""
        self.core.set_motion(*self._gate.motion)
        self._gate.was_set = False
        self.core.detours = detours

    def made(self, kind: str, hand: Hand, *arguments: Any) -> Any:
        """Return the core's way from samples to steps of a hand, by the name of its class."""
        return getattr(core, kind)(self.core, self._gate, hand, *arguments)

    def _linearise(self, tasks: Sequence[Task], q: Array) -> tuple[Array, Array, Array]:
        """Return the rows of tasks that are written in Python, at a configuration."""
        placed = self._placed
        placed.place(q)
        rows = (task.linearise(placed) for task in tasks)
        residuals, jacobians, dampings = zip(*rows, strict=True)
        residual, jacobian = map(np.concatenate, (residuals, jacobians))
        return residual, jacobian, sum(dampings, np.zeros(placed.nv))

    @cached_property
    def _placed(self) -> Configuration:
        return self._hand.configuration()


@lru_cache(maxsize=16)
def core_tree(hand: Hand) -> Any | None:
    """Return the core's kinematics of a hand; None without a core, or if it lacks a joint."""
    if hand.unscaled:
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
    if not (core and tree and is_asked):
        return None
    try:
        return CompiledIk(hand, core.Ik(tree, hand, options, gate), gate)
    except ValueError:
        # A kind of shape that the core does not have.
        return None
