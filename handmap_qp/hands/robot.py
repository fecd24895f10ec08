"""A robot with one or two hands: `Robot`, and the `robot.yaml` it is read from.

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

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

from msgspec import Meta
from msgspec.structs import replace

from handmap_qp.errors import HandError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import find_file
from handmap_qp.hands.model import compose_urdf
from handmap_qp.hands.sources import read_urdf, source_file, urdf_directory, urdf_path
from handmap_qp.hands.spec import (
    Document,
    HandSpec,
    Side,
    Vector,
    read_document,
    read_hand_spec,
    typed,
)
from handmap_qp.hands.urdf import (
    parse_urdf,
    rename,
    root_links,
    set_mesh_paths,
    set_numbers,
)

_BASE = "robot_base"
"""Link that all hands stand on."""


class RobotHandSpec(Document, frozen=True):
    """One hand of a robot, with its arm.

    Attributes:
        hand: Name of a hand, or path of its `hand.yaml` from the folder of the `robot.yaml`.
        xyz: Origin of its URDF's root on the robot's base [m].
        rpy: Roll, pitch and yaw of the root there, as in a URDF [rad].
    """

    hand: str
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)


class RobotSpec(Document, frozen=True):
    """What a `robot.yaml` says: the hands that follow a person's left and right one.

    Attributes:
        name: Short name of the robot.
        hands: Its hands by their side.
        directory: Folder of the file, at which relative paths start.
    """

    name: str
    hands: Annotated[dict[Side, RobotHandSpec], Meta(min_length=1)]
    directory: Path


class Robot(NamedTuple):
    """A robot with its hands, in one model.

    Attributes:
        name: Short name of the robot.
        hands: Its hands by their side; each has all joints of the robot.
    """

    name: str
    hands: dict[Side, Hand]


def joined(hands: Sequence[Hand]) -> Hand:
    """Return the hands of one robot as one, which a QP moves; `Hand.parts` has them.

    Its palm and wrist are those of the first one, its reference points those of all, one hand after
    the other.
    """
    whole = copy(hands[0])
    whole.parts = tuple(hands)
    whole.use_points(tuple(p for hand in hands for p in hand.reference_points))
    return whole


def robot_files() -> dict[str, Path]:
    """Return the description of every robot of the package, by name."""
    files = sorted(urdf_directory().glob("*/robot.yaml"))
    return {file.parent.name: file for file in files}


def is_robot(name: str) -> bool:
    """Return whether a name or path is that of a robot, not of a hand."""
    return name in robot_files() or Path(name).name == "robot.yaml"


def load_robot(robot: str | Path) -> Robot:
    """Load a robot with its hands.

    Args:
        robot: Name of a robot (`robot_files()`), or path of a `robot.yaml`.

    Raises:
        HandError: If there is no such robot, or its description or that of a hand cannot be used.
        MissingExtraError: If a URDF lies in a package that is not installed.
    """
    file = find_file(robot, robot_files(), "robot")
    described = typed(read_document(file), RobotSpec, file)
    trees: dict[Any, list[HandSpec]] = {}
    for side, hand in sorted(described.hands.items()):
        spec = read_hand_spec(find_file(hand.hand, folder=described.directory))
        if spec.side != side:
            problem = f"{spec.name} is a {spec.side} hand"
            raise HandError(problem, file=file, key=f"hands.{side}", value=spec.name)
        # Hands on arms of their own share nothing.
        tree = (source_file(spec), spec.root) if spec.arm is None else side
        trees.setdefault((tree, hand.xyz, hand.rpy), []).append(spec)
    whole = Element("robot", name=described.name)
    SubElement(whole, "link", name=_BASE)
    parts: list[tuple[str, HandSpec]] = []
    rest: dict[str, float] = {}
    for (_, xyz, rpy), specs in trees.items():
        prefix = "" if len(trees) == 1 else f"{specs[0].side}_"
        parts += [(prefix, spec) for spec in specs]
        spec = reduce(_merged, specs)
        _stand(whole, spec, prefix, xyz, rpy)
        arm = {} if spec.arm is None else spec.arm.rest
        rest |= {f"{prefix}{joint}": at for joint, at in (arm | spec.rest).items()}
    text = tostring(whole, encoding="unicode")
    hands = {
        spec.side: Hand(
            _on_robot(spec, described.name, prefix, rest),
            mount="fixed",
            urdf_text=text,
        )
        for prefix, spec in parts
    }
    return Robot(described.name, hands)


def _merged(one: HandSpec, other: HandSpec) -> HandSpec:
    """Return the description of all joints that two hands of one URDF move."""
    rest = one.rest | other.rest
    locked = one.locked | other.locked
    return replace(
        one,
        joints=(*rest,),
        rest=rest,
        matched=None,
        locked={joint: at for joint, at in locked.items() if joint not in rest},
        limits=one.limits | other.limits,
        mimic=one.mimic | other.mimic,
    )


def _stand(
    robot: Element, spec: HandSpec, prefix: str, xyz: Vector, rpy: Vector
) -> None:
    """Add what a description composes to a robot's URDF, somewhere on its base."""
    text, *_ = compose_urdf(spec, read_urdf(spec))
    tree = parse_urdf(text)
    # The whole lies in no folder.
    set_mesh_paths(tree, urdf_path(spec).parent)
    rename(tree, prefix)
    mount = SubElement(robot, "joint", name=f"{prefix}{_BASE}", type="fixed")
    SubElement(mount, "parent", link=_BASE)
    SubElement(mount, "child", link=root_links(tree)[0])
    set_numbers(SubElement(mount, "origin"), xyz=xyz, rpy=rpy)
    robot.extend(list(tree))


def _on_robot(
    spec: HandSpec, name: str, prefix: str, rest: dict[str, float]
) -> HandSpec:
    """Return the description of a hand in the composed URDF of its robot."""

    def renamed(value: Any) -> Any:
        return replace(value, link=f"{prefix}{value.link}")

    matched = spec.matched
    if matched is not None:
        matched = rest | {f"{prefix}{joint}": at for joint, at in matched.items()}
    collision = spec.collision
    if collision is not None:
        pairs = tuple((f"{prefix}{a}", f"{prefix}{b}") for a, b in collision.pairs)
        collision = replace(collision, pairs=pairs)
    return replace(
        spec,
        name=f"{name}_{spec.side}",
        joints=(*rest,),
        rest=rest,
        matched=matched,
        palm=renamed(spec.palm),
        wrist=renamed(spec.wrist),
        points=tuple(map(renamed, spec.points)),
        collision=collision,
        mirror=False,
        root=None,
        arm=None,
        locked={},
        limits={},
        mimic={},
    )
