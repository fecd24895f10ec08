"""A robot with one or two hands: `load_robot`, and the `robot.yaml` it is read from.

    name: g1
    hands:
      left: {hand: ../g1_arm_left/hand.yaml}
      right: {hand: ../g1_arm_right/hand.yaml}

Hands of one URDF share its root, waist and torso: a joint that any of them moves is one of the
robot's. Hands of other URDFs, such as two arms on a table, stand beside each other; names of their
links and joints then begin with `left_` or `right_`.

A hand of a robot is a `Hand` whose model is that of the whole robot: palm, wrist and points are its
own, and every `q` has all joints of the robot. So a method, a task or a limit needs no other hand.
"""

import warnings
from collections.abc import Sequence
from copy import copy, deepcopy
from functools import lru_cache, reduce
from itertools import compress
from operator import or_
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

from msgspec import Meta, field
from msgspec.structs import replace

from handmap_core.errors import HandError, expect
from handmap_core.hands import Side
from .hand import Hand
from .library import (
    Stamps,
    file_stamps,
    find_file,
    handed_out,
    load_hand,
    robot_files,
    sided_name,
)
from .model import compose_urdf
from .sources import source_file
from .spec import (
    ORIGIN,
    Document,
    HandSpec,
    Positions,
    Vector,
    Weights,
    read_document,
    read_hand_spec,
    typed,
)
from .urdf import (
    parse_urdf,
    rename,
    root_links,
    set_numbers,
)

BASE = "robot_base"
"""Link that all hands stand on."""


class RobotHandSpec(Document, frozen=True):
    """One hand of a robot, with its arm.

    Attributes:
        hand: Name of a hand, or path of its `hand.yaml` from the folder of the `robot.yaml`.
        xyz: Origin of its URDF's root on the robot's base [m].
        rpy: Roll, pitch and yaw of the root there, as in a URDF [rad].
    """

    hand: str
    xyz: Vector = ORIGIN
    rpy: Vector = ORIGIN


class RobotSpec(Document, frozen=True):
    """A robot: the hands that follow a person's left and right one.

    Attributes:
        name: Short name of the robot.
        hands: Its hands by their side.
        base: `floating` where it walks or drives; see `RobotMapper.base_pose`.
        joint_weights: As in `HandSpec`, by the robot's joints; it overrules those of its hands.
        directory: Folder at which relative paths start; that of `robot.yaml`.
        file: The file that the description was read from, for messages.
    """

    name: str
    hands: Annotated[dict[Side, RobotHandSpec], Meta(min_length=1)]
    base: Literal["fixed", "floating"] = "fixed"
    joint_weights: Weights = field(default_factory=dict)
    directory: Path | None = None
    file: Path | None = None


def joined(name: str, *hands: Hand) -> Hand:
    """Return the hands of a robot as one, which a QP moves; `Hand.parts` has them.

    Its palm and wrist are those of the first one, its reference points those of all, one hand after
    the other.
    """
    whole = copy(hands[0])
    whole.name = name
    whole.parts = hands
    whole.use_points(tuple(p for hand in hands for p in hand.reference_points))
    return whole


def is_robot(name: str) -> bool:
    """Return whether a name or path is that of a robot, not of a hand."""
    return name in robot_files() or Path(name).name == "robot.yaml"


def read_robot_spec(file: Path) -> RobotSpec:
    """Read and check a `robot.yaml`; its folder becomes the spec's `directory`.

    Raises:
        HandError: If the file cannot be read, is not YAML, or has an unknown, missing or mistyped
            key.
    """
    return typed(read_document(file) | {"file": str(file)}, RobotSpec, file)


def read_hands(robot: RobotSpec) -> dict[Side, HandSpec]:
    """Read the descriptions of a robot's hands, by their side.

    Raises:
        HandError: If one cannot be read, or is of the other side.
    """
    specs = {}
    for side, hand in robot.hands.items():
        file = find_file(hand.hand, folder=robot.directory or Path())
        specs[side] = spec = read_hand_spec(file)
        if spec.side != side:
            problem = f"{spec.name} is a {spec.side} hand"
            key = f"hands.{side}"
            raise HandError(problem, file=robot.file, key=key, value=spec.name)
    return specs


def load_robot(robot: str | Path | RobotSpec) -> Hand:
    """Load a robot with its hands, as one hand; see `joined`. Each has all joints of the robot.

    Args:
        robot: Name of a robot (`robot_files()`), path of a `robot.yaml`, or a `RobotSpec` built in
            code.

    Raises:
        HandError: If there is no such robot, or its description or that of a hand cannot be used.
        MissingExtraError: If a URDF lies in a package that is not installed.
    """
    if isinstance(robot, RobotSpec):
        return _build(robot)
    file = find_file(robot, "robot")
    spec = read_robot_spec(file)
    hands = read_hands(spec)
    if str(robot) not in robot_files():
        return _build(spec)
    try:
        stamps = file_stamps(file, *hands.values())
    except OSError:
        # It says which file is missing.
        return _build(spec)
    kept = _named(file, stamps)
    if (kept.spec, kept.hands) != (spec, hands):
        # The description of a hand was changed.
        return _build(spec)
    # Callers may change descriptions and models.
    own = [handed_out(hand, deepcopy(hand.spec)) for hand in kept.robot.parts]
    return joined(spec.name, *own)


class _Kept(NamedTuple):
    """A robot that is kept for later, and the descriptions that it was built from."""

    robot: Hand
    spec: RobotSpec
    hands: dict[Side, HandSpec]


@lru_cache(maxsize=8)
def _named(file: Path, stamps: Stamps) -> _Kept:
    """Build a robot that has a name, as `library.load_hand` does; it takes 60 ms."""
    spec = read_robot_spec(file)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _Kept(_build(spec), spec, read_hands(spec))


def _build(robot: RobotSpec) -> Hand:
    """Build a robot of its description."""
    specs = read_hands(robot)
    _check_roots(robot, [*specs.values()])
    trees: dict[Any, list[Side]] = {}
    for side, spec in specs.items():
        place = robot.hands[side].xyz, robot.hands[side].rpy
        # Hands on arms of their own share nothing.
        tree = side if spec.arm else (source_file(spec), spec.root)
        trees.setdefault((tree, place), []).append(side)
    whole = Element("robot", name=robot.name)
    SubElement(whole, "link", name=BASE)
    prefixes: dict[Side, str] = {}
    rest: Positions = {}
    weights: Positions = {}
    carriers: list[str] = []
    for (_, place), sides in trees.items():
        prefix = "" if len(trees) == 1 else f"{sides[0]}_"
        spec = _merged([specs[side] for side in sides])
        _stand(whole, spec, prefix, *place)
        arm = spec.arm.rest if spec.arm else {}
        rest |= {f"{prefix}{joint}": at for joint, at in (arm | spec.rest).items()}
        weights |= {
            f"{prefix}{name}": float(at) for name, at in spec.joint_weights.items()
        }
        if len(sides) == 1 and (spec.locked or (spec.arm and spec.arm.locked)):
            # What is locked has no joint in the robot's URDF, so its limbs are found here.
            alone = Hand(spec)
            named = compress(alone.joint_names, alone.carries_limbs)
            carriers += [f"{prefix}{name}" for name in named]
        prefixes |= dict.fromkeys(sides, prefix)
    for joint in sorted(robot.joint_weights.keys() - rest.keys()):
        problem = f"{joint!r} is not one of the robot's joints"
        raise HandError(problem, file=robot.file, key="joint_weights", value=joint)
    weights |= robot.joint_weights
    text = tostring(whole, encoding="unicode")
    hands = []
    for side, prefix in sorted(prefixes.items()):
        spec = _on_robot(specs[side], robot.name, prefix, rest, weights)
        hands.append(Hand(spec, urdf_text=text))
        hands[-1].has_floating_base = robot.base == "floating"
        hands[-1].limb_carriers = tuple(carriers)
    return joined(robot.name, *hands)


def load_whole(
    name: str, points: str | None = None, *, side: Side | None = None, **options: Any
) -> Hand:
    """Load a robot hand, or the hands of a robot as one (`joined`).

    Args:
        name: Name or path of a hand or of a robot; with `side` also the name of a family of hands.
        points: Set of reference points of a single hand; its own if omitted.
        side: Which hand of a family, such as `allegro`. Other names do not depend on it.
        **options: Others of a single hand, as in `load_hand`.

    Raises:
        HandError: If there is none, or its description cannot be used.
        MissingExtraError: If a URDF lies in a package that is not installed.
    """
    if is_robot(name):
        message = "none for a robot with two hands"
        expect(points is None, "robot_points", message, value=points)
        return load_robot(name)
    return load_hand(sided_name(name, side), points=points, **options)


def _check_roots(robot: RobotSpec, specs: Sequence[HandSpec]) -> None:
    """Reject arms of one URDF that begin at different links: no joint would be shared."""
    arms = [s for s in specs if not s.arm and s.wrist.mount == "fixed"]
    files = {source_file(spec) for spec in arms}
    roots = {(source_file(spec), spec.root) for spec in arms}
    if len(files) < len(roots):
        links = ", ".join(str(root or "its own root") for _, root in roots)
        problem = f"its hands begin at different links of one URDF, {links}"
        advice = "use the same `root`"
        raise HandError(f"{problem}: {advice}", file=robot.file, key="hands")


def _merged(specs: Sequence[HandSpec]) -> HandSpec:
    """Return the description of all joints that hands of one URDF move."""
    keys = "rest", "locked", "limits", "mimic", "joint_weights"
    whole = {k: reduce(or_, (getattr(spec, k) for spec in specs)) for k in keys}
    # One hand holds still what is the other's: its joints, and those that follow them.
    own = whole["rest"] | whole["mimic"]
    whole["locked"] = {j: at for j, at in whole["locked"].items() if j not in own}
    return replace(specs[0], joints=(*whole["rest"],), neutral_match=None, **whole)


def _stand(
    robot: Element, spec: HandSpec, prefix: str, xyz: Vector, rpy: Vector
) -> None:
    """Add what a description composes to the URDF of a robot."""
    text, *_ = compose_urdf(spec)
    tree = parse_urdf(text)
    rename(tree, prefix)
    mount = SubElement(robot, "joint", name=f"{prefix}{BASE}", type="fixed")
    SubElement(mount, "parent", link=BASE)
    SubElement(mount, "child", link=root_links(tree)[0])
    set_numbers(SubElement(mount, "origin"), xyz=xyz, rpy=rpy)
    robot.extend(list(tree))


def _on_robot(
    spec: HandSpec, name: str, prefix: str, rest: Positions, weights: Positions
) -> HandSpec:
    """Return the description of a hand in the composed URDF of its robot."""

    def renamed(value: Any) -> Any:
        return replace(value, link=f"{prefix}{value.link}")

    match = spec.neutral_match
    if match:
        match = rest | {f"{prefix}{joint}": at for joint, at in match.items()}
    collision = spec.collision
    if collision:
        pairs = tuple((f"{prefix}{a}", f"{prefix}{b}") for a, b in collision.pairs)
        collision = replace(collision, pairs=pairs)
    return replace(
        spec,
        name=f"{name}_{spec.side}",
        joints=(*rest,),
        rest=rest,
        neutral_match=match,
        palm=renamed(spec.palm),
        wrist=replace(renamed(spec.wrist), mount="fixed"),
        points=tuple(map(renamed, spec.points)),
        collision=collision,
        mirror=False,
        root=None,
        arm=None,
        locked={},
        limits={},
        mimic={},
        joint_weights=weights,
    )
