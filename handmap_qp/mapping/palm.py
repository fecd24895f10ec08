"""Methods whose palm follows the human's, and the landmarks of a human hand by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from handmap_core.errors import InvalidOptionsError
from handmap_core.mapping import palm
from handmap_core.se3 import Array
from handmap_qp.hands import Hand
from .alignment import AlignedOptions

if TYPE_CHECKING:
    from handmap_qp.hands import ShapePairs


class PalmMethod(palm.PalmMethod[Hand]):
    """Base of methods for two hands whose wrist target is that of a `PalmMap`.

    See `BoundMethod`.

    Args:
        choices: The method.
        human: The hand that leads.
        robot: The hand that follows.
    """

    contacts: ShapePairs | None = None

    def __init__(self, choices: AlignedOptions, human: Hand, robot: Hand) -> None:
        super().__init__(choices.alignment, human, robot)


def point_indices(human: Hand) -> dict[str, int]:
    """Return the indices of a human hand's reference points by name."""
    return {point.name: k for k, point in enumerate(human.reference_points)}


def require_points(human: Hand, names: Iterable[str], user: str) -> Array:
    """Return the indices of named reference points of a human hand, shape (k,).

    Args:
        human: The human hand.
        names: The names.
        user: What needs them, for the message.

    Raises:
        InvalidOptionsError: If the hand has no reference point of a name.
    """
    wanted = list(names)
    known = point_indices(human)
    if missing := [name for name in wanted if name not in known]:
        raise InvalidOptionsError(
            f"{user} needs {', '.join(missing)} among the human's points",
            option="human_points",
            advice="load the human with points='joints' or points='landmarks'",
        )
    return np.array([known[name] for name in wanted], dtype=int)
