"""The names of `ik.compiled`: a saved hand has its own kinematics."""

from typing import Any


def core_tree(hand: Any) -> None:
    """Return nothing: landmarks at rest are saved."""
    del hand
