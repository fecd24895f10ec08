"""The compiled core of a hand: its kinematics, and the gate that its QPs move it through.

The core (`handmap_qp/core`, C++) has kinematics, distances and a QP solver of its own.
"""

from functools import lru_cache
from typing import Any

from handmap_qp.errors import HandError
from handmap_qp.hands import Hand
from .core import core


@lru_cache(maxsize=16)
def core_tree(hand: Hand) -> Any:
    """Return the core's kinematics of a hand.

    Raises:
        HandError: If the hand has a joint that is neither revolute, prismatic nor floating.
    """
    if hand.unscaled:
        return core_tree(hand.unscaled).moved(hand.moves)
    try:
        return core.Tree(hand)
    except ValueError as error:
        raise HandError(f"{hand.name}: {error}", key="urdf") from error
