"""Thumb, palm directions, side and finger names, from the fingers' positions and flexion.

Each answer is *certain* only if two independent kinds of evidence agree: position, flexion, the
plane of the knuckles, or names. What is derived from an answer is never surer than it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from handmap_qp.apps.onboarding.finger_names import named_fingers, named_side
from handmap_qp.apps.onboarding.flexion import HandFlexion
from handmap_qp.hands import human
from handmap_qp.hands.spec import Side

FINGERS = human.FINGERS[1:]
"""The fingers from the thumb's side outwards; additional fingers are numbered."""
_T = TypeVar("_T")
# Confidence with two kinds of evidence that agree, with one, and with two that disagree.
_CERTAIN, _LIKELY, _DISPUTED = 0.95, 0.75, 0.5
# Score margins above which an answer is clear, or better than none.
_CLEAR, _VISIBLE = 0.3, 0.1
# Largest angles at which a direction counts as the palm link's axis: alone, and if the knuckles lie
# in that direction from the link's origin [deg].
_SNAP, _SNAP_WITH_PALM = 5.0, 16.0
# Largest angle of the axis of flexion to another of these axes for the latter [deg].
_SNAP_AXIS = 8.0
# Directions agree within this angle [deg].
_AGREEING = 25.0
# A thumb flexes about the fingers' axis, in the opposite sense, if their cosine is smaller.
_FACING = -0.9
# A gripper's thumb points forward as its fingers do, with this cosine, and all are this alike in
# length.
_AHEAD, _ALIKE = 0.2, 0.1
# A thumb opposes the fingers' direction if the cosine between both is smaller.
_OPPOSED = -0.5
# Neighbouring fingers closer than this could be in either order [m].
_NARROW = 0.004


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
        levels = ((0.9, "certain"), (0.6, "likely"), (0.0, "a guess: check it"))
        return next(words for least, words in levels if self.confidence >= least)


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


class _Found(NamedTuple):
    """A direction in the palm link's coordinates, and the evidence for it.

    Attributes:
        direction: A unit vector, shape (3,).
        how: Evidence, a sentence without a full stop.
        confidence: From 0 to 1.
        sign: Confidence in its sign alone.
    """

    direction: np.ndarray
    how: str
    confidence: float
    sign: float = 1.0

    def clue(self, what: str) -> Clue:
        """Return it as a property of the hand."""
        return Clue(what, _shown(self.direction), self.how, self.confidence)


def find_anatomy(
    flexion: HandFlexion,
    names: list[list[str]],
    hints: Iterable[str],
    side: Side | None,
    thumb: int | None,
) -> Anatomy:
    """Name the fingers, and find the palm's directions.

    Args:
        flexion: How the fingers flex.
        names: Names of every finger's links and joints.
        hints: Names that may contain a side: of the robot, its file and its palm.
        side: The side, if known.
        thumb: Index of the thumb, if known.
    """
    hand = _Evidence(flexion, names, thumb)
    distal = hand.find_distal()
    dorsal = hand.find_dorsal(distal.direction)
    dorsal = dorsal._replace(confidence=min(dorsal.confidence, distal.confidence))
    radial = hand.find_radial(np.cross(distal.direction, dorsal.direction))
    declared = side or named_side([*hints, *itertools.chain(*names)])
    turned, found, clue = _find_side(
        distal.direction,
        dorsal,
        radial,
        hand.thumb_clue,
        declared,
        is_given=side is not None,
    )
    # The thumb's side orders the fingers; only without it the side does.
    if radial.confidence == 0.0:
        across = np.cross(distal.direction, turned.direction)
        radial = radial._replace(
            direction=-across if found == "right" else across, confidence=0.2
        )
    fingers, order = hand.name_fingers(radial)
    clues = (hand.thumb_clue, distal.clue("distal"), turned.clue("dorsal"), clue, order)
    return Anatomy(distal.direction, turned.direction, found, fingers, clues)


class _Evidence:
    """What flexion, places and names say of a hand's thumb, directions and fingers.

    Attributes:
        thumb: Index of the thumb; None if there is one finger only.
        thumb_clue: Evidence for it.
        rest: Indices of the other fingers.
        axis: Mean axis of their flexion, disregarding its sense; zero without a common one.
    """

    def __init__(
        self, flexion: HandFlexion, names: list[list[str]], thumb: int | None
    ) -> None:
        self.flexion, self.names, self.labels = flexion, names, named_fingers(names)
        self.thumb, how, confidence = self._find_thumb(thumb)
        answer = "none" if self.thumb is None else names[self.thumb][-1]
        self.thumb_clue = Clue("thumb", answer, how, confidence)
        self.rest = [i for i in range(len(names)) if i != self.thumb]
        axes = flexion.axes[self.rest]
        axes = axes[np.linalg.norm(axes, axis=1) > 0.5]
        values, vectors = np.linalg.eigh(axes.T @ axes)
        # Jaws and hands with fingers all around have no common axis.
        has_axis = len(axes) and values[-1] >= 0.8 * len(axes)
        self.axis = vectors[:, -1] if has_axis else np.zeros(3)

    def _find_thumb(self, given: int | None) -> tuple[int | None, str, float]:
        """Find the finger that differs from the others, or that the names call a thumb.

        Returns:
            Its index, the evidence, and the confidence.
        """
        names, count = self.names, len(self.names)
        if given is not None:
            return given, "as given", 1.0
        if count < 2:
            return None, "the hand has one finger only", 0.9
        parts = _differences(self.flexion)
        # A different number of joints counts, but less than any of the others.
        sizes = np.array([len(one) for one in names])
        scores = _stands_out(0.5 * sum(parts) + 0.15 * (sizes[:, None] != sizes))
        best, ranked = int(np.argmax(scores)), np.sort(scores)
        margin = float(ranked[-1] - ranked[-2]) if count > 2 else 0.0
        peaks = [_stands_out(part) for part in parts]
        agreeing = sum(
            np.argmax(peak) == best and max(peak) > _VISIBLE for peak in peaks
        )
        is_named = "thumb" in self.labels
        named = self.labels.index("thumb") if is_named else best
        shown = f" (margin {margin:.2f} of 1)"
        differs = f"its position, direction and flexion differ from the others'{shown}"
        is_clear = margin > _CLEAR and agreeing > 1
        alike = (
            "the fingers are alike: the first, or the one that differs most, was taken"
        )
        return _first(
            (is_named and named == best and margin > _VISIBLE,
             (named, f"from the link names; {differs}", _CERTAIN)),
            (is_named and (named == best or margin < _CLEAR),
             (named, "from the link names; the kinematics is ambiguous", _LIKELY)),
            (is_named,
             (best, f"{differs}; the link names suggest {names[named][-1]}", _DISPUTED)),
            (margin > _VISIBLE, (best, differs, _CERTAIN if is_clear else _LIKELY)),
            (True, (best if margin > 1e-6 else 0, alike, 0.3)),
        )  # fmt: skip

    def find_distal(self) -> _Found:
        """Find the direction of the stretched fingers."""
        flexion, rest, axis = self.flexion, self.rest, self.axis
        # Fingers and thumb of a gripper lean to opposite sides: take the middle of both.
        mean = flexion.directions[rest].mean(axis=0)
        if len(flexion.bases) == 2:
            mean = flexion.directions.mean(axis=0)
        elif self._is_gripper():
            mean = _unit(mean + flexion.directions[self.thumb])
        agreement = float(np.linalg.norm(mean))
        if agreement < 0.2:
            mean = flexion.tips_closed.mean(axis=0) - flexion.bases.mean(axis=0)
        if np.linalg.norm(_beside(mean, axis)) > 0.2:
            mean = _beside(mean, axis)
        knuckles = flexion.bases[rest if len(flexion.bases) > 2 else ...]
        mean = _snapped(_unit(mean), knuckles.mean(axis=0), axis)
        how = f"the mean direction of the straight fingers (agreement {agreement:.2f} of 1)"
        confidence = _LIKELY if agreement > 0.8 else 0.4
        line = _widest(knuckles) if len(rest) > 2 and axis.any() else mean
        confirmations = (
            (angle_between(mean, knuckles.mean(axis=0)) < _AGREEING,
             "the knuckles lie in this direction from the palm's origin"),
            (abs(mean @ line) < np.sin(np.radians(_AGREEING)),
             "at right angles to the row of the knuckles"),
        )  # fmt: skip
        more = next((text for holds, text in confirmations if holds), "")
        if more and agreement > 0.85:
            how, confidence = f"{how}; {more}", _CERTAIN
        thumb = flexion.directions[rest if self.thumb is None else [self.thumb]]
        if len(rest) > 1 and thumb.mean(axis=0) @ mean < _OPPOSED:
            # Fingers around a centre, as a Barrett hand's, have no straight posture of a person.
            how = f"{how}; the thumb points the other way: the palm's direction may be better"
            confidence = _DISPUTED
        return _Found(mean, how, confidence)

    def _is_gripper(self) -> bool:
        """Return whether a thumb is as long as the fingers, and faces them at less than 90 deg."""
        flexion, thumb, rest = self.flexion, self.thumb, self.rest
        if thumb is None:
            return False
        lengths = flexion.reach
        faces = flexion.axes[thumb] @ flexion.axes[rest].mean(axis=0) < _FACING
        ahead = flexion.directions[thumb] @ flexion.directions[rest].mean(axis=0)
        is_alike = np.ptp(lengths) < _ALIKE * lengths.mean()
        return bool(faces and ahead > _AHEAD and is_alike)

    def find_dorsal(self, distal: np.ndarray) -> _Found:
        """Find the back of the hand: opposite to the way in which the fingertips flex."""
        flexion, rest, thumb = self.flexion, self.rest, self.thumb
        mean = flexion.ways[rest].mean(axis=0)
        agreement, palmar = float(np.linalg.norm(mean)), _beside(mean, distal)
        how = f"opposite to the fingertips' motion in flexion (agreement {agreement:.2f} of 1)"
        sign = float(np.median(flexion.certainty[rest]))
        upright = np.cross(self.axis, distal)
        if abs(palmar @ upright) > 0.2:
            # The axes of flexion are exact; the way of the tips depends on the posture.
            palmar = np.sign(palmar @ upright) * upright
        if np.linalg.norm(palmar) < 0.2 and thumb is not None:
            to_thumb = flexion.tips_open[thumb] - flexion.tips_open[rest].mean(axis=0)
            palmar, sign = _beside(to_thumb, distal), 0.5
            how = "away from the thumb, because the other fingertips flex in different directions"
        if np.linalg.norm(palmar) < 1e-6:
            palmar, sign = _beside(np.eye(3)[np.argmin(np.abs(distal))], distal), 0.05
            how = "undetermined: an arbitrary direction at right angles to distal"
        dorsal = _unit(_rounded(_beside(_snapped(_unit(-palmar)), distal)))
        confidence = min(sign, _LIKELY if agreement > 0.4 else _DISPUTED)
        more, contradiction = self._confirmations(distal, dorsal)
        if more and agreement > 0.85 and sign > 0.6:
            how = "; ".join([how, *more])
            confidence = max(confidence, min(sign, _CERTAIN))
        if contradiction:
            how, confidence = f"{how}; {contradiction}", min(confidence, _DISPUTED)
        return _Found(dorsal, how, confidence, sign)

    def _confirmations(
        self, distal: np.ndarray, dorsal: np.ndarray
    ) -> tuple[list[str], str]:
        """Return what confirms the dorsal direction besides flexion, and what contradicts it."""
        flexion, rest, thumb, more, against = (
            self.flexion,
            self.rest,
            self.thumb,
            [],
            "",
        )
        knuckles = flexion.bases[rest]
        if len(rest) > 2:
            normal = np.cross(_widest(knuckles), distal)
            angle = angle_between(normal, dorsal)
            angle = min(angle, 180.0 - angle)
            if np.linalg.norm(normal) < 0.5:
                angle = 1.5 * _AGREEING
            if angle < _AGREEING:
                more.append("at right angles to the row of the knuckles")
            elif angle > 2.0 * _AGREEING:
                against = f"the row of the knuckles is {angle:.0f} degrees off the palm's plane"
        if thumb is not None and flexion.certainty[thumb] > 0.6:
            height = (flexion.tips_closed[thumb] - knuckles.mean(axis=0)) @ -dorsal
            if height > 0.1 * flexion.reach[rest].mean():
                more.append("the thumb closes on the other side")
        return more, against

    def find_radial(self, across: np.ndarray) -> _Found:
        """Find the thumb's side of the palm: by its place, or by the other fingers' names.

        Returns:
            The direction across the palm towards the thumb; confidence 0 if the thumb is central.
        """
        place, is_outside = self._thumb_place(across)
        bases = {self.labels[i]: self.flexion.bases[i] for i in self.rest}
        row = [bases[label] @ across for label in FINGERS if label in bases]
        steps = np.diff(row)
        is_row = np.ptp(np.sign(steps)) == 0.0 if len(steps) else False
        named = (
            -np.sign(steps[0])
            if is_row and np.abs(steps).min() > 0.5 * _NARROW
            else 0.0
        )
        by_names = "the fingers' names"
        by_place = (
            np.sign(place) if abs(place) > _VISIBLE and len(self.names) > 2 else 0.0
        )
        is_clear = abs(place) > _CLEAR
        sign, how, confidence = _first(
            (not by_place and not named, (1.0, "", 0.0)),
            (not by_place, (named, by_names, _LIKELY)),
            (named == by_place, (named, f"the thumb's place and {by_names}", _CERTAIN)),
            (named and not is_clear, (named, by_names, _LIKELY)),
            (named, (by_place, "the thumb's place", _DISPUTED)),
            (
                abs(place) > 2.0 * _CLEAR and is_outside,
                (by_place, "the thumb's place", _CERTAIN),
            ),
            (True, (by_place, "the thumb's place", _LIKELY if is_clear else 0.65)),
        )
        return _Found(sign * across, how, confidence)

    def _thumb_place(self, across: np.ndarray) -> tuple[float, bool]:
        """Return how far the thumb is to one side, in half widths of the palm.

        Also return whether its base and its tip are both on that side.
        """
        flexion, thumb, rest = self.flexion, self.thumb, self.rest
        if thumb is None:
            return 0.0, False
        row = flexion.bases[rest] @ across
        width = max(float(np.ptp(row)) / 2.0, 0.25 * float(flexion.reach[rest].mean()))
        ends = np.array([flexion.roots[thumb], flexion.tips_open[thumb]]) @ across
        ends = (ends - row.mean()) / width
        return float(ends.mean()), bool((ends * ends.mean() > 0.0).all())

    def name_fingers(self, radial: _Found) -> tuple[tuple[str, ...], Clue]:
        """Name the fingers by their order across the palm, or by their own names."""
        flexion, labels, sure = self.flexion, self.labels, self.thumb_clue.confidence
        # Order fingers by base and tip: fingers spread towards their tips, and bases may lie one
        # behind the other.
        places = (0.7 * flexion.bases + 0.3 * flexion.tips_open) @ radial.direction
        order = sorted(self.rest, key=lambda i: -places[i])
        apart = float(-np.diff(places[order]).max(initial=-np.inf))
        own = sorted(
            (FINGERS.index(labels[i]), i) for i in self.rest if labels[i] in FINGERS
        )
        by_name = [i for _, i in own]
        confidence = min(radial.confidence, _CERTAIN if apart > _NARROW else 0.4, sure)
        if len(order) < 2:
            # Nothing is left to choose but the thumb.
            confidence = max(confidence, min(0.9, sure))
        called = {
            i: FINGERS[k] if k < len(FINGERS) else f"finger{k + 2}"
            for k, i in enumerate(order)
        }
        is_named = 0 < len(order) == len(by_name)
        is_narrow = apart < 2.0 * _NARROW or confidence < _LIKELY
        how = "ordered by position across the palm, from the thumb's side"
        said = ", ".join(FINGERS[k] for k, _ in own)
        how, confidence = _first(
            (not is_named, (how, confidence)),
            (by_name == order,
             (f"{how}; the names agree", _CERTAIN if sure >= _LIKELY else _LIKELY)),
            (is_narrow, ("from the names; their places are ambiguous", _LIKELY)),
            (True, (f"{how}; the names say {said}", min(confidence, _DISPUTED))),
        )  # fmt: skip
        if is_named and (by_name == order or is_narrow):
            called, order = {i: FINGERS[k] for k, i in own}, by_name
        if self.thumb is not None:
            called[self.thumb], order = "thumb", [self.thumb, *order]
        answer = ", ".join(called[i] for i in order)
        names = tuple(called[i] for i in range(len(labels)))
        return names, Clue("fingers", answer, how, confidence)


def _differences(flexion: HandFlexion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how much fingers differ in position, direction and flexion, 0 to 1, shape (F, F)."""
    lines = flexion.tips_open - flexion.roots
    lengths, directions = np.linalg.norm(lines, axis=1), _unit(lines)
    along = _unit(directions[:, None] + directions)
    apart = np.abs(((flexion.roots[:, None] - flexion.roots) * along).sum(axis=2))
    longer = np.maximum(np.maximum(lengths[:, None], lengths), 1e-9)
    ahead = np.minimum(1.0, 2.0 * apart / longer)
    return ahead, 1.0 - directions @ directions.T, 1.0 - flexion.ways @ flexion.ways.T


def _stands_out(differences: np.ndarray) -> np.ndarray:
    """Return how much each finger differs from the others, less how much they differ, (F,)."""
    others = len(differences) - 1
    own = differences.sum(axis=1) - differences.diagonal()
    among = (
        differences.sum()
        - differences.sum(axis=0)
        - differences.sum(axis=1)
        + differences.diagonal()
    )
    return own / others - among / max(1, others * (others - 1))


def _find_side(
    distal: np.ndarray,
    dorsal: _Found,
    radial: _Found,
    thumb: Clue,
    declared: Side | None,
    *,
    is_given: bool,
) -> tuple[_Found, Side, Clue]:
    """Find the side: a right hand seen from the back, fingers up, has its thumb on the left.

    A given side, or a named one, sets the sign of the dorsal direction if the thumb is clearly on
    one side of the palm.

    Returns:
        The dorsal direction, the side, and the evidence for it.
    """
    is_right = radial.direction @ np.cross(distal, dorsal.direction) < 0.0
    found: Side = "right" if is_right else "left"
    source = "as given" if is_given else "from the names"
    seen = (
        f"seen from the back with the fingers up, the thumb is on the "
        f"{'left' if is_right else 'right'} ({radial.how})"
    )
    least = min(radial.confidence, thumb.confidence)
    is_central, is_clear = radial.confidence == 0.0, dorsal.sign > 0.9
    agrees = declared == found
    opposite = f"the ranges of the joints suggest {found}"
    named: Side = declared or found
    side, how, confidence = _first(
        (is_central and declared is None, ("right", "undetermined; right by convention", 0.2)),
        (is_central, (named, f"{source}; the thumb is in the middle", 1.0 if is_given else 0.65)),
        (declared is None, (found, seen, min(least, dorsal.confidence))),
        (agrees and is_given, (found, source, 1.0)),
        (agrees, (found, f"{source}, and {seen}", _CERTAIN if least >= _LIKELY else _LIKELY)),
        # They disagree: names yield to clear flexion, an owner's word does not.
        (not is_given and is_clear and radial.confidence >= _LIKELY,
         (found, f"{seen}; the names say {declared}", _DISPUTED)),
        (is_clear, (named, f"{source}; {opposite}", 0.5)),
        (True, (named, source, 0.9 if is_given else min(_LIKELY, thumb.confidence))),
    )  # fmt: skip
    clue = Clue("side", side, how, confidence)
    if is_central or declared is None:
        return dorsal, side, clue
    if side == found:
        return _confirmed(dorsal) if agrees else dorsal, side, clue
    why = opposite if is_clear else "flexion is symmetric"
    sure = 0.4 if is_clear else min(_LIKELY, radial.confidence)
    how = f"the back of a {side} hand with its thumb there; {why}"
    return _Found(-dorsal.direction + 0.0, how, sure, 0.0), side, clue


def _confirmed(dorsal: _Found) -> _Found:
    """Return a dorsal direction with which the side agrees."""
    least = 0.0
    if dorsal.sign > 0.05:
        is_likely = dorsal.sign > 0.6 and dorsal.confidence >= _LIKELY
        least = _CERTAIN if is_likely else _LIKELY
    how = f"{dorsal.how}; the side agrees"
    return dorsal._replace(how=how, confidence=max(dorsal.confidence, least))


def _first(*rules: tuple[object, _T]) -> _T:
    """Return the answer of the first rule that holds; the last one always does."""
    return next(answer for holds, answer in rules if holds)


# -- geometry


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def _beside(vector: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the part of a vector at right angles to a unit vector."""
    return vector - (vector @ direction) * direction


def _rounded(direction: np.ndarray) -> np.ndarray:
    return np.where(np.abs(direction) < 1e-6, 0.0, direction)


def _widest(points: np.ndarray) -> np.ndarray:
    """Return the direction in which points extend most, a unit vector, shape (3,)."""
    return np.linalg.svd(points - points.mean(axis=0))[2][0]


def angle_between(one: np.ndarray, other: np.ndarray) -> float:
    """Return the angle between two vectors [deg]; 90 if one is zero."""
    return float(np.degrees(np.arccos(np.clip(_unit(one) @ _unit(other), -1.0, 1.0))))


def _snapped(
    direction: np.ndarray,
    knuckles: np.ndarray | None = None,
    axis: np.ndarray | None = None,
) -> np.ndarray:
    """Return the link's axis next to a direction, or else the direction.

    The mean direction of spread fingers is a few degrees off the link's axis. Fingers that cannot
    stretch fully are farther off it. The link's axis is then taken if the axis of flexion is
    another of the link's axes, and the knuckles lie in its direction from the link's origin.
    """
    nearest = int(np.argmax(np.abs(direction)))
    ahead = np.sign(direction[nearest]) * np.eye(3)[nearest]
    angle = angle_between(direction, ahead)
    if angle < _SNAP:
        return ahead
    if knuckles is not None and axis is not None and angle < _SNAP_WITH_PALM:
        lateral = np.delete(np.abs(axis), nearest).max() > np.cos(
            np.radians(_SNAP_AXIS)
        )
        if lateral and angle_between(_beside(knuckles, axis), ahead) < angle:
            return ahead
    return _unit(_rounded(direction))


def _shown(direction: np.ndarray) -> str:
    nearest = int(np.argmax(np.abs(direction)))
    if abs(direction[nearest]) > 0.9999:
        return f"{'+' if direction[nearest] > 0 else '-'}{'xyz'[nearest]}"
    return "[" + ", ".join(f"{value:.3f}" for value in direction) + "]"
