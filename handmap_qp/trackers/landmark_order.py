"""Orders in which 21 landmarks are found in the wild, and the one that explains given landmarks."""

from __future__ import annotations

from functools import cache
from itertools import permutations

import numpy as np

from handmap_qp.hands.human import FINGERS
from handmap_qp.human.sample import LANDMARK_COUNT
from handmap_qp.trackers.hand_geometry import (
    Distances,
    distances_in_orders,
    misfit,
    palmar_evidence,
)
from handmap_qp.trackers.layouts import LAYOUTS

# A misfit that no hand has (`hand_geometry.misfit`): at most 1.2 in recordings.
_NO_HAND = 1.45
# An order must fit better than ours by this much. Real recordings fit no other order better.
_BETTER_BY = 0.12
# Evidence of `palmar_evidence`, from -5 to 5, that the order or the side cannot be right.
_CONTRADICTION = 0.6


def prepare() -> None:
    """Read the tables of layouts now, so that the first batch of a session does not wait."""
    _known_orders()


def find_order(
    landmarks: np.ndarray,
    sign: float,
    own_evidence: float,
) -> str | None:
    """Look for another order that explains landmarks much better than ours.

    Args:
        landmarks: Some samples, as they came, shape (T, 21, 3).
        sign: 1 for a right hand, -1 for a left one.
        own_evidence: How well the palmar side fits in our order, from -5 to 5.

    Returns:
        Name of the order that explains them, in words, empty if none does; None if our order is
        plausible and none is much better.
    """
    names, orders = _known_orders()
    distances = distances_in_orders(landmarks, orders)
    misfits = misfit(distances)
    own = float(misfits[0])
    # The other hand is an explanation too, so an order of fingers must beat it only where our own
    # order contradicts the side.
    needed = own - _BETTER_BY if own_evidence > -_CONTRADICTION else own
    better = np.argsort(misfits)
    for k in better[misfits[better] < needed]:
        total = palmar_evidence(landmarks[:, orders[k]]).total
        if sign * float(np.median(total)) > min(-_CONTRADICTION, own_evidence):
            return names[k] if misfits[k] < _NO_HAND else ""
    shape = Distances(distances.medians[0], np.zeros(len(distances.medians[0])))
    if misfit(shape) <= _NO_HAND:
        return None
    best = int(misfits.argmin())
    is_hand = misfits[best] < min(_NO_HAND, own - 3.0 * _BETTER_BY)
    return names[best] if is_hand else ""


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
    own = np.arange(LANDMARK_COUNT)
    known = {"": own}
    known |= {f"that of the layout {n}": order for n, order in named_orders().items()}
    known["one with the wrist last"] = np.roll(own, 1)
    for fingers in permutations(range(len(FINGERS))):
        # Finger `fingers[k]` was found at the place of finger k.
        places = own[1:].reshape(-1, 4)[np.argsort(fingers)]
        name = "one with the fingers " + ", ".join(FINGERS[i] for i in fingers)
        known[name] = np.concatenate([[0], places.ravel()])
    known.pop("one with the fingers " + ", ".join(FINGERS))
    return list(known), np.array(list(known.values()))
