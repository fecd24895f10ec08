"""Thumb, palm directions, side and finger names, from the fingers' positions and flexion."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from handmap_qp.hands.spec import Side
from handmap_qp.onboarding.flexion import FingerFlexion

FINGERS = ("index", "middle", "ring", "little")
"""The fingers from the thumb's side outwards; additional fingers are numbered."""
# Score margins above which an answer is clear, or likely, without other evidence.
_CLEAR, _LIKELY = 0.3, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Clue:
    """One detected property of a hand.

    Attributes:
        what: The property: `palm`, `thumb`, ...
        answer: Its detected value.
        how: Evidence for it, a sentence without a full stop.
        confidence: From 0 to 1.
    """

    what: str
    answer: str
    how: str
    confidence: float

    @property
    def certainty(self) -> str:
        """The confidence in words."""
        return (
            "certain"
            if self.confidence >= 0.9
            else "likely"
            if self.confidence >= 0.6
            else "a guess: check it"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Anatomy:
    """The hand's directions and the names of its fingers.

    Attributes:
        distal: Direction of the stretched fingers, in the palm link's coordinates, shape (3,).
        dorsal: Direction out of the back of the hand, at right angles to it, shape (3,).
        side: `right` or `left`.
        fingers: Anatomical name of every finger, in the order of the chains.
        clues: Evidence for each of these.
    """

    distal: np.ndarray
    dorsal: np.ndarray
    side: Side
    fingers: tuple[str, ...]
    clues: tuple[Clue, ...]


def find_anatomy(
    flexion: FingerFlexion,
    names: list[list[str]],
    hints: Iterable[str],
    side: Side | None,
    thumb: int | None,
) -> Anatomy:
    """Name the fingers, and find the palm's directions.

    Args:
        flexion: How the fingers flex.
        names: Names of every finger's links and joints, used only where kinematics is ambiguous.
        hints: Names that may contain a side: of the robot, its file and its palm.
        side: The side, if known.
        thumb: Index of the thumb, if known.

    Returns:
        Directions, side and finger names.
    """
    count = len(flexion.bases)
    thumb, thumb_clue = _find_thumb(flexion, names, thumb)
    rest = [i for i in range(count) if i != thumb]
    distal, distal_clue = _find_distal(flexion, rest)
    dorsal, dorsal_clue = _find_dorsal(flexion, rest, thumb, distal)
    across = np.cross(distal, dorsal)
    found, side_clue = _find_side(
        flexion, across, rest, thumb, [*hints, *(name for group in names for name in group)], side
    )
    radial = -across if found == "right" else across
    # Order fingers by base and tip: fingers spread towards their tips, and bases may lie one behind
    # the other.
    places = (flexion.bases + 0.3 * (flexion.tips_open - flexion.bases)) @ radial
    order = sorted(rest, key=lambda i: -places[i])
    fingers = [""] * count
    if thumb is not None:
        fingers[thumb] = "thumb"
    for place, i in enumerate(order):
        fingers[i] = FINGERS[place] if place < len(FINGERS) else f"finger{place + 2}"
    gaps = -np.diff([places[i] for i in order])
    order_clue = Clue(
        "fingers",
        ", ".join(fingers[i] for i in ([] if thumb is None else [thumb]) + order),
        "ordered by position across the palm, from the thumb's side"
        + (f"; neighbours are at least {1e3 * gaps.min():.0f} mm apart" if len(gaps) else ""),
        min(side_clue.confidence, 0.95 if not len(gaps) or gaps.min() > 0.004 else 0.4)
        if len(rest) > 1
        else 0.9,
    )
    return Anatomy(
        distal,
        dorsal,
        found,
        tuple(fingers),
        (thumb_clue, distal_clue, dorsal_clue, side_clue, order_clue),
    )


def _find_thumb(
    flexion: FingerFlexion, names: list[list[str]], given: int | None
) -> tuple[int | None, Clue]:
    count = len(flexion.bases)
    if given is not None:
        return given, Clue("thumb", names[given][-1], "as given", 1.0)
    if count < 2:
        return None, Clue("thumb", "none", "the hand has one finger only", 0.9)
    scores = _dissimilarity(flexion, names)
    best = int(np.argmax(scores))
    margin = float(np.sort(scores)[-1] - np.sort(scores)[-2]) if count > 2 else 0.0
    named = [i for i, group in enumerate(names) if any("thumb" in name.lower() for name in group)]
    if margin > _LIKELY:
        confidence = 0.95 if margin > _CLEAR else 0.75
        how = "its position, direction and flexion differ from those of the other fingers"
        if len(named) == 1 and named[0] != best:
            how += f"; the link names suggest {names[named[0]][-1]}"
            confidence = min(confidence, 0.5)
        return best, Clue("thumb", names[best][-1], f"{how} (margin {margin:.2f} of 1)", confidence)
    if len(named) == 1:
        return named[0], Clue(
            "thumb",
            names[named[0]][-1],
            "from the link names; the kinematics is ambiguous",
            0.6,
        )
    how = (
        "the fingers are alike, so the first one was taken"
        if count > 2
        else "of two similar fingers the first one was taken"
    )
    return best if margin > 1e-6 else 0, Clue(
        "thumb", names[best if margin > 1e-6 else 0][-1], how, 0.3
    )


def _dissimilarity(flexion: FingerFlexion, names: list[list[str]]) -> np.ndarray:
    """Score each finger: difference from the others minus theirs from each other, shape (F,)."""
    directions, count = flexion.directions, len(flexion.bases)
    differences = np.zeros((count, count))
    for i in range(count):
        for j in range(count):
            along = directions[i] + directions[j]
            length = np.linalg.norm(along)
            ahead = (
                abs((flexion.bases[i] - flexion.bases[j]) @ along) / length
                if length > 1e-6
                else 0.0
            )
            differences[i, j] = (
                0.5 * (1.0 - directions[i] @ directions[j])
                + 0.5 * (1.0 - flexion.ways[i] @ flexion.ways[j])
                + 0.5 * min(1.0, 2.0 * ahead / max(flexion.reach[i], flexion.reach[j], 1e-9))
                # A different number of joints counts, but less than any of the above.
                + 0.15 * (len(names[i]) != len(names[j]))
            )
    scores = np.zeros(count)
    for i in range(count):
        others = [j for j in range(count) if j != i]
        among = differences[np.ix_(others, others)]
        scores[i] = differences[i, others].mean() - among.sum() / max(
            1, len(others) * (len(others) - 1)
        )
    return scores


def _find_distal(flexion: FingerFlexion, fingers: list[int]) -> tuple[np.ndarray, Clue]:
    directions = flexion.directions[fingers]
    # The two jaws of a gripper lean in opposite directions: average both.
    mean = directions.mean(axis=0)
    if len(flexion.bases) == 2:
        mean = flexion.directions.mean(axis=0)
    agreement = float(np.linalg.norm(mean))
    if agreement < 0.2:
        mean = flexion.tips_closed.mean(axis=0) - flexion.bases.mean(axis=0)
    mean = _snapped(mean / np.linalg.norm(mean))
    how = f"the mean direction of the straight fingers (agreement {agreement:.2f} of 1)"
    return mean, Clue(
        "distal", _shown(mean), how, 0.95 if agreement > 0.85 else 0.7 if agreement > 0.6 else 0.4
    )


def _find_dorsal(
    flexion: FingerFlexion, fingers: list[int], thumb: int | None, distal: np.ndarray
) -> tuple[np.ndarray, Clue]:
    palmar = flexion.ways[fingers].mean(axis=0)
    agreement = float(np.linalg.norm(palmar))
    palmar = palmar - (palmar @ distal) * distal
    how = f"opposite to the fingertips' motion in flexion (agreement {agreement:.2f} of 1)"
    certainty = float(flexion.certainty[fingers].min())
    if np.linalg.norm(palmar) < 0.2 and thumb is not None:
        palmar = flexion.tips_open[thumb] - flexion.tips_open[fingers].mean(axis=0)
        palmar = palmar - (palmar @ distal) * distal
        how, certainty = (
            "away from the thumb, because the other fingertips flex in different directions",
            0.5,
        )
    if np.linalg.norm(palmar) < 1e-6:
        palmar = np.eye(3)[np.argmin(np.abs(distal))]
        palmar = palmar - (palmar @ distal) * distal
        how, certainty = "undetermined: an arbitrary direction at right angles to distal", 0.05
    dorsal = _snapped(-palmar / np.linalg.norm(palmar))
    dorsal = dorsal - (dorsal @ distal) * distal
    dorsal = np.where(np.abs(dorsal) < 1e-9, 0.0, dorsal)
    dorsal = dorsal / np.linalg.norm(dorsal)
    confidence = min(certainty, 0.95 if agreement > 0.85 else 0.7 if agreement > 0.4 else 0.5)
    return dorsal, Clue("dorsal", _shown(dorsal), how, confidence)


def _find_side(
    flexion: FingerFlexion,
    across: np.ndarray,
    fingers: list[int],
    thumb: int | None,
    names: list[str],
    given: Side | None,
) -> tuple[Side, Clue]:
    """Find the side: a right hand seen from the back, fingers up, has its thumb on the left."""
    sides: tuple[Side, Side] = ("right", "left")
    votes = {side: sum(bool(_SIDES[side].search(name)) for name in names) for side in sides}
    named = None if votes["right"] == votes["left"] else max(sides, key=lambda side: votes[side])
    place = 0.0
    if thumb is not None:
        middle = flexion.bases[fingers].mean(axis=0) @ across
        width = max(
            float(np.ptp(flexion.bases[fingers] @ across)) / 2.0,
            0.25 * float(flexion.reach[fingers].mean()),
        )
        place = (
            float(((flexion.bases[thumb] + flexion.tips_open[thumb]) / 2.0) @ across - middle)
            / width
        )
    found: Side = "right" if place < 0.0 else "left"
    if abs(place) > _LIKELY and len(flexion.bases) > 2:
        confidence = 0.95 if abs(place) > _CLEAR else 0.7
        thumb_side = "left" if found == "right" else "right"
        how = f"seen from the back with the fingers up, the thumb is on the {thumb_side}"
        if named is not None and named != found:
            how, confidence = f"{how}; the names say {named}", 0.5
    elif named is not None:
        found, confidence = named, 0.6
        how = "from the names; the thumb is in the middle"
    else:
        found, confidence, how = "right", 0.2, "undetermined; right by convention"
    if given is None or given == found:
        return found, Clue("side", found, how, 1.0 if given else confidence)
    how = (
        f"as given; {how.replace('; right by convention', '')}, which suggests {found}"
        if confidence > 0.3
        else "as given"
    )
    return given, Clue("side", given, how, 0.9 if confidence <= 0.7 else 0.5)


# A single letter counts only at the start or end of a name: `l3` is usually the third link, not a
# left one.
_SIDES = {
    "right": re.compile(r"[Rr]ight|RIGHT|(?:^|_)(?:rh|RH)(?:_|$)|^[rR]_|_[rR]$|^R(?=[A-Z][a-z])"),
    "left": re.compile(r"[Ll]eft|LEFT|(?:^|_)(?:lh|LH)(?:_|$)|^[lL]_|_[lL]$|^L(?=[A-Z][a-z])"),
}


def _snapped(direction: np.ndarray) -> np.ndarray:
    """Return the axis within 5 degrees of a direction, or else the direction, normalised.

    The mean direction of spread fingers is a few degrees off the link's axis.
    """
    nearest = int(np.argmax(np.abs(direction)))
    if abs(direction[nearest]) > np.cos(np.radians(5.0)):
        return np.sign(direction[nearest]) * np.eye(3)[nearest]
    direction = np.where(np.abs(direction) < 1e-6, 0.0, direction)
    return direction / np.linalg.norm(direction)


def _shown(direction: np.ndarray) -> str:
    for axis, name in enumerate("xyz"):
        if abs(direction[axis]) > 0.9999:
            return f"{'+' if direction[axis] > 0 else '-'}{name}"
    return "[" + ", ".join(f"{value:.3f}" for value in direction) + "]"
