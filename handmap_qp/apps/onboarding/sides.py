"""Which side a hand is of: by where its thumb is, its names, and the other hand of a robot."""

from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array
from handmap_qp.hands import Side
from .finger_order import FINGERS, NARROW
from .hypotheses import CERTAIN, CLEAR, CLEAR_FLEXION, DISPUTED, LIKELY, VISIBLE
from .layout import Layout
from .palm_directions import confirmed
from .structure import Clue


class Declared(NamedTuple):
    """The side that something beside the hand's shape says.

    Attributes:
        side: The side, if any says it.
        source: What says it.
        is_given: Whether an owner does.
        is_forced: Whether it counts more than where the hand's own thumb is.
    """

    side: Side | None
    source: str
    is_given: bool = False
    is_forced: bool = False


def find_radial(layout: Layout, across: Array, values: dict[str, float]) -> Clue:
    """Return the direction across the palm to the thumb; confidence 0 if that is central.

    Args:
        layout: The fingers about the thumb.
        across: Unit vector across the palm, shape (3,).
        values: Evidence, to which that of the fingers' names is added.
    """
    flexion = layout.flexion
    others = layout.others
    bases = {layout.labels[i]: flexion.bases[i] @ across for i in others}
    steps = -np.diff([bases[label] for label in FINGERS if label in bases])
    # Names count if all steps are to one side, and none is too small to tell.
    named = np.sign(steps.sum())
    named *= (named * steps > 0.5 * NARROW).all()
    # Where the thumb's base and tip are on one side, in half widths of the palm.
    ends = np.zeros(2)
    if len(others) > 1:
        row = flexion.bases[others] @ across
        width = max(0.5 * np.ptp(row), 0.25 * flexion.reach[others].mean())
        points = np.array([flexion.roots, flexion.tips_open])[:, layout.thumb]
        ends = (points @ across - row.mean()) / width
    place = ends.mean()
    is_outside = abs(place) > 2.0 * CLEAR and (ends * place > 0.0).all()
    place *= abs(place) > VISIBLE
    how = "the thumb's place"
    is_clear = abs(place) > CLEAR
    values["finger names"] = float(np.sign(named * place))
    confidence = (
        CERTAIN if is_outside else LIKELY if is_clear else 0.65 if place else 0.0
    )
    if named * place > 0.0:
        how = "the thumb's place and the fingers' names"
        confidence = CERTAIN
    elif named:
        how = how if is_clear else "the fingers' names"
        confidence = DISPUTED if is_clear else LIKELY
    # Names count as much as a clear place.
    return Clue("radial", np.sign(place + CLEAR * named) * across, how, confidence)


def find_side(
    told: Declared,
    across: Array,
    dorsal: Clue,
    radial: Clue,
    thumb: Clue,
    *,
    is_turned: bool | None,
) -> tuple[Clue, Clue]:
    """Find the side: a right hand seen from the back, fingers up, has its thumb on the left.

    A given or named side may turn the dorsal direction over.

    Args:
        told: The side that something else says.
        across: Unit vector across the palm, at right angles to both directions, shape (3,).
        dorsal: The direction out of the back by flexion.
        radial: The direction across the palm to the thumb.
        thumb: Evidence for the thumb.
        is_turned: Whether the palm is turned over; by what is told if None.

    Returns:
        The direction out of the back, and the side.
    """
    declared, source, given, is_forced = told
    if radial.confidence == 0.0:
        how = f"{source}; the thumb is in the middle"
        sure = 1.0 if given else 0.65
        if declared is None:
            how = "undetermined; right by convention"
            sure = 0.2
        return dorsal, Clue("side", declared or "right", how, sure)
    is_right = radial.answer @ across < 0.0
    found, place = ("right", "left") if is_right else ("left", "right")
    how = f"seen from the back with the fingers up, the thumb is on the {place} ({radial.how})"
    least = min(radial.confidence, thumb.confidence)
    sure = min(least, dorsal.confidence)
    if is_turned and not given:
        back = f"the back of a {place} hand with its thumb there"
        over = Clue("dorsal", -dorsal.answer + 0.0, back, min(LIKELY, least), 0.0)
        return over, Clue("side", place, how, min(LIKELY, least))
    if is_turned is False and declared != found and not given:
        return dorsal, Clue("side", found, how, sure)
    answer = found
    is_clear = dorsal.sign > CLEAR_FLEXION
    if declared == found:
        how = f"{source}, and {how}"
        sure = 1.0 if given else CERTAIN if least >= LIKELY else LIKELY
        dorsal = confirmed(dorsal)
    elif declared and is_clear and is_forced:
        # The other hand is of the side that this one looks like. Its palm is known.
        answer = declared
        how = f"{source}; {how}, as on the other hand"
        sure = DISPUTED
    elif declared and is_clear and not given and radial.confidence >= LIKELY:
        # They disagree: names yield to clear flexion, an owner's word does not.
        how += f"; the names say {declared}"
        sure = DISPUTED
    elif declared:
        answer = declared
        why = f"the ranges of the joints suggest {found}"
        sure = 0.4
        if not is_clear:
            why = "flexion is symmetric"
            sure = 0.9 if given else min(LIKELY, least)
        how = f"{source}; {why}"
        back = f"the back of a {declared} hand with its thumb there; {why}"
        turned = min(LIKELY, sure)
        dorsal = Clue("dorsal", -dorsal.answer + 0.0, back, turned, 0.0)
    return dorsal, Clue("side", answer, how, sure)
