"""Orders in which 21 landmarks are found in the wild, and the one that explains given landmarks."""

from __future__ import annotations

from functools import cache
from itertools import permutations
from typing import NamedTuple

import numpy as np

from handmap_qp.hands.human import FINGERS
from handmap_qp.human.sample import LANDMARK_COUNT
from handmap_qp.trackers.hand_geometry import (
    all_distances,
    misfits_of_orders,
    own_distances,
    palmar_evidence,
    shape_misfit,
)
from handmap_qp.trackers.layouts import LAYOUTS

# A misfit that no hand has (`hand_geometry.own_misfit`): at most 1.2 in recordings.
_NO_HAND = 1.45
# An order must fit better than ours by this much. Real recordings fit no other order better.
_BETTER_BY = 0.12
# Evidence of `palmar_evidence`, from -5 to 5, that the order or the side cannot be right.
_CONTRADICTION = 0.6


class OrderGuess(NamedTuple):
    """What is wrong with the order of landmarks.

    Attributes:
        name: The order that explains them, in words; empty if none does.
        misfit: Misfit of our own order.
        best: Misfit of the named order, or of the best one.
    """

    name: str
    misfit: float
    best: float


def prepare() -> None:
    """Read the tables of layouts now, so that the first batch of a session does not wait."""
    _known_orders()


def find_order(
    landmarks: np.ndarray, sign: float, own_evidence: float
) -> OrderGuess | None:
    """Look for another order that explains landmarks much better than ours.

    Args:
        landmarks: Some samples, as they came, shape (T, 21, 3).
        sign: 1 for a right hand, -1 for a left one.
        own_evidence: How well the palmar side fits in our order, from -5 to 5.

    Returns:
        What is wrong; None if our order is plausible and none is much better.
    """
    names, orders = _known_orders()
    misfits = misfits_of_orders(all_distances(landmarks), orders)
    own = float(misfits[0])
    # The other hand is an explanation too, so an order of fingers must beat it only where our own
    # order contradicts the side.
    needed = own - _BETTER_BY if own_evidence > -_CONTRADICTION else own
    for k in np.argsort(misfits):
        if misfits[k] >= needed:
            break
        if k == 0:
            continue
        evidence = sign * float(
            np.median(palmar_evidence(landmarks[:, orders[k]]).total)
        )
        if evidence > min(-_CONTRADICTION, own_evidence):
            name = names[k] if misfits[k] < _NO_HAND else ""
            return OrderGuess(name, own, float(misfits[k]))
    if shape_misfit(own_distances(landmarks)) > _NO_HAND:
        best = int(misfits.argmin())
        name = (
            names[best] if misfits[best] < min(_NO_HAND, own - 3.0 * _BETTER_BY) else ""
        )
        return OrderGuess(name, own, float(misfits[best]))
    return None


@cache
def named_orders() -> dict[str, np.ndarray]:
    """Return the orders of all layouts with 21 joints, but for our own.

    Returns:
        By name of the layout, the index at which each of our landmarks is found, shape (21,).
    """
    found = {}
    for name, layout in LAYOUTS.items():
        order = layout.order("right") if layout.shapes[0][0] == LANDMARK_COUNT else None
        if order is not None and (order != np.arange(LANDMARK_COUNT)).any():
            found[name] = order
    return found


@cache
def _known_orders() -> tuple[list[str], np.ndarray]:
    """Return names and indices of our own order, of the named ones, and of all finger orders."""
    names, rows = [""], [list(range(LANDMARK_COUNT))]
    for name, order in named_orders().items():
        names.append(f"that of the layout {name}")
        rows.append(order.tolist())
    names.append("one with the wrist last")
    rows.append([20, *range(20)])
    for fingers in permutations(range(5)):
        if fingers == (0, 1, 2, 3, 4):
            continue
        # Finger `fingers[k]` was found at the place of finger k.
        order = [0] * LANDMARK_COUNT
        for place, finger in enumerate(fingers):
            order[1 + 4 * finger : 5 + 4 * finger] = range(1 + 4 * place, 5 + 4 * place)
        names.append("one with the fingers " + ", ".join(FINGERS[i] for i in fingers))
        rows.append(order)
    return names, np.array(rows)
