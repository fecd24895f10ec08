"""What is only human: the twenty joints, the lengths of a person's bones, and postural synergies.

The hand itself is an ordinary hand in `urdf/human`. It can be scaled to a person (`HumanLengths`,
`scaled_human_urdf`), always as a right hand: a left person's lengths are given mirrored, and the
mirror (`handmap_qp.hands.urdf.elements.mirrored_urdf`) comes after.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Self
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt

from handmap_qp.errors import HandError, InvalidInputError
from handmap_qp.hands.urdf.elements import get_numbers, parse_urdf, set_numbers
from handmap_qp.hands.urdf.package_data import urdf_directory
from handmap_qp.transform import as_floats, rotation_from_rpy

FINGERS = ("thumb", "index", "middle", "ring", "little")
"""The fingers, in the order of the rows of `HumanLengths`."""

_THUMB_JOINTS = ("TM_abduction", "TM_flexion", "MCP_flexion", "IP_flexion")
_FINGER_JOINTS = ("MCP_abduction", "MCP_flexion", "PIP_flexion", "DIP_flexion")

HUMAN_JOINTS: tuple[str, ...] = tuple(
    f"{finger}_{joint}"
    for finger in FINGERS
    for joint in (_THUMB_JOINTS if finger == "thumb" else _FINGER_JOINTS)
)
"""The joints of the human hand, four a finger; the order of every human q."""

# Buchholz, Armstrong and Goldstein, Ergonomics 35 (1992) 261-273, doi 10.1080/00140139208967812,
# from two public transcriptions. Bones as fractions of hand length: thumb metacarpal, proximal,
# distal; fingers proximal, middle, distal.
_BUCHHOLZ_SEGMENTS = np.array(
    [
        [0.251, 0.196, 0.158],
        [0.245, 0.143, 0.097],
        [0.266, 0.170, 0.108],
        [0.244, 0.165, 0.107],
        [0.204, 0.117, 0.093],
    ]
)
# The same source: distance of the thumb's CMC and the fingers' MCP joints from the distal wrist
# crease along the third metacarpal (fraction of hand length), and to the radial side of it
# (fraction of hand breadth).
_BUCHHOLZ_DISTAL = np.array([0.073, 0.447, 0.446, 0.409, 0.368])
_BUCHHOLZ_RADIAL = np.array([0.196, 0.251, 0.0, -0.206, -0.402])
# Hand breadth over hand length at which these offsets set the index and little MCP joints as far
# apart as trackers see them: the median of five tracked hands has them at 0.347 of the
# wrist-to-middle-tip length, which is 0.990 hand lengths here, so that sqrt((0.347 * 0.990)^2 -
# (0.447 - 0.368)^2) / (0.251 + 0.402) = 0.512.
_BREADTH_OVER_LENGTH = 0.512


@dataclass(frozen=True, slots=True, eq=False)
class HumanLengths:
    """The lengths that make a person's hand, as a right hand (a left one mirrored in the palm's plane x = 0).

    Attributes:
        bases: First joint of each finger (thumb CMC, the other fingers' MCP) in the palm frame:
            origin at the wrist, +y distal, +z dorsal, thumb at -x [m], shape (5, 3). Row order
            `FINGERS`.
        segments: Bone lengths outwards from there: thumb metacarpal, proximal, distal; fingers
            proximal, middle, distal [m], shape (5, 3).

    Raises:
        InvalidInputError: On a wrong shape, a number that is not finite, a bone that is not longer
            than 0, a finger whose MCP joint is not distal of the wrist, or an index finger that is
            not at the -x side of the little one.
    """

    bases: np.ndarray
    segments: np.ndarray

    def __post_init__(self) -> None:
        for name in ("bases", "segments"):
            object.__setattr__(self, name, _checked(getattr(self, name), (5, 3), name))
        if not (self.segments > 0.0).all():
            raise InvalidInputError(
                "segments: every bone must be longer than 0", value=self.segments
            )
        if not (self.bases[1:, 1] > 0.0).all():
            raise InvalidInputError(
                "bases: the MCP joints must be distal (+y) of the wrist", value=self.bases
            )
        if not self.bases[1, 0] < self.bases[4, 0]:
            message = "bases: expected a right hand, with the index finger at the -x side of the little one; mirror a left hand's"
            raise InvalidInputError(message, value=self.bases)

    def __reduce__(self) -> tuple[type[Self], tuple[np.ndarray, np.ndarray]]:
        return type(self), (self.bases, self.segments)

    @property
    def hand_length(self) -> float:
        """From the wrist to the middle fingertip along the bones [m]."""
        return float(np.linalg.norm(self.bases[2]) + self.segments[2].sum())

    @classmethod
    def from_hand_length(cls, hand_length: float, hand_breadth: float | None = None) -> Self:
        """Typical lengths for a hand of a given size (Buchholz et al. 1992).

        The palm frame's origin lies on the distal wrist crease and its y axis on the third
        metacarpal, from which the source measures. The source places joints in the plane of the
        palm only, so all bases have z = 0: the arch of the metacarpals and the depth of the thumb's
        CMC joint are left out, as they are in the default hand.

        Args:
            hand_length: From the distal wrist crease to the tip of the middle finger [m]. Its bones
                add up to 0.990 of it.
            hand_breadth: The breadth of the palm that the source's radial offsets multiply [m];
                0.512 of the length if omitted, which sets the knuckles as far apart as camera and
                glove trackers report them.

        Returns:
            The lengths.

        Raises:
            InvalidInputError: If a length is not a number > 0.
        """
        breadth = _BREADTH_OVER_LENGTH * hand_length if hand_breadth is None else hand_breadth
        for name, value in (("hand_length", hand_length), ("hand_breadth", breadth)):
            if not (np.isfinite(value) and value > 0.0):
                raise InvalidInputError(
                    f"{name}: expected a length > 0 in metres, got {value}", value=value
                )
        bases = np.column_stack(
            [-breadth * _BUCHHOLZ_RADIAL, hand_length * _BUCHHOLZ_DISTAL, np.zeros(5)]
        )
        return cls(bases=bases, segments=hand_length * _BUCHHOLZ_SEGMENTS)

    @classmethod
    def from_urdf(cls, text: str) -> Self:
        """The lengths of a human hand's URDF, such as `urdf/human/hand.urdf`.

        Raises:
            HandError: If the text is not the URDF of a human hand with this package's names.
        """
        joints = _joints(parse_urdf(text))
        bases = [_position(joints[_chain(finger)[0]]) for finger in FINGERS]
        segments = [
            [_position(joints[name])[0] for name in _chain(finger)[2:]] for finger in FINGERS
        ]
        return cls(bases=np.array(bases), segments=np.array(segments))


def scaled_human_urdf(text: str, lengths: HumanLengths) -> str:
    """Give a right human hand's URDF the lengths of a person.

    Joint origins, fingertips and shapes move; axes, limits and names stay. Bones are stretched
    along themselves, and all thicknesses follow the length of the whole hand. In the palm, a shape
    named after a finger (`index_metacarpal`) follows that finger's first joint; the others follow
    the breadth and length of the palm and the middle of the knuckles.

    Args:
        text: URDF of the right human hand (`urdf/human/hand.urdf`, or one scaled before).
        lengths: The person's lengths.

    Returns:
        The scaled URDF, without comments. With the hand's own lengths its kinematics are unchanged.

    Raises:
        HandError: If the text is not the URDF of a human hand with this package's names.
    """
    robot = parse_urdf(text)
    joints = _joints(robot)
    old = HumanLengths.from_urdf(text)
    size = lengths.hand_length / old.hand_length
    for i, finger in enumerate(FINGERS):
        chain = _chain(finger)
        _set_position(joints[chain[0]], lengths.bases[i])
        for k, name in enumerate(chain[2:]):
            _set_position(joints[name], np.array([lengths.segments[i, k], 0.0, 0.0]))
            stretch = np.array([lengths.segments[i, k] / old.segments[i, k], size, size])
            for shape in _shapes(robot, _bone(joints[chain[1 + k]])):
                _scale_shape(shape, partial(np.multiply, stretch), size)
    for shape in _shapes(robot, "palm"):
        _scale_shape(shape, _palm_map(old, lengths, shape.get("name", "")), size)
    return ET.tostring(robot, encoding="unicode")


@dataclass(frozen=True, slots=True, eq=False)
class Synergies:
    """Postural synergies: `q = mean + matrix @ z`.

    Attributes:
        matrix: S, joint angles per unit of each synergy [rad], shape (20, 15); rows in the order of
            `HUMAN_JOINTS`. Its columns are not orthonormal, because DIP angles follow PIP angles in
            it.
        mean: Mean posture q_m [rad], shape (20,).

    Raises:
        InvalidInputError: On a wrong shape or a number that is not finite.
    """

    matrix: np.ndarray
    mean: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _checked(self.matrix, (20, 15), "matrix"))
        object.__setattr__(self, "mean", _checked(self.mean, (20,), "mean"))

    def __reduce__(self) -> tuple[type[Self], tuple[np.ndarray, np.ndarray]]:
        return type(self), (self.matrix, self.mean)

    def posture(self, z: npt.ArrayLike) -> np.ndarray:
        """The posture of given synergy coordinates.

        Args:
            z: Coordinates of the first synergies; those left out are 0. Shape (k,), k <= 15.

        Returns:
            Joint angles in the order of `HUMAN_JOINTS` [rad], shape (20,). They are not held to any
            limits.

        Raises:
            InvalidInputError: On a wrong shape or a number that is not finite.
        """
        coordinates = np.asarray(z, dtype=float)
        if coordinates.ndim != 1 or len(coordinates) > 15 or not np.isfinite(coordinates).all():
            raise InvalidInputError(
                f"z: expected at most 15 finite numbers, got shape {coordinates.shape}", value=z
            )
        return self.mean + self.matrix[:, : len(coordinates)] @ coordinates

    def coordinates(self, q: npt.ArrayLike) -> np.ndarray:
        """The synergy coordinates nearest to a posture, in the least-squares sense over the joint angles.

        Args:
            q: Joint angles [rad], shape (20,).

        Returns:
            Coordinates, shape (15,).

        Raises:
            InvalidInputError: On a wrong shape or a number that is not finite.
        """
        return np.linalg.lstsq(self.matrix, _checked(q, (20,), "q") - self.mean, rcond=None)[0]

    def explained_variance(self, q: npt.ArrayLike) -> np.ndarray:
        """How much of a motion's variance the first synergies can reproduce.

        The motion is taken about its own mean, and projected by least squares over the joint angles
        onto the span of the first k synergies, for each k.

        Args:
            q: Joint angles over time [rad], shape (T, 20), T >= 2.

        Returns:
            Fractions in 0..1 that never fall, for k = 1..15, shape (15,).

        Raises:
            InvalidInputError: On a wrong shape, a number that is not finite, or a motion that
                stands still.
        """
        postures = as_floats(q, "q")
        if postures.ndim != 2 or len(postures) < 2:
            raise InvalidInputError(f"q: expected shape (T, 20) with T >= 2, got {postures.shape}")
        motion = _checked(postures, (len(postures), 20), "q")
        motion = motion - motion.mean(axis=0)
        total = float(np.square(motion).sum())
        if not total > 0.0:
            raise InvalidInputError("q: expected a motion, got the same posture throughout")
        # The first k columns of an orthonormal factor span what the first k synergies span.
        directions, _ = np.linalg.qr(self.matrix)
        return np.clip(np.cumsum(np.square(motion @ directions).sum(axis=0)) / total, 0.0, 1.0)


@cache
def load_synergies() -> Synergies:
    """The synergies of the 20-joint human hand, from `urdf/human/synergies.json`, which names their source."""
    document = json.loads(
        (urdf_directory() / "human" / "synergies.json").read_text(encoding="utf-8")
    )
    if document["joint_names"] != list(HUMAN_JOINTS):
        raise HandError(
            "synergies.json lists other joints than the human hand has", key="joint_names"
        )
    return Synergies(matrix=np.array(document["S"]), mean=np.array(document["q_m"]))


def _checked(values: npt.ArrayLike, shape: tuple[int, ...], name: str) -> np.ndarray:
    """A write-protected copy of finite numbers of the right shape."""
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{name}: expected numbers of shape {shape}: {error}") from error
    if array.shape != shape:
        raise InvalidInputError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InvalidInputError(f"{name}: expected finite numbers", value=array)
    array.setflags(write=False)
    return array


def _chain(finger: str) -> tuple[str, ...]:
    """A finger's four joints and the fixed one of its tip, outwards."""
    first = 4 * FINGERS.index(finger)
    return (*HUMAN_JOINTS[first : first + 4], f"{finger}_tip_joint")


def _joints(robot: ET.Element) -> dict[str, ET.Element]:
    joints = {joint.get("name", ""): joint for joint in robot.iterfind("joint")}
    for finger in FINGERS:
        for name in _chain(finger):
            if (
                name not in joints
                or joints[name].find("origin") is None
                or joints[name].find("child") is None
            ):
                raise HandError(
                    f"not a human hand of this package: {name!r} is missing or has no origin",
                    value=name,
                )
    return joints


def _bone(joint: ET.Element) -> str:
    child = joint.find("child")
    return "" if child is None else child.get("link", "")


def _origin(element: ET.Element) -> ET.Element:
    origin = element.find("origin")
    return ET.SubElement(element, "origin") if origin is None else origin


def _position(element: ET.Element) -> np.ndarray:
    return np.array(get_numbers(_origin(element), "xyz", 3, "0 0 0"))


def _set_position(element: ET.Element, position: np.ndarray) -> None:
    set_numbers(_origin(element), "xyz", list(position))


def _shapes(robot: ET.Element, link_name: str) -> list[ET.Element]:
    """The visuals and collisions of a link."""
    for link in robot.iterfind("link"):
        if link.get("name") == link_name:
            return [*link.iterfind("visual"), *link.iterfind("collision")]
    raise HandError(
        f"not a human hand of this package: the link {link_name!r} is missing", value=link_name
    )


def _palm_map(
    old: HumanLengths, new: HumanLengths, shape_name: str
) -> Callable[[np.ndarray], np.ndarray]:
    """Where a point of a palm's shape goes."""
    knuckles_old, knuckles_new = (
        old.bases[4, 0] - old.bases[1, 0],
        new.bases[4, 0] - new.bases[1, 0],
    )
    scale = np.array(
        [
            knuckles_new / knuckles_old,
            new.bases[2, 1] / old.bases[2, 1],
            new.hand_length / old.hand_length,
        ]
    )
    finger = shape_name.partition("_")[0]
    # Shapes of no finger follow the middle of the knuckles, which is not on the palm's y axis of
    # every hand.
    rows = [FINGERS.index(finger)] if finger in FINGERS else [1, 4]
    base_old, base_new = old.bases[rows].mean(axis=0), new.bases[rows].mean(axis=0)

    def follow(point: np.ndarray) -> np.ndarray:
        # What plain scaling misses at the base is made up for in proportion to the way from the
        # wrist to there.
        way = max(0.0, point @ base_old / (base_old @ base_old))
        return scale * point + way * (base_new - scale * base_old)

    return follow


def _scale_shape(shape: ET.Element, move: Callable[[np.ndarray], np.ndarray], size: float) -> None:
    """Move a primitive's centre and ends with `move`, and its thickness with `size`."""
    origin, centre = _origin(shape), _position(shape)
    axes = rotation_from_rpy(get_numbers(origin, "rpy", 3, "0 0 0"))
    primitive = shape.find("geometry/*")
    kind = None if primitive is None else primitive.tag
    if primitive is None or kind not in ("sphere", "cylinder", "box"):
        raise HandError(
            f"not a human hand of this package: a shape is <{kind}>",
            key=shape.get("name"),
            value=kind,
        )
    if kind == "box":
        sides = zip(axes.T, get_numbers(primitive, "size", 3), strict=True)
        ends = [
            (move(centre - side * axis / 2), move(centre + side * axis / 2)) for axis, side in sides
        ]
        set_numbers(
            primitive, "size", [float(np.linalg.norm(upper - lower)) for lower, upper in ends]
        )
        _set_position(shape, move(centre))
        return
    set_numbers(primitive, "radius", [size * get_numbers(primitive, "radius", 1)[0]])
    if kind == "sphere":
        _set_position(shape, move(centre))
        return
    half = get_numbers(primitive, "length", 1)[0] / 2 * axes[:, 2]
    lower, upper = move(centre - half), move(centre + half)
    length = float(np.linalg.norm(upper - lower))
    x, y, z = (upper - lower) / length
    set_numbers(primitive, "length", [length])
    _set_position(shape, (lower + upper) / 2)
    # Any rotation that lays the cylinder's z axis on the new direction will do: a cylinder has no
    # roll.
    set_numbers(origin, "rpy", [0.0, float(np.arctan2(np.hypot(x, y), z)), float(np.arctan2(y, x))])
