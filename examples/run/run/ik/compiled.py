"""The names of `ik.compiled`: a saved hand has its own kinematics."""

from typing import Any, get_args

from handmap_qp.ik.qp import Status

STATUSES = get_args(Status)
"""Outcomes in the order of the core's numbers."""


def core_tree(hand: Any) -> Any:
    """Return the core's kinematics of a hand."""
    return hand.tree
