"""The description of a hand as a typed value: `HandSpec`, and the `hand.yaml` it is read from.

A spec says what the URDF does not. It is read from a file (`read_hand_spec`) or built in code;
making a `Hand` checks it against its URDF.
"""

import math
import pickle
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import msgspec
import numpy as np
import yaml
from msgspec import Meta

from handmap_core.errors import HandError, reason_of
from handmap_core.hands import UPRIGHT, Names, Side, Values

Links = tuple[str, str]
"""Names of two links."""
Mount = Literal["floating", "fixed"]
Vector = tuple[float, float, float]
ORIGIN: Vector = (0.0, 0.0, 0.0)
Positions = dict[str, float]
"""Positions of joints by name [rad or m]."""
Positive = Annotated[float, Meta(gt=0.0)]
Weights = dict[str, Annotated[float, Meta(ge=1e-4, le=1e4)]]
"""Weights of joints by name."""
Upright = Annotated[str, Meta(pattern=UPRIGHT)]
"""Axes of a world that are up and forward, such as `+y up, -z forward`."""
_Spec = TypeVar("_Spec")
Problems = Iterator[tuple[str, str, Any]]
"""What is wrong with a spec: messages, keys, and the values there."""

PACKAGE_SCHEME = "package://"
DESCRIPTION_SCHEME = "robot_descriptions:"
# libyaml parses in a tenth of the time, but crashes on some ten thousand levels, where plain Python
# raises `RecursionError`. Every level takes one of these characters, and a description a few
# hundred of them.
_LEVELS = "[{-?:"
_MOST_LEVELS = 2000
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class Document(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all that files of the user describe: an unknown key is an error."""


class PadSpec(Document, frozen=True):
    """The pad of a fingertip: a ball that touches the surface from inside, for pinches.

    Attributes:
        radius: Its radius [m], greater than 0.
        xyz: Its centre in the coordinates of the point's link [m].
    """

    radius: Positive
    xyz: Vector = ORIGIN


class PointSpec(Document, frozen=True):
    """A named reference point: a place on a link.

    Attributes:
        name: Unique in the hand.
        link: URDF link that carries the point.
        xyz: Offset in link coordinates [m].
        finger: Anatomical name of the finger it belongs to; None for points of the palm.
        weight: Weight in the estimation of T (on the human) and in the point task (on the robot),
            greater than 0.
        partner: On a robot, the human point whose residual it follows in part (see
            `residual_gain`). If omitted, the human point of the same name. If there is none, the
            last point of a named finger has the partner `<finger>_tip`.
        pad: Pad of the finger, on one of its points. If omitted, it is computed from the collision
            shapes. Give it for a soft cover or a fingertip that the URDF does not have.
    """

    name: str
    link: str
    xyz: Vector = ORIGIN
    finger: str | None = None
    weight: Positive = 1.0
    partner: str | None = None
    pad: PadSpec | None = None


class PalmSpec(Document, frozen=True):
    """The palm frame, its axes named by anatomy: +y distal, +z dorsal, and x = y cross z.

    Attributes:
        link: URDF link that the frame is fixed to.
        distal: Direction of the stretched fingers, in link coordinates; a unit vector.
        dorsal: Direction out of the back of the hand, in link coordinates; a unit vector at right
            angles to `distal`.
        xyz: Origin in link coordinates [m].
    """

    link: str
    distal: Vector
    dorsal: Vector
    xyz: Vector = ORIGIN


class WristSpec(Document, frozen=True):
    """The wrist frame, which the rigid part of the motion carries, and how it is held.

    Attributes:
        link: URDF link whose frame is the wrist's.
        mount: `floating` (six free coordinates) or `fixed` to the world.
        max_linear_speed: Limit of a floating wrist's speed along each of its axes [m/s].
        max_angular_speed: Limit of its speed about each of its axes [rad/s].
    """

    link: str
    mount: Mount = "floating"
    max_linear_speed: Positive = 3.0
    max_angular_speed: Positive = 12.0


class CollisionSpec(Document, frozen=True):
    """Links of the hand that self-collision avoidance keeps apart, where it is on.

    Attributes:
        pairs: Pairs of URDF links that have collision shapes.
        margin: Least distance between their shapes [m].
    """

    pairs: Annotated[tuple[Links, ...], Meta(min_length=1)]
    margin: Annotated[float, Meta(ge=0.0)] = 0.0005


class LimitSpec(Document, frozen=True):
    """Limits of a joint, in place of the URDF's; None keeps the URDF's.

    Attributes:
        lower: Lower position limit [rad or m].
        upper: Upper position limit [rad or m].
        velocity: Speed limit [rad/s or m/s].
    """

    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None


class MimicSpec(Document, frozen=True):
    """A joint that mimics another one: `q = multiplier * q[joint] + offset`.

    Attributes:
        joint: The leader's name; it may mimic another joint itself.
        multiplier: The follower's motion per motion of the leader.
        offset: Its position where the leader's is zero [rad or m].
    """

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


Rules = Mapping[str, MimicSpec]
"""Rules of joints that mimic others, by the follower's name."""


class ArmSpec(Document, frozen=True):
    """An arm that carries the hand: its joints move the wrist within their own limits.

    Attributes:
        name: Short name of the arm.
        urdf: Path of its URDF, as in `HandSpec.urdf`.
        tip: URDF link that carries the hand.
        joints: Names of its movable joints; they come first in every `q`.
        rest: Rest position of every joint [rad or m].
        xyz: Origin of the hand's root link in the tip's frame [m].
        rpy: Roll, pitch and yaw of the hand's root link there, as in a URDF [rad].
        root: Link that is fixed to the world; the root of the URDF if omitted.
        without: Links to remove with all their descendants, such as a gripper.
        locked: Positions of movable joints to hold still [rad or m].
        limits: Limits by joint, in place of the URDF's.
        directory: Folder at which relative paths start; that of `arm.yaml` if it was read from one.
    """

    name: str
    urdf: str
    tip: str
    joints: Names
    rest: Positions
    xyz: Vector = ORIGIN
    rpy: Vector = ORIGIN
    root: str | None = None
    without: Names = ()
    locked: Positions = {}
    limits: dict[str, LimitSpec] = {}
    directory: Path | None = None
    # An arm has no key for rules.
    mimic: ClassVar[Rules] = {}

    def error(self, message: str, key: str, value: Any = None) -> HandError:
        """Return an error about one key of this arm, as part of a hand."""
        return HandError(message, key=f"arm.{key}", value=value)


class _HandFields(Document, frozen=True):
    """The fields of `HandSpec`, without the checks that concern several of them."""

    name: str
    urdf: str
    side: Side
    palm: PalmSpec
    wrist: WristSpec
    joints: Annotated[Names, Meta(min_length=1)]
    rest: Positions
    points: tuple[PointSpec, ...]
    sets: dict[str, Names]
    reference: str
    mirror: bool = False
    collision: CollisionSpec | None = None
    root: str | None = None
    locked: Positions = {}
    limits: dict[str, LimitSpec] = {}
    speeds: Literal["assumed", "estimated", "given", "maker", "urdf"] | None = None
    mimic: dict[str, MimicSpec | None] = {}
    shapes: dict[str, Vector] = {}
    arm: ArmSpec | None = None
    neutral_match: Positions | None = None
    joint_weights: Weights = {}
    upright: Upright = "+z up, +x forward"
    tuning: Values = {}
    directory: Path | None = None
    file: Path | None = None


class HandSpec(_HandFields, frozen=True):
    """A hand: its URDF and what the URDF does not say.

    Attributes:
        name: Short name of the hand.
        urdf: Path of the URDF or MJCF, relative to `directory` or absolute. It may begin with an
            environment variable, as in `${FOLDER}/hand.urdf`. `package://PACKAGE/path` lies inside
            an installed Python package; `robot_descriptions:MODULE` is a robot of that package, or
            `robot_descriptions:MODULE.VARIABLE` one of its variants.
        side: `right` or `left`.
        palm: The palm frame.
        wrist: The wrist frame and its mount.
        joints: Names of the movable joints; their order is the order of every `q` that crosses the
            API.
        rest: Rest position of every joint [rad or m], inside its limits.
        points: All named reference points.
        sets: Named lists of points.
        reference: The set used unless the caller names another.
        mirror: Whether to mirror the URDF in its root link's plane x = 0; all coordinates here are
            those of the mirrored hand.
        collision: Links to keep apart; None where there are none.
        root: In the URDF of a whole robot, the link at which the hand begins: it and its
            descendants are the hand. The URDF's own root if omitted.
        locked: Positions of movable joints to hold still [rad or m].
        limits: Limits by joint, in place of the URDF's.
        speeds: Where the joints' speed limits are from, for people and `handmap hands check`: the
            `urdf`, the `maker` (a data sheet, a measurement), `given` by the owner (`handmap hands
            init --speed`), `estimated` from the actuators of an MJCF file, or `assumed`: those in
            `limits`, or all if it gives none. Not known if omitted.
        mimic: Rules by follower, in place of the URDF's; None makes a joint independent that mimics
            another in the URDF.
        shapes: Displacement in its link of each shape that the URDF or MJCF has in a wrong place,
            by its name there [m].
        arm: The arm that the hand is mounted on; None without one.
        neutral_match: Position of every joint in the posture that corresponds to the resting human
            hand [rad or m], inside its limits. Teleoperation starts there. If omitted, it is solved
            for each pair of hands; `handmap hands match` prints it.
        joint_weights: What the motion of a joint costs, and leaving its rest, where a finger's or
            an arm's costs 1. If omitted, 30 for joints that carry another limb too, such as a
            waist; see `Hand.carries_limbs`.
        upright: Which axes of the world of a hand on an arm are up and forward, of its root link
            without `arm`; those of REP 103 if omitted.
        tuning: Parameters of one hand and its motors, for `handmap drive --tuning`, as `handmap
            calibrate-actuators` writes them.
        directory: Folder at which relative paths start; that of `hand.yaml` if it was read from
            one.
        file: The file that the description was read from, for messages; None if built in code.
    """

    @property
    def assumed_speeds(self) -> Names:
        """Joints whose speed limits are assumed: see `speeds`."""
        if self.speeds != "assumed":
            return ()
        written = (
            joint
            for joint in self.joints
            if self.limits.get(joint, LimitSpec()).velocity is not None
        )
        return tuple(written) or self.joints

    @property
    def all_joints(self) -> Names:
        """Joints of arm and hand: the order of every `q`."""
        return (*self.arm.joints, *self.joints) if self.arm else self.joints

    def __post_init__(self) -> None:
        """Check everything that does not need the URDF, and copy what the caller may change.

        Raises:
            HandError: With the key and the value at fault.
        """
        checked = typed(self, _HandFields, self.file)
        for name, value in msgspec.structs.asdict(checked).items():
            msgspec.structs.force_setattr(self, name, value)
        self.reject(
            chain(
                _pad_problems(self.points),
                _joint_problems(self),
                _set_problems(self),
                _axis_problems(self.palm),
                _pair_problems(self.collision),
            )
        )

    def error(self, message: str, key: str, value: Any = None) -> HandError:
        """Return an error about one key of this spec, with its file."""
        return HandError(message, file=self.file, key=key, value=value)

    def reject(self, problems: Problems) -> None:
        """Raise an error about the first of some problems, if there are any."""
        for message, key, value in problems:
            raise self.error(message, key, value)


_FORMER_KEYS = {"matched": "neutral_match"}
"""Former names of keys of a `hand.yaml`, which are read as what they are called now."""


def read_hand_spec(path: Path) -> HandSpec:
    """Read and check a `hand.yaml`; its folder becomes the spec's `directory`.

    Raises:
        HandError: If the file cannot be read, is not YAML, has a wrong or missing key, or is that
            of a robot.
    """
    file = Path(path)
    document = read_document(file)
    if "hands" in document:
        problem = f"{document.get('name')} is a robot with hands, not a hand"
        advice = "give one of the hands that this file names, or a command that takes a robot: "
        commands = "`handmap robots`, retarget, view, simulate or batch"
        raise HandError(f"{problem}: {advice}{commands}", file=file)
    for former, key in _FORMER_KEYS.items():
        if former in document and key in document:
            problem = f"{former} is the former name of {key}: give one of them"
            raise HandError(problem, key=former, file=file)
    document = {_FORMER_KEYS.get(key, key): value for key, value in document.items()}
    fields = typed(document | {"file": str(file)}, _HandFields, file)
    return HandSpec(**msgspec.structs.asdict(fields))


def is_named_source(reference: str) -> bool:
    """Return whether a `urdf` of a description has the same meaning in every folder."""
    return reference.startswith((PACKAGE_SCHEME, DESCRIPTION_SCHEME, "$"))


def check_point(point: PointSpec) -> PointSpec:
    """Check a point that is not part of a spec; return it with its numbers as floats.

    Raises:
        HandError: With the key and the value at fault.
    """
    checked = typed(point, PointSpec, None)
    for message, _, value in _pad_problems([checked]):
        raise HandError(message, key="pad", value=value)
    return checked


def typed(value: Any, kind: type[_Spec], file: Path | None) -> _Spec:
    """Copy plain values, or a value built in code, as a type; reject numbers that are not finite.

    Raises:
        HandError: With the file, and the key and the value at fault.
    """
    try:
        document = msgspec.to_builtins(value, enc_hook=_plain)
    except (TypeError, ValueError, NotImplementedError, RecursionError) as error:
        raise HandError(
            f"holds a value that a description cannot have: {error}", file=file
        ) from error
    if not _is_finite(document):
        key, found = next(
            each
            for each in _values(document)
            if isinstance(each[1], float) and not math.isfinite(each[1])
        )
        raise HandError(
            f"expected a finite number, got {found}",
            file=file,
            key=key,
            value=found,
        )
    try:
        return msgspec.convert(
            document, kind, dec_hook=lambda wanted, text: wanted(text)
        )
    except msgspec.ValidationError as error:
        # msgspec names the place in its message only.
        message, _, place = str(error).partition(" - at `$")
        key = place.rstrip("`").lstrip(".") or None
        # A value of any key of a mapping is at `[...]`.
        at = key and dict(_values(document)).get(key.removesuffix("[...]"))
        got = "" if at is None else f" (value {at!r})"
        raise HandError(f"{message}{got}", file=file, key=key, value=at) from error


def _plain(value: Any) -> Any:
    """Return numpy's values and paths as plain ones."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise NotImplementedError(f"{type(value).__name__} {value!r:.60}")


def _is_finite(value: Any) -> bool:
    """Return whether no number in a value is infinite or NaN."""
    if isinstance(value, dict):
        return all(map(_is_finite, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _values(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Iterate over a value and all that is in it, with keys such as `points[2].weight`."""
    yield key.lstrip("."), value
    if isinstance(value, dict):
        for name, each in value.items():
            yield from _values(each, f"{key}.{name}")
    elif isinstance(value, list | tuple):
        for i, each in enumerate(value):
            yield from _values(each, f"{key}[{i}]")


def read_yaml(path: Path) -> Any:
    """Return the document in a file; a `HandError` if it is not YAML."""
    try:
        text = path.read_text(encoding="utf-8")
    # ValueError: not UTF-8, or a null character in the path.
    except (OSError, ValueError) as error:
        raise HandError(f"cannot be read: {reason_of(error)}", file=path) from error
    try:
        return pickle.loads(_parsed(text))
    # ValueError: an impossible date.
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise HandError(f"is not valid YAML: {reason_of(error)}", file=path) from error


@lru_cache(maxsize=128)
def _parsed(text: str) -> bytes:
    """Return a document, pickled: that makes a copy for each reader in a tenth of the time.

    Every list of hands, every service and every loaded hand reads the same few files.
    """
    is_deep = sum(map(text.count, _LEVELS)) > _MOST_LEVELS
    return pickle.dumps(yaml.load(text, Loader=yaml.SafeLoader if is_deep else _LOADER))


def read_document(path: Path, extending: tuple[Path, ...] = ()) -> Values:
    """Read a file's keys, with those of the file that it extends, and its folder."""
    document = read_yaml(path)
    if not isinstance(document, dict):
        raise HandError(
            f"expected a mapping of keys, got {type(document).__name__}", file=path
        )
    for key in sorted({"directory", "file"} & document.keys()):
        raise HandError("unknown key", file=path, key=key, value=document[key])
    folder = {"directory": str(path.parent)}
    arm = document.get("arm")
    if isinstance(arm, str):
        arm = {"extends": arm}
    if isinstance(arm, dict):
        document = {**document, "arm": folder | _extended(arm, path, extending)}
    return _extended(document, path, extending) | folder


def _extended(document: Values, path: Path, extending: tuple[Path, ...]) -> Values:
    """Add the keys of the file that the key `extends` names, where a mapping lacks them.

    Its relative paths keep their meaning.
    """
    own = dict(document)
    if "extends" not in own:
        return own
    other = (path.parent / str(own.pop("extends"))).resolve()
    if other in extending:
        raise HandError(
            "files extend each other in a circle",
            file=path,
            key="extends",
            value=str(other),
        )
    base = read_document(other, (*extending, path.resolve(), other))
    if "urdf" not in own and not is_named_source(str(base.get("urdf"))):
        own["urdf"] = str(other.parent / str(base.get("urdf")))
    return base | own


def repeated(names: Sequence[str]) -> list[str]:
    """Return the names that are given more than once."""
    return [name for name, count in Counter(names).items() if count > 1]


def twice(names: Sequence[str], key: str) -> Problems:
    """Find names that are given more than once under one key of a spec."""
    for name in repeated(names):
        yield f"{name!r} is given twice", key, name


def _pad_problems(points: Sequence[PointSpec]) -> Problems:
    """Find pads of points that are on no finger."""
    for i, point in enumerate(points):
        if point.pad and point.finger is None:
            yield "expected a point with `finger`, got None", f"points[{i}].pad", None


def _joint_problems(spec: HandSpec) -> Problems:
    """Check names of joints: unique, each with a rest position, none of them locked."""
    yield from twice(spec.all_joints, "joints")
    arm = (("arm.", spec.arm),) if spec.arm else ()
    for prefix, part in (("", spec), *arm):
        for joint in sorted({*part.joints} & part.locked.keys()):
            message = f"{joint!r} is one of `joints`, and cannot be locked"
            yield message, f"{prefix}locked", joint
        yield from _posture_problems(part.joints, part.rest, f"{prefix}rest")
    for joint in sorted(spec.joint_weights.keys() - {*spec.all_joints}):
        yield f"{joint!r} is not one of `joints`", "joint_weights", joint
    match = spec.rest if spec.neutral_match is None else spec.neutral_match
    yield from _posture_problems(spec.joints, match, "neutral_match")


def _posture_problems(
    joints: Sequence[str], positions: Positions, key: str
) -> Problems:
    """Check that a posture has a position for each joint, and for no other."""
    for joint in sorted({*joints} ^ positions.keys()):
        lacks = f"has no {key.removeprefix('arm.')} position"
        what = "is not one of `joints`" if joint in positions else lacks
        yield f"{joint!r} {what}", key, joint


def _set_problems(spec: HandSpec) -> Problems:
    """Check that points have unique names and sets name points."""
    names = [point.name for point in spec.points]
    yield from twice(names, "points")
    for set_name, members in spec.sets.items():
        key = f"sets.{set_name}"
        for member in members:
            if member not in names:
                yield f"{member!r} is not one of `points`", key, member
        yield from twice(members, key)
    if spec.reference not in spec.sets:
        expected = ", ".join(spec.sets) or "(none)"
        message = f"expected one of the sets {expected}, got {spec.reference!r}"
        yield message, "reference", spec.reference


def _axis_problems(palm: PalmSpec) -> Problems:
    """Check that the palm's axes are orthonormal."""
    for key, axis in (("palm.distal", palm.distal), ("palm.dorsal", palm.dorsal)):
        if abs(math.hypot(*axis) - 1.0) >= 1e-6:
            yield f"expected a unit vector, got {axis}", key, axis
    if abs(np.dot(palm.distal, palm.dorsal)) >= 1e-6:
        message = f"expected a direction at right angles to distal, got {palm.dorsal}"
        yield message, "palm.dorsal", palm.dorsal


def _pair_problems(collision: CollisionSpec | None) -> Problems:
    """Check that pairs of links to keep apart are two links each, and given once."""
    seen: set[frozenset[str]] = set()
    for i, pair in enumerate(collision.pairs if collision else ()):
        links = frozenset(pair)
        if len(links) < 2 or links in seen:
            what = "is given twice" if links in seen else "is one link; expected two"
            yield f"{list(pair)} {what}", f"collision.pairs[{i}]", pair
        seen.add(links)
