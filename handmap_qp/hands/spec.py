"""The description of a hand as a typed value: `HandSpec`, and the `hand.yaml` it is read from.

A spec says what the URDF cannot: which joints in which order, where palm and wrist are, which
points matter, what rest is. It can be read from a file (`read_hand_spec`) or built in code; whether
it fits its URDF is checked when a `Hand` is made.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import yaml

from handmap_qp.errors import HandError

Side = Literal["right", "left"]
Mount = Literal["floating", "fixed"]
Vector = tuple[float, float, float]
_Spec = TypeVar("_Spec")


class PointSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A named reference point: a place on a link.

    Attributes:
        name: Unique in the hand.
        link: URDF link that carries the point.
        xyz: Offset in link coordinates [m].
        finger: Anatomical name of the finger it belongs to; None for points of the palm.
        weight: Weight in the estimation of T (on the human) and in the point task (on the robot).
        partner: On a robot, the human point whose misfit it takes over in part (see
            `residual_gain`); the point of the same name if omitted.
    """

    name: str
    link: str
    xyz: Vector = (0.0, 0.0, 0.0)
    finger: str | None = None
    weight: float = 1.0
    partner: str | None = None


class PalmSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The palm frame, its axes named by anatomy: +y distal, +z dorsal, and x = y cross z.

    Attributes:
        link: URDF link that the frame is fixed to.
        distal: Direction of the stretched fingers, in link coordinates.
        dorsal: Direction out of the back of the hand, in link coordinates.
        xyz: Origin in link coordinates [m].
    """

    link: str
    distal: Vector
    dorsal: Vector
    xyz: Vector = (0.0, 0.0, 0.0)


class WristSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The wrist frame, which the rigid part of the motion carries, and how it is held.

    Attributes:
        link: URDF link whose frame is the wrist's.
        mount: `floating` (six free coordinates) or `fixed` to the world.
        max_linear_speed: Limit of a floating wrist's speed along each of its axes [m/s].
        max_angular_speed: Limit of its speed about each of its axes [rad/s].
    """

    link: str
    mount: Mount = "floating"
    max_linear_speed: float = 3.0
    max_angular_speed: float = 12.0


class CollisionSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which links of the hand are kept apart from each other, where self-collision avoidance is asked for.

    Attributes:
        pairs: Pairs of URDF links that have collision shapes.
        margin: Distance that their shapes keep [m].
    """

    pairs: tuple[tuple[str, str], ...]
    margin: float = 0.002


class LimitSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of a joint that its URDF lacks, or has otherwise.

    What is left out stays as in the URDF.

    Attributes:
        lower: Lower position limit [rad or m].
        upper: Upper position limit [rad or m].
        velocity: Speed limit [rad/s or m/s].
    """

    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None


class MimicSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A joint that copies another one: `q = multiplier * q[joint] + offset`.

    Attributes:
        joint: The leader's name; it may itself be a follower.
        multiplier: The follower's motion per motion of the leader.
        offset: Its position where the leader's is zero [rad or m].
    """

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


class ArmSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An arm that carries the hand: its joints then move the wrist, within their own limits.

    Attributes:
        name: Short name of the arm.
        urdf: Path of its URDF, as of `HandSpec.urdf`.
        tip: URDF link that carries the hand.
        joints: Names of its movable joints; they come first in every `q`.
        rest: Rest position of every joint [rad or m].
        xyz: Origin of the hand's root link in the tip's frame [m].
        rpy: Its roll, pitch and yaw there, as in a URDF [rad].
        root: Link that stands still; the URDF's own root if omitted.
        without: Links that are taken off, with all that hangs from them: a gripper, say.
        locked: Joints that hold still, and where [rad or m].
        limits: Limits by joint that replace the URDF's.
        directory: Where relative paths start; the folder of `arm.yaml` when it was read from one.
    """

    name: str
    urdf: str
    tip: str
    joints: tuple[str, ...]
    rest: dict[str, float]
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    root: str | None = None
    without: tuple[str, ...] = ()
    locked: dict[str, float] = {}
    limits: dict[str, LimitSpec] = {}
    directory: Path | None = None


class HandSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A hand: its URDF and what the URDF cannot say.

    Attributes:
        name: Short name of the hand.
        urdf: Path of the URDF relative to `directory`, absolute, or `package://PACKAGE/path` inside
            an installed package's `share` folder.
        side: `right` or `left`.
        palm: The palm frame.
        wrist: The wrist frame and its mount.
        joints: Names of the movable joints; their order is the order of every `q` that crosses the
            API.
        rest: Rest angle of every joint [rad], inside its limits.
        points: All named reference points.
        sets: Named lists of points.
        reference: The set used unless the caller names another.
        mirror: Reflect the URDF in its root link's x = 0 plane; all coordinates here are those of
            the reflected hand.
        collision: Links to keep apart; None where there is nothing to say.
        root: Where the hand begins in the URDF of a whole robot: this link and what hangs from it
            are the hand. The URDF's own root if omitted.
        locked: Movable joints that hold still, and where [rad or m].
        limits: Limits by joint that replace the URDF's.
        mimic: Rules by follower that replace the URDF's; None makes a joint of its own out of one
            that mimics in the URDF.
        arm: The arm that the hand is mounted on; None without one.
        directory: Where relative paths start; the folder of `hand.yaml` when it was read from one.
    """

    name: str
    urdf: str
    side: Side
    palm: PalmSpec
    wrist: WristSpec
    joints: tuple[str, ...]
    rest: dict[str, float]
    points: tuple[PointSpec, ...]
    sets: dict[str, tuple[str, ...]]
    reference: str
    mirror: bool = False
    collision: CollisionSpec | None = None
    root: str | None = None
    locked: dict[str, float] = {}
    limits: dict[str, LimitSpec] = {}
    mimic: dict[str, MimicSpec | None] = {}
    arm: ArmSpec | None = None
    directory: Path | None = None

    @property
    def all_joints(self) -> tuple[str, ...]:
        """Joints of arm and hand: the order of every `q`."""
        return self.joints if self.arm is None else (*self.arm.joints, *self.joints)

    @property
    def all_rest(self) -> dict[str, float]:
        """Rest positions of arm and hand [rad or m]."""
        return self.rest if self.arm is None else {**self.arm.rest, **self.rest}

    @property
    def file(self) -> Path | None:
        """The `hand.yaml` that the spec was read from, for error messages."""
        return None if self.directory is None else self.directory / "hand.yaml"

    def __post_init__(self) -> None:
        """Check everything that can be told without the URDF.

        Raises:
            HandError: With the key and the value at fault.
        """
        _check_finite(self)
        if not self.joints:
            raise self.error("expected at least one joint", key="joints", value=self.joints)
        _check_unique(self, self.all_joints, "joints")
        _check_unique(self, tuple(point.name for point in self.points), "points")
        for prefix, part in (("", self), ("arm.", self.arm)):
            if part is None:
                continue
            for joint in sorted(set(part.joints) ^ set(part.rest)):
                what = "is no joint of `joints`" if joint in part.rest else "has no rest angle"
                raise self.error(f"{joint!r} {what}", key=f"{prefix}rest", value=joint)
            for joint in sorted(set(part.joints) & set(part.locked)):
                raise self.error(
                    f"{joint!r} is one of `joints`, and cannot be locked",
                    key=f"{prefix}locked",
                    value=joint,
                )
        names = {point.name for point in self.points}
        for set_name, members in self.sets.items():
            for member in members:
                if member not in names:
                    raise self.error(
                        f"{member!r} is no point of `points`", key=f"sets.{set_name}", value=member
                    )
            _check_unique(self, members, f"sets.{set_name}")
        if self.reference not in self.sets:
            expected = ", ".join(self.sets) or "(none)"
            raise self.error(
                f"expected one of the sets {expected}, got {self.reference!r}", key="reference"
            )
        _check_axes(self)
        _check_collision(self)

    def error(self, message: str, *, key: str, value: Any = None) -> HandError:
        """An error about one key of this spec, carrying its file."""
        return HandError(message, file=self.file, key=key, value=value)


def read_hand_spec(path: Path) -> HandSpec:
    """Read and check a `hand.yaml`.

    Args:
        path: The file.

    Returns:
        The spec, its `directory` set to the file's.

    Raises:
        HandError: If the file cannot be read, is no YAML, or has an unknown, missing or mistyped
            key.
    """
    return _converted(_read_document(path), HandSpec, path)


def read_arm_spec(path: Path) -> ArmSpec:
    """Read an `arm.yaml`, as `read_hand_spec` does a `hand.yaml`.

    Whether it fits is checked when a hand is mounted on it.
    """
    return _converted(_read_document(path), ArmSpec, path)


def _converted(document: dict[str, Any], kind: type[_Spec], path: Path) -> _Spec:
    """A document as a typed value, with errors that name file, key and value."""
    try:
        return msgspec.convert(document, kind, dec_hook=lambda wanted, value: wanted(value))
    except msgspec.ValidationError as error:
        if isinstance(cause := error.__cause__, HandError):
            text = str(cause).removeprefix(f"{cause.file}: ").removeprefix(f"{cause.key}: ")
            raise HandError(text, file=path, key=cause.key, value=cause.value) from error
        message, _, place = str(error).partition(" - at `$")
        key = place.rstrip("`").lstrip(".") or None
        value = _value_at(document, key)
        got = "" if value is None else f" (value {value!r})"
        raise HandError(f"{message}{got}", file=path, key=key, value=value) from error


def _read_document(path: Path, extending: tuple[Path, ...] = ()) -> dict[str, Any]:
    """A file's keys, with those of the file that it extends, and its folder."""
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise HandError(f"cannot be read: {error}", file=path) from error
    except yaml.YAMLError as error:
        raise HandError(f"is no YAML: {' '.join(str(error).split())}", file=path) from error
    if not isinstance(document, dict):
        raise HandError(f"expected a mapping of keys, got {type(document).__name__}", file=path)
    if "directory" in document:
        raise HandError("unknown key", file=path, key="directory", value=document["directory"])
    if isinstance(document.get("arm"), str):
        document["arm"] = {"extends": document["arm"]}
    if isinstance(document.get("arm"), dict):
        document["arm"] = {
            "directory": str(path.parent),
            **_extended(document["arm"], path, extending),
        }
    return {**_extended(document, path, extending), "directory": str(path.parent)}


def _extended(document: dict[str, Any], path: Path, extending: tuple[Path, ...]) -> dict[str, Any]:
    """A mapping's keys over those of the file that its key `extends` names, whose relative paths stay what they were there."""
    own = dict(document)
    if "extends" not in own:
        return own
    other = (path.parent / str(own.pop("extends"))).resolve()
    if other in extending:
        raise HandError(
            "files extend each other in a circle", file=path, key="extends", value=str(other)
        )
    base = _read_document(other, (*extending, path.resolve(), other))
    if "urdf" not in own and not str(base.get("urdf")).startswith("package://"):
        own["urdf"] = str(other.parent / str(base.get("urdf")))
    return {**base, **own}


def _value_at(document: Any, key: str | None) -> Any:
    """The value at a path such as `points[2].weight`; None where there is none."""
    for part in re.findall(r"[^.\[\]]+", key or ""):
        try:
            document = document[int(part) if isinstance(document, list) else part]
        except (KeyError, IndexError, TypeError, ValueError):
            return None
    return document if key else None


def _check_unique(spec: HandSpec, names: tuple[str, ...], key: str) -> None:
    for name in names:
        if names.count(name) > 1:
            raise spec.error(f"{name!r} is given twice", key=key, value=name)


def _check_finite(spec: HandSpec) -> None:
    numbers: dict[str, tuple[float, ...]] = {
        "palm.xyz": spec.palm.xyz,
        "rest": tuple(spec.all_rest.values()),
        "locked": tuple(spec.locked.values()),
        **{
            f"mimic.{name}": (rule.multiplier, rule.offset)
            for name, rule in spec.mimic.items()
            if rule is not None
        },
        **_limit_numbers(spec.limits, "limits"),
        **{f"points[{i}].xyz": point.xyz for i, point in enumerate(spec.points)},
    }
    if spec.arm is not None:
        numbers |= {
            "arm.xyz": spec.arm.xyz,
            "arm.rpy": spec.arm.rpy,
            "arm.locked": tuple(spec.arm.locked.values()),
        }
        numbers |= _limit_numbers(spec.arm.limits, "arm.limits")
    for key, values in numbers.items():
        if not all(map(math.isfinite, values)):
            raise spec.error(f"expected finite numbers, got {values}", key=key, value=values)
    positive = {
        "wrist.max_linear_speed": spec.wrist.max_linear_speed,
        "wrist.max_angular_speed": spec.wrist.max_angular_speed,
        **{f"points[{i}].weight": point.weight for i, point in enumerate(spec.points)},
    }
    for key, value in positive.items():
        if not (math.isfinite(value) and value > 0.0):
            raise spec.error(f"expected a number > 0, got {value}", key=key, value=value)


def _limit_numbers(limits: dict[str, LimitSpec], key: str) -> dict[str, tuple[float, ...]]:
    """The numbers that limits give, by key."""
    return {
        f"{key}.{name}": tuple(
            value for value in (limit.lower, limit.upper, limit.velocity) if value is not None
        )
        for name, limit in limits.items()
    }


def _check_axes(spec: HandSpec) -> None:
    distal, dorsal = spec.palm.distal, spec.palm.dorsal
    for key, axis in (("palm.distal", distal), ("palm.dorsal", dorsal)):
        if not abs(math.hypot(*axis) - 1.0) < 1e-6:
            raise spec.error(f"expected a unit vector, got {axis}", key=key, value=axis)
    cosine = sum(a * b for a, b in zip(distal, dorsal, strict=True))
    if not abs(cosine) < 1e-6:
        raise spec.error(
            f"expected a direction at right angles to distal, got {dorsal}",
            key="palm.dorsal",
            value=dorsal,
        )


def _check_collision(spec: HandSpec) -> None:
    if spec.collision is None:
        return
    margin, seen = spec.collision.margin, set()
    if not spec.collision.pairs:
        raise spec.error(
            "expected at least one pair of links", key="collision.pairs", value=spec.collision.pairs
        )
    if not (math.isfinite(margin) and margin >= 0.0):
        raise spec.error(
            f"expected a distance >= 0, got {margin}", key="collision.margin", value=margin
        )
    for i, pair in enumerate(spec.collision.pairs):
        links = frozenset(pair)
        if len(links) < 2 or links in seen:
            what = "is given twice" if links in seen else "is one link; expected two"
            raise spec.error(f"{list(pair)} {what}", key=f"collision.pairs[{i}]", value=pair)
        seen.add(links)
