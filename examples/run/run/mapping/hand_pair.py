"""The names of `mapping.hand_pair`: a saved pair of hands was measured before."""

from typing import Any, NoReturn

from handmap_core.errors import InvalidOptionsError
from ..hands import Grasp, Hand


def _refuse(*_: Any, **__: Any) -> NoReturn:
    raise InvalidOptionsError(
        "a saved hand keeps its method",
        option="method",
        advice="save it again with another one: handmap hands save",
    )


hand_pair = finger_landmarks = touching_distances = require_partners = _refuse


def robot_fingers(hand: Hand) -> Grasp:
    """Return what was measured on a robot hand for its grips."""
    return hand.grasp
