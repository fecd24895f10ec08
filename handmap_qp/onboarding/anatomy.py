"""Thumb, palm directions, side and finger names, from the fingers' positions and flexion.

Each answer is *certain* only if two independent kinds of evidence agree: position, flexion, the
plane of the knuckles, or names. What is derived from an answer is never surer than it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from handmap_qp.hands.spec import Side
from handmap_qp.onboarding.finger_names import named_fingers, named_side
from handmap_qp.onboarding.flexion import HandFlexion

FINGERS = ("index", "middle", "ring", "little")
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

    Returns:
        Directions, side and finger names.
    """
    labels = named_fingers(names)
    declared = named_side([*hints, *(name for group in names for name in group)])
    thumb, thumb_clue = _find_thumb(flexion, names, labels, thumb)
    rest = [i for i in range(len(flexion.bases)) if i != thumb]
    axis = _flexion_axis(flexion, rest)
    distal, distal_clue = _find_distal(flexion, rest, thumb, axis)
    bend = _find_dorsal(flexion, rest, thumb, distal, axis)
    bend = replace(bend, confidence=min(bend.confidence, distal_clue.confidence))
    if thumb is not None and len(rest) > 1 and flexion.directions[thumb] @ distal < _OPPOSED:
        # Fingers around a centre, as a Barrett hand's, have no straight posture of a person.
        how = "the thumb points the other way: the best direction may be nearer to the palm's"
        distal_clue = replace(distal_clue, how=f"{distal_clue.how}; {how}", confidence=_DISPUTED)
        bend = replace(bend, confidence=min(bend.confidence, distal_clue.confidence))
    radial = _radial(flexion, rest, thumb, distal, bend.dorsal, labels)
    bend, side, side_clue = _find_side(flexion, bend, radial, thumb_clue, declared, side, distal)
    dorsal_clue = Clue("dorsal", _shown(bend.dorsal), bend.how, bend.confidence)
    # The thumb's side orders the fingers; only without it the side does.
    across = np.cross(distal, bend.dorsal)
    towards = radial.direction
    if radial.confidence == 0.0:
        towards = -across if side == "right" else across
    fingers, order_clue = _name_fingers(
        flexion, towards, rest, thumb, labels, max(radial.confidence, 0.2), thumb_clue
    )
    return Anatomy(
        distal,
        bend.dorsal,
        side,
        fingers,
        (thumb_clue, distal_clue, dorsal_clue, side_clue, order_clue),
    )


# -- thumb


def _find_thumb(
    flexion: HandFlexion, names: list[list[str]], labels: list[str | None], given: int | None
) -> tuple[int | None, Clue]:
    """Find the finger that differs from the others, or that the names call a thumb."""
    count = len(flexion.bases)
    if given is not None:
        return given, Clue("thumb", names[given][-1], "as given", 1.0)
    if count < 2:
        return None, Clue("thumb", "none", "the hand has one finger only", 0.9)
    scores = _dissimilarity(flexion, names)
    best = int(np.argmax(scores))
    margin = float(np.sort(scores)[-1] - np.sort(scores)[-2]) if count > 2 else 0.0
    named = labels.index("thumb") if "thumb" in labels else None
    if named is not None and (named == best or margin < _CLEAR):
        how = (
            f"from the link names; its position and flexion differ from the others' "
            f"(margin {margin:.2f} of 1)"
            if named == best and margin > _VISIBLE
            else "from the link names; the kinematics is ambiguous"
        )
        is_confirmed = named == best and margin > _VISIBLE
        confidence = _CERTAIN if is_confirmed else _LIKELY
        return named, Clue("thumb", names[named][-1], how, confidence)
    if margin > _VISIBLE:
        how = "its position, direction and flexion differ from those of the other fingers"
        if named is not None:
            how += f"; the link names suggest {names[named][-1]}"
        parts = _parts_that_agree(flexion, best)
        clear = _CERTAIN if margin > _CLEAR and parts > 1 else _LIKELY
        confidence = _DISPUTED if named is not None else clear
        return best, Clue("thumb", names[best][-1], f"{how} (margin {margin:.2f} of 1)", confidence)
    how = (
        "the fingers are alike, so the first one was taken"
        if count > 2
        else "of two similar fingers the first one was taken"
    )
    chosen = best if margin > 1e-6 else 0
    return chosen, Clue("thumb", names[chosen][-1], how, 0.3)


def _dissimilarity(flexion: HandFlexion, names: list[list[str]]) -> np.ndarray:
    """Score each finger: difference from the others minus theirs from each other, shape (F,)."""
    position, direction, way = _differences(flexion)
    count = len(names)
    # A different number of joints counts, but less than any of the others.
    joints = np.array([[len(one) != len(other) for other in names] for one in names])
    differences = 0.5 * (position + direction + way) + 0.15 * joints
    return np.array([_stands_out(differences, i) for i in range(count)])


def _differences(flexion: HandFlexion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how much fingers differ in position, direction and flexion, 0 to 1, shape (F, F)."""
    lines = flexion.tips_open - flexion.roots
    lengths = np.maximum(np.linalg.norm(lines, axis=1), 1e-9)
    directions, count = lines / lengths[:, None], len(lengths)
    ahead = np.zeros((count, count))
    for i in range(count):
        for j in range(count):
            along = directions[i] + directions[j]
            if (length := float(np.linalg.norm(along))) > 1e-6:
                distance = abs((flexion.roots[i] - flexion.roots[j]) @ along) / length
                ahead[i, j] = min(1.0, 2.0 * distance / max(lengths[i], lengths[j]))
    return (
        ahead,
        1.0 - directions @ directions.T,
        1.0 - flexion.ways @ flexion.ways.T,
    )


def _stands_out(differences: np.ndarray, i: int) -> float:
    """Return how much a finger differs from the others, less how much they differ themselves."""
    others = [j for j in range(len(differences)) if j != i]
    among = differences[np.ix_(others, others)]
    return float(
        differences[i, others].mean() - among.sum() / max(1, len(others) * (len(others) - 1))
    )


def _parts_that_agree(flexion: HandFlexion, finger: int) -> int:
    """Return in how many of position, direction and flexion a finger stands out most."""
    count = 0
    for part in _differences(flexion):
        scores = [_stands_out(part, i) for i in range(len(part))]
        count += int(np.argmax(scores)) == finger and max(scores) > _VISIBLE
    return count


# -- directions


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


def _flexion_axis(flexion: HandFlexion, fingers: list[int]) -> np.ndarray | None:
    """Return the mean axis of the fingers' flexion, disregarding its sense; None without one."""
    axes = flexion.axes[fingers]
    axes = axes[np.linalg.norm(axes, axis=1) > 0.5]
    if not len(axes):
        return None
    values, vectors = np.linalg.eigh(axes.T @ axes)
    # Jaws and hands with fingers all around have no common axis.
    return None if values[-1] < 0.8 * len(axes) else vectors[:, -1]


def _find_distal(
    flexion: HandFlexion, fingers: list[int], thumb: int | None, axis: np.ndarray | None
) -> tuple[np.ndarray, Clue]:
    mean = flexion.directions[fingers].mean(axis=0)
    # Fingers and thumb of a gripper lean to opposite sides: take the middle of both.
    if len(flexion.bases) == 2:
        mean = flexion.directions.mean(axis=0)
    elif thumb is not None and _is_gripper(flexion, fingers, thumb):
        mean = 0.5 * (mean + flexion.directions[thumb])
        mean = mean / max(float(np.linalg.norm(mean)), 1e-9)
    agreement = float(np.linalg.norm(mean))
    if agreement < 0.2:
        mean = flexion.tips_closed.mean(axis=0) - flexion.bases.mean(axis=0)
    if axis is not None and np.linalg.norm(mean - (mean @ axis) * axis) > 0.2:
        mean = mean - (mean @ axis) * axis
    knuckles = flexion.bases[fingers if len(flexion.bases) > 2 else ...].mean(axis=0)
    mean = _snapped(mean / np.linalg.norm(mean), knuckles, axis)
    how = f"the mean direction of the straight fingers (agreement {agreement:.2f} of 1)"
    confidence = _LIKELY if agreement > 0.8 else 0.4
    if agreement > 0.85 and _angle(mean, knuckles) < _AGREEING:
        how = f"{how}; the knuckles lie in this direction from the palm's origin"
        confidence = _CERTAIN
    elif agreement > 0.85 and len(fingers) > 2 and axis is not None:
        line = _widest(flexion.bases[fingers])
        if abs(np.degrees(np.arcsin(np.clip(abs(mean @ line), 0.0, 1.0)))) < _AGREEING:
            how = f"{how}; at right angles to the row of the knuckles"
            confidence = _CERTAIN
    return mean, Clue("distal", _shown(mean), how, confidence)


def _is_gripper(flexion: HandFlexion, fingers: list[int], thumb: int) -> bool:
    """Return whether a thumb is as long as the fingers, and faces them, at less than 90 degrees."""
    lengths = flexion.reach[[thumb, *fingers]]
    faces = flexion.axes[thumb] @ flexion.axes[fingers].mean(axis=0) < _FACING
    is_ahead = flexion.directions[thumb] @ flexion.directions[fingers].mean(axis=0) > _AHEAD
    return bool(faces and is_ahead and np.ptp(lengths) < _ALIKE * lengths.mean())


def _find_dorsal(
    flexion: HandFlexion,
    fingers: list[int],
    thumb: int | None,
    distal: np.ndarray,
    axis: np.ndarray | None,
) -> _Bend:
    """Find the back of the hand: opposite to the way in which the fingertips flex."""
    palmar = flexion.ways[fingers].mean(axis=0)
    agreement = float(np.linalg.norm(palmar))
    palmar = palmar - (palmar @ distal) * distal
    how = f"opposite to the fingertips' motion in flexion (agreement {agreement:.2f} of 1)"
    certainty = float(np.median(flexion.certainty[fingers]))
    if axis is not None and abs(palmar @ np.cross(axis, distal)) > 0.2:
        # The axes of flexion are exact; the way of the tips depends on the posture.
        upright = np.cross(axis, distal)
        palmar = np.sign(palmar @ upright) * upright
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
    confidence = min(certainty, _LIKELY if agreement > 0.4 else _DISPUTED)
    more, is_contradicted = _confirmations(flexion, fingers, thumb, distal, dorsal)
    if more and agreement > 0.85 and certainty > 0.6:
        how, confidence = f"{how}; {' and '.join(more)}", max(confidence, min(certainty, _CERTAIN))
    if is_contradicted:
        how, confidence = f"{how}; {is_contradicted}", min(confidence, _DISPUTED)
    return _Bend(dorsal, how, confidence, certainty)


def _confirmations(
    flexion: HandFlexion,
    fingers: list[int],
    thumb: int | None,
    distal: np.ndarray,
    dorsal: np.ndarray,
) -> tuple[list[str], str]:
    """Return what confirms the dorsal direction besides flexion, and what contradicts it."""
    more, against = [], ""
    if len(fingers) > 2:
        line = _widest(flexion.bases[fingers])
        normal = np.cross(line, distal)
        if np.linalg.norm(normal) > 0.5:
            angle = _angle(normal, dorsal)
            angle = min(angle, 180.0 - angle)
            if angle < _AGREEING:
                more.append("at right angles to the row of the knuckles")
            elif angle > 2.0 * _AGREEING:
                against = f"the row of the knuckles is {angle:.0f} degrees off the palm's plane"
    if thumb is not None and flexion.certainty[thumb] > 0.6:
        height = (flexion.tips_closed[thumb] - flexion.bases[fingers].mean(axis=0)) @ -dorsal
        if height > 0.1 * flexion.reach[fingers].mean():
            more.append("the thumb closes on the other side")
    return more, against


def _radial(
    flexion: HandFlexion,
    fingers: list[int],
    thumb: int | None,
    distal: np.ndarray,
    dorsal: np.ndarray,
    labels: list[str | None],
) -> _Radial:
    """Find the thumb's side of the palm: by its place, or by the names of the other fingers."""
    across = np.cross(distal, dorsal)
    named = {label: i for i, label in enumerate(labels) if label is not None and i != thumb}
    row = [named[label] for label in FINGERS if label in named]
    named_sign = 0.0
    if len(row) > 1:
        steps = np.diff([float(flexion.bases[i] @ across) for i in row])
        if (np.abs(steps) > 0.5 * _NARROW).all() and abs(np.sign(steps).sum()) == len(steps):
            named_sign = -float(np.sign(steps[0]))
    place = _thumb_place(flexion, fingers, thumb, across)
    if abs(place) > _VISIBLE and len(flexion.bases) > 2:
        sign = float(np.sign(place))
        clear = _LIKELY if abs(place) > _CLEAR else 0.65
        if named_sign == sign:
            return _Radial(sign * across, "the thumb's place and the fingers' names", _CERTAIN)
        if named_sign and abs(place) < _CLEAR:
            return _Radial(named_sign * across, "the fingers' names", _LIKELY)
        if abs(place) > 2.0 * _CLEAR and not named_sign and thumb is not None:
            # Its base and its tip are both on that side.
            middle = flexion.bases[fingers].mean(axis=0)
            both = [(p - middle) @ across * sign for p in (flexion.roots[thumb],
                                                          flexion.tips_open[thumb])]  # fmt: skip
            if min(both) > 0.0:
                clear = _CERTAIN
        clear = min(clear, _DISPUTED) if named_sign else clear
        return _Radial(sign * across, "the thumb's place", clear)
    if named_sign:
        return _Radial(named_sign * across, "the fingers' names", _LIKELY)
    return _Radial(across, "", 0.0)


def _thumb_place(
    flexion: HandFlexion, fingers: list[int], thumb: int | None, across: np.ndarray
) -> float:
    """Return how far the thumb is to one side, in half widths of the palm."""
    if thumb is None:
        return 0.0
    middle = flexion.bases[fingers].mean(axis=0) @ across
    width = max(
        float(np.ptp(flexion.bases[fingers] @ across)) / 2.0,
        0.25 * float(flexion.reach[fingers].mean()),
    )
    centre = (flexion.roots[thumb] + flexion.tips_open[thumb]) / 2.0
    return float(centre @ across - middle) / width


# -- side


def _find_side(
    flexion: HandFlexion,
    bend: _Bend,
    radial: _Radial,
    thumb: Clue,
    named: Side | None,
    given: Side | None,
    distal: np.ndarray,
) -> tuple[_Bend, Side, Clue]:
    """Find the side: a right hand seen from the back, fingers up, has its thumb on the left.

    A given side, or a named one, sets the sign of the dorsal direction if the thumb is clearly on
    one side of the palm.
    """
    declared = given if given is not None else named
    source = "as given" if given is not None else "from the names"
    is_lateral = radial.confidence > 0.0
    found: Side = "right" if radial.direction @ np.cross(distal, bend.dorsal) < 0.0 else "left"
    if not is_lateral:
        if declared is None:
            how = "undetermined; right by convention"
            return bend, "right", Clue("side", "right", how, 0.2)
        confidence = 1.0 if given is not None else 0.65
        return (
            bend,
            declared,
            Clue("side", declared, f"{source}; the thumb is in the middle", confidence),
        )
    where = "left" if found == "right" else "right"
    how = f"seen from the back with the fingers up, the thumb is on the {where} ({radial.how})"
    if declared is None:
        confidence = min(radial.confidence, thumb.confidence, bend.confidence)
        return bend, found, Clue("side", found, how, confidence)
    if declared == found:
        if bend.sign_certainty > 0.6 and _LIKELY <= bend.confidence < _CERTAIN:
            bend = replace(bend, how=f"{bend.how}; the side agrees", confidence=_CERTAIN)
        elif bend.confidence < _LIKELY:
            raised = _LIKELY if bend.sign_certainty > 0.05 else bend.confidence
            bend = replace(bend, how=f"{bend.how}; the side agrees", confidence=raised)
        least = min(radial.confidence, thumb.confidence)
        confidence = 1.0 if given is not None else _CERTAIN if least >= _LIKELY else _LIKELY
        what = source if given is not None else f"{source}, and {how}"
        return bend, declared, Clue("side", declared, what, confidence)
    # They disagree: names yield to clear flexion, an owner's word does not.
    if given is None and bend.sign_certainty > 0.9 and radial.confidence >= _LIKELY:
        return bend, found, Clue("side", found, f"{how}; the names say {declared}", _DISPUTED)
    is_clear = bend.sign_certainty > 0.9
    turned = _Bend(
        -bend.dorsal + 0.0,
        f"the back of a {declared} hand with its thumb there; "
        + ("the ranges of the joints suggest the opposite" if is_clear else "flexion is symmetric"),
        0.4 if is_clear else min(_LIKELY, radial.confidence),
        0.0,
    )
    how = f"{source}; the ranges of the joints suggest {found}" if is_clear else source
    confidence = 0.5 if is_clear else 0.9 if given is not None else min(_LIKELY, thumb.confidence)
    return turned, declared, Clue("side", declared, how, confidence)


# -- fingers


def _name_fingers(
    flexion: HandFlexion,
    radial: np.ndarray,
    rest: list[int],
    thumb: int | None,
    labels: list[str | None],
    confidence: float,
    thumb_clue: Clue,
) -> tuple[tuple[str, ...], Clue]:
    """Name the fingers by their order across the palm, or by their own names."""
    # Order fingers by base and tip: fingers spread towards their tips, and bases may lie one behind
    # the other.
    places = (flexion.bases + 0.3 * (flexion.tips_open - flexion.bases)) @ radial
    order = sorted(rest, key=lambda i: -places[i])
    gaps = -np.diff([places[i] for i in order])
    narrowest = float(gaps.min()) if len(gaps) else np.inf
    fingers = [""] * len(labels)
    if thumb is not None:
        fingers[thumb] = "thumb"
    for place, i in enumerate(order):
        fingers[i] = FINGERS[place] if place < len(FINGERS) else f"finger{place + 2}"
    own = [labels[i] for i in rest]
    how = "ordered by position across the palm, from the thumb's side" + (
        f"; neighbours are at least {1e3 * narrowest:.0f} mm apart" if len(gaps) else ""
    )
    confidence = min(confidence, _CERTAIN if narrowest > _NARROW else 0.4, thumb_clue.confidence)
    if rest and None not in own and "thumb" not in own:
        by_name = sorted(rest, key=lambda i: FINGERS.index(str(labels[i])))
        if by_name == order:
            how = f"{how}; the names agree"
            confidence = _CERTAIN if thumb_clue.confidence >= _LIKELY else _LIKELY
            order = by_name
            for i in rest:
                fingers[i] = str(labels[i])
        elif narrowest < 2.0 * _NARROW or confidence < _LIKELY:
            how, confidence, order = "from the names; their places are ambiguous", _LIKELY, by_name
            for i in rest:
                fingers[i] = str(labels[i])
        else:
            how = f"{how}; the names say {', '.join(str(labels[i]) for i in order)}"
            confidence = min(confidence, _DISPUTED)
    answer = ", ".join(fingers[i] for i in ([] if thumb is None else [thumb]) + order)
    if len(rest) < 2:
        # Nothing is left to choose but the thumb.
        confidence = max(confidence, min(0.9, thumb_clue.confidence))
    return tuple(fingers), Clue("fingers", answer, how, confidence)


# -- geometry


def _widest(points: np.ndarray) -> np.ndarray:
    """Return the direction in which points extend most, a unit vector, shape (3,)."""
    return np.linalg.svd(points - points.mean(axis=0))[2][0]


def _angle(one: np.ndarray, other: np.ndarray) -> float:
    """Return the angle between two vectors [deg]; 180 if one is zero."""
    length = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(one @ other / length, -1.0, 1.0)))) if length else 180


def _snapped(
    direction: np.ndarray, knuckles: np.ndarray | None = None, axis: np.ndarray | None = None
) -> np.ndarray:
    """Return the link's axis next to a direction, or else the direction, normalised.

    The mean direction of spread fingers is a few degrees off the link's axis. Fingers that cannot
    stretch fully are farther off it. The link's axis is then taken if the axis of flexion is
    another of the link's axes, and the knuckles lie in its direction from the link's origin.
    """
    nearest = int(np.argmax(np.abs(direction)))
    ahead = np.sign(direction[nearest]) * np.eye(3)[nearest]
    angle = _angle(direction, ahead)
    if angle < _SNAP:
        return ahead
    if knuckles is not None and axis is not None and angle < _SNAP_WITH_PALM:
        lateral = np.delete(np.abs(axis), nearest).max() > np.cos(np.radians(_SNAP_AXIS))
        sagittal = knuckles - (knuckles @ axis) * axis
        if lateral and _angle(sagittal, ahead) < angle:
            return ahead
    direction = np.where(np.abs(direction) < 1e-6, 0.0, direction)
    return direction / np.linalg.norm(direction)


def _shown(direction: np.ndarray) -> str:
    for axis, name in enumerate("xyz"):
        if abs(direction[axis]) > 0.9999:
            return f"{'+' if direction[axis] > 0 else '-'}{name}"
    return "[" + ", ".join(f"{value:.3f}" for value in direction) + "]"
