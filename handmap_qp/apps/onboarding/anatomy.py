"""Thumb, palm directions, side and finger names, from the fingers' positions and flexion.

Each answer is *certain* only if two independent kinds of evidence agree: position, flexion, the
plane of the knuckles, or names. What is derived from an answer is never surer than it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from handmap_qp.apps.onboarding.finger_names import named_fingers, named_side
from handmap_qp.apps.onboarding.flexion import HandFlexion
from handmap_qp.hands import human
from handmap_qp.hands.spec import Side

FINGERS = human.FINGERS[1:]
"""The fingers from the thumb's side outwards; additional fingers are numbered."""
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
    distal, distal_clue = hand.find_distal()
    bend = hand.find_dorsal(distal)
    is_round = (
        hand.thumb is not None and flexion.directions[hand.thumb] @ distal < _OPPOSED
    )
    if is_round and len(hand.rest) > 1:
        # Fingers around a centre, as a Barrett hand's, have no straight posture of a person.
        how = "the thumb points the other way: the best direction may be nearer to the palm's"
        how = f"{distal_clue.how}; {how}"
        distal_clue = replace(distal_clue, how=how, confidence=_DISPUTED)
    bend = replace(bend, confidence=min(bend.confidence, distal_clue.confidence))
    across = np.cross(distal, bend.dorsal)
    radial = hand.find_radial(across)
    named = named_side([*hints, *(name for group in names for name in group)])
    bend, side, side_clue = _find_side(
        bend, radial, hand.thumb_clue, named, side, across
    )
    # The thumb's side orders the fingers; only without it the side does.
    across = np.cross(distal, bend.dorsal)
    towards = radial.direction
    if radial.confidence == 0.0:
        towards = -across if side == "right" else across
    fingers, order_clue = hand.name_fingers(towards, max(radial.confidence, 0.2))
    dorsal_clue = Clue("dorsal", _shown(bend.dorsal), bend.how, bend.confidence)
    clues = (hand.thumb_clue, distal_clue, dorsal_clue, side_clue, order_clue)
    return Anatomy(distal, bend.dorsal, side, fingers, clues)


@dataclass(frozen=True, slots=True, eq=False)
class _Bend:
    """The dorsal direction, and the evidence for its axis and for its sign."""

    dorsal: np.ndarray
    how: str
    confidence: float
    sign_certainty: float


@dataclass(frozen=True, slots=True, eq=False)
class _Radial:
    """The direction across the palm towards the thumb; confidence 0 if the thumb is central."""

    direction: np.ndarray
    how: str
    confidence: float


class _Evidence:
    """What flexion, places and names say of a hand's thumb, directions and fingers.

    Attributes:
        thumb: Index of the thumb; None if there is one finger only.
        thumb_clue: Evidence for it.
        rest: Indices of the other fingers.
        axis: Mean axis of their flexion, disregarding its sense; None without a common one.
    """

    def __init__(
        self, flexion: HandFlexion, names: list[list[str]], thumb: int | None
    ) -> None:
        self.flexion, self.names, self.labels = flexion, names, named_fingers(names)
        self.thumb, self.thumb_clue = self._find_thumb(thumb)
        self.rest = [i for i in range(len(names)) if i != self.thumb]
        axes = flexion.axes[self.rest]
        axes = axes[np.linalg.norm(axes, axis=1) > 0.5]
        values, vectors = np.linalg.eigh(axes.T @ axes)
        # Jaws and hands with fingers all around have no common axis.
        has_axis = len(axes) and values[-1] >= 0.8 * len(axes)
        self.axis = vectors[:, -1] if has_axis else None

    # -- thumb

    def _find_thumb(self, given: int | None) -> tuple[int | None, Clue]:
        """Find the finger that differs from the others, or that the names call a thumb."""
        names, count = self.names, len(self.names)
        if given is not None:
            return given, Clue("thumb", names[given][-1], "as given", 1.0)
        if count < 2:
            return None, Clue("thumb", "none", "the hand has one finger only", 0.9)
        position, direction, way = parts = _differences(self.flexion)
        # A different number of joints counts, but less than any of the others.
        joints = np.array(
            [[len(one) != len(other) for other in names] for one in names]
        )
        scores = _stands_out(0.5 * (position + direction + way) + 0.15 * joints)
        best, ranked = int(np.argmax(scores)), np.sort(scores)
        margin = float(ranked[-1] - ranked[-2]) if count > 2 else 0.0
        named = self.labels.index("thumb") if "thumb" in self.labels else None
        if named is not None and (named == best or margin < _CLEAR):
            if named == best and margin > _VISIBLE:
                how = "from the link names; its position and flexion differ from the others'"
                return named, _thumb_clue(names[named], how, _CERTAIN, margin)
            how = "from the link names; the kinematics is ambiguous"
            return named, _thumb_clue(names[named], how, _LIKELY)
        if margin > _VISIBLE:
            how = "its position, direction and flexion differ from those of the other fingers"
            if named is not None:
                how += f"; the link names suggest {names[named][-1]}"
                return best, _thumb_clue(names[best], how, _DISPUTED, margin)
            agreeing = sum(
                int(np.argmax(part)) == best and max(part) > _VISIBLE
                for part in map(_stands_out, parts)
            )
            confidence = _CERTAIN if margin > _CLEAR and agreeing > 1 else _LIKELY
            return best, _thumb_clue(names[best], how, confidence, margin)
        how = "of two similar fingers the first one was taken"
        if count > 2:
            how = "the fingers are alike, so the first one was taken"
        chosen = best if margin > 1e-6 else 0
        return chosen, _thumb_clue(names[chosen], how, 0.3)

    # -- directions

    def find_distal(self) -> tuple[np.ndarray, Clue]:
        """Find the direction of the stretched fingers."""
        flexion, rest, axis = self.flexion, self.rest, self.axis
        mean = flexion.directions[rest].mean(axis=0)
        # Fingers and thumb of a gripper lean to opposite sides: take the middle of both.
        if len(flexion.bases) == 2:
            mean = flexion.directions.mean(axis=0)
        elif self.thumb is not None and self._is_gripper(self.thumb):
            mean = mean + flexion.directions[self.thumb]
            mean = mean / max(float(np.linalg.norm(mean)), 1e-9)
        agreement = float(np.linalg.norm(mean))
        if agreement < 0.2:
            mean = flexion.tips_closed.mean(axis=0) - flexion.bases.mean(axis=0)
        if axis is not None and np.linalg.norm(mean - (mean @ axis) * axis) > 0.2:
            mean = mean - (mean @ axis) * axis
        knuckles = flexion.bases[rest if len(flexion.bases) > 2 else ...].mean(axis=0)
        mean = _snapped(mean / np.linalg.norm(mean), knuckles, axis)
        how = f"the mean direction of the straight fingers (agreement {agreement:.2f} of 1)"
        confidence = _LIKELY if agreement > 0.8 else 0.4
        more = ""
        if angle_between(mean, knuckles) < _AGREEING:
            more = "the knuckles lie in this direction from the palm's origin"
        elif len(rest) > 2 and axis is not None:
            line = _widest(flexion.bases[rest])
            if abs(mean @ line) < np.sin(np.radians(_AGREEING)):
                more = "at right angles to the row of the knuckles"
        if agreement > 0.85 and more:
            how, confidence = f"{how}; {more}", _CERTAIN
        return mean, Clue("distal", _shown(mean), how, confidence)

    def _is_gripper(self, thumb: int) -> bool:
        """Return whether a thumb is as long as the fingers, and faces them at less than 90 deg."""
        flexion, rest = self.flexion, self.rest
        lengths = flexion.reach[[thumb, *rest]]
        faces = flexion.axes[thumb] @ flexion.axes[rest].mean(axis=0) < _FACING
        is_ahead = (
            flexion.directions[thumb] @ flexion.directions[rest].mean(axis=0) > _AHEAD
        )
        return bool(faces and is_ahead and np.ptp(lengths) < _ALIKE * lengths.mean())

    def find_dorsal(self, distal: np.ndarray) -> _Bend:
        """Find the back of the hand: opposite to the way in which the fingertips flex."""
        flexion, rest = self.flexion, self.rest
        palmar = flexion.ways[rest].mean(axis=0)
        agreement = float(np.linalg.norm(palmar))
        palmar = palmar - (palmar @ distal) * distal
        how = f"opposite to the fingertips' motion in flexion (agreement {agreement:.2f} of 1)"
        certainty = float(np.median(flexion.certainty[rest]))
        upright = np.zeros(3) if self.axis is None else np.cross(self.axis, distal)
        if abs(palmar @ upright) > 0.2:
            # The axes of flexion are exact; the way of the tips depends on the posture.
            palmar = np.sign(palmar @ upright) * upright
        if np.linalg.norm(palmar) < 0.2 and self.thumb is not None:
            palmar = flexion.tips_open[self.thumb] - flexion.tips_open[rest].mean(
                axis=0
            )
            palmar = palmar - (palmar @ distal) * distal
            how = "away from the thumb, because the other fingertips flex in different directions"
            certainty = 0.5
        if np.linalg.norm(palmar) < 1e-6:
            palmar = np.eye(3)[np.argmin(np.abs(distal))]
            palmar = palmar - (palmar @ distal) * distal
            how = "undetermined: an arbitrary direction at right angles to distal"
            certainty = 0.05
        dorsal = _snapped(-palmar / np.linalg.norm(palmar))
        dorsal = dorsal - (dorsal @ distal) * distal
        dorsal = np.where(np.abs(dorsal) < 1e-9, 0.0, dorsal)
        dorsal = dorsal / np.linalg.norm(dorsal)
        confidence = min(certainty, _LIKELY if agreement > 0.4 else _DISPUTED)
        more, contradiction = self._confirmations(distal, dorsal)
        if more and agreement > 0.85 and certainty > 0.6:
            how = f"{how}; {' and '.join(more)}"
            confidence = max(confidence, min(certainty, _CERTAIN))
        if contradiction:
            how, confidence = f"{how}; {contradiction}", min(confidence, _DISPUTED)
        return _Bend(dorsal, how, confidence, certainty)

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
        if len(rest) > 2:
            normal = np.cross(_widest(flexion.bases[rest]), distal)
            angle = angle_between(normal, dorsal)
            angle = min(angle, 180.0 - angle)
            if np.linalg.norm(normal) > 0.5 and angle < _AGREEING:
                more.append("at right angles to the row of the knuckles")
            elif np.linalg.norm(normal) > 0.5 and angle > 2.0 * _AGREEING:
                against = f"the row of the knuckles is {angle:.0f} degrees off the palm's plane"
        if thumb is not None and flexion.certainty[thumb] > 0.6:
            height = (
                flexion.tips_closed[thumb] - flexion.bases[rest].mean(axis=0)
            ) @ -dorsal
            if height > 0.1 * flexion.reach[rest].mean():
                more.append("the thumb closes on the other side")
        return more, against

    def find_radial(self, across: np.ndarray) -> _Radial:
        """Find the thumb's side of the palm: by its place, or by the other fingers' names."""
        flexion = self.flexion
        named = {self.labels[i]: i for i in self.rest}
        row = (
            flexion.bases[[named[label] for label in FINGERS if label in named]]
            @ across
        )
        steps, named_sign = np.diff(row), 0.0
        if (
            len(steps)
            and (np.abs(steps) > 0.5 * _NARROW).all()
            and len({*np.sign(steps)}) == 1
        ):
            named_sign = -float(np.sign(steps[0]))
        by_names = _Radial(named_sign * across, "the fingers' names", _LIKELY)
        place, is_outside = self._thumb_place(across)
        if abs(place) > _VISIBLE and len(flexion.bases) > 2:
            sign = float(np.sign(place))
            if named_sign == sign:
                how = "the thumb's place and the fingers' names"
                return _Radial(sign * across, how, _CERTAIN)
            if named_sign and abs(place) < _CLEAR:
                return by_names
            clear = _LIKELY if abs(place) > _CLEAR else 0.65
            if named_sign:
                clear = min(clear, _DISPUTED)
            elif abs(place) > 2.0 * _CLEAR and is_outside:
                clear = _CERTAIN
            return _Radial(sign * across, "the thumb's place", clear)
        return by_names if named_sign else _Radial(across, "", 0.0)

    def _thumb_place(self, across: np.ndarray) -> tuple[float, bool]:
        """Return how far the thumb is to one side, in half widths of the palm.

        Also return whether its base and its tip are both on that side.
        """
        flexion, thumb, rest = self.flexion, self.thumb, self.rest
        if thumb is None:
            return 0.0, False
        row = flexion.bases[rest] @ across
        width = max(float(np.ptp(row)) / 2.0, 0.25 * float(flexion.reach[rest].mean()))
        ends = (
            np.array([flexion.roots[thumb], flexion.tips_open[thumb]]) @ across
            - row.mean()
        )
        place = float(ends.mean()) / width
        return place, bool((ends * place > 0.0).all())

    # -- fingers

    def name_fingers(
        self, radial: np.ndarray, confidence: float
    ) -> tuple[tuple[str, ...], Clue]:
        """Name the fingers by their order across the palm, or by their own names."""
        flexion, rest, labels = self.flexion, self.rest, self.labels
        # Order fingers by base and tip: fingers spread towards their tips, and bases may lie one
        # behind the other.
        places = (flexion.bases + 0.3 * (flexion.tips_open - flexion.bases)) @ radial
        order = sorted(rest, key=lambda i: -places[i])
        narrowest = float(-np.diff(places[order]).max()) if len(order) > 1 else np.inf
        called = dict.fromkeys([] if self.thumb is None else [self.thumb], "thumb")
        for place, i in enumerate(order):
            called[i] = FINGERS[place] if place < len(FINGERS) else f"finger{place + 2}"
        how = "ordered by position across the palm, from the thumb's side"
        if len(order) > 1:
            how += f"; neighbours are at least {1e3 * narrowest:.0f} mm apart"
        sure = self.thumb_clue.confidence
        confidence = min(confidence, _CERTAIN if narrowest > _NARROW else 0.4, sure)
        own = {i: label for i in rest if (label := labels[i]) in FINGERS}
        if rest and len(own) == len(rest):
            by_name = sorted(rest, key=lambda i: FINGERS.index(own[i]))
            if by_name == order:
                how = f"{how}; the names agree"
                confidence = _CERTAIN if sure >= _LIKELY else _LIKELY
                called |= own
            elif narrowest < 2.0 * _NARROW or confidence < _LIKELY:
                how, confidence = "from the names; their places are ambiguous", _LIKELY
                order = by_name
                called |= own
            else:
                how = f"{how}; the names say {', '.join(own[i] for i in order)}"
                confidence = min(confidence, _DISPUTED)
        answer = [
            called[i] for i in ([] if self.thumb is None else [self.thumb]) + order
        ]
        if len(rest) < 2:
            # Nothing is left to choose but the thumb.
            confidence = max(confidence, min(0.9, sure))
        clue = Clue("fingers", ", ".join(answer), how, confidence)
        return tuple(called[i] for i in range(len(labels))), clue


def _thumb_clue(
    names: list[str], how: str, confidence: float, margin: float | None = None
) -> Clue:
    shown = "" if margin is None else f" (margin {margin:.2f} of 1)"
    return Clue("thumb", names[-1], how + shown, confidence)


def _differences(flexion: HandFlexion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how much fingers differ in position, direction and flexion, 0 to 1, shape (F, F)."""
    lines = flexion.tips_open - flexion.roots
    lengths = np.maximum(np.linalg.norm(lines, axis=1), 1e-9)
    directions = lines / lengths[:, None]
    along = directions[:, None] + directions
    apart = np.abs(((flexion.roots[:, None] - flexion.roots) * along).sum(axis=2))
    sums = np.linalg.norm(along, axis=2)
    ahead = 2.0 * apart / np.maximum(sums, 1e-6) / np.maximum(lengths[:, None], lengths)
    ahead = np.where(sums > 1e-6, np.minimum(1.0, ahead), 0.0)
    return ahead, 1.0 - directions @ directions.T, 1.0 - flexion.ways @ flexion.ways.T


def _stands_out(differences: np.ndarray) -> np.ndarray:
    """Return how much each finger differs from the others, less how much they differ, (F,)."""
    scores = []
    for i in range(len(differences)):
        others = np.delete(np.arange(len(differences)), i)
        among = differences[np.ix_(others, others)].sum()
        among /= max(1, len(others) * (len(others) - 1))
        scores.append(differences[i, others].mean() - among)
    return np.array(scores)


def _find_side(
    bend: _Bend,
    radial: _Radial,
    thumb: Clue,
    named: Side | None,
    given: Side | None,
    across: np.ndarray,
) -> tuple[_Bend, Side, Clue]:
    """Find the side: a right hand seen from the back, fingers up, has its thumb on the left.

    A given side, or a named one, sets the sign of the dorsal direction if the thumb is clearly on
    one side of the palm.
    """
    is_given, declared = given is not None, given or named
    source = "as given" if is_given else "from the names"
    found: Side = "right" if radial.direction @ across < 0.0 else "left"
    if radial.confidence == 0.0:
        if declared is None:
            return (
                bend,
                "right",
                Clue("side", "right", "undetermined; right by convention", 0.2),
            )
        how = f"{source}; the thumb is in the middle"
        return bend, declared, Clue("side", declared, how, 1.0 if is_given else 0.65)
    where = "left" if found == "right" else "right"
    how = f"seen from the back with the fingers up, the thumb is on the {where} ({radial.how})"
    if declared is None:
        confidence = min(radial.confidence, thumb.confidence, bend.confidence)
        return bend, found, Clue("side", found, how, confidence)
    if declared == found:
        least = min(radial.confidence, thumb.confidence)
        confidence = 1.0 if is_given else _CERTAIN if least >= _LIKELY else _LIKELY
        what = source if is_given else f"{source}, and {how}"
        return _confirmed(bend), declared, Clue("side", declared, what, confidence)
    # They disagree: names yield to clear flexion, an owner's word does not.
    is_clear = bend.sign_certainty > 0.9
    if not is_given and is_clear and radial.confidence >= _LIKELY:
        return (
            bend,
            found,
            Clue("side", found, f"{how}; the names say {declared}", _DISPUTED),
        )
    why, how = "flexion is symmetric", source
    sure, confidence = min(_LIKELY, radial.confidence), min(_LIKELY, thumb.confidence)
    if is_clear:
        why, sure, confidence = (
            "the ranges of the joints suggest the opposite",
            0.4,
            0.5,
        )
        how = f"{source}; the ranges of the joints suggest {found}"
    elif is_given:
        confidence = 0.9
    turned = f"the back of a {declared} hand with its thumb there; {why}"
    bend = _Bend(-bend.dorsal + 0.0, turned, sure, 0.0)
    return bend, declared, Clue("side", declared, how, confidence)


def _confirmed(bend: _Bend) -> _Bend:
    """Return a dorsal direction with which the side agrees."""
    raised = bend.confidence
    if bend.sign_certainty > 0.6 and raised >= _LIKELY:
        raised = _CERTAIN
    elif bend.sign_certainty > 0.05:
        raised = max(raised, _LIKELY)
    if raised > bend.confidence or raised < _LIKELY:
        return replace(bend, how=f"{bend.how}; the side agrees", confidence=raised)
    return bend


# -- geometry


def _widest(points: np.ndarray) -> np.ndarray:
    """Return the direction in which points extend most, a unit vector, shape (3,)."""
    return np.linalg.svd(points - points.mean(axis=0))[2][0]


def angle_between(one: np.ndarray, other: np.ndarray) -> float:
    """Return the angle between two vectors [deg]; 180 if one is zero."""
    length = float(np.linalg.norm(one) * np.linalg.norm(other))
    return (
        float(np.degrees(np.arccos(np.clip(one @ other / length, -1.0, 1.0))))
        if length
        else 180
    )


def _snapped(
    direction: np.ndarray,
    knuckles: np.ndarray | None = None,
    axis: np.ndarray | None = None,
) -> np.ndarray:
    """Return the link's axis next to a direction, or else the direction, normalised.

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
        sagittal = knuckles - (knuckles @ axis) * axis
        if lateral and angle_between(sagittal, ahead) < angle:
            return ahead
    direction = np.where(np.abs(direction) < 1e-6, 0.0, direction)
    return direction / np.linalg.norm(direction)


def _shown(direction: np.ndarray) -> str:
    for axis, name in enumerate("xyz"):
        if abs(direction[axis]) > 0.9999:
            return f"{'+' if direction[axis] > 0 else '-'}{name}"
    return "[" + ", ".join(f"{value:.3f}" for value in direction) + "]"
