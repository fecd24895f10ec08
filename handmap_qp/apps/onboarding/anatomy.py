"""Thumb, palm directions, side and finger names, from the fingers' positions and flexion.

Each answer is *certain* only if two independent kinds of evidence agree: position, flexion, the
plane of the knuckles, or names. What is derived from an answer is never surer than it.
"""

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import NamedTuple, get_args

import numpy as np

from handmap_core.se3 import Array
from handmap_qp.hands import Side
from .finger_names import named_fingers, named_side
from .finger_order import name_fingers
from .flexion import HandFlexion
from .hypotheses import CLEAR_FLEXION, DISPUTED, LIKELY, Hypothesis, score
from .layout import lay_out
from .palm_directions import find_distal, find_dorsal, thumb_height
from .robot import Robot
from .sides import Declared, find_radial, find_side
from .single_joints import FingerKind, find_single_joints
from .structure import Clue, RobotFinger, Structure
from .thumbs import find_thumb
from .two_hands import PairedSide
from .vectors import UNKNOWN, angle_between, shown, snapped

# Ranges that show flexion less than clearly count this share of it.
_VAGUE = 0.4
# The fingers are along the arm up to the first angle, and not from the second one on [deg].
_OFF_THE_ARM = (5.0, 25.0)
# A thumb that closes this far before the palm is clearly there, in lengths of the fingers.
_HIGH = 0.3


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
        surface: Points of the palm's surface in its link's frame [m], shape (k, 3).
        kind: What fingers with one flexing joint are; None if there are none.
        straight: Confidence in these that zero is straight, 0 of jaws, shape (F,).
        values: Evidence for that kind.
        ahead: Direction in which the arm points, zero if unknown, shape (3,).
    """

    robot: Robot
    palm: Clue
    fingers: list[RobotFinger]
    notes: list[str]
    names: list[list[str]]
    labels: list[str | None]
    flexion: HandFlexion
    surface: Array
    kind: FingerKind | None
    straight: Array
    values: Mapping[str, float]
    ahead: Array


def find_anatomy(
    robot: Robot,
    structure: Structure,
    side: Side | None = None,
    thumb: str | None = None,
    paired: PairedSide | None = None,
    kind: FingerKind | None = None,
    ahead: Array = UNKNOWN,
) -> "Anatomy":
    """Return what a hand most likely is, of all that it may be.

    Args:
        robot: The robot.
        structure: Its palm and fingers.
        side: The side, if known.
        thumb: A link or joint of the thumb, if known.
        paired: The side by the other hand of a robot, if there is one.
        kind: What fingers with one flexing joint each are, if known.
        ahead: Direction in which the arm points in the palm link's coordinates, as of
            `arm_direction`, shape (3,); zero if unknown.

    Raises:
        HandError: If no finger has that link or joint.
    """
    readings = _readings(robot, structure, kind, ahead)
    given = None if thumb is None else _given_thumb(readings[0], thumb)
    first, *others = (Anatomy(parts, side, paired, given) for parts in readings)
    count = len(structure.fingers)
    thumbs = [given] if given is not None else range(count * (count > 2))
    ways = (None,) if side or (paired and paired.is_forced) else (False, True)
    assumed = [(i, is_turned) for i in thumbs for is_turned in ways]
    others += [
        Anatomy(parts, side, paired, given, assumed=i, is_turned=is_turned)
        for parts in readings
        for i, is_turned in assumed
    ]
    if ahead.any():
        others += [
            Anatomy(
                parts,
                side,
                paired,
                given,
                assumed=i,
                is_turned=is_turned,
                is_along_arm=True,
            )
            for parts in readings
            for i, is_turned in [(None, None), *assumed]
        ]
    best = choose(first, others)
    best.settle()
    return best


def _readings(
    robot: Robot, structure: Structure, given: FingerKind | None, ahead: Array
) -> list[Parts]:
    """Return what a hand consists of, once for each kind that its fingers may be.

    The first one has most evidence of its kind.
    """
    palm, fingers, notes = structure
    names = [[*finger.joint_names, *finger.links] for finger in fingers]
    labels = named_fingers(names)
    surface = robot.palm_surface()
    single = find_single_joints(robot, fingers, labels)

    def reading(kind: FingerKind | None) -> Parts:
        sense = -1.0 if kind == "jaws" else 1.0
        straight = single.straight * (kind != "jaws")
        values = {name: sense * value for name, value in single.values.items()}
        flexion = HandFlexion(robot, fingers, straight=straight)
        return Parts(
            robot,
            palm,
            fingers,
            notes,
            names,
            labels,
            flexion,
            surface,
            kind,
            straight,
            values,
            ahead,
        )

    if not single.is_ambiguous:
        return [reading(None)]
    kinds = (given,) if given else get_args(FingerKind)
    return sorted(map(reading, kinds), key=lambda parts: -score(parts.values))


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
        is_along_arm: Whether the hand points where the arm does, and not where its fingers do.

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
        runner_up: The next one, if it has nearly as much evidence.
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
        is_along_arm: bool = False,
    ) -> None:
        self._parts = parts
        self.robot = parts.robot
        self.notes = [*parts.notes]
        self._paired = paired
        self.flexion = flexion = parts.flexion
        self._values = {**parts.values}
        self.ranking: tuple[Hypothesis, ...] = ()
        self.runner_up: Hypothesis | None = None
        # The thumb, if there are several fingers, and the other ones.
        known = assumed if thumb is None else thumb
        names, labels = parts.names, parts.labels
        found_thumb, clue = find_thumb(flexion, names, labels, known, self._values)
        if thumb is not None:
            found_thumb = thumb
            clue = Clue("thumb", parts.names[thumb][-1], "as given", 1.0)
        self._layout = layout = lay_out(flexion, labels, found_thumb, parts.surface)
        self.others = layout.others
        # No direction of fingers is surer than the fingertips.
        sure = float(np.median([finger.end.confidence for finger in parts.fingers]))
        distal = find_distal(layout)
        distal = self._weigh_arm(distal, sure, is_along_arm=is_along_arm)
        dorsal = find_dorsal(layout, distal)
        across = np.cross(distal.answer, dorsal.answer)
        radial = find_radial(layout, across, self._values)
        self._told = self._declare(side)
        turned, found = find_side(
            self._told, across, dorsal, radial, clue, is_turned=is_turned
        )
        self.side: Side = found.answer
        # The thumb's side orders the fingers; only without it the side does.
        if radial.confidence == 0.0:
            outwards = -across if self.side == "right" else across
            radial = radial._replace(answer=outwards, confidence=0.2)
        self._named, order = name_fingers(layout, radial, clue, sure)
        self.fingers = [parts.fingers[i] for i in self._named]
        self.distal = distal.answer
        self.dorsal = turned.answer
        directions = [
            distal._replace(answer=shown(distal.answer)),
            turned._replace(
                answer=shown(turned.answer), confidence=min(turned.confidence, sure)
            ),
        ]
        self.clues = [parts.palm, clue, *directions, found, order]
        is_over = bool(turned.answer @ dorsal.answer < 0.0)
        has_side = radial.confidence > 0.2
        self._weigh(dorsal, has_side=has_side, sense=-1.0 if is_over else 1.0)
        self.hypothesis = Hypothesis(
            found_thumb,
            clue.answer,
            self.side,
            is_over,
            self._values,
            parts.kind,
            is_along_arm,
        )

    def _weigh_arm(self, distal: Clue, sure: float, *, is_along_arm: bool) -> Clue:
        """Note what the arm says of the direction of the fingers, and return the one to take.

        Args:
            distal: The direction of the fingers.
            sure: Confidence in their tips.
            is_along_arm: Whether to take the arm's.
        """
        ahead = self._parts.ahead
        if is_along_arm:
            self._values["straight fingers"] = -sure
            self._values["arm"] = 1.0
            how = "the axis of the joint that turns the hand about its length"
            return Clue("distal", snapped(ahead), how, LIKELY)
        if ahead.any():
            angle = angle_between(ahead, distal.answer)
            self._values["arm"] = float(np.interp(angle, _OFF_THE_ARM, (1.0, -1.0)))
        return distal._replace(confidence=min(distal.confidence, sure))

    def _weigh(self, dorsal: Clue, *, has_side: bool, sense: float) -> None:
        """Note what evidence says of the side, and of a palm that is turned over (sense -1)."""
        is_clear = dorsal.sign > CLEAR_FLEXION
        self._values["flexion"] = sense * (1.0 if is_clear else _VAGUE * dorsal.sign)
        height = sense * thumb_height(self._layout, dorsal.answer)
        self._values["thumb ahead"] = float(np.clip(height / _HIGH, -1.0, 1.0))
        declared = self._told.side
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
                straight=self._parts.straight,
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

    @property
    def sure(self) -> dict[str, float]:
        """Confidence in each answer, from 0 to 1."""
        return {clue.what: clue.confidence for clue in self.clues}

    def _declare(self, given: Side | None) -> Declared:
        """Return the side that is given, of the other hand or in the names."""
        paired = self._paired
        is_forced = paired is not None and paired.is_forced
        if given:
            return Declared(given, "as given", True, is_forced)
        robot = self.robot
        hints = (robot.name, robot.file.stem, robot.palm_frame.name)
        named = named_side(chain(hints, *self._parts.names))
        if paired and paired.side != named:
            return Declared(paired.side, paired.how, False, is_forced)
        return Declared(named, "from the names", False, is_forced)


def choose(first: Anatomy, others: Sequence[Anatomy]) -> Anatomy:
    """Return the hypothesis with most evidence, and note the next one if it has nearly as much.

    Args:
        first: The one that is found step by step; it yields only to a clearly better one.
        others: All others, and perhaps this one again.
    """
    ranked = sorted(others, key=lambda one: -one.hypothesis.score)
    best = first
    distinct = {one.hypothesis.answer: one.hypothesis for one in [*ranked[::-1], first]}
    ranking = sorted(distinct.values(), key=lambda one: -one.score)
    if ranked and ranked[0].hypothesis.overrules(first.hypothesis):
        best = ranked[0]
        why = best.hypothesis.told_from(first.hypothesis)
        for what in best.hypothesis.differences(first.hypothesis):
            best.told(what, why, LIKELY)
    mine = best.hypothesis
    best.ranking = tuple(ranking)
    following = next((one for one in ranking if one.options != mine.options), None)
    if following and (note := mine.doubt(following)):
        best.runner_up = following
        best.notes.append(note)
    rivals = (one for one in ranking if one.kind != mine.kind)
    if (rival := next(rivals, None)) and mine.is_near(rival):
        # Another kind of fingers is straight elsewhere.
        for what in ("distal", "dorsal"):
            best.told(what, f"its fingers may be {rival.kind}", DISPUTED)
    return best


def _given_thumb(parts: Parts, given: str) -> int:
    """Return the finger of a link or joint."""
    for i, group in enumerate(parts.names):
        if given in group:
            return i
    raise parts.robot.error(f"no finger has a link or joint {given!r}", given)
