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

from handmap_qp.errors import HandError, without_errno
from handmap_qp.hands.fingers import Finger, PalmKinematics
from handmap_qp.hands.pads import ball_in
from handmap_qp.hands.spec import HandSpec, Mount, PadSpec, PalmSpec, PointSpec, Side, WristSpec
from handmap_qp.hands.urdf.xml_text import decode_xml
from handmap_qp.onboarding.anatomy import Anatomy, Clue, find_anatomy
from handmap_qp.onboarding.flexion import HandFlexion, find_flexion
from handmap_qp.onboarding.middle_joints import middle_joint
from handmap_qp.onboarding.robot import Robot
from handmap_qp.onboarding.structure import Chain, Structure, find_structure, fingers_of
from handmap_qp.transform import transform_points

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
            self.spec if reference is None else msgspec.structs.replace(self.spec, urdf=reference)
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

    Returns:
        The hand.

    Raises:
        HandError: If the URDF cannot be used, or contains no hand or more than one.
    """
    try:
        text = decode_xml(urdf.read_bytes())
    except (OSError, ValueError) as error:  # ValueError: also a null character in the path
        raise HandError(f"cannot be read: {without_errno(error)}", file=urdf) from error
    return detect_text(text, urdf, root=root, base=base, side=side, thumb=thumb, name=name)


def detect_text(
    text: str,
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
    structure = find_structure(robot)
    left_out: tuple[str, ...] = ()
    if root is None and (structure.above or structure.palm != robot.root):
        if base is None:
            left_out = _wrist_note(robot, structure)
        robot = Robot(text, urdf, root=structure.palm)
        structure = find_structure(robot)
    fingers = fingers_of(robot, structure)
    flexion = find_flexion(robot, fingers)
    names = [[*chain.joints, *chain.links] for chain in structure.chains]
    given = (
        None
        if thumb is None
        else next((i for i, group in enumerate(names) if thumb in group), None)
    )
    if thumb is not None and given is None:
        raise HandError(f"no finger has a link or joint {thumb!r}", file=urdf, value=thumb)
    hints = (robot.name, urdf.stem, structure.palm)
    anatomy = find_anatomy(flexion, names, hints, side, given)
    others = [i for i, finger in enumerate(anatomy.fingers) if finger != "thumb"]
    if (flexion.ways[others].sum(axis=0) @ anatomy.dorsal) > 0.0:
        # The side turned the palm over: joints with symmetric ranges flex the other way.
        flexion = find_flexion(robot, fingers, palmar=-anatomy.dorsal)
    if name is None:
        name = robot.name
        if not robot.is_whole and anatomy.side not in re.split(r"[^a-z]+", name.lower()):
            name = f"{name}_{anatomy.side}"
    spec, clues = _describe(robot, structure, fingers, flexion, anatomy, name)
    notes = (*left_out, *structure.notes, *robot.notes)
    chains = {
        finger: (*dict.fromkeys([*map(robot.drivers, chain.joints), *chain.joints]),)
        for finger, chain in _in_order(anatomy, structure.chains)
    }
    if base is not None:
        spec, more = _on_arm(text, urdf, spec, base)
        notes = (*notes, *more)
    return Detection(spec, clues, notes, chains)


def _wrist_note(robot: Robot, structure: Structure) -> tuple[str, ...]:
    """Name the actuated wrist joints that are left out, and the option that keeps them."""
    robot.place(robot.zero)
    near = [
        (joint, link)
        for joint, link in robot.chain(structure.palm, robot.root)
        if joint in robot.active
        and np.linalg.norm(robot.pose_in(link, structure.palm)[:3, 3]) < _WRIST_REACH
    ]
    if not near:
        return ()
    joints = ", ".join(joint for joint, _ in near)
    base = robot.parent[near[0][1]][1]
    return (
        f"wrist joints are left out, and the wrist floats: {joints}; keep them with --base {base}",
    )


def _describe(
    robot: Robot,
    structure: Structure,
    fingers: list[Finger],
    flexion: HandFlexion,
    anatomy: Anatomy,
    name: str,
) -> tuple[HandSpec, tuple[Clue, ...]]:
    joints = _ordered_joints(robot, structure, anatomy)
    q_rest = _rest(robot, flexion, anatomy)
    rest = {joint: round(float(q_rest[robot.active.index(joint)]), 4) + 0.0 for joint in joints}
    rest = {joint: _inside(rest[joint], robot, joint) for joint in joints}
    robot.place(q_rest)
    points, tips = _points(robot, structure, flexion, anatomy)
    origin, origin_clue = _palm_origin(robot, structure, flexion, anatomy)
    sets = {"fingertips": tips}
    if len(points) > len(tips):
        sets["fingertips_middle"] = (
            *tips,
            *(point.name for point in points if point.name not in tips),
        )
    mount: Mount = "floating"
    spec = HandSpec(
        name=name,
        urdf=str(robot.file),
        side=anatomy.side,
        palm=PalmSpec(
            structure.palm,
            _vector(anatomy.distal, 9),
            _vector(anatomy.dorsal, 9),
            _vector(origin, 4),
        ),
        wrist=WristSpec(robot.root, mount),
        joints=joints,
        rest=rest,
        points=points,
        sets=sets,
        reference="fingertips",
        root=None if robot.is_whole else robot.root,
        locked={
            **{joint: round(value, 6) for joint, value in robot.locked.items()},
            **{joint: float(robot.zero[robot.active.index(joint)]) for joint in structure.idle},
        },
        limits={joint: limit for joint, limit in robot.assumed.items() if joint in joints},
        mimic=dict(robot.dropped_rules),
    )
    sure = {clue.what: clue.confidence for clue in anatomy.clues}
    palm_clue = Clue("palm", structure.palm, structure.how, structure.confidence)
    tip_clues = [
        Clue(
            f"{finger}_tip",
            chain.tip.link,
            chain.tip.how,
            min(chain.tip.confidence, max(sure["thumb" if finger == "thumb" else "fingers"], 0.3)),
        )
        for finger, chain in _in_order(anatomy, structure.chains)
    ]
    tips_at_rest = PalmKinematics(robot).points(q_rest, [finger.tip for finger in fingers])
    moved = tips_at_rest - flexion.tips_open
    share = float(np.mean((moved @ -anatomy.dorsal) > 0.0))
    rest_clue = Clue(
        "rest",
        "half open",
        f"{_REST_SHARE:g} of the way from straight fingers to a fist, at most {_REST_MOST} rad per "
        "joint; other joints near zero, or at mid-range on the thumb",
        min(0.9 if share > 0.5 else 0.6, sure["dorsal"]),
    )
    return spec, (palm_clue, *anatomy.clues, origin_clue, *tip_clues, rest_clue)


def _in_order(anatomy: Anatomy, chains: tuple[Chain, ...]) -> list[tuple[str, Chain]]:
    """Return the fingers with their chains, the thumb first."""
    known = ("thumb", "index", "middle", "ring", "little")
    pairs = list(zip(anatomy.fingers, chains, strict=True))
    return sorted(
        pairs,
        key=lambda pair: (
            known.index(pair[0]) if pair[0] in known else len(known),
            len(pair[0]),
            pair[0],
        ),
    )


def _ordered_joints(robot: Robot, structure: Structure, anatomy: Anatomy) -> tuple[str, ...]:
    """Return the active joints, finger by finger from the palm outwards."""
    found: list[str] = []
    for _, chain in _in_order(anatomy, structure.chains):
        for joint in chain.joints:
            driver = robot.drivers(joint)
            if driver in robot.active and driver not in found and driver not in structure.idle:
                found.append(driver)
    return tuple(found)


def _rest(robot: Robot, flexion: HandFlexion, anatomy: Anatomy) -> np.ndarray:
    """Return the half-open posture; joints that do not flex are near zero, or centred (thumb)."""
    travel = flexion.q_closed - flexion.q_open
    step = np.where(
        robot.slides, 0.5 * travel, np.clip(_REST_SHARE * travel, -_REST_MOST, _REST_MOST)
    )
    q = np.where(flexion.flexes, flexion.q_open + step, robot.zero)
    if "thumb" in anatomy.fingers:
        of_thumb = flexion.moves[anatomy.fingers.index("thumb")] & ~flexion.flexes
        one_sided = of_thumb & ((robot.lower_limits > -0.1) | (robot.upper_limits < 0.1))
        q = np.where(one_sided, 0.5 * (robot.lower_limits + robot.upper_limits), q)
    # Joints that spread the fingers to one side only rest away from that limit, fingers apart.
    spreads = flexion.moves.any(axis=0) & ~flexion.flexes & (q == robot.zero)
    width = robot.upper_limits - robot.lower_limits
    q = np.where(
        spreads & (q - robot.lower_limits < _AT_LIMIT * width),
        robot.lower_limits + _SPREAD * width,
        q,
    )
    q = np.where(
        spreads & (robot.upper_limits - q < _AT_LIMIT * width),
        robot.upper_limits - _SPREAD * width,
        q,
    )
    return np.clip(q, robot.lower_limits, robot.upper_limits)


def _inside(value: float, robot: Robot, joint: str) -> float:
    """Clip a rounded value to the joint's limits."""
    at = robot.active.index(joint)
    return float(np.clip(value, robot.lower_limits[at], robot.upper_limits[at]))


def _points(
    robot: Robot, structure: Structure, flexion: HandFlexion, anatomy: Anatomy
) -> tuple[tuple[PointSpec, ...], tuple[str, ...]]:
    """Return fingertips, and the PIP joint of each finger and the IP joint of the thumb, if any."""
    tips, middles = [], []
    for finger, chain in _in_order(anatomy, structure.chains):
        # An additional finger has no human counterpart: pair it with the little finger.
        is_extra = finger.startswith("finger")
        partner = "little_tip" if is_extra else f"{finger}_tip"
        tip = PointSpec(
            f"{finger}_tip",
            chain.tip.link,
            _vector(chain.tip.xyz, 4),
            finger,
            1.0,
            partner,
            _pad(robot, chain),
        )
        tips.append(tip if partner != tip.name else msgspec.structs.replace(tip, partner=None))
        i = structure.chains.index(chain)
        middle = middle_joint(robot, structure, flexion, i, is_thumb=finger == "thumb")
        if middle is not None:
            name = f"{finger}_ip" if finger == "thumb" else f"{finger}_pip"
            link, place = middle
            xyz = _vector(place, 4) if np.linalg.norm(place) > _OFF_AXIS else (0.0, 0.0, 0.0)
            middles.append(
                PointSpec(name, link, xyz, finger, 1.0, "little_pip" if is_extra else None)
            )
    return (*tips, *middles), tuple(point.name for point in tips)


def _pad(robot: Robot, chain: Chain) -> PadSpec | None:
    """Return the pad of a finger whose surface is visual only; else the mapping finds it itself."""
    last, tip = chain.links[-1], chain.tip
    cloud = robot.body_surface(last)
    if not len(cloud) or robot.has_collision_shapes(last):
        return None
    pose = robot.pose_in(tip.link, last)
    centre, radius = ball_in(cloud, transform_points(pose, tip.xyz))
    return PadSpec(round(radius, 4), _vector(transform_points(np.linalg.inv(pose), centre), 4))


def _palm_origin(
    robot: Robot, structure: Structure, flexion: HandFlexion, anatomy: Anatomy
) -> tuple[np.ndarray, Clue]:
    """Estimate the wrist position: behind the knuckles, at the palm's proximal end."""
    robot.place(robot.zero)
    fingers = [i for i, finger in enumerate(anatomy.fingers) if finger != "thumb"] or [0]
    knuckles = flexion.bases[fingers].mean(axis=0)
    finger_length = float(flexion.reach[fingers].max())
    body = robot.body(structure.palm)
    cloud = robot.body_surface(body)
    if len(cloud):
        cloud = transform_points(robot.pose_in(body, structure.palm), cloud)
        back = float(knuckles @ anatomy.distal - (cloud @ anatomy.distal).min())
        how = "the proximal end of the palm's surface, behind the centre of the knuckles"
    else:
        back = float(knuckles @ anatomy.distal)
        how = "the origin of the palm's link, behind the centre of the knuckles"
    low, high = (ratio * finger_length for ratio in _PALM_RATIO)
    confidence = 0.8
    if not low <= back <= high:
        back, confidence = float(np.clip(back, low, high)), 0.5
        how = (
            f"{how}; moved to {1e3 * back:.0f} mm behind the knuckles, as in a person's proportions"
        )
    confidence = min(confidence, next(c.confidence for c in anatomy.clues if c.what == "distal"))
    origin = knuckles - back * anatomy.distal
    return origin, Clue("palm origin", f"{1e3 * back:.0f} mm behind the knuckles", how, confidence)


def _on_arm(text: str, urdf: Path, spec: HandSpec, base: str) -> tuple[HandSpec, tuple[str, ...]]:
    """Return the hand with the arm from `base` to it; all other joints are locked."""
    robot = Robot(text, urdf, root=base)
    hand = spec.root or spec.wrist.link
    if hand not in robot.links:
        raise HandError(
            f"the hand {hand!r} does not hang from the base {base!r}", file=urdf, value=base
        )
    arm = tuple(joint for joint, _ in robot.chain(hand, robot.root) if joint in robot.active)
    if not arm:
        raise HandError(
            f"no joint moves between {base!r} and the hand {hand!r}", file=urdf, value=base
        )
    still = [joint for joint in robot.active if joint not in arm and joint not in spec.joints]
    middle = 0.5 * (robot.lower_limits + robot.upper_limits)
    # A straight arm is singular; at mid-range it seldom is.
    rest = {joint: round(float(middle[robot.active.index(joint)]), 4) + 0.0 for joint in arm}
    changes = {
        "root": None if robot.is_whole else base,
        "wrist": WristSpec(spec.wrist.link, "fixed"),
        "joints": (*arm, *spec.joints),
        "rest": {**rest, **spec.rest},
        "locked": {
            **spec.locked,
            **{joint: float(robot.zero[robot.active.index(joint)]) for joint in still},
        },
        "limits": {
            **{joint: limit for joint, limit in robot.assumed.items() if joint in arm},
            **spec.limits,
        },
    }
    notes = (
        f"the arm from {base} to {hand} moves the wrist: {', '.join(arm)}",
        f"{len(still)} other joints are locked",
    )
    return msgspec.structs.replace(spec, **changes), notes


def _vector(values: Iterable[float], digits: int) -> tuple[float, float, float]:
    x, y, z = (round(float(value), digits) + 0.0 for value in values)
    return x, y, z
