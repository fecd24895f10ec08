"""The directions of a palm: along the straight fingers, and out of its back."""

import numpy as np

from handmap_core.se3 import Array, lengths, unit
from handmap_qp.hands import PARALLEL
from .hypotheses import CERTAIN, DISPUTED, LIKELY
from .layout import Layout
from .structure import Clue
from .vectors import (
    UNKNOWN,
    across_ways,
    angle_between,
    beside,
    nearest_axis,
    snapped,
    widest,
)

# Length of the mean unit vector of fingers that agree.
_AGREED = 0.85
# Directions agree within this angle [deg].
_AGREEING = 25.0
# A thumb opposes the fingers' direction if the cosine between both is smaller.
_OPPOSED = -0.5
# The line from a hinge beside a fixed jaw to its end is at most this far off the jaw [deg], whose
# surface is so many times longer than wide, and reaches at most this share of it beyond the end.
# The hinge is at right angles to it within the last angle [deg].
_OBLIQUE = 30.0
_LONGER = 1.3
_SHORT = 0.15
_UPRIGHT = 8.0


def find_distal(layout: Layout) -> Clue:
    """Find the direction of the stretched fingers, in the palm link's coordinates."""
    flexion = layout.flexion
    axis = layout.axis
    chosen, mean = _mean_direction(layout)
    knuckles = flexion.bases[chosen]
    agreement = lengths(mean)
    if agreement < 0.2:
        mean = (flexion.tips_closed - flexion.bases).mean(axis=0)
    if lengths(mean) < 1e-6:
        # Jaws without a length lie ahead of the palm's origin.
        mean = flexion.tips_closed.mean(axis=0)
    ahead = unit(flexion.tips_closed.mean(axis=0))
    if flexion.slides.any() and not axis.any() and unit(mean) @ ahead < _OPPOSED:
        # Slides of jaws may start anywhere, also beyond the tips.
        mean = lengths(mean) * ahead
    across = beside(mean, axis)
    middle = knuckles.mean(axis=0)
    reaching = _along_fixed_jaw(layout)
    mean = snapped(unit(across if lengths(across) > 0.2 else mean), middle, axis)
    how = f"the mean direction of the straight fingers (agreement {agreement:.2f} of 1)"
    if reaching.any():
        mean = reaching
        how = "the way of the jaw that does not move, whose surface reaches farthest there"
    confidence = 0.4
    if agreement > _AGREED:
        # Jaws start anywhere: only with an axis of flexion is their direction exact.
        confidence = CERTAIN if axis.any() else LIKELY
        row = widest(knuckles) if len(knuckles) > 2 else mean
        if angle_between(mean, middle) < _AGREEING:
            how += "; the knuckles lie in this direction from the palm's origin"
        elif abs(mean @ row) < np.sin(np.radians(_AGREEING)):
            how += "; at right angles to the row of the knuckles"
        else:
            confidence = LIKELY
    # Fingers around a centre, as a Barrett hand's, have no straight posture of a person.
    if len(layout.others) > 1 and flexion.directions[layout.thumb] @ mean < _OPPOSED:
        how += "; the thumb points the other way: the palm's direction may be better"
        confidence = DISPUTED
    return Clue("distal", mean, how, confidence)


def _mean_direction(layout: Layout) -> tuple[list[int], Array]:
    """Return the fingers that tell the direction of a hand, and the mean of theirs, shape (3,).

    Jaws lean to opposite sides: of two, it is the middle of both, or the fixed one.
    """
    flexion = layout.flexion
    if _is_pair_against_one(layout):
        return layout.others, _middle(flexion.directions)
    chosen = layout.others
    if len(flexion.bases) == 2 and flexion.moves[chosen].any():
        chosen = [0, 1]
    return chosen, flexion.directions[chosen].mean(axis=0)


def _is_pair_against_one(layout: Layout) -> bool:
    """Return whether two fingers with one joint each close against a third one, as jaws do.

    Such a finger may lean at zero, and the other side then leans the other way. More fingers are a
    row, which has a direction of its own.
    """
    flexion = layout.flexion
    if len(layout.others) != 2 or flexion.shortens.any():
        return False
    ways = across_ways(flexion.ways, flexion.directions, layout.others)
    way = unit(ways[layout.others].sum(axis=0))
    return bool(ways[layout.thumb] @ way < _OPPOSED)


def _middle(directions: Array) -> Array:
    """Return the mean of directions (k, 3) in which those that are alike count once."""
    alike = directions @ directions.T > PARALLEL
    return np.average(directions, axis=0, weights=1.0 / alike.sum(axis=1))


def _along_fixed_jaw(layout: Layout) -> Array:
    """Return the link's axis along a jaw that is a part of the palm, zero if none is clear.

    Where that jaw begins is not known. The other one's hinge is beside it, so that the line from
    there is oblique. The jaw lies where its surface reaches farthest, in the plane in which the
    other one opens.
    """
    flexion = layout.flexion
    surface = layout.surface
    fixed = np.flatnonzero(~flexion.moves.any(axis=1))
    if not len(fixed) or not len(surface):
        return UNKNOWN
    line = unit(beside(flexion.directions[fixed[0]], flexion.hinges[fixed[0]]))
    nearest, ahead = nearest_axis(line)
    sizes = np.ptp(surface, axis=0)
    short = (surface @ ahead).max() - flexion.tips_open[fixed[0]] @ ahead
    is_along = (
        angle_between(line, ahead) < _OBLIQUE
        and abs(angle_between(flexion.hinges[fixed[0]], ahead) - 90.0) < _UPRIGHT
        and sizes[nearest] > _LONGER * np.delete(sizes, nearest).max()
        and short < _SHORT * sizes[nearest]
    )
    return ahead if is_along else UNKNOWN


def find_dorsal(layout: Layout, distal: Clue) -> Clue:
    """Find the back of the hand: opposite to the way in which the fingertips flex."""
    flexion = layout.flexion
    others = layout.others
    ahead = distal.answer
    mean = flexion.ways[others].mean(axis=0)
    agreement = lengths(mean)
    how = f"opposite to the fingertips' motion in flexion (agreement {agreement:.2f} of 1)"
    overtaking = _overtaking(layout)
    if overtaking.any():
        mean = overtaking
        how = "away from the jaw that closes on the other one, which moves the same way"
    palmar = beside(mean, ahead)
    sign = np.median(flexion.certainty[others])
    upright = np.cross(layout.axis, ahead)
    if abs(palmar @ upright) > 0.2:
        # The axes of flexion are exact; the way of the tips depends on the posture.
        palmar = np.sign(palmar @ upright) * upright
    if lengths(palmar) < 0.2 and layout.thumb is not None:
        tips = flexion.tips_open
        palmar = beside(tips[layout.thumb] - tips[others].mean(axis=0), ahead)
        sign = 0.5
        how = "away from the thumb, because the other fingertips flex in different directions"
    if lengths(palmar) < 1e-6:
        palmar = beside(np.eye(3)[np.argmin(np.abs(ahead))], ahead)
        sign = 0.05
        how = "undetermined: an arbitrary direction at right angles to distal"
    dorsal = unit(beside(snapped(unit(-palmar)), ahead))
    best = LIKELY if agreement > 0.4 else DISPUTED
    tilt = _tilt(layout, ahead, dorsal)
    height = thumb_height(layout, dorsal)
    if agreement > _AGREED and (tilt < _AGREEING or height > 0.1):
        best = CERTAIN
        how += "; at right angles to the row of the knuckles" * (tilt < _AGREEING)
        how += "; the thumb closes on the other side" * (height > 0.1)
    if tilt > 2.0 * _AGREEING:
        best = DISPUTED
        how += f"; the row of the knuckles is {tilt:.0f} degrees off the palm's plane"
    return Clue("dorsal", dorsal, how, min(best, sign, distal.confidence), sign)


def _overtaking(layout: Layout) -> Array:
    """Return the way of the other jaw relative to the thumb that overtakes it, zero if none does.

    One joint that moves two jaws the same way closes them by the difference of their motions.
    """
    flexion = layout.flexion
    if len(flexion.bases) != 2 or layout.thumb is None or flexion.axes.any():
        return UNKNOWN
    travels = flexion.tips_closed - flexion.tips_open
    (other,) = layout.others
    relative = travels[other] - travels[layout.thumb]
    return unit(relative) if relative @ flexion.ways[other] < 0.0 else UNKNOWN


def confirmed(dorsal: Clue) -> Clue:
    """Return a dorsal direction with which the side agrees."""
    if dorsal.sign <= 0.05:
        return dorsal
    sure = CERTAIN if dorsal.confidence >= LIKELY else LIKELY
    return dorsal._replace(how=f"{dorsal.how}; the side agrees", confidence=sure)


def thumb_height(layout: Layout, dorsal: Array) -> float:
    """Return how far before the knuckles the thumb closes, in lengths of the fingers."""
    flexion = layout.flexion
    thumb = layout.thumb
    if thumb is None or flexion.certainty[thumb] <= 0.6:
        return 0.0
    before = flexion.bases[layout.others].mean(axis=0) - flexion.tips_closed[thumb]
    return float(before @ dorsal / max(flexion.reach[layout.others].mean(), 1e-6))


def _tilt(layout: Layout, distal: Array, dorsal: Array) -> float:
    """Return the angle of the row of the knuckles to the palm [deg], a neutral one without."""
    across = beside(widest(layout.flexion.bases[layout.others]), distal)
    if len(layout.others) < 3 or lengths(across) < 0.5:
        return 1.5 * _AGREEING
    return abs(angle_between(across, dorsal) - 90.0)
