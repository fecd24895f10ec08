"""Tell wrong input from a human hand, also by the orders that layouts have; see `InputCheck`.

    check = InputCheck("right")
    finding = check.update(time, landmarks, wrist)      # at every valid sample; None if plausible

`check_recording` does the same for a file.
"""

from functools import cache

from handmap_core.errors import InvalidInputError
from handmap_core.human import Finding, Recording
from handmap_core.se3 import Array
from handmap_core.trackers import plausibility
from handmap_core.trackers.orders import KnownOrders
from handmap_qp.hands import Side
from handmap_qp.human import LANDMARK_COUNT
from .layouts import LAYOUTS


def layout_orders() -> dict[str, Array]:
    """Return where our landmarks are in each layout that has 21 of them, shape (21,), by name."""
    layouts = {}
    for name, layout in LAYOUTS.items():
        is_like_ours = layout.shapes[0][0] == LANDMARK_COUNT
        order = layout.order("right") if is_like_ours else None
        if order is not None:
            layouts[name] = order
    return layouts


@cache
def known_orders() -> KnownOrders:
    """Return the known orders, with those of all layouts that have 21 landmarks."""
    return KnownOrders(layout_orders())


class InputCheck(plausibility.InputCheck):
    """Checks one hand's samples as they come; knows the orders of all layouts.

    Args:
        side: The hand that the samples are said to be of.

    Raises:
        InvalidInputError: If the side is neither `right` nor `left`.
    """

    def __init__(self, side: Side) -> None:
        super().__init__(side, known_orders())


def check_recording(recording: Recording, *, name: str = "") -> None:
    """Reject a recording that cannot be what it says.

    Args:
        recording: The recording.
        name: What to call the recording in an error; its own name if omitted.

    Raises:
        InvalidInputError: If something is wrong in a quarter of it or more.
    """
    finding = examine_recording(recording)
    if finding is not None:
        raise InvalidInputError(
            finding.problem, argument=name or recording.name, advice=finding.advice
        )


def examine_recording(recording: Recording) -> Finding | None:
    """Tell what is wrong with a recording.

    Args:
        recording: The recording; its wrist poses are examined too.

    Returns:
        What is wrong in a quarter of its valid samples or more; None if it is plausible. A tracker
        that confuses the hand for a moment is left to the guard (`stream.guard`).
    """
    return InputCheck(recording.side).examine(recording)
