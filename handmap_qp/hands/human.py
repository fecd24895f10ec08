"""The human hand: its twenty joints, the measures of a person's hand, and scaling to them.

The hand itself is an ordinary hand in `urdf/human`. It can be scaled to a person (`HumanLengths`,
`scaled_human_urdf`), always as a right hand: a left person's lengths are given mirrored, and the
URDF is mirrored afterwards (`handmap_qp.hands.urdf.mirror`).
"""

import json
import math
from collections.abc import Callable
from functools import partial
from typing import Self
from xml.etree.ElementTree import Element, tostring

import numpy as np
from msgspec import field
from msgspec.structs import force_setattr

from handmap_core.errors import HandError, expect
from handmap_core.hands import CONTACT_GAP, FINGERS, Names, Side
from handmap_core.se3 import Array, Arrays, ArrayStruct, as_floats, frozen
from .sources import urdf_directory
from .urdf import (
    child_of,
    get_numbers,
    joints_by_name,
    origin_of,
    parse_urdf,
    set_numbers,
)

_THUMB_JOINTS = ("TM_abduction", "TM_flexion", "MCP_flexion", "IP_flexion")
_FINGER_JOINTS = ("MCP_abduction", "MCP_flexion", "PIP_flexion", "DIP_flexion")

HUMAN_JOINTS: Names = tuple(
    f"{finger}_{joint}"
    for finger in FINGERS
    for joint in (_THUMB_JOINTS if finger == "thumb" else _FINGER_JOINTS)
)
"""The joints of the human hand, four a finger; the order of every human q."""

# Proportions of hands (Buchholz et al. 1992); the file names their source.
_FILE = urdf_directory() / "human" / "buchholz.json"
_BUCHHOLZ = json.loads(_FILE.read_bytes())
# Hand breadth over hand length at which these offsets set the index and little MCP joints as far
# apart as trackers see them: the median of five tracked hands has them at 0.347 of the
# wrist-to-middle-tip length, which is 0.990 hand lengths here, so that sqrt((0.347 * 0.990)^2 -
# (0.447 - 0.368)^2) / (0.251 + 0.402) = 0.512.
_BREADTH_OVER_LENGTH = 0.512


_NOT_HUMAN = "not a human hand of this package"
LARGEST_ROLL = math.radians(45.0)
"""Largest roll of a finger [rad]."""


class HumanLengths(ArrayStruct, frozen=True):
    """What is measured of a person's hand: lengths, rolls and contact gap, as a right hand.

    A left hand's are given mirrored in the palm's plane x = 0.

    The paper's hand bends all fingers about parallel axes. Fingers of people converge as they bend,
    the little finger most: its axes are turned by 10 to 20 degrees about the palm's y axis.

    Attributes:
        bases: First joint of each finger (thumb CMC, the other fingers' MCP) in the palm frame:
            origin at the wrist, +y distal, +z dorsal, thumb at -x [m], shape (5, 3). Row order
            `FINGERS`.
        segments: Bone lengths outwards from there: thumb metacarpal, proximal, distal; fingers
            proximal, middle, distal [m], shape (5, 3).
        rolls: Turn of all joint axes of each finger about the palm's y axis, from their directions
            in the paper's hand [rad], shape (5,), within 45 degrees of 0.
        palm_weights: Weight of each finger's first joint where the palm is fitted to landmarks,
            shape (5,), from 0 to 1; the thumb's is not used. Below 1 for a joint that moves on the
            palm, as the little finger's does by its metacarpal.
        contact_gap: Distance of the tracker's thumb and finger landmarks where the skin touches
            [m].

    Raises:
        InvalidInputError: On a wrong shape, a number that is not finite, a bone that is shorter
            than 0.1 mm or longer than 1 m, a finger whose MCP joint is not distal of the wrist, an
            index finger that is not at the -x side of the little one, or a roll that is too large.
    """

    bases: Array
    segments: Array
    rolls: Array = field(default_factory=partial(np.zeros, 5))
    contact_gap: float = CONTACT_GAP
    palm_weights: Array = field(default_factory=partial(np.ones, 5))

    def __post_init__(self) -> None:
        shapes = {
            "bases": (5, 3),
            "segments": (5, 3),
            "rolls": (5,),
            "palm_weights": (5,),
        }
        for name, shape in shapes.items():
            given = as_floats(getattr(self, name), name, shape=shape, is_finite=True)
            force_setattr(self, name, frozen(given.copy()))
        weights = self.palm_weights
        expect(
            weights.min() >= 0.0 and weights.max() <= 1.0 and weights[1:4].min() > 0.0,
            "palm_weights",
            "weights from 0 to 1, above 0 of index, middle and ring finger",
            value=weights,
        )
        bases = self.bases
        segments = self.segments
        rolls = self.rolls
        shortest = segments.min()
        longest = np.abs((bases, segments)).max()
        expect(
            1e-4 <= shortest <= longest <= 1.0,
            "segments",
            "bones of 0.1 mm to 1 m",
            value=segments,
            got=f"{shortest:.6g} to {longest:.6g} m",
        )
        knuckle = bases[1:, 1].min()
        expect(
            knuckle > 0.0,
            "bases",
            "MCP joints distal (+y) of the wrist",
            value=bases,
            got=f"y = {knuckle:.6g} m",
        )
        expect(
            bases[1, 0] < bases[4, 0],
            "bases",
            "a right hand, with the index finger at the -x side of the little one",
            value=bases,
            got="a left one: mirror it",
        )
        roll = np.abs(rolls).max()
        expect(
            roll <= LARGEST_ROLL,
            "rolls",
            "angles within 45 degrees of 0",
            value=rolls,
            got=f"{roll:.3g} rad",
        )

    def palm(self, side: Side) -> Array:
        """Return wrist and knuckles of a hand of a side in its palm frame [m], shape (5, 3)."""
        sign = -1.0 if side == "left" else 1.0
        return np.vstack([np.zeros(3), self.bases[1:]]) * (sign, 1.0, 1.0)

    @property
    def hand_length(self) -> float:
        """From the wrist to the middle fingertip along the bones [m]."""
        return float(np.linalg.norm(self.bases[2]) + self.segments[2].sum())

    @classmethod
    def from_hand_length(
        cls, hand_length: float, hand_breadth: float | None = None
    ) -> Self:
        """Return typical lengths for a hand of a given size (Buchholz et al. 1992).

        The palm frame's origin lies on the distal wrist crease, its axes are those of measured
        people (`measure_hand`). The source places joints in the plane of the palm only, so all
        bases have z = 0. The arch of the metacarpals and the depth of the thumb's CMC joint are
        missing, as they are in the default hand.

        Args:
            hand_length: From the distal wrist crease to the tip of the middle finger [m]. Its bones
                add up to 0.990 of it.
            hand_breadth: The breadth of the palm that the source's radial offsets multiply [m];
                0.512 of the length if omitted, which sets the knuckles as far apart as camera and
                glove trackers report them.

        Raises:
            InvalidInputError: If a length is not one from 1 mm to 1 m.
        """
        length = _checked_length(hand_length, "hand_length")
        breadth = _BREADTH_OVER_LENGTH * length
        if hand_breadth is not None:
            breadth = _checked_length(hand_breadth, "hand_breadth")
        across = np.multiply(-breadth, _BUCHHOLZ["radial"])
        along = np.multiply(length, _BUCHHOLZ["distal"])
        bases = np.column_stack([across, along]) @ _BUCHHOLZ["axes"]
        return cls(bases, np.multiply(length, _BUCHHOLZ["segments"]))

    @classmethod
    def from_urdf(cls, text: str | bytes) -> Self:
        """Read the lengths from a right human hand's URDF, such as `urdf/human/hand.urdf`.

        Raises:
            HandError: If the text is not the URDF of a human hand with this package's names.
        """
        named = joints_by_name(parse_urdf(text))
        for finger in FINGERS:
            for name in _chain(finger):
                tags = {element.tag for element in named.get(name, ())}
                if not {"origin", "child"} <= tags:
                    problem = f"the joint {name!r} is missing or has no origin"
                    raise HandError(f"{_NOT_HUMAN}: {problem}", value=name)
        joints = [[named[name] for name in _chain(finger)] for finger in FINGERS]
        poses = np.array([[*map(origin_of, chain)] for chain in joints])
        rolls = [
            get_numbers(child_of(first, "origin"), "rpy", 3, "0 0 0")[0]
            for first, *_ in joints
        ]
        return cls(poses[:, 0, :3, 3], poses[:, 2:, 0, 3], np.array(rolls))


JointMove = tuple[Array, float]
"""Position of a joint on its parent link [m], shape (3,), and a turn about its own x axis [rad]."""


def joint_moves(
    old: HumanLengths, new: HumanLengths, *, mirrors: bool = False
) -> dict[str, JointMove]:
    """Return how joints move when a hand is scaled to a person.

    Args:
        old: Lengths of the hand.
        new: Lengths of the person.
        mirrors: Return the moves of a left hand.

    Returns:
        Moves by the joint's name: of each finger its first joint, the two at the ends of bones, and
        the fixed one of its tip.
    """
    signs = np.array([-1.0 if mirrors else 1.0, 1.0, 1.0])
    moves: dict[str, JointMove] = {}
    for i, finger in enumerate(FINGERS):
        chain = _chain(finger)
        moves[chain[0]] = new.bases[i] * signs, float(new.rolls[i] - old.rolls[i])
        for name, length in zip(chain[2:], new.segments[i], strict=True):
            moves[name] = np.array([length, 0.0, 0.0]) * signs, 0.0
    return moves


def shape_stretches(old: HumanLengths, new: HumanLengths) -> Arrays:
    """Return factors on the shapes of the fingers' bones; arguments as in `joint_moves`.

    Returns:
        Factors along the axes of the joint that carries a bone, x along the bone, shape (3,), by
        the joint's name.
    """
    size = new.hand_length / old.hand_length
    return {
        name: np.array([bone, size, size])
        for finger, bones in zip(FINGERS, new.segments / old.segments, strict=True)
        for name, bone in zip(_chain(finger)[1:], bones, strict=False)
    }


def scaled_human_urdf(text: str | bytes, lengths: HumanLengths) -> str:
    """Scale a right human hand's URDF to the lengths of a person.

    Joint origins, fingertips and shapes move, and fingers roll; limits and names stay. Bones are
    stretched along themselves, and all thicknesses scale with the length of the whole hand. In the
    palm, a shape named after a finger (`index_metacarpal`) follows that finger's first joint. The
    other shapes follow the breadth and length of the palm and the middle of the knuckles.

    Args:
        text: URDF of the right human hand (`urdf/human/hand.urdf`, or one scaled before).
        lengths: The person's lengths.

    Returns:
        The scaled URDF, without comments. With the hand's own lengths its kinematics are unchanged.

    Raises:
        HandError: If the text is not the URDF of a human hand with this package's names.
    """
    robot = parse_urdf(text)
    old = HumanLengths.from_urdf(text)
    joints = joints_by_name(robot)
    size = lengths.hand_length / old.hand_length
    shapes = {
        link.get("name"): [*link.iterfind("visual"), *link.iterfind("collision")]
        for link in robot.iterfind("link")
    }
    if "palm" not in shapes:
        raise HandError(f"{_NOT_HUMAN}: the link 'palm' is missing", value="palm")
    for name, (position, turn) in joint_moves(old, lengths).items():
        origin = child_of(joints[name], "origin")
        roll, pitch, yaw = get_numbers(origin, "rpy", 3, "0 0 0")
        # Fingers point along their x axes, about which the first of the three turns is.
        set_numbers(origin, xyz=position, rpy=[roll + turn, pitch, yaw])
    for name, stretch in shape_stretches(old, lengths).items():
        link = child_of(joints[name], "child").get("link")
        for shape in shapes.get(link, ()):
            _scale_shape(shape, partial(np.multiply, stretch), size)
    for shape in shapes["palm"]:
        _scale_shape(shape, _palm_map(old, lengths, shape.get("name", "")), size)
    return tostring(robot, encoding="unicode")


def _checked_length(value: float, name: str) -> float:
    length = float(as_floats(value, name, shape=()))
    expect(1e-3 <= length <= 1.0, name, "0.001 to 1, in metres", value=value)
    return length


def _chain(finger: str) -> Names:
    """Return a finger's four joints and the fixed one of its tip, outwards."""
    first = 4 * FINGERS.index(finger)
    return (*HUMAN_JOINTS[first : first + 4], f"{finger}_tip_joint")


def _palm_map(
    old: HumanLengths, new: HumanLengths, shape_name: str
) -> Callable[[Array], Array]:
    """Return the map of points of a shape in the palm."""
    sizes = [
        (each.bases[4, 0] - each.bases[1, 0], each.bases[2, 1], each.hand_length)
        for each in (old, new)
    ]
    scale = np.divide(sizes[1], sizes[0])
    finger = shape_name.partition("_")[0]
    # Shapes that belong to no finger follow the middle of the knuckles, which is not always on the
    # palm's y axis.
    rows = [FINGERS.index(finger)] if finger in FINGERS else [1, 4]
    base = old.bases[rows].mean(axis=0)
    residual = new.bases[rows].mean(axis=0) - scale * base

    def follow(point: Array) -> Array:
        # Add the residual at the finger base, weighted linearly from wrist to base.
        return scale * point + max(0.0, point @ base / (base @ base)) * residual

    return follow


def _scale_shape(shape: Element, move: Callable[[Array], Array], size: float) -> None:
    """Move a primitive's centre and ends by `move`, and scale its thickness by `size`."""
    pose = origin_of(shape)
    primitive = next(shape.iterfind("geometry/*"), Element("nothing"))
    axes = pose[:3, :3]
    centre = pose[:3, 3]
    kind = primitive.tag
    if kind not in ("sphere", "cylinder", "box"):
        problem = f"{_NOT_HUMAN}: a shape is <{kind}>"
        raise HandError(problem, key=shape.get("name"), value=kind)
    origin = child_of(shape, "origin")
    moved = move(centre)
    if kind == "box":
        halves = 0.5 * axes * get_numbers(primitive, "size", 3)
        sides = [move(centre + half) - move(centre - half) for half in halves.T]
        set_numbers(primitive, size=np.linalg.norm(sides, axis=1))
    else:
        (radius,) = get_numbers(primitive, "radius", 1)
        set_numbers(primitive, radius=size * radius)
    if kind == "cylinder":
        half = 0.5 * get_numbers(primitive, "length", 1)[0] * axes[:, 2]
        ends = np.array([move(centre - half), move(centre + half)])
        moved = ends.mean(axis=0)
        x, y, z = along = ends[1] - ends[0]
        set_numbers(primitive, length=np.linalg.norm(along))
        # Any rotation that lays the z axis on the new direction will do: a cylinder has no roll.
        set_numbers(origin, rpy=[0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])
    set_numbers(origin, xyz=moved)
