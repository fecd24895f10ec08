"""Thumb, directions of the palm, side and names of the fingers, from where fingers stand and how they close."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from handmap_qp.hands.spec import Side
from handmap_qp.onboarding.flexion import Closing

FINGERS = ("index", "middle", "ring", "little")
"""The fingers from the thumb's side outwards; further ones are numbered."""
# Least difference of scores that settles a question by itself.
_CLEAR, _LIKELY = 0.3, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Clue:
    """Something found out about a hand.

    Attributes:
        what: What it is about: `palm`, `thumb`, ...
        answer: What was found.
        how: How, in a sentence without a full stop.
        confidence: From 0 to 1.
    """

    what: str
    answer: str
    how: str
    confidence: float

    @property
    def sureness(self) -> str:
        """The confidence as a word."""
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
        clues: How all of it was found.
    """

    distal: np.ndarray
    dorsal: np.ndarray
    side: Side
    fingers: tuple[str, ...]
    clues: tuple[Clue, ...]


def find_anatomy(
    closing: Closing,
    names: list[list[str]],
    hints: Iterable[str],
    side: Side | None,
    thumb: int | None,
) -> Anatomy:
    """Name the fingers and find the palm's directions.

    Args:
        closing: How the fingers close.
        names: Names of every finger's links and joints; they decide only what kinematics leaves
            open.
        hints: Names that may tell a side: of the robot, its file and its palm.
        side: The side, where it is known.
        thumb: Index of the thumb, where it is known.

    Returns:
        Directions, side and names.
    """
    count = len(closing.bases)
    thumb, thumb_clue = _find_thumb(closing, names, thumb)
    rest = [i for i in range(count) if i != thumb]
    distal, distal_clue = _find_distal(closing, rest)
    dorsal, dorsal_clue = _find_dorsal(closing, rest, thumb, distal)
    across = np.cross(distal, dorsal)
    found, side_clue = _find_side(
        closing, across, rest, thumb, [*hints, *(name for group in names for name in group)], side
    )
    radial = -across if found == "right" else across
    # Fingers spread from each other towards their tips, and bases may stand one behind the other:
    # both tell the order.
    places = (closing.bases + 0.3 * (closing.tips_open - closing.bases)) @ radial
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
        "numbered by their place across the palm, from the thumb's side"
        + (f"; neighbours are {1e3 * gaps.min():.0f} mm apart or more" if len(gaps) else ""),
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
    closing: Closing, names: list[list[str]], given: int | None
) -> tuple[int | None, Clue]:
    count = len(closing.bases)
    if given is not None:
        return given, Clue("thumb", names[given][-1], "as given", 1.0)
    if count < 2:
        return None, Clue("thumb", "none", "there is one finger only", 0.9)
    scores = _strangeness(closing, names)
    best = int(np.argmax(scores))
    margin = float(np.sort(scores)[-1] - np.sort(scores)[-2]) if count > 2 else 0.0
    named = [i for i, group in enumerate(names) if any("thumb" in name.lower() for name in group)]
    if margin > _LIKELY:
        confidence = 0.95 if margin > _CLEAR else 0.75
        how = "it stands, points and closes otherwise than the others, which agree with each other"
        if len(named) == 1 and named[0] != best:
            how += f"; its names say otherwise ({names[named[0]][-1]})"
            confidence = min(confidence, 0.5)
        return best, Clue("thumb", names[best][-1], f"{how} (by {margin:.2f} of 1)", confidence)
    if len(named) == 1:
        return named[0], Clue(
            "thumb",
            names[named[0]][-1],
            "its kinematics leaves it open; the links' names say so",
            0.6,
        )
    how = (
        "the fingers are alike, so the first one stands for it"
        if count > 2
        else "of two alike fingers the first one stands for it"
    )
    return best if margin > 1e-6 else 0, Clue(
        "thumb", names[best if margin > 1e-6 else 0][-1], how, 0.3
    )


def _strangeness(closing: Closing, names: list[list[str]]) -> np.ndarray:
    """How much more each finger differs from the others than those differ from each other, shape (F,)."""
    directions, count = closing.directions, len(closing.bases)
    differences = np.zeros((count, count))
    for i in range(count):
        for j in range(count):
            along = directions[i] + directions[j]
            length = np.linalg.norm(along)
            ahead = (
                abs((closing.bases[i] - closing.bases[j]) @ along) / length
                if length > 1e-6
                else 0.0
            )
            differences[i, j] = (
                0.5 * (1.0 - directions[i] @ directions[j])
                + 0.5 * (1.0 - closing.ways[i] @ closing.ways[j])
                + 0.5 * min(1.0, 2.0 * ahead / max(closing.reach[i], closing.reach[j], 1e-9))
                # A finger of other joints is another finger, but only where nothing else tells.
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


def _find_distal(closing: Closing, fingers: list[int]) -> tuple[np.ndarray, Clue]:
    directions = closing.directions[fingers]
    # The jaws of a gripper lean in and out; where they lie between their bases and their middle
    # they agree.
    mean = directions.mean(axis=0)
    if len(closing.bases) == 2:
        mean = closing.directions.mean(axis=0)
    agreement = float(np.linalg.norm(mean))
    if agreement < 0.2:
        mean = closing.tips_closed.mean(axis=0) - closing.bases.mean(axis=0)
    mean = _snapped(mean / np.linalg.norm(mean))
    how = f"the mean direction of the stretched fingers, which agree to {agreement:.2f} of 1"
    return mean, Clue(
        "distal", _shown(mean), how, 0.95 if agreement > 0.85 else 0.7 if agreement > 0.6 else 0.4
    )


def _find_dorsal(
    closing: Closing, fingers: list[int], thumb: int | None, distal: np.ndarray
) -> tuple[np.ndarray, Clue]:
    palmar = closing.ways[fingers].mean(axis=0)
    agreement = float(np.linalg.norm(palmar))
    palmar = palmar - (palmar @ distal) * distal
    how = f"away from where the fingertips go when they close; they agree to {agreement:.2f} of 1"
    sureness = float(closing.certainty[fingers].min())
    if np.linalg.norm(palmar) < 0.2 and thumb is not None:
        palmar = closing.tips_open[thumb] - closing.tips_open[fingers].mean(axis=0)
        palmar = palmar - (palmar @ distal) * distal
        how, sureness = (
            "away from the thumb, since the other fingertips close in different directions",
            0.5,
        )
    if np.linalg.norm(palmar) < 1e-6:
        palmar = np.eye(3)[np.argmin(np.abs(distal))]
        palmar = palmar - (palmar @ distal) * distal
        how, sureness = "nothing tells: any direction at right angles to distal", 0.05
    dorsal = _snapped(-palmar / np.linalg.norm(palmar))
    dorsal = dorsal - (dorsal @ distal) * distal
    dorsal = np.where(np.abs(dorsal) < 1e-9, 0.0, dorsal)
    dorsal = dorsal / np.linalg.norm(dorsal)
    confidence = min(sureness, 0.95 if agreement > 0.85 else 0.7 if agreement > 0.4 else 0.5)
    return dorsal, Clue("dorsal", _shown(dorsal), how, confidence)


def _find_side(
    closing: Closing,
    across: np.ndarray,
    fingers: list[int],
    thumb: int | None,
    names: list[str],
    given: Side | None,
) -> tuple[Side, Clue]:
    """A right hand seen from the back with its fingers up has the thumb on the left."""
    sides: tuple[Side, Side] = ("right", "left")
    votes = {side: sum(bool(_SIDES[side].search(name)) for name in names) for side in sides}
    named = None if votes["right"] == votes["left"] else max(sides, key=lambda side: votes[side])
    place = 0.0
    if thumb is not None:
        middle = closing.bases[fingers].mean(axis=0) @ across
        width = max(
            float(np.ptp(closing.bases[fingers] @ across)) / 2.0,
            0.25 * float(closing.reach[fingers].mean()),
        )
        place = (
            float(((closing.bases[thumb] + closing.tips_open[thumb]) / 2.0) @ across - middle)
            / width
        )
    found: Side = "right" if place < 0.0 else "left"
    if abs(place) > _LIKELY and len(closing.bases) > 2:
        confidence = 0.95 if abs(place) > _CLEAR else 0.7
        how = f"the thumb stands on the {'left' if found == 'right' else 'right'}, seen from the back with the fingers up"
        if named is not None and named != found:
            how, confidence = f"{how}; names say {named}", 0.5
    elif named is not None:
        found, confidence = named, 0.6
        how = "the thumb stands in the middle, and tells nothing; names say so"
    else:
        found, confidence, how = "right", 0.2, "nothing tells; by convention"
    if given is None or given == found:
        return found, Clue("side", found, how, 1.0 if given else confidence)
    how = (
        f"as given; {how.replace('; by convention', '')}, which would make it {found}"
        if confidence > 0.3
        else "as given"
    )
    return given, Clue("side", given, how, 0.9 if confidence <= 0.7 else 0.5)


# A lone letter counts only where a name begins or ends with it: `l3` is the third link more often
# than a left one.
_SIDES = {
    "right": re.compile(r"[Rr]ight|RIGHT|(?:^|_)(?:rh|RH)(?:_|$)|^[rR]_|_[rR]$|^R(?=[A-Z][a-z])"),
    "left": re.compile(r"[Ll]eft|LEFT|(?:^|_)(?:lh|LH)(?:_|$)|^[lL]_|_[lL]$|^L(?=[A-Z][a-z])"),
}


def _snapped(direction: np.ndarray) -> np.ndarray:
    """The link's axis that a direction is all but parallel to (the mean of a fan of fingers is some degrees off), or itself."""
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
