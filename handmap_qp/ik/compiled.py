"""The compiled core of a hand: built from what Pinocchio loaded, and called once a sample.

The core (`handmap_qp/core`, C++) does what `handmap_qp.ik.qp`, `limits` and `collision` do, up to
rounding: they are its readable reference. It has kinematics, distances and a QP solver of its own.
"""

from functools import lru_cache
from typing import Any, get_args

from handmap_qp.hands import Hand
from .core import core
from .limits import Gate
from .options import IkOptions
from .qp import Status

STATUSES = get_args(Status)
"""Outcomes in the order of the core's numbers."""


@lru_cache(maxsize=16)
def core_tree(hand: Hand) -> Any | None:
    """Return the core's kinematics of a hand; None if it lacks a joint."""
    if hand.unscaled:
        standard = core_tree(hand.unscaled)
        return standard and standard.moved(hand.moves)
    try:
        return core.Tree(hand)
    except ValueError:
        return None


def compile_ik(hand: Hand, options: IkOptions, gate: Gate) -> Any | None:
    """Return the core of a hand, which moves it and the gate with it.

    It is None where it is not asked for, or not able.

    Args:
        hand: The hand.
        options: Weights and settings.
        gate: Its limits and pairs.
    """
    is_asked = options.formulation == "compiled" and options.solver == "daqp"
    tree = core_tree(hand)
    if not (tree and is_asked):
        return None
    try:
        return core.Ik(tree, hand, options, gate)
    except ValueError:
        # A kind of shape that the core does not have.
        return None
