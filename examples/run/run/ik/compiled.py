"""The names of `ik.compiled`: a saved hand has its own kinematics."""

from typing import Any


def core_tree(hand: Any) -> Any:
    """Return the core's kinematics of a hand."""
    return hand.tree
