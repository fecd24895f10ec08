"""Find the palm and the fingers, from the branches of a robot and their lengths.

A branch of a body is *finger-like* by its length and names. The palm is the body with at least two
finger-like branches and most evidence. Bodies inside such branches that qualify too, such as a
metacarpal with two fingers, are not the palm.
"""

import math
import re
from itertools import chain, compress
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from handmap_core.se3 import Array, box_of, lengths, transform_points, unit
from handmap_qp.hands import LOOP_END, Finger, ends_of, origin_of
from .limbs import (
    LONGEST_FINGER,
    finger_evidence,
    names_other_part,
    palm_evidence,
)
from .robot import Robot, carriers

# A chain that moves its end by less than this is a motor or a sensor, not a finger [m].
_LEAST_TRAVEL = 0.004
# An end frame closer than this to the last joint is not a fingertip [m].
_LEAST_TIP = 0.005
# An end frame is the fingertip up to this far inside the end of the surface, or beyond it [m].
_INSIDE = 0.005
_IN_THE_AIR = 0.012
# Without a surface, a link is this share of the one before.
_TIP_SHARE = 0.8
# Its axes are those of that link if they are turned by less than this in one of so many postures,
# and it is bent at rest if they are turned by more there [rad].
_ALIGNED = 0.25
_BENT = 0.3
_POSTURES = 11
# A surface whose farthest points have a centre this near to the joint lies around it [sizes].
_AROUND = 0.05
# An end frame this near to the centre of a ball is its centre, and the largest such ball [m].
_AT_CENTRE = 0.001
_LARGEST_BALL = 0.015
# A chain whose end stays within this of a point on another finger is part of a linkage [m].
_LINKAGE_SLACK = 0.004
# A bar turns this far about its pivot [rad], which is this share of its length off its joint.
_LEAST_PIVOT = 0.1
_PIVOT_SHARE = 0.4
# A bar ends this near to the box around a link of a finger [m], and this far from its tip [lengths
# of the bar].
_ON = 0.005
_OFF_TIP = 0.3
# The tip of a jaw opens by the first, and closes to within the second [m].
_OPEN = 0.02
_CLOSED = 0.015
_JAW = re.compile("jaw|grip|claw|clamp|pinc", re.IGNORECASE)
# Fingers of one hand start within this distance of each other [m].
_APART = 0.16
# A palm with so much less evidence than another one is none.
_BEHIND = 1.5


class Clue(NamedTuple):
    """One detected property of a hand.

    Attributes:
        what: The property: `palm`, `thumb`, ...
        answer: Its detected value in words; a unit vector in the palm link's coordinates, shape
            (3,), while directions are compared.
        how: Evidence for it, a sentence without a full stop.
        confidence: From 0 to 1.
        sign: Confidence in the sign of a direction alone.
    """

    what: str
    answer: Any
    how: str
    confidence: float
    sign: float = 1.0

    @property
    def certainty(self) -> str:
        """The confidence in words."""
        if self.confidence >= 0.9:
            return "certain"
        return "likely" if self.confidence >= 0.6 else "a guess: check it"


class RobotFinger(Finger):
    """A chain of a robot's bodies from a palm to a leaf, which may be a finger, or a fixed jaw.

    Attributes:
        end: Link that carries its fingertip, and the evidence for it.
        xyz: The fingertip in that link's frame [m], shape (3,).
        joint_names: Movable joints from the palm outwards.
        drivers: The active joints that move them, each itself or its mimic leader.
        links: First link of the body on each joint.
        carriers: Links from the one that carries the finger to the root.
        length: Length from its first joint to its tip at zero [m].
    """

    def __init__(
        self,
        robot: Robot,
        leaf: int,
        palm: int,
        fixed: tuple[Clue, Array] | None = None,
    ) -> None:
        self.robot = robot
        supports = robot.model.supports
        joints = [*supports[leaf]][len(supports[palm]) :]
        self.end, self.xyz = fixed or find_tip(robot, joints)
        frame = robot.frames[self.end.answer]
        super().__init__(robot, joints, (leaf, frame.placement.act(self.xyz)))
        self.joint_names = [robot.model.names[joint] for joint in joints]
        self.drivers = [robot.joint_names[column] for column in self.columns]
        self.links = [robot.links[joint][0] for joint in joints]
        link = robot.parents[self.links[0]] if joints else self.end.answer
        self.carriers = [*carriers(robot.parents, link)]
        steps = [robot.model.jointPlacements[joint].translation for joint in joints[1:]]
        self.length = lengths(np.vstack([*steps, self.tip[1]])).sum()


_Hand = tuple[list[RobotFinger], list[str], str, float]
"""Fingers, notes, and evidence for the palm with the confidence in it."""
_Scored = tuple[float, list[RobotFinger]]
"""How much speaks for a body as a palm, and the chains that branch from it."""


class Structure(NamedTuple):
    """The palm and the fingers of a robot.

    Attributes:
        palm: Link of the palm's body from which all fingers branch, with the evidence.
        fingers: The fingers, in the order of the file.
        notes: Chains that were ignored, and why.
    """

    palm: Clue
    fingers: list[RobotFinger]
    notes: list[str]


def find_structure(robot: Robot) -> Structure:
    """Find the palm, which becomes that of the robot, and the fingers.

    Raises:
        HandError: If there is no hand or more than one; the message names candidates for `root`.
    """
    palms = _hands(robot)
    if len(palms) > 1:
        links = ", ".join(map(_palm_link, palms[:8]))
        problem = f"there are {len(palms)} possible palms: {links}"
        raise robot.error(f"{problem}; choose one with --root", links)
    fingers, notes, how, sure = _hand(robot, *palms) if palms else _one_finger(robot)
    palm = Clue("palm", _palm_link(fingers), how, sure)
    robot.palm_frame = robot.frames[palm.answer]
    return Structure(palm, fingers, notes)


def find_palms(robot: Robot) -> list[str]:
    """Return the links of all palms of a robot from which at least two fingers branch.

    Two hands may be on one body, if they start at links of their own.
    """
    links = []
    for fingers in _hands(robot):
        groups = [_palm_link(group) for group in _groups(robot, fingers)]
        is_apart = len({*groups}) == len(groups) > 1
        links += groups if is_apart else [_palm_link(fingers)]
    return links


def _hands(robot: Robot) -> list[list[RobotFinger]]:
    """Return the finger-like chains of each palm, or else each moving and fixed jaw."""
    jaws = (_jaws(robot, leaf) for leaf in robot.leaves(0))
    taken, _ = _branching(robot)
    return [fingers for _, fingers in taken] or [*filter(None, jaws)]


def passed_over(robot: Robot) -> list[str]:
    """Return notes on bodies with chains like fingers that have less evidence than the hands.

    Each says how much less, and how it is described all the same.
    """
    taken, others = _branching(robot)
    if not taken:
        return []
    best = max(score for score, _ in taken)
    links = ((_palm_link(fingers), len(fingers), score) for score, fingers in others)
    return [
        f"the {count} chains at {link} are taken for no hand (evidence {score:.1f}, of the hand "
        f"{best:.1f}): describe them with --root {link}"
        for link, count, score in links
    ]


def _jaws(robot: Robot, leaf: int) -> list[RobotFinger]:
    """Return the jaw at the end of a chain, and the place on the body before it that it closes on.

    A last body is a jaw by its name, or if its tip comes from afar to the other's surface. The
    fixed tip is where the moving one is then. There are none of a finger by itself, and a head or
    a stump at a wrist is none.
    """
    palm = robot.model.parents[leaf]
    whole = RobotFinger(robot, leaf, 0)
    jaw = RobotFinger(robot, leaf, palm)
    if names_other_part(jaw.joint_names[0]):
        return []
    tips = transform_points(_poses(jaw, palm), jaw.tip[1])[[0, -1]]
    is_finger = whole.joints != jaw.joints and whole.length < LONGEST_FINGER
    if is_finger or jaw.length > LONGEST_FINGER or math.dist(*tips) < _OPEN:
        return []
    # Of ends that are equally near, the one nearer to zero is closed.
    gaps = 1e-6 * np.abs(ends_of(robot, robot.rest, jaw.moves)).sum(axis=1)
    cloud = robot.surface(palm)
    if len(cloud):
        gaps += lengths(tips - tips.clip(*box_of(cloud)))
    sure = 0.75 if gaps.min() < _CLOSED < gaps.max() else 0.3
    if sure < 0.5 and not _JAW.search(jaw.joint_names[0] + jaw.links[0]):
        return []
    link = robot.links[palm][0]
    tip = Clue("tip", link, f"where the jaw {jaw.links[0]} closes", sure)
    return [jaw, RobotFinger(robot, palm, palm, (tip, tips[gaps.argmin()]))]


def _branching(robot: Robot) -> tuple[list[_Scored], list[_Scored]]:
    """Return the finger-like chains of each palm, and of bodies with less evidence."""
    found = {
        body: fingers
        for body in range(robot.model.njoints)
        if not _is_base(robot, body) and (fingers := _fingerlike(robot, body))
    }
    supports = robot.model.supports
    # Bodies inside the fingers of another palm are none, and neither is a base with wheels.
    starts = {finger.joints[0] for finger in chain.from_iterable(found.values())}
    palms = [body for body in found if starts.isdisjoint(supports[body])]
    bases = {*chain.from_iterable([*supports[palm]][:-1] for palm in palms)}
    hands = [found[palm] for palm in palms if palm not in bases]
    scored = [(_evidence(fingers), fingers) for fingers in hands]
    # A hand's name, or the arm that carries it, tells a hand from a foot, a base or a mouth.
    least = max(0.0, max((score for score, _ in scored), default=0.0) - _BEHIND)
    taken = [one for one in scored if one[0] > least]
    return taken, [one for one in scored if one[0] <= least]


def _evidence(fingers: list[RobotFinger]) -> float:
    """Return how much speaks for the body from which chains branch as a palm."""
    robot = fingers[0].robot
    body = robot.frames[_palm_link(fingers)].parentJoint
    parts = ([*finger.joint_names, *finger.links] for finger in fingers)
    above = [robot.model.names[joint] for joint in robot.model.supports[body]]
    return palm_evidence([*robot.links[body], *chain.from_iterable(parts)], above[1:])


def _is_base(robot: Robot, body: int) -> bool:
    """Return whether a body carries two hands, or one of five fingers beside something else."""
    # Pinocchio leaves the root out of its own subtree.
    inner = {*robot.model.subtrees[body]} - {body}
    sizes = [len(robot.below(part)) for part in inner]
    return sum(size for size in sizes if size > 2) > 4


def _hand(robot: Robot, fingers: list[RobotFinger]) -> _Hand:
    """Return the hand of all chains that are fingers."""
    notes: list[str] = []
    if not fingers[-1].joints:
        return fingers, notes, "the link that the only jaw closes on", 0.85
    for fault_of in (_idleness, _second_end, _linkage):
        faults = {finger: fault_of(finger, fingers) for finger in fingers}
        notes += [
            f"{', '.join(finger.joint_names)}: {fault}"
            for finger, fault in faults.items()
            if fault
        ]
        fingers = [finger for finger in fingers if not faults[finger]]
    if not fingers:
        problem = f"no branch of the palm moves its end{robot.locked_advice}"
        raise robot.error(problem)
    _check_one_hand(robot, fingers)
    longest = max(LONGEST_FINGER, *(finger.length for finger in fingers))
    how = f"the only link from which {len(fingers)} chains of at most {longest:.2g} m branch"
    return fingers, notes, how, 0.95 if len(fingers) > 2 else 0.85


def _one_finger(robot: Robot) -> _Hand:
    """Return a robot that is one finger; the whole of it must be one."""
    leaves = robot.leaves(0)
    finger = RobotFinger(robot, leaves[0], 0)
    if len(leaves) > 1 or finger.length > LONGEST_FINGER:
        what = f"one chain of {finger.length:.2f} m"
        if len(leaves) > 1:
            what = f"{len(leaves)} chains, none of which branches into fingers"
        hint = ", or name the palm with --root"
        if finger.length > 10.0:
            hint = "; are its lengths in millimetres?"
        problem = f"no hand found from {robot.root!r} outwards: {what}{hint}"
        raise robot.error(problem + robot.locked_advice, robot.root)
    note = "there is only one finger, so the dorsal direction and the side are guesses"
    return [finger], [note], "the link from which the only chain starts", 0.5


def _groups(robot: Robot, fingers: list[RobotFinger]) -> list[list[RobotFinger]]:
    """Return the groups of at least two fingers that start near each other."""
    links = [finger.links[0] for finger in fingers if finger.joints]
    if len(links) < len(fingers):
        return [fingers]
    roots = robot.link_poses(links, robot.rest)[:, :3, 3]
    near = lengths(roots[:, None] - roots) < _APART
    joined = np.linalg.matrix_power(near, len(fingers))
    groups = np.unique(joined, axis=0)[::-1]
    return [[*compress(fingers, group)] for group in groups if group.sum() > 1]


def _check_one_hand(robot: Robot, fingers: list[RobotFinger]) -> None:
    """Reject two hands on one base: two groups of fingers, far apart."""
    groups = _groups(robot, fingers)
    if len(groups) < 2:
        return
    links = [_palm_link(group) for group in groups]
    advice = "choose one with --root"
    if len({*links}) == 1:
        advice = "keep the links of one hand in the URDF, because both start at the same link"
    one, other = map(len, groups[:2])
    raise robot.error(
        f"there are two hands on one base: {one} fingers from {links[0]!r} and "
        f"{other} from {links[1]!r}; {advice}",
        links,
    )


def _fingerlike(robot: Robot, body: int) -> list[RobotFinger]:
    """Return the chains of the branches of a body that could be fingers; none of a single one."""
    starts = robot.below(body)
    # Most bodies of an arm have one: its surfaces need not be read.
    if len(starts) < 2:
        return []
    branches = []
    for start in starts:
        branch = [RobotFinger(robot, leaf, body) for leaf in robot.leaves(start)]
        least = min(
            finger_evidence(one.joint_names, robot.endless, one.length)
            for one in branch
        )
        if least > 0.0:
            branches.append(branch)
    return [*chain.from_iterable(branches)] if len(branches) > 1 else []


def _palm_link(fingers: list[RobotFinger]) -> str:
    """Return the outermost link of a body from which all its fingers branch."""
    first, *others = [finger.carriers for finger in fingers]
    return next(link for link in first if all(link in way for way in others))


def find_tip(robot: Robot, joints: list[int]) -> tuple[Clue, Array]:
    """Find the end of a finger: an end frame of its last body, or else the end of its surface.

    Returns:
        The link that carries it, with the evidence, and its position in the link's frame [m], (3,).
    """
    leaf = joints[-1]
    link = robot.links[leaf][0]
    cloud = robot.surface(leaf)
    sizes = lengths(cloud)
    size = sizes.max(initial=0.0)
    before = robot.pose_in(robot.links[robot.model.parents[leaf]][0], link)[:3, 3]
    # Of links that carry no other one.
    ends = [
        (lengths(robot.frames[end].placement.translation), end)
        for end in robot.links[leaf][1:]
        if end not in robot.parents.values()
    ]
    distance, far = max(ends, default=(0.0, ""))
    if distance > max(_LEAST_TIP, 0.5 * size) and _is_at_end(robot, far, cloud):
        how = f"the link {far} ends the chain, {1e3 * distance:.0f} mm beyond the last joint"
        return Clue("tip", far, how, 0.95), np.zeros(3)
    if size > _LEAST_TIP:
        middle, is_around = _far_end(cloud, -before)
        how = f"the far end of the surface of {link}, {1e3 * size:.0f} mm from the last joint"
        if is_around:
            how = f"the end of the surface of {link}, which lies all around the last joint"
        return Clue("tip", link, how, 0.3 if is_around else 0.8), middle
    how = f"{link} has no surface and no end frame"
    # A first joint without shapes, and not with lost ones, is a motor.
    parts = [*joints[1:], *robot.elements[link].iterfind("visual")]
    if parts and _LEAST_TIP < lengths(before) < LONGEST_FINGER:
        how += ": 0.8 of the previous link's length"
        return Clue("tip", link, how, 0.3), _TIP_SHARE * _onwards(robot, joints, before)
    return Clue("tip", link, f"{how}: its origin", 0.1), np.zeros(3)


def _onwards(robot: Robot, joints: list[int], before: Array) -> Array:
    """Return the way on from the last joint of a finger to where a next one would be [m], (3,).

    A finger that is bent at zero ends there beside its line. Where the last link's axes are at some
    posture those of the link before, as of links that were drawn alike, it goes on as that link
    did. Else it goes on straight at rest.

    Args:
        robot: The robot.
        joints: Joints of the finger, outwards.
        before: The joint before, in the last link's frame at rest [m], shape (3,).
    """
    leaf = joints[-1]
    row = robot.model.idx_vs[leaf]
    ends = ends_of(robot, robot.rest, np.abs(robot.joint_motion[row]))
    names = [robot.links[joint][0] for joint in (leaf, robot.model.parents[leaf])]
    poses = [
        robot.pose_in(*names, q) for q in (robot.rest, *np.linspace(*ends, _POSTURES))
    ]
    turned = [float(np.linalg.norm(pin.log3(pose[:3, :3]))) for pose in poses]
    if min(turned) < _ALIGNED and turned[0] > _BENT:
        return poses[0][:3, 3]
    return -before


def _far_end(cloud: Array, ahead: Array) -> tuple[Array, bool]:
    """Return the end of a surface that is farthest from the origin.

    Args:
        cloud: Points of the surface [m], shape (k, 3).
        ahead: Direction from the joint before, shape (3,): that of the end of a surface which lies
            all around the origin, such as a cube.

    Returns:
        The centre of its outermost slice, which lies on a finger's axis and not on its skin [m],
        shape (3,); and whether the surface lies all around.
    """
    sizes = lengths(cloud)
    size = sizes.max()
    middle = cloud[sizes > 0.95 * size].mean(axis=0)
    is_around = bool(lengths(middle) < _AROUND * size)
    if is_around:
        middle = ahead if lengths(ahead) > _LEAST_TIP else cloud[sizes.argmax()]
    for _ in range(2):
        along = cloud @ middle
        outermost = cloud[along > 0.85 * along.max()]
        middle = box_of(outermost).mean(axis=0)
    return middle * (cloud @ middle).max() / (middle @ middle), is_around


def _is_at_end(robot: Robot, end: str, cloud: Array) -> bool:
    """Return whether an end frame ends its body's surface, if any, or is the centre of a ball."""
    frame = robot.frames[end]
    place = frame.placement.translation
    if not len(cloud):
        return True
    length = lengths(place)
    beyond = (cloud @ place).max() / length - length
    balls = [
        robot.frames[link].placement.act(origin_of(shape)[:3, 3])
        for link in robot.links[frame.parentJoint]
        for shape in robot.elements[link]
        if shape.find("geometry/sphere") is not None
    ]
    is_centre = any(lengths(ball - place) < _AT_CENTRE for ball in balls)
    return -_IN_THE_AIR < beyond < _INSIDE or (
        is_centre and 0.0 < beyond < _LARGEST_BALL
    )


def _poses(finger: RobotFinger, other: int) -> Array:
    """Return poses of a finger's last body on another, over all its joints' ranges, (5, 4, 4)."""
    robot = finger.robot
    base = robot.links[other][0]
    postures = np.linspace(*ends_of(robot, robot.rest, finger.moves), 5)
    return np.array([robot.pose_in(finger.links[-1], base, q) for q in postures])


def _travel(finger: RobotFinger, poses: Array) -> float:
    """Return how far a fingertip moves along an axis in poses of its body [m]."""
    return np.ptp(transform_points(poses, finger.tip[1]), axis=0).max()


def _idleness(finger: RobotFinger, _: list[RobotFinger]) -> str:
    """Return what is wrong with a chain that does not move its own end."""
    poses = _poses(finger, finger.robot.model.parents[finger.joints[0]])
    is_idle = _travel(finger, poses) < _LEAST_TRAVEL
    return "does not move the end of its chain, so not a finger" if is_idle else ""


def _second_end(finger: RobotFinger, fingers: list[RobotFinger]) -> str:
    """Return what is wrong with a chain that shares most joints with a longer one."""
    for other in sorted(fingers, key=lambda one: -len(one.joints)):
        if other is finger:
            break
        if len({*finger.joints} & {*other.joints}) > 0.5 * len(finger.joints):
            return f"a second end of the finger that ends at {other.links[-1]}"
    return ""


def _linkage(bar: RobotFinger, fingers: list[RobotFinger]) -> str:
    """Return what is wrong with a bar: hinged to a finger that the same joints drive.

    A file of MuJoCo says what closes a loop.
    """
    links = [bar.robot.elements[link] for link in bar.robot.links[bar.joints[-1]]]
    if any(link.find(LOOP_END) is not None for link in links):
        return "a bar that closes a loop, so not a finger"
    for host in fingers:
        if (
            len(host.joints) > len(bar.joints)
            and {*host.columns} >= {*bar.columns}
            and (
                _ends_on(bar, host)
                or any(_is_hinged(bar, _poses(bar, body)) for body in host.joints)
            )
        ):
            return f"a bar of the linkage of the finger that ends at {host.links[-1]}"
    return ""


def _ends_on(bar: RobotFinger, host: RobotFinger) -> bool:
    """Return whether a bar's end at rest lies on a later body of a finger, and not at its tip.

    A coupling that a description gives is often too rough for a bar to stay hinged.
    """
    robot = bar.robot
    body = robot.links[host.joints[-1]][0]
    tip = transform_points(robot.pose_in(bar.links[-1], body), bar.tip[1])
    if lengths(tip - host.tip[1]) < _OFF_TIP * bar.length:
        return False
    for joint in host.joints[1:]:
        cloud = robot.surface(joint)
        pose = robot.pose_in(bar.links[-1], robot.links[joint][0])
        place = transform_points(pose, bar.tip[1])
        if len(cloud) and lengths(place - place.clip(*box_of(cloud))) < _ON:
            return True
    return False


def _is_hinged(bar: RobotFinger, poses: Array) -> bool:
    """Return whether the last body of a bar stays at rest on a body, or turns about a point of it.

    The pivot p in the bar and c in the body solve `R p + t = c` for the bar's poses (R, t).
    """
    rotations = poses[:, :3, :3]
    turned = np.linalg.norm(rotations - rotations[0], axis=(1, 2))
    if turned.max() < _LEAST_PIVOT:
        return _travel(bar, poses) < _LINKAGE_SLACK
    changes = poses - poses.mean(axis=0)
    turns = changes[:, :3, :3]
    shifts = changes[:, :3, 3]
    # All points on the pivot's axis fit: the shortest solution is the one nearest to the origin.
    pivot = np.linalg.lstsq(turns.reshape(-1, 3), -shifts.ravel(), rcond=1e-6)[0]
    residuals = lengths(turns @ pivot + shifts)
    axis = pin.log3(rotations[0].T @ rotations[-1])
    off_axis = lengths(np.cross(unit(axis), pivot))
    length = lengths(bar.tip[1])
    is_off = _PIVOT_SHARE * length < off_axis < length + _LINKAGE_SLACK
    return bool(residuals.max() < _LINKAGE_SLACK and is_off)
