"""From a URDF to a hand's description: `detect`.

Detection uses the kinematics: which chains branch from one body, where fingers are straight, how
their tips move in flexion, and where the thumb is. Names decide only where that is ambiguous. Each
answer has its evidence and its confidence.
"""

import re
from collections.abc import Iterable, Iterator
from itertools import chain, compress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handmap_core.errors import HandError
from handmap_core.se3 import Array, lengths
from handmap_qp.hands import (
    FINGERS,
    THUMB,
    HandSpec,
    Names,
    PadSpec,
    PalmSpec,
    PointSpec,
    Side,
    Vector,
    WristSpec,
    ball_in,
)
from .anatomy import Anatomy, find_anatomy
from .arm_directions import arm_direction
from .hypotheses import Hypothesis
from .robot import Robot
from .single_joints import FingerKind
from .structure import (
    Clue,
    RobotFinger,
    Structure,
    find_palms,
    find_structure,
    passed_over,
)
from .two_hands import PairedSide, paired_sides
from .vectors import UNKNOWN

REST_SHARE = 0.4
"""A finger rests at this share of the way from straight to its fist."""
REST_MOST = 0.75
"""At rest, no joint is flexed by more than this [rad]."""
# A middle joint's point is its link's origin if that is this near to the finger's plane [m].
_OFF_AXIS = 0.0015
# A joint this near to the palm is one of its wrist [m].
_WRIST_REACH = 0.25
# A joint that spreads fingers, with its zero this near to a limit, rests this far off it [ranges].
_AT_LIMIT = 0.05
_SPREAD = 0.3
# Range of a person's wrist-to-knuckle distance, in lengths of the longest finger.
_PALM_RATIO = np.array([0.4, 1.4])
# Confidence in what a measurement contradicts.
_DOUBT = 0.5


class Detection(NamedTuple):
    """A hand found in a URDF.

    Attributes:
        spec: The description, ready to be written or loaded.
        clues: Evidence for each part of it.
        notes: Assumptions and omissions.
        chains: Joints that move each finger, its own and their leaders, by the finger's name.
        runner_up: The next hypothesis of what it is, if it has nearly as much evidence.
        other_roots: Palms of other hands of the robot, if nobody chose one.
        kind: What its fingers with one flexing joint each are; None if it has none.
    """

    spec: HandSpec
    clues: tuple[Clue, ...]
    notes: Names
    chains: dict[str, Names]
    runner_up: Hypothesis | None = None
    other_roots: Names = ()
    kind: FingerKind | None = None

    def doubted(self, findings: Iterable[Any]) -> "Detection":
        """Return the detection with clues that are guesses where a finding contradicts them."""
        wrong = {f.key.removeprefix("palm."): f.text for f in findings if f.change}
        clues = (
            clue._replace(confidence=_DOUBT, how=f"{clue.how}; but {wrong[clue.what]}")
            if clue.what in wrong
            else clue
            for clue in self.clues
        )
        return self._replace(clues=tuple(clues))


def detect_hands(
    urdf: Path,
    *,
    root: str | None = None,
    base: str | None = None,
    side: Side | None = None,
    thumb: str | None = None,
    kind: FingerKind | None = None,
    name: str | None = None,
) -> list[Detection]:
    """Find the hand in a URDF file, or the left and the right hand of a robot with their arms.

    Args:
        urdf: The file.
        root: As in `detect`. If `root`, `side`, `thumb` or `kind` is given, one hand is looked for.
        base: As in `detect`; that of two hands is the robot's root if omitted.
        side: As in `detect`.
        thumb: As in `detect`.
        kind: As in `detect`.
        name: Name of a single hand; that of the robot if omitted.

    Raises:
        HandError: If the URDF cannot be used, or contains no hand, or others than these.
    """
    if not (root or side or thumb or kind):
        robot = Robot(urdf)
        palms = find_palms(robot)
        if len(palms) == 2:
            return _detect_two(robot, (palms[0], palms[1]), base)
    one = detect(
        urdf, root=root, base=base, side=side, thumb=thumb, kind=kind, name=name
    )
    return [one]


def _detect_two(
    robot: Robot, palms: tuple[str, str], base: str | None
) -> list[Detection]:
    """Find two hands of a robot, the left one first.

    If both look like hands of one side, their names or places tell them apart: the one that is less
    certain gets the other side.
    """
    shared = base or robot.root
    pair = paired_sides(robot, palms)

    def found(k: int, is_forced: bool = False) -> Detection:
        side = pair[k]._replace(is_forced=is_forced) if pair else None
        return _detect(
            robot.file,
            None,
            palms[k],
            shared,
            paired=side,
            may_be_rigid=True,
            whole=robot,
        )

    hands = [found(0), found(1)]
    first, second = (hand.spec.side for hand in hands)
    if first == second:
        if not pair:
            both = f"{' and '.join(palms)} both look like {first} hands"
            advice = "describe each with --root and --side"
            raise robot.error(f"{both}; {advice}", palms)
        wrong = next(k for k, side in enumerate(pair) if side.side != first)
        hands[wrong] = found(wrong, is_forced=True)
    return sorted(hands, key=lambda one: one.spec.side)


def detect(
    urdf: Path,
    text: str | bytes | None = None,
    *,
    root: str | None = None,
    base: str | None = None,
    side: Side | None = None,
    thumb: str | None = None,
    kind: FingerKind | None = None,
    name: str | None = None,
    paired: PairedSide | None = None,
) -> Detection:
    """Find a hand in a URDF.

    Args:
        urdf: Its file.
        text: The URDF; that of the file if omitted.
        root: Link at which the hand, or the part of the robot with the hand, begins; the whole URDF
            if omitted.
        base: Fixed link of an arm whose joints then move the wrist; the hand floats if omitted.
        side: The hand's side; detected if omitted.
        thumb: A link or joint of the thumb; detected if omitted.
        kind: What fingers with one flexing joint each are; detected if omitted.
        name: The hand's name; that of the robot if omitted.
        paired: The side by the other hand of the robot, if there is one.

    Raises:
        HandError: If the URDF cannot be used, or contains no hand or more than one.
    """
    return _detect(urdf, text, root, base, side, thumb, name, paired=paired, kind=kind)


def _detect(
    urdf: Path,
    text: str | bytes | None,
    root: str | None,
    base: str | None,
    side: Side | None = None,
    thumb: str | None = None,
    name: str | None = None,
    *,
    paired: PairedSide | None = None,
    may_be_rigid: bool = False,
    kind: FingerKind | None = None,
    whole: Robot | None = None,
) -> Detection:
    """Find a hand as `detect` does, or one of two hands.

    Args:
        urdf: As in `detect`.
        text: As in `detect`.
        root: As in `detect`.
        base: As in `detect`.
        side: As in `detect`.
        thumb: As in `detect`.
        name: As in `detect`.
        paired: The side by the other hand.
        may_be_rigid: Whether the hand may hang from the base without a joint.
        kind: As in `detect`.
        whole: The robot from its root on, if it is loaded.
    """
    robot = Robot(urdf, text, root=root)
    structure = find_structure(robot)
    palm = robot.palm_frame.name
    ahead = _arm_ahead(robot, whole, structure)
    joints, above = left_out_wrist(robot, palm)
    notes = passed_over(robot)
    if root is None and palm != robot.root:
        robot = Robot(urdf, text, root=palm)
        structure = find_structure(robot)
        if joints and base is None:
            what = f"wrist joints are left out, and the wrist floats: {joints}"
            notes.append(f"{what}; keep them with --base {above}")
    hand = find_anatomy(robot, structure, side, thumb, paired, kind, ahead)
    part = robot if base is None else Robot(urdf, text, root=base)
    spec = _describe(hand, name, part, may_be_rigid=may_be_rigid)
    notes += [*hand.notes, *robot.remarks]
    if base is not None:
        arm = [joint for joint in spec.joints if joint not in robot.joint_names]
        others = {*part.joint_names} - {*spec.joints}
        moved = f"the arm from {base} to {robot.root} moves the wrist: {', '.join(arm)}"
        fixed = f"the hand is fixed to {base}: its wrist does not move"
        notes += [moved if arm else fixed, f"{len(others)} other joints are locked"]
    chains = {
        finger.name: (*finger.drivers, *finger.joint_names) for finger in hand.fingers
    }
    clues = tuple(hand.clues)
    return Detection(
        spec,
        clues,
        tuple(notes),
        chains,
        hand.runner_up,
        kind=hand.hypothesis.kind,
    )


def _arm_ahead(robot: Robot, whole: Robot | None, structure: Structure) -> Array:
    """Return the direction in which the arm points, as `arm_direction` does.

    Args:
        robot: The robot, or the part of it that was chosen.
        whole: The robot from its root on; the file's if omitted.
        structure: The palm and the fingers.
    """
    palm = robot.palm_frame.name
    links = [finger.links[0] for finger in structure.fingers if finger.joints]
    if robot.is_whole:
        return arm_direction(robot, palm, links)
    try:
        return arm_direction(whole or Robot(robot.file), palm, links)
    except HandError:
        # The rest of the file may be no robot.
        return UNKNOWN


def _describe(
    hand: Anatomy, name: str | None, part: Robot, *, may_be_rigid: bool
) -> HandSpec:
    """Return the description; `part` is the robot from the arm's base, if there is one.

    It adds clues of what it finds to those of the hand, as the functions below do.
    """
    robot = hand.robot
    drivers = chain.from_iterable(finger.drivers for finger in hand.fingers)
    own = (*dict.fromkeys(drivers),)
    has_base = part is not robot
    arm = _arm(part, robot.root, may_be_rigid=may_be_rigid) if has_base else ()
    joints = (*arm, *own)
    still = robot.positions(robot.rest) | part.positions(part.rest)
    origin = _palm_origin(hand)
    found = (_points(hand, finger) for finger in hand.fingers)
    points, sets = point_sets(chain.from_iterable(found))
    rest = robot.positions(_rest(hand))
    palm = robot.palm_frame.name
    if arm:
        rest = part.positions(_arm_rest(part, palm)) | rest
    return HandSpec(
        name=name or _name(hand),
        urdf=str(robot.file),
        side=hand.side,
        palm=PalmSpec(
            palm,
            _vector(hand.distal, 9),
            _vector(hand.dorsal, 9),
            _vector(origin, 4),
        ),
        wrist=WristSpec(robot.root, "fixed" if has_base else "floating"),
        joints=joints,
        rest=_chosen(rest, joints),
        points=points,
        sets=sets,
        reference="fingertips",
        root=None if part.is_whole else part.root,
        locked={joint: at for joint, at in still.items() if joint not in joints},
        limits=_chosen(part.spec.limits, arm) | _chosen(robot.spec.limits, own),
        mimic=robot.spec.mimic,
    )


def _name(hand: Anatomy) -> str:
    """Return the robot's name, with the hand's side if there is more to the robot."""
    name = hand.robot.name
    side = hand.side
    has_side = re.search(rf"(?<![a-z]){side}(?![a-z])", name.lower())
    return name if hand.robot.is_whole or has_side else f"{name}_{side}"


def _rest(hand: Anatomy) -> Array:
    """Return the half-open posture; other joints are near zero, or centred (thumb)."""
    robot = hand.robot
    flexion = hand.flexion
    lower = robot.lower_limits
    upper = robot.upper_limits
    zero = robot.rest
    travel = flexion.q_closed - flexion.q_open
    step = np.clip(REST_SHARE * travel, -REST_MOST, REST_MOST)
    step = np.where(flexion.slides, 0.5 * travel, step)
    of_thumb = np.delete(flexion.moves, hand.others, axis=0).any(axis=0)
    one_sided = of_thumb & ((lower > -0.1) | (upper < 0.1))
    # Joints that spread the fingers to one side only rest away from that limit, fingers apart.
    width = flexion.moves.any(axis=0) * (upper - lower)
    near = _AT_LIMIT * width
    spread = _SPREAD * width
    q = np.select(
        [flexion.sign != 0.0, one_sided, upper - zero < near, zero - lower < near],
        [
            flexion.q_open + step,
            0.5 * (lower + upper),
            upper - spread,
            lower + spread,
        ],
        zero,
    )
    q = np.clip(q.round(4) + 0.0, lower, upper)
    heights = (flexion.tips(q) - flexion.tips_open) @ hand.dorsal
    sure = 0.9 if np.mean(heights < 0.0) > 0.5 else 0.6
    how = (
        f"{REST_SHARE:g} of the way from straight fingers to a fist, at most {REST_MOST} rad "
        "per joint; other joints near zero, or at mid-range on the thumb"
    )
    sure = min(sure, hand.sure["dorsal"])
    hand.clues.append(Clue("rest", "half open", how, sure))
    return q


def _points(hand: Anatomy, finger: RobotFinger) -> Iterator[PointSpec]:
    """Yield a fingertip, and the PIP joint of a finger, or the IP joint of the thumb."""
    robot = hand.robot
    end = finger.end
    is_thumb = finger.name == THUMB
    sure = max(hand.sure["thumb" if is_thumb else "fingers"], 0.3)
    sure = min(end.confidence, sure)
    hand.clues.append(end._replace(what=f"{finger.name}_tip", confidence=sure))
    places = {"tip": (end.answer, finger.xyz)}
    if finger.joints and (middle := finger.find_middle()):
        body, xyz = middle
        xyz = xyz * (lengths(xyz) > _OFF_AXIS)
        places["ip" if is_thumb else "pip"] = robot.links[body][0], xyz
    for kind, (link, xyz) in places.items():
        # An additional finger is paired with the human little one.
        yield PointSpec(
            f"{finger.name}_{kind}",
            link,
            _vector(xyz, 4),
            finger.name,
            partner=None if finger.name in FINGERS else f"little_{kind}",
            pad=_pad(robot, finger) if kind == "tip" else None,
        )


def _pad(robot: Robot, finger: RobotFinger) -> PadSpec | None:
    """Return the pad of a finger whose surface is visual only; the mapping finds all others."""
    body, tip = finger.tip
    cloud = robot.surface(body)
    links = [robot.elements[link] for link in robot.links[body]]
    if not len(cloud) or any(link.findall("collision") for link in links):
        return None
    centre, radius = ball_in([(cloud, 0.0)], tip)
    centre = robot.frames[finger.end.answer].placement.actInv(centre)
    return PadSpec(round(radius, 4), _vector(centre, 4))


def _palm_origin(hand: Anatomy) -> Array:
    """Estimate the wrist position: behind the knuckles, at the palm's proximal end."""
    robot = hand.robot
    distal = hand.distal
    chosen = hand.others or slice(None)
    knuckles = hand.flexion.bases[chosen].mean(axis=0)
    cloud = robot.palm_surface()
    back = knuckles @ distal
    how = "the origin of the palm's link"
    if len(cloud):
        back -= (cloud @ distal).min()
        how = "the proximal end of the palm's surface"
    how += ", behind the centre of the knuckles"
    sure = 0.8
    likely = np.clip(back, *_PALM_RATIO * hand.flexion.reach[chosen].max())
    if back != likely:
        sure = 0.5
        how += "; moved to a distance as in a person's proportions"
    answer = f"{1e3 * likely:.0f} mm behind the knuckles"
    sure = min(sure, hand.sure["distal"])
    hand.clues.append(Clue("palm origin", answer, how, sure))
    return knuckles - likely * distal


def point_sets(
    points: Iterable[PointSpec],
) -> tuple[tuple[PointSpec, ...], dict[str, Names]]:
    """Return all points of a hand, the fingertips first, and the sets of their names."""
    every = sorted(points, key=lambda point: not point.name.endswith("_tip"))
    names = tuple(point.name for point in every)
    tips = tuple(name for name in names if name.endswith("_tip"))
    more = {"fingertips_middle": names} if names != tips else {}
    return tuple(every), {"fingertips": tips} | more


def left_out_wrist(robot: Robot, palm: str) -> tuple[str, str]:
    """Name the actuated wrist joints above a palm, and the base that keeps them; else nothing."""
    above = robot.model.supports[robot.frames[palm].parentJoint]
    links = {robot.model.names[joint]: robot.links[joint][0] for joint in above}
    near = [
        joint
        for joint, link in links.items()
        if joint in robot.joint_names
        and lengths(robot.pose_in(link, palm)[:3, 3]) < _WRIST_REACH
    ]
    return ", ".join(near), robot.parents[links[near[0]]] if near else ""


def _arm(robot: Robot, hand: str, *, may_be_rigid: bool) -> Names:
    """Return the active joints between the root of a robot and the link of a hand."""
    problem = f"the hand {hand!r} does not hang from the base {robot.root!r}"
    if hand in robot.frames:
        arm = tuple(compress(robot.joint_names, robot.carries(robot.frames[hand])))
        if arm or may_be_rigid:
            return arm
        problem = f"no joint moves between {robot.root!r} and the hand {hand!r}"
    raise robot.error(problem, robot.root)


def _arm_rest(robot: Robot, palm: str) -> Array:
    """Return a posture for the arm of a palm: at mid-range, where it is seldom singular.

    Joints that carry another palm too, such as a waist, are upright, unless zero is a limit.
    """
    shared = [
        robot.carries(robot.frames[link]) for link in find_palms(robot) if link != palm
    ]
    lower = robot.lower_limits
    upper = robot.upper_limits
    is_upright = np.any(shared, axis=0) & (lower * upper < 0.0)
    return np.where(is_upright, 0.0, 0.5 * (lower + upper)).round(4) + 0.0


def _chosen(values: dict[str, Any], joints: Names) -> dict[str, Any]:
    """Return what some joints have of values by joint."""
    return {joint: values[joint] for joint in joints if joint in values}


def _vector(values: Array, digits: int) -> Vector:
    x, y, z = values.round(digits) + 0.0
    return x, y, z
