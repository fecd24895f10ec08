"""Anatomical names of a hand's fingers, by their order across the palm and their own names."""

from itertools import combinations

import numpy as np

from handmap_qp.hands import THUMB, Names, human
from .hypotheses import CERTAIN, DISPUTED, LIKELY
from .layout import Layout
from .structure import Clue

FINGERS = human.FINGERS[1:]
"""The fingers from the thumb's side outwards; additional fingers are numbered."""
NARROW = 0.004
"""Neighbouring fingers closer than this could be in either order [m]."""


def name_fingers(
    layout: Layout, radial: Clue, thumb: Clue, tips: float
) -> tuple[dict[int, str], Clue]:
    """Name the fingers by their order across the palm, or by their own names.

    Args:
        layout: The fingers about the thumb.
        radial: Direction across the palm to the thumb.
        thumb: Evidence for the thumb.
        tips: Confidence in the fingertips, which their order across the palm depends on.
    """
    flexion = layout.flexion
    labels = layout.labels
    sure = thumb.confidence
    # By base and tip: fingers spread towards their tips, and bases may lie in line.
    places = (0.7 * flexion.bases + 0.3 * flexion.tips_open) @ radial.answer
    order = sorted(layout.others, key=lambda i: -places[i])
    apart = -np.diff(places[order]).max(initial=-np.inf)
    how = "ordered by position across the palm, from the thumb's side"
    confidence = min(radial.confidence, CERTAIN if apart > NARROW else 0.4, sure, tips)
    if len(order) < 2:
        # Nothing is left to choose but the thumb.
        confidence = max(confidence, min(0.9, sure))
    own = {labels.index(label): label for label in FINGERS if label in labels}
    # A finger of another name may be given as the thumb.
    own.pop(layout.thumb, None)
    named = _fitting(order, {}) or {}
    is_named = 0 < len(order) == len(own)
    if (fitting := _fitting(order, own)) and own:
        named = fitting
        if is_named:
            how += "; the names agree"
            confidence = CERTAIN if sure >= LIKELY else LIKELY
        else:
            how += f"; the names {', '.join(own.values())} agree"
    elif own and (apart < 2.0 * NARROW or confidence < LIKELY):
        how = "from the names; their places are ambiguous"
        free = (name for name in named.values() if name not in own.values())
        given = own | {i: next(free) for i in order if i not in own}
        ranks = _names_of(len(order))
        named = dict(sorted(given.items(), key=lambda item: ranks.index(item[1])))
        confidence = LIKELY if is_named else confidence
    elif own:
        how += f"; the names say {', '.join(own.values())}"
        confidence = min(confidence, DISPUTED)
    if layout.thumb is not None:
        named = {layout.thumb: THUMB, **named}
    return named, Clue("fingers", ", ".join(named.values()), how, confidence)


def _fitting(order: list[int], own: dict[int, str]) -> dict[int, str] | None:
    """Return names of fingers in their order that include their own ones; None if none do."""
    for names in combinations(_names_of(len(order)), len(order)):
        named = dict(zip(order, names, strict=True))
        if named | own == named:
            return named
    return None


def _names_of(count: int) -> Names:
    """Return the names that some fingers besides the thumb may have, outwards."""
    more = range(len(FINGERS) + 2, count + 2)
    return (*FINGERS, *(f"finger{k}" for k in more))
