"""Thumb, palm directions, side and finger names, from the fingers' positions and flexion.

Each answer is *certain* only if two independent kinds of evidence agree: position, flexion, the
plane of the knuckles, or names. What is derived from an answer is never surer than it.
"""

from collections.abc import Sequence
from itertools import chain, combinations
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array, lengths, unit
from handmap_qp.hands import THUMB, Names, Side, human
from .finger_names import named_fingers, named_side
from .flexion import HandFlexion
from .hypotheses import Hypothesis
from .robot import Robot
from .structure import Clue, RobotFinger, find_structure
from .two_hands import PairedSide

FINGERS = human.FINGERS[1:]
"""The fingers from the thumb's side outwards; additional fingers are numbered."""
NARROW = 0.004
"""Neighbouring fingers closer than this could be in either order [m]."""
# Confidence with two kinds of evidence that agree, with one, and with two that disagree.
_CERTAIN = 0.95
_LIKELY = 0.75
_DISPUTED = 0.5
# Score margins of a clear answer, and of one; length of the mean unit vector of fingers that agree.
_DECISIVE = 5.0
_CLEAR = 0.3
_VISIBLE = 0.1
_AGREED = 0.85
# Largest angles at which a direction counts as the palm link's axis: alone, and if the knuckles lie
# in that direction from the link's origin [deg].
_SNAP = 5.0
_SNAP_WITH_PALM = 16.0
# Largest angle of the axis of flexion to another of these axes for the latter [deg].
_SNAP_AXIS = 8.0
# Ranges that show flexion with more confidence than this are clear, others count this share of it.
_CLEAR_FLEXION = 0.9
_VAGUE = 0.4
# A thumb that closes this far before the palm is clearly there, in lengths of the fingers.
_HIGH = 0.3
# Directions agree within this angle [deg].
_AGREEING = 25.0
# A thumb opposes the fingers' direction if the cosine between both is smaller.
_OPPOSED = -0.5
# A direction that is not known.
_UNKNOWN = np.zeros(3)


class Parts(NamedTuple):
    """What a hand consists of, whatever it may be.

    Attributes:
        robot: The robot.
        palm: The palm's link, with its evidence.
        fingers: All fingers, in the order of the file.
        notes: Chains that were ignored, and why.
        names: Names of the joints and links of each finger.
        labels: The anatomical name in these, of each finger.
        flexion: How all fingers flex.
    """

    robot: Robot
    palm: Clue
    fingers: list[RobotFinger]
    notes: list[str]
    names: list[list[str]]
    labels: list[str | None]
    flexion: HandFlexion


def find_anatomy(
    robot: Robot,
    side: Side | None = None,
    thumb: str | None = None,
    paired: PairedSide | None = None,
) -> "Anatomy":
    """Return what a hand most likely is, of all that it may be.

    Args:
        robot: The robot; the palm becomes its own.
        side: The side, if known.
        thumb: A link or joint of the thumb, if known.
        paired: The side by the other hand of a robot, if there is one.

    Raises:
        HandError: If the robot is no hand, or no finger has that link or joint.
    """
    palm, fingers, notes = find_structure(robot)
    names = [[*finger.joint_names, *finger.links] for finger in fingers]
    labels = named_fingers(names)
    flexion = HandFlexion(robot, fingers, has_thumb=THUMB in labels)
    parts = Parts(robot, palm, fingers, notes, names, labels, flexion)
    given = None if thumb is None else _given_thumb(parts, thumb)
    first = Anatomy(parts, side, paired, given)
    thumbs = [given] if given is not None else range(len(fingers) * (len(fingers) > 2))
    ways = (None,) if side or (paired and paired.is_forced) else (False, True)
    others = [
        Anatomy(parts, side, paired, given, assumed=i, is_turned=is_turned)
        for i in thumbs
        for is_turned in ways
    ]
    best = choose(first, others)
    best.settle()
    return best


class Anatomy:
    """A hand of a robot as it may be: its directions and fingers, by flexion, places and names.

    Args:
        parts: What it consists of.
        side: The side, if known.
        paired: The side by the other hand of a robot, if there is one.
        thumb: Index of the thumb, if known.
        assumed: Index of the thumb that this hypothesis assumes; that which differs if omitted.
        is_turned: Whether the palm is turned over against the flexion that was found; by the side
            in the names if omitted.

    Attributes:
        robot: The robot.
        notes: Chains that were ignored, and why.
        flexion: How all fingers flex, in the order of the file.
        others: Indices of all fingers there but the thumb.
        distal: Direction of the stretched fingers, in the palm link's coordinates, shape (3,).
        dorsal: Direction out of the back of the hand, at right angles to it, shape (3,).
        side: `right` or `left`.
        fingers: The fingers with their anatomical names, the thumb first.
        clues: Evidence for each of these.
        sure: The confidence in them by what they are.
        hypothesis: What all evidence says of it.
        ranking: All that was compared, the one with most evidence first.
    """

    def __init__(
        self,
        parts: Parts,
        side: Side | None,
        paired: PairedSide | None,
        thumb: int | None = None,
        *,
        assumed: int | None = None,
        is_turned: bool | None = None,
    ) -> None:
        self._parts = parts
        self.robot = parts.robot
        self.notes = [*parts.notes]
        self._paired = paired
        self._is_turned = is_turned
        self._names = parts.names
        self._labels = parts.labels
        self.flexion = flexion = parts.flexion
        self._values: dict[str, float] = {}
        self.ranking: tuple[Hypothesis, ...] = ()
        # The thumb, if there are several fingers, and the other ones.
        known = assumed if thumb is None else thumb
        self._thumb, self._thumb_clue = self._find_thumb(known)
        if thumb is not None:
            self._thumb = thumb
            link = parts.names[thumb][-1]
            self._thumb_clue = Clue("thumb", link, "as given", 1.0)
        count = len(parts.fingers)
        self.others = [i for i in range(count) if i != self._thumb]
        axes = flexion.axes[self.others]
        values, vectors = np.linalg.eigh(axes.T @ axes)
        # Jaws and hands with fingers all around have no common axis of flexion.
        has_axis = values[-1] > 0.8 * values.sum()
        self._axis = has_axis * vectors[:, -1]
        distal = self._find_distal()
        dorsal = self._find_dorsal(distal)
        across = np.cross(distal.answer, dorsal.answer)
        radial = self._find_radial(across)
        turned, found = self._find_side(side, across, dorsal, radial)
        self.side: Side = found.answer
        # The thumb's side orders the fingers; only without it the side does.
        if radial.confidence == 0.0:
            outwards = -across if self.side == "right" else across
            radial = radial._replace(answer=outwards, confidence=0.2)
        self._named, order = self._name_fingers(radial)
        self.fingers = [parts.fingers[i] for i in self._named]
        self.distal = distal.answer
        self.dorsal = turned.answer
        # No direction is surer than the fingertips.
        sure = float(np.median([finger.end.confidence for finger in parts.fingers]))
        directions = [
            each._replace(
                answer=_shown(each.answer), confidence=min(each.confidence, sure)
            )
            for each in (distal, turned)
        ]
        self.clues = [parts.palm, self._thumb_clue, *directions, found, order]
        self.sure = {clue.what: clue.confidence for clue in self.clues}
        is_over = bool(turned.answer @ dorsal.answer < 0.0)
        has_side = radial.confidence > 0.2
        self._weigh(dorsal, has_side=has_side, sense=-1.0 if is_over else 1.0)
        self.hypothesis = Hypothesis(
            self._thumb, self._thumb_clue.answer, self.side, is_over, self._values
        )

    def _weigh(self, dorsal: Clue, *, has_side: bool, sense: float) -> None:
        """Note what evidence says of the side, and of a palm that is turned over (sense -1)."""
        is_clear = dorsal.sign > _CLEAR_FLEXION
        self._values["flexion"] = sense * (1.0 if is_clear else _VAGUE * dorsal.sign)
        height = sense * self._thumb_height(dorsal.answer)
        self._values["thumb ahead"] = float(np.clip(height / _HIGH, -1.0, 1.0))
        declared, _ = self._declared
        if has_side and declared:
            what = "other hand" if self._paired else "side name"
            self._values[what] = 1.0 if declared == self.side else -1.0

    def settle(self) -> None:
        """Name the fingers, and flex them to the palm, once this is what the hand is."""
        for finger, name in zip(self.fingers, self._named.values(), strict=True):
            finger.name = name
        flexion = self.flexion
        if flexion.ways[self.others].sum(axis=0) @ self.dorsal > 0.0:
            # The side turned the palm over: joints with symmetric ranges flex the other way.
            self.flexion = HandFlexion(
                self.robot,
                self._parts.fingers,
                palmar=-self.dorsal,
                has_thumb=THUMB in self._labels,
            )

    def told(self, what: str, how: str, most: float) -> None:
        """Add to the evidence for one answer, which is no surer than `most`."""
        self.clues = [
            clue._replace(
                how=f"{clue.how}; {how}", confidence=min(clue.confidence, most)
            )
            if clue.what == what
            else clue
            for clue in self.clues
        ]
        self.sure = {clue.what: clue.confidence for clue in self.clues}

    def _find_thumb(self, assumed: int | None) -> tuple[int | None, Clue]:
        """Find the finger that differs from the others, or that the names call a thumb."""
        names = self._names
        count = len(names)
        if count < 2:
            return None, Clue("thumb", "none", "the hand has one finger only", 0.9)
        peaks = [_stands_out(part) for part in _differences(self.flexion)]
        # The number of joints counts less than the others, a name as much as a clear margin; where
        # every finger has its own name, or one of several has lost it, they decide.
        sizes = np.array([*map(len, names)])
        is_named = np.array(self._labels) == "thumb"
        scores = 0.5 * sum(peaks) + 0.15 * _stands_out(sizes[:, None] != sizes)
        is_decisive = self._labels.count(None) <= int(count > 3)
        differences = scores
        scores = scores + (_DECISIVE if is_decisive else _CLEAR) * is_named
        best = int(np.argmax(scores))
        lead = np.diff(np.sort(scores))[-1]
        margin = lead if count > 2 else _CLEAR * is_named.sum()
        agreeing = is_named[best] + sum(
            np.argmax(peak) == best and max(peak) > _VISIBLE for peak in peaks
        )
        how = f"it differs most in position, direction, flexion and name (margin {margin:.2f} of 1)"
        sure = _CERTAIN if margin > _CLEAR and agreeing > 1 else _LIKELY
        if margin <= _VISIBLE:
            how = "the fingers are alike: one that differs little was taken"
            sure = 0.3
            best = best if margin > 1e-6 else 0
        if assumed is not None and assumed != best:
            best = assumed
            how = "chosen by all evidence together"
            sure = _LIKELY
        elif is_named.any() and not is_named[best]:
            how += "; the names suggest another finger"
            sure = _DISPUTED
        named = 1.0 if is_decisive else 0.5 * _CLEAR
        self._values["difference"] = float(np.clip(differences[best], -1.0, 1.0))
        if is_named.any() or self._labels[best]:
            self._values["thumb name"] = named if is_named[best] else -named
        return best, Clue("thumb", names[best][-1], how, sure)

    def _find_distal(self) -> Clue:
        """Find the direction of the stretched fingers."""
        flexion = self.flexion
        axis = self._axis
        # Two jaws lean to opposite sides: take the middle of both, or the fixed one.
        chosen = self.others
        if len(flexion.bases) == 2 and flexion.moves[chosen].any():
            chosen = slice(None)
        mean = flexion.directions[chosen].mean(axis=0)
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
        beside = _beside(mean, axis)
        middle = knuckles.mean(axis=0)
        mean = _snapped(unit(beside if lengths(beside) > 0.2 else mean), middle, axis)
        how = f"the mean direction of the straight fingers (agreement {agreement:.2f} of 1)"
        confidence = 0.4
        if agreement > _AGREED:
            # Jaws start anywhere: only with an axis of flexion is their direction exact.
            confidence = _CERTAIN if axis.any() else _LIKELY
            row = _widest(knuckles) if len(knuckles) > 2 else mean
            if angle_between(mean, middle) < _AGREEING:
                how += "; the knuckles lie in this direction from the palm's origin"
            elif abs(mean @ row) < np.sin(np.radians(_AGREEING)):
                how += "; at right angles to the row of the knuckles"
            else:
                confidence = _LIKELY
        # Fingers around a centre, as a Barrett hand's, have no straight posture of a person.
        if len(self.others) > 1 and flexion.directions[self._thumb] @ mean < _OPPOSED:
            how += (
                "; the thumb points the other way: the palm's direction may be better"
            )
            confidence = _DISPUTED
        return Clue("distal", mean, how, confidence)

    def _find_dorsal(self, distal: Clue) -> Clue:
        """Find the back of the hand: opposite to the way in which the fingertips flex."""
        flexion = self.flexion
        others = self.others
        ahead = distal.answer
        mean = flexion.ways[others].mean(axis=0)
        agreement = lengths(mean)
        palmar = _beside(mean, ahead)
        how = f"opposite to the fingertips' motion in flexion (agreement {agreement:.2f} of 1)"
        sign = np.median(flexion.certainty[others])
        upright = np.cross(self._axis, ahead)
        if abs(palmar @ upright) > 0.2:
            # The axes of flexion are exact; the way of the tips depends on the posture.
            palmar = np.sign(palmar @ upright) * upright
        if lengths(palmar) < 0.2 and self._thumb is not None:
            tips = flexion.tips_open
            palmar = _beside(tips[self._thumb] - tips[others].mean(axis=0), ahead)
            sign = 0.5
            how = "away from the thumb, because the other fingertips flex in different directions"
        if lengths(palmar) < 1e-6:
            palmar = _beside(np.eye(3)[np.argmin(np.abs(ahead))], ahead)
            sign = 0.05
            how = "undetermined: an arbitrary direction at right angles to distal"
        dorsal = unit(_beside(_snapped(unit(-palmar)), ahead))
        best = _LIKELY if agreement > 0.4 else _DISPUTED
        tilt = self._tilt(ahead, dorsal)
        height = self._thumb_height(dorsal)
        if agreement > _AGREED and (tilt < _AGREEING or height > 0.1):
            best = _CERTAIN
            how += "; at right angles to the row of the knuckles" * (tilt < _AGREEING)
            how += "; the thumb closes on the other side" * (height > 0.1)
        if tilt > 2.0 * _AGREEING:
            best = _DISPUTED
            how += (
                f"; the row of the knuckles is {tilt:.0f} degrees off the palm's plane"
            )
        return Clue("dorsal", dorsal, how, min(best, sign, distal.confidence), sign)

    def _tilt(self, distal: Array, dorsal: Array) -> float:
        """Return the angle of the row of the knuckles to the palm [deg], a neutral one without."""
        across = _beside(_widest(self.flexion.bases[self.others]), distal)
        if len(self.others) < 3 or lengths(across) < 0.5:
            return 1.5 * _AGREEING
        return abs(angle_between(across, dorsal) - 90.0)

    def _thumb_height(self, dorsal: Array) -> float:
        """Return how far before the knuckles the thumb closes, in lengths of the fingers."""
        flexion = self.flexion
        thumb = self._thumb
        if thumb is None or flexion.certainty[thumb] <= 0.6:
            return 0.0
        before = flexion.bases[self.others].mean(axis=0) - flexion.tips_closed[thumb]
        return float(before @ dorsal / max(flexion.reach[self.others].mean(), 1e-6))

    def _find_radial(self, across: Array) -> Clue:
        """Return the direction across the palm to the thumb; confidence 0 if that is central."""
        flexion = self.flexion
        others = self.others
        bases = {self._labels[i]: flexion.bases[i] @ across for i in others}
        steps = -np.diff([bases[label] for label in FINGERS if label in bases])
        # Names count if all steps are to one side, and none is too small to tell.
        named = np.sign(steps.sum())
        named *= (named * steps > 0.5 * NARROW).all()
        # Where the thumb's base and tip are on one side, in half widths of the palm.
        ends = np.zeros(2)
        if len(others) > 1:
            row = flexion.bases[others] @ across
            width = max(0.5 * np.ptp(row), 0.25 * flexion.reach[others].mean())
            points = np.array([flexion.roots, flexion.tips_open])[:, self._thumb]
            ends = (points @ across - row.mean()) / width
        place = ends.mean()
        is_outside = abs(place) > 2.0 * _CLEAR and (ends * place > 0.0).all()
        place *= abs(place) > _VISIBLE
        how = "the thumb's place"
        is_clear = abs(place) > _CLEAR
        self._values["finger names"] = float(np.sign(named * place))
        confidence = (
            _CERTAIN if is_outside else _LIKELY if is_clear else 0.65 if place else 0.0
        )
        if named * place > 0.0:
            how = "the thumb's place and the fingers' names"
            confidence = _CERTAIN
        elif named:
            how = how if is_clear else "the fingers' names"
            confidence = _DISPUTED if is_clear else _LIKELY
        # Names count as much as a clear place.
        return Clue("radial", np.sign(place + _CLEAR * named) * across, how, confidence)

    def _declare(self, given: Side | None) -> tuple[Side | None, str]:
        """Return the side that is given, of the other hand or in the names, and its source."""
        if given:
            return given, "as given"
        robot = self.robot
        hints = (robot.name, robot.file.stem, robot.palm_frame.name)
        named = named_side(chain(hints, *self._names))
        paired = self._paired
        if paired and paired.side != named:
            return paired.side, paired.how
        return named, "from the names"

    def _find_side(
        self, given: Side | None, across: Array, dorsal: Clue, radial: Clue
    ) -> tuple[Clue, Clue]:
        """Find the side: a right hand seen from the back, fingers up, has its thumb on the left.

        A given or named side may turn the dorsal direction over.
        """
        declared, source = self._declared = self._declare(given)
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
        least = min(radial.confidence, self._thumb_clue.confidence)
        sure = min(least, dorsal.confidence)
        if self._is_turned and not given:
            back = f"the back of a {place} hand with its thumb there"
            over = Clue("dorsal", -dorsal.answer + 0.0, back, min(_LIKELY, least), 0.0)
            return over, Clue("side", place, how, min(_LIKELY, least))
        if self._is_turned is False and declared != found and not given:
            return dorsal, Clue("side", found, how, sure)
        answer = found
        is_clear = dorsal.sign > _CLEAR_FLEXION
        if declared == found:
            how = f"{source}, and {how}"
            sure = 1.0 if given else _CERTAIN if least >= _LIKELY else _LIKELY
            dorsal = _confirmed(dorsal)
        elif declared and is_clear and self._paired and self._paired.is_forced:
            # The other hand is of the side that this one looks like. Its palm is known.
            answer = declared
            how = f"{source}; {how}, as on the other hand"
            sure = _DISPUTED
        elif declared and is_clear and not given and radial.confidence >= _LIKELY:
            # They disagree: names yield to clear flexion, an owner's word does not.
            how += f"; the names say {declared}"
            sure = _DISPUTED
        elif declared:
            answer = declared
            why = f"the ranges of the joints suggest {found}"
            sure = 0.4
            if not is_clear:
                why = "flexion is symmetric"
                sure = 0.9 if given else min(_LIKELY, least)
            how = f"{source}; {why}"
            back = f"the back of a {declared} hand with its thumb there; {why}"
            turned = min(_LIKELY, sure)
            dorsal = Clue("dorsal", -dorsal.answer + 0.0, back, turned, 0.0)
        return dorsal, Clue("side", answer, how, sure)

    def _name_fingers(self, radial: Clue) -> tuple[dict[int, str], Clue]:
        """Name the fingers by their order across the palm, or by their own names."""
        flexion = self.flexion
        labels = self._labels
        sure = self._thumb_clue.confidence
        # By base and tip: fingers spread towards their tips, and bases may lie in line.
        places = (0.7 * flexion.bases + 0.3 * flexion.tips_open) @ radial.answer
        order = sorted(self.others, key=lambda i: -places[i])
        apart = -np.diff(places[order]).max(initial=-np.inf)
        how = "ordered by position across the palm, from the thumb's side"
        confidence = min(radial.confidence, _CERTAIN if apart > NARROW else 0.4, sure)
        if len(order) < 2:
            # Nothing is left to choose but the thumb.
            confidence = max(confidence, min(0.9, sure))
        own = {labels.index(label): label for label in FINGERS if label in labels}
        # A finger of another name may be given as the thumb.
        own.pop(self._thumb, None)
        named = _fitting(order, {}) or {}
        is_named = 0 < len(order) == len(own)
        if (fitting := _fitting(order, own)) and own:
            named = fitting
            if is_named:
                how += "; the names agree"
                confidence = _CERTAIN if sure >= _LIKELY else _LIKELY
            else:
                how += f"; the names {', '.join(own.values())} agree"
        elif own and (apart < 2.0 * NARROW or confidence < _LIKELY):
            how = "from the names; their places are ambiguous"
            free = (name for name in named.values() if name not in own.values())
            given = own | {i: next(free) for i in order if i not in own}
            ranks = _names_of(len(order))
            named = dict(sorted(given.items(), key=lambda item: ranks.index(item[1])))
            confidence = _LIKELY if is_named else confidence
        elif own:
            how += f"; the names say {', '.join(own.values())}"
            confidence = min(confidence, _DISPUTED)
        if self._thumb is not None:
            named = {self._thumb: "thumb", **named}
        return named, Clue("fingers", ", ".join(named.values()), how, confidence)


def choose(first: Anatomy, others: Sequence[Anatomy]) -> Anatomy:
    """Return the hypothesis with most evidence, and note the next one if it has nearly as much.

    Args:
        first: The one that is found step by step; it yields only to a clearly better one.
        others: All others, and this one again.
    """
    ranked = sorted(others, key=lambda one: -one.hypothesis.score)
    best = first
    distinct = {one.hypothesis.answer: one.hypothesis for one in [*ranked[::-1], first]}
    ranking = sorted(distinct.values(), key=lambda one: -one.score)
    if ranked and ranked[0].hypothesis.overrules(first.hypothesis):
        best = ranked[0]
        why = best.hypothesis.told_from(first.hypothesis)
        for what in best.hypothesis.differences(first.hypothesis):
            best.told(what, why, _LIKELY)
    mine = best.hypothesis
    best.ranking = tuple(ranking)
    following = next((one for one in ranking if mine.differences(one)), None)
    if following and (note := mine.doubt(following)):
        best.notes.append(note)
    return best


def _given_thumb(parts: Parts, given: str) -> int:
    """Return the finger of a link or joint."""
    for i, group in enumerate(parts.names):
        if given in group:
            return i
    raise parts.robot.error(f"no finger has a link or joint {given!r}", given)


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


def _differences(flexion: HandFlexion) -> tuple[Array, Array, Array]:
    """Return how much fingers differ in position, direction and flexion, 0 to 1, shape (F, F)."""
    lines = flexion.tips_open - flexion.roots
    sizes = lengths(lines)
    directions = unit(lines)
    along = unit(directions[:, None] + directions)
    between = flexion.roots[:, None] - flexion.roots
    apart = np.abs(np.vecdot(between, along))
    longer = np.maximum.outer(sizes, sizes).clip(1e-9)
    ahead = np.minimum(1.0, 2.0 * apart / longer)
    return ahead, 1.0 - directions @ directions.T, 1.0 - flexion.ways @ flexion.ways.T


def _stands_out(differences: Array) -> Array:
    """Return how much each finger differs from the others, less how much they differ, (F,)."""
    others = len(differences) - 1
    own = differences.sum(axis=1) - differences.diagonal()
    # Differences are symmetric.
    among = differences.sum() - 2.0 * own - differences.diagonal()
    return own / others - among / max(1, others * (others - 1))


def _confirmed(dorsal: Clue) -> Clue:
    """Return a dorsal direction with which the side agrees."""
    if dorsal.sign <= 0.05:
        return dorsal
    sure = _CERTAIN if dorsal.confidence >= _LIKELY else _LIKELY
    return dorsal._replace(how=f"{dorsal.how}; the side agrees", confidence=sure)


# -- geometry


def _beside(vector: Array, direction: Array) -> Array:
    """Return the part of a vector at right angles to a unit vector."""
    return vector - (vector @ direction) * direction


def _widest(points: Array) -> Array:
    """Return the direction in which points extend most, a unit vector, shape (3,)."""
    return np.linalg.svd(points - points.mean(axis=0))[2][0]


def angle_between(one: Array, other: Array) -> float:
    """Return the angle between two vectors [deg]; 90 if one is zero."""
    return float(np.degrees(np.arccos(np.clip(unit(one) @ unit(other), -1.0, 1.0))))


def _snapped(
    direction: Array, knuckles: Array = _UNKNOWN, axis: Array = _UNKNOWN
) -> Array:
    """Return the link's axis next to a unit vector, or else the vector.

    Fingers that cannot stretch fully are farther off it: it is then taken if the axis of flexion is
    another of the link's axes, and the knuckles lie in its direction from the link's origin.
    """
    nearest = np.abs(direction).argmax()
    ahead = np.sign(direction[nearest]) * np.eye(3)[nearest]
    angle = angle_between(direction, ahead)
    lateral = np.delete(np.abs(axis), nearest).max()
    is_lateral = lateral > np.cos(np.radians(_SNAP_AXIS))
    is_ahead = angle_between(_beside(knuckles, axis), ahead) < angle
    limit = _SNAP_WITH_PALM if is_lateral and is_ahead else _SNAP
    return ahead if angle < limit else direction


def _shown(direction: Array) -> str:
    nearest = np.abs(direction).argmax()
    if abs(direction[nearest]) > 0.9999:
        return f"{'+' if direction[nearest] > 0 else '-'}{'xyz'[nearest]}"
    return f"[{', '.join(f'{value:.3f}' for value in direction)}]"
