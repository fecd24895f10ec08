"""From a URDF to a hand's description: `detect`.

Detection uses the kinematics: which chains branch from one body, where fingers are straight, how
their tips move in flexion, and where the thumb is. Names decide only where that is ambiguous. Each
answer has its evidence and its confidence.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from handmap_qp.apps.onboarding.anatomy import Anatomy, Clue, find_anatomy
from handmap_qp.apps.onboarding.flexion import HandFlexion, find_flexion
from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.apps.onboarding.structure import (
    Chain,
    Structure,
    find_structure,
    fingers_of,
)
from handmap_qp.errors import HandError, without_errno
from handmap_qp.hands.fingers import THUMB, Finger, PalmKinematics, Place
from handmap_qp.hands.human import FINGERS
from handmap_qp.hands.pads import ball_in
from handmap_qp.hands.spec import (
    HandSpec,
    PadSpec,
    PalmSpec,
    PointSpec,
    Side,
    WristSpec,
)
from handmap_qp.se3 import inverse_pose, transform_points

# Half open: this share of the way to the fist, and at most this much per joint [rad].
_REST_SHARE, _REST_MOST = 0.4, 0.75
# A middle joint's point is its link's origin if that is this near to the finger's plane [m].
_OFF_AXIS = 0.0015
# A joint this near to the palm is one of its wrist [m].
_WRIST_REACH = 0.25
# A joint that spreads fingers and has its zero within this share of its range from a limit rests
# this share away from it.
_AT_LIMIT, _SPREAD = 0.05, 0.3
# Range of a person's wrist-to-knuckle distance, in lengths of the longest finger.
_PALM_RATIO = (0.4, 1.4)


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A hand found in a URDF.

    Attributes:
        spec: The description, ready to be written or loaded.
        clues: Evidence for each part of it.
        notes: Assumptions and omissions.
        chains: Joints that move each finger, its own and their leaders, by the finger's name.
    """

    spec: HandSpec
    clues: tuple[Clue, ...]
    notes: tuple[str, ...]
    chains: dict[str, tuple[str, ...]]

    def from_source(self, reference: str | None, notes: tuple[str, ...]) -> Detection:
        """Return the detection with another reference to its URDF, and with more notes.

        Args:
            reference: What `hand.yaml` names as `urdf`; the file itself if None.
            notes: Notes of the URDF's conversion; they come first.
        """
        spec = (
            self.spec
            if reference is None
            else msgspec.structs.replace(self.spec, urdf=reference)
        )
        return replace(self, spec=spec, notes=(*notes, *self.notes))


def detect(
    urdf: Path,
    *,
    root: str | None = None,
    base: str | None = None,
    side: Side | None = None,
    thumb: str | None = None,
    name: str | None = None,
) -> Detection:
    """Find a hand in a URDF.

    Args:
        urdf: The file.
        root: Link at which the hand, or the part of the robot with the hand, begins; the whole URDF
            if omitted.
        base: Fixed link of an arm whose joints then move the wrist; the hand floats if omitted.
        side: The hand's side; detected if omitted.
        thumb: A link or joint of the thumb; detected if omitted.
        name: The hand's name; that of the robot if omitted.

    Raises:
        HandError: If the URDF cannot be used, or contains no hand or more than one.
    """
    try:
        text = urdf.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        raise HandError(f"cannot be read: {without_errno(error)}", file=urdf) from error
    return detect_text(
        text, urdf, root=root, base=base, side=side, thumb=thumb, name=name
    )


def detect_text(
    text: str | bytes,
    urdf: Path,
    *,
    root: str | None = None,
    base: str | None = None,
    side: Side | None = None,
    thumb: str | None = None,
    name: str | None = None,
) -> Detection:
    """Find a hand in a URDF's text; `urdf` is its file, the rest is as in `detect`."""
    robot = Robot(text, urdf, root=root)
    structure, notes = find_structure(robot), []
    if root is None and (structure.above or structure.palm != robot.root):
        if base is None:
            joints, above = left_out_wrist(robot, structure.palm)
            left_out = f"wrist joints are left out, and the wrist floats: {joints}"
            notes = [f"{left_out}; keep them with --base {above}"] if joints else []
        robot = Robot(text, urdf, root=structure.palm)
        structure = find_structure(robot)
    fingers = fingers_of(robot, structure)
    flexion = find_flexion(robot, fingers)
    names = [[*chain.joints, *chain.links] for chain in structure.chains]
    given = next((i for i, group in enumerate(names) if thumb in group), None)
    if thumb is not None and given is None:
        raise HandError(
            f"no finger has a link or joint {thumb!r}", file=urdf, value=thumb
        )
    anatomy = find_anatomy(
        flexion, names, (robot.name, urdf.stem, structure.palm), side, given
    )
    for finger, called in zip(fingers, anatomy.fingers, strict=True):
        finger.name = called
    others = [i for i, finger in enumerate(fingers) if finger.name != THUMB]
    if (flexion.ways[others].sum(axis=0) @ anatomy.dorsal) > 0.0:
        # The side turned the palm over: joints with symmetric ranges flex the other way.
        flexion = find_flexion(robot, fingers, palmar=-anatomy.dorsal)
    if name is None:
        name = robot.name
        if not robot.is_whole and anatomy.side not in re.split(
            r"[^a-z]+", name.lower()
        ):
            name = f"{name}_{anatomy.side}"
    hand = _FoundHand(robot, structure, fingers, flexion, anatomy)
    spec, notes = hand.describe(name), [*notes, *structure.notes, *robot.notes]
    if base is not None:
        spec, more = _on_arm(text, urdf, spec, base)
        notes += more
    chains = {
        finger.name: (
            *dict.fromkeys([*map(robot.drivers, chain.joints), *chain.joints]),
        )
        for finger, chain in hand.fingers
    }
    return Detection(spec, tuple(hand.clues), tuple(notes), chains)


class _FoundHand:
    """A hand that is found in a robot, to be described.

    Attributes:
        fingers: The fingers with their chains, the thumb first, additional ones last.
        clues: Evidence for each part of the description; complete after `describe`.
    """

    def __init__(
        self,
        robot: Robot,
        structure: Structure,
        fingers: list[Finger],
        flexion: HandFlexion,
        anatomy: Anatomy,
    ) -> None:
        self.robot, self.structure, self.flexion, self.anatomy = (
            robot,
            structure,
            flexion,
            anatomy,
        )
        self._thumbs = np.array([finger.name == THUMB for finger in fingers])
        known = {name: place for place, name in enumerate(FINGERS)}
        self.fingers = sorted(
            zip(fingers, structure.chains, strict=True),
            key=lambda pair: (
                known.get(pair[0].name, 9),
                len(pair[0].name),
                pair[0].name,
            ),
        )
        self._sure = {clue.what: clue.confidence for clue in anatomy.clues}
        palm = Clue("palm", structure.palm, structure.how, structure.confidence)
        self.clues = [palm, *anatomy.clues]

    def describe(self, name: str) -> HandSpec:
        """Return the description."""
        robot, anatomy, origin = self.robot, self.anatomy, self._palm_origin()
        joints = tuple(
            dict.fromkeys(
                driver
                for _, chain in self.fingers
                for driver in map(robot.drivers, chain.joints)
                if driver in robot.active
            )
        )
        tips = [self._tip(finger, chain) for finger, chain in self.fingers]
        middles = [
            self._middle(finger, place)
            for finger, _ in self.fingers
            if (place := finger.find_middle()) is not None
        ]
        sets = {"fingertips": tuple(point.name for point in tips)}
        if middles:
            sets["fingertips_middle"] = tuple(point.name for point in (*tips, *middles))
        lower, upper = (
            dict(zip(robot.active, limits.tolist(), strict=True))
            for limits in (robot.lower_limits, robot.upper_limits)
        )
        rest = dict(zip(robot.active, self._rest().tolist(), strict=True))
        zero = dict(zip(robot.active, robot.zero.tolist(), strict=True))
        return HandSpec(
            name=name,
            urdf=str(robot.file),
            side=anatomy.side,
            palm=PalmSpec(
                self.structure.palm,
                _vector(anatomy.distal, 9),
                _vector(anatomy.dorsal, 9),
                _vector(origin, 4),
            ),
            wrist=WristSpec(robot.root, "floating"),
            joints=joints,
            rest={
                joint: min(max(_rounded(rest[joint]), lower[joint]), upper[joint])
                for joint in joints
            },
            points=(*tips, *middles),
            sets=sets,
            reference="fingertips",
            root=None if robot.is_whole else robot.root,
            locked={
                **{joint: round(value, 6) for joint, value in robot.locked.items()},
                **{joint: zero[joint] for joint in self.structure.idle},
            },
            limits={
                joint: limit
                for joint, limit in robot.assumed.items()
                if joint in joints
            },
            mimic=dict(robot.dropped_rules),
        )

    def _rest(self) -> np.ndarray:
        """Return the half-open posture; other joints are near zero, or centred (thumb)."""
        robot, flexion = self.robot, self.flexion
        lower, upper = robot.lower_limits, robot.upper_limits
        travel = flexion.q_closed - flexion.q_open
        step = np.clip(_REST_SHARE * travel, -_REST_MOST, _REST_MOST)
        step = np.where(robot.slides, 0.5 * travel, step)
        q = np.where(flexion.flexes, flexion.q_open + step, robot.zero)
        of_thumb = flexion.moves[self._thumbs].any(axis=0) & ~flexion.flexes
        one_sided = of_thumb & ((lower > -0.1) | (upper < 0.1))
        q = np.where(one_sided, 0.5 * (lower + upper), q)
        # Joints that spread the fingers to one side only rest away from that limit, fingers apart.
        spreads = flexion.moves.any(axis=0) & ~flexion.flexes & (q == robot.zero)
        width = upper - lower
        q = np.where(
            spreads & (q - lower < _AT_LIMIT * width), lower + _SPREAD * width, q
        )
        q = np.where(
            spreads & (upper - q < _AT_LIMIT * width), upper - _SPREAD * width, q
        )
        q = np.clip(q, lower, upper)
        tips = [finger.tip for finger, _ in self.fingers]
        at_rest, stretched = PalmKinematics(robot).points(
            np.array([q, flexion.q_open]), tips
        )
        share = float(np.mean(((at_rest - stretched) @ -self.anatomy.dorsal) > 0.0))
        self._add(
            "rest",
            "half open",
            f"{_REST_SHARE:g} of the way from straight fingers to a fist, at most {_REST_MOST} rad "
            "per joint; other joints near zero, or at mid-range on the thumb",
            min(0.9 if share > 0.5 else 0.6, self._sure["dorsal"]),
        )
        return q

    def _tip(self, finger: Finger, chain: Chain) -> PointSpec:
        """Return a fingertip; an additional finger is paired with the human little finger."""
        name, tip = f"{finger.name}_tip", chain.tip
        sure = max(self._sure["thumb" if finger.name == THUMB else "fingers"], 0.3)
        self._add(name, tip.link, tip.how, min(tip.confidence, sure))
        partner = None if finger.name in FINGERS else "little_tip"
        pad = self._pad(chain)
        return PointSpec(
            name, tip.link, _vector(tip.xyz, 4), finger.name, 1.0, partner, pad
        )

    def _middle(self, finger: Finger, place: Place) -> PointSpec:
        """Return the PIP joint of a finger, or the IP joint of the thumb."""
        xyz = (
            _vector(place[1], 4)
            if np.linalg.norm(place[1]) > _OFF_AXIS
            else (0.0, 0.0, 0.0)
        )
        return PointSpec(
            f"{finger.name}_{'ip' if finger.name == THUMB else 'pip'}",
            self.robot.carried[place[0]],
            xyz,
            finger.name,
            1.0,
            None if finger.name in FINGERS else "little_pip",
        )

    def _pad(self, chain: Chain) -> PadSpec | None:
        """Return the pad of a finger whose surface is visual only; the mapping finds all others."""
        robot, last, tip = self.robot, chain.links[-1], chain.tip
        cloud = robot.body_surface(last)
        if not len(cloud) or robot.has_collision_shapes(last):
            return None
        pose = robot.pose_in(tip.link, last)
        centre, radius = ball_in(cloud, transform_points(pose, tip.xyz))
        return PadSpec(
            round(radius, 4), _vector(transform_points(inverse_pose(pose), centre), 4)
        )

    def _palm_origin(self) -> np.ndarray:
        """Estimate the wrist position: behind the knuckles, at the palm's proximal end."""
        robot, palm, distal = self.robot, self.structure.palm, self.anatomy.distal
        chosen = ~self._thumbs if not self._thumbs.all() else self._thumbs
        knuckles = self.flexion.bases[chosen].mean(axis=0)
        cloud = robot.body_surface(robot.body(palm))
        back, how = float(knuckles @ distal), "the origin of the palm's link"
        if len(cloud):
            cloud = transform_points(robot.pose_in(robot.body(palm), palm), cloud)
            back -= float((cloud @ distal).min())
            how = "the proximal end of the palm's surface"
        how += ", behind the centre of the knuckles"
        low, high = (
            ratio * float(self.flexion.reach[chosen].max()) for ratio in _PALM_RATIO
        )
        confidence = 0.8
        if not low <= back <= high:
            back, confidence = float(np.clip(back, low, high)), 0.5
            place = f"{1e3 * back:.0f} mm behind the knuckles"
            how += f"; moved to {place}, as in a person's proportions"
        confidence = min(confidence, self._sure["distal"])
        self._add(
            "palm origin", f"{1e3 * back:.0f} mm behind the knuckles", how, confidence
        )
        return knuckles - back * distal

    def _add(self, what: str, answer: str, how: str, confidence: float) -> None:
        self.clues.append(Clue(what, answer, how, confidence))


def left_out_wrist(robot: Robot, palm: str) -> tuple[str, str]:
    """Name the actuated wrist joints above a palm, and the base that keeps them; else nothing."""
    near = [
        (joint, link)
        for joint, link in robot.chain(palm, robot.root)
        if joint in robot.active
        and np.linalg.norm(robot.pose_in(link, palm)[:3, 3]) < _WRIST_REACH
    ]
    if not near:
        return "", ""
    return ", ".join(joint for joint, _ in near), robot.parent[near[0][1]][1]


def _on_arm(
    text: str | bytes, urdf: Path, spec: HandSpec, base: str
) -> tuple[HandSpec, list[str]]:
    """Return the hand with the arm from `base` to it; all other joints are locked."""
    robot = Robot(text, urdf, root=base)
    hand = spec.root or spec.wrist.link
    if hand not in robot.links:
        problem = f"the hand {hand!r} does not hang from the base {base!r}"
        raise HandError(problem, file=urdf, value=base)
    arm = tuple(
        joint for joint, _ in robot.chain(hand, robot.root) if joint in robot.active
    )
    if not arm:
        problem = f"no joint moves between {base!r} and the hand {hand!r}"
        raise HandError(problem, file=urdf, value=base)
    still = [
        joint for joint in robot.active if joint not in arm and joint not in spec.joints
    ]
    middle = 0.5 * (robot.lower_limits + robot.upper_limits)
    changed = msgspec.structs.replace(
        spec,
        root=None if robot.is_whole else base,
        wrist=WristSpec(spec.wrist.link, "fixed"),
        joints=(*arm, *spec.joints),
        # A straight arm is singular; at mid-range it seldom is.
        rest={joint: _rounded(middle[robot.active.index(joint)]) for joint in arm}
        | spec.rest,
        locked=spec.locked
        | {joint: float(robot.zero[robot.active.index(joint)]) for joint in still},
        limits={joint: limit for joint, limit in robot.assumed.items() if joint in arm}
        | spec.limits,
    )
    notes = [
        f"the arm from {base} to {hand} moves the wrist: {', '.join(arm)}",
        f"{len(still)} other joints are locked",
    ]
    return changed, notes


def _rounded(value: float, digits: int = 4) -> float:
    return round(float(value), digits) + 0.0


def _vector(values: Iterable[float], digits: int) -> tuple[float, float, float]:
    x, y, z = (_rounded(value, digits) for value in values)
    return x, y, z
