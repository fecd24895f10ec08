"""A URDF for onboarding: its model, its links' places and surfaces, and its limits.

A *body* is a set of links joined by fixed joints; its number is that of the joint that moves it, 0
for the root's. Limits and speeds that the URDF lacks are assumed and recorded, so that they can be
written to the `hand.yaml` for its owner to correct.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, tostring

import numpy as np
import pinocchio as pin

from handmap_qp.apps.drawing import shape_meshes
from handmap_qp.errors import HandError, reason_of
from handmap_qp.hands import (
    MOVABLE,
    LimitSpec,
    MimicSpec,
    Place,
    check_tree,
    child_of,
    cut_subtree,
    edges,
    expansion_matrix,
    fix_free_joints,
    joints_by_name,
    mimics_of,
    origin_of,
    parse_urdf,
    prepare_urdf,
    read_mimic_rules,
    root_links,
    tighten_model,
    zero_posture,
)
from handmap_qp.se3 import Array, transform_points

# Assumed ranges [rad or m] and speeds [per s] of joints without limits in the URDF.
_ASSUMED_RANGE = {
    "revolute": (-math.pi / 2, math.pi / 2),
    "continuous": (-math.pi, math.pi),
    "prismatic": (0.0, 0.04),
}
_ASSUMED_SPEED = {"revolute": 5.0, "continuous": 5.0, "prismatic": 0.1}
# A larger range is in degrees; joints of arms turn twice [rad].
_LARGEST_TURN = 4.0 * math.pi + 0.01
# Most names in one note.
_MOST_NAMES = 12
# Most surface points kept of one mesh.
_MOST_POINTS = 3000


class Robot:
    """A robot, or a part of one, prepared for detection.

    Args:
        text: The URDF.
        file: The URDF's file, for messages and mesh paths.
        root: Link to start at; the URDF's own root if omitted.

    Attributes:
        file: The URDF's file.
        name: The robot's name.
        root: Link that it starts at.
        is_whole: Whether `root` is the root of the URDF.
        model: Pinocchio model of the movable joints, which sorts them by name.
        frames: Frame of the model for each link.
        links: Links of each body, its first one first.
        surface: Points of a body's visuals, else of its collision shapes, by its number, in its
            frame [m], shape (k, 3); a `HandError` if a shape lacks its numbers.
        palm_frame_id: Frame of the palm's link, once it is found; before that, of the world.
        joints: Movable joints of the model, in the order of the file.
        active: Names of the n joints that are not mimic joints, in the order of the file.
        lower_limits: Their lower limits, narrowed by mimic joints [rad or m], shape (n,).
        upper_limits: Their upper limits, shape (n,).
        zero: Zero clipped to the limits [rad or m], shape (n,).
        endless: Names of the joints of type `continuous` in the file.
        assumed: Limits that the URDF lacks, by joint.
        locked: Positions of joints that are locked [rad or m].
        dropped_rules: Mimic rules whose leader is not in this part of the robot; these joints are
            treated as independent.

    Raises:
        HandError: If the URDF cannot be used, in one line.
    """

    def __init__(
        self,
        text: str | bytes,
        file: Path,
        *,
        root: str | None = None,
    ) -> None:
        self.file = file
        self._remarks = dict[str, list[str]]()
        self.surface = cache(self._surface)
        try:
            robot = parse_urdf(text)
            check_tree(robot)
            self.is_whole = root is None or root_links(robot) == [root]
            if root is not None:
                cut_subtree(robot, root)
            self._read(robot)
        except HandError as error:
            error.file = file
            raise

    def _read(self, robot: Element) -> None:
        """Complete the limits, and build the model."""
        (self.root,) = root_links(robot)
        self.name = robot.get("name") or self.file.stem
        for name in fix_free_joints(robot):
            self._remark(name, "has more than one coordinate: it is taken as fixed")
        given = {
            name: _limits(joint)
            for name, joint in joints_by_name(robot, MOVABLE).items()
        }
        self.endless = {n for n, one in given.items() if one.kind == "continuous"}
        rules = mimics_of(robot)
        leaders = {name: rules[name].joint for name in given if name in rules}
        lost = {n: leader for n, leader in leaders.items() if leader not in given}
        self.dropped_rules = dict.fromkeys(lost)
        for name, leader in lost.items():
            self._remark(
                f"{name} (mimics {leader})",
                "has a leader that is missing or fixed here: taken as independent; couple what "
                "belongs together under `mimic` in the hand.yaml",
            )
        equal = self._assume_limits(given, leaders.keys() - lost)
        self.locked = prepare_urdf(robot, None, self.dropped_rules, equal, self.assumed)
        movable = [name for name in given if name not in self.locked]
        if not movable:
            problem = f"no movable joint hangs from the link {self.root!r}"
            raise HandError(problem, value=self.root)
        self._rules = read_mimic_rules(robot)
        self.active = [name for name in movable if name not in self._rules]
        self._elements = {link.get("name", ""): link for link in robot.iterfind("link")}
        self._parents = {child: parent for _, parent, child in edges(robot)}
        self._build(tostring(robot, encoding="unicode"))
        self.joints = [self.model.getJointId(name) for name in movable]

    def _build(self, text: str) -> None:
        """Build the model, and place it at zero."""
        try:
            self.model = model = pin.buildModelFromXML(text)
        except (RuntimeError, ValueError) as error:
            problem = f"Pinocchio cannot read the URDF: {reason_of(error)}"
            raise HandError(problem) from error
        for note in tighten_model(model, self._rules):
            self._remark("", note)
        names = list(model.names)[1:]
        self.expansion = expansion_matrix(names, self.active, self._rules)
        self.joint_columns = np.arange(len(self.active))
        at = [names.index(name) for name in self.active]
        self.lower_limits = model.lowerPositionLimit[at]
        self.upper_limits = model.upperPositionLimit[at]
        self.zero = zero_posture(self)
        self.palm_frame_id = 0
        bodies = [f for f in model.frames if f.type == pin.FrameType.BODY]
        self.frames = {frame.name: frame for frame in bodies}
        self.links = [
            [frame.name for frame in bodies if frame.parentJoint == body]
            for body in range(model.njoints)
        ]
        self._data = model.createData()
        vector = self.configuration_vector(self.zero)
        pin.framesForwardKinematics(model, self._data, vector)

    @property
    def notes(self) -> list[str]:
        """Assumptions, one sentence each; those about several joints in one."""
        found = []
        for what, subjects in self._remarks.items():
            shown = ", ".join(subjects[:_MOST_NAMES])
            if len(subjects) > _MOST_NAMES:
                shown += f" and {len(subjects) - _MOST_NAMES} more"
            shown += ": each" * (len(subjects) > 1)
            found.append(f"{shown} {what}".strip())
        return found

    def _remark(self, subject: str, what: str) -> None:
        self._remarks.setdefault(what, []).append(subject)

    # -- structure

    def body(self, link: str) -> int:
        """Return the body of a link."""
        return self.frames[link].parentJoint

    def path(self, body: int, above: int) -> list[int]:
        """Return the joints from below a body `above` out to a body."""
        return [*self.model.supports[body]][len(self.model.supports[above]) :]

    def leaves(self, body: int) -> list[int]:
        """Return the last bodies of all branches of a body; the body itself if it has none."""
        below = [j for j in self.joints if self.model.parents[j] == body]
        return [leaf for j in below for leaf in self.leaves(j)] or [body]

    def ends(self, body: int) -> list[str]:
        """Return the links of a body, but its first one, that carry no other link."""
        inner = {*self._parents.values()}
        return [link for link in self.links[body][1:] if link not in inner]

    def carriers(self, joint: int) -> list[str]:
        """Return the links of a body out to the one that carries a joint."""
        body = self.links[self.model.parents[joint]]
        link = self._parents[self.links[joint][0]]
        passed = [link]
        while (link := self._parents.get(link, "")) in body:
            passed.insert(0, link)
        return passed

    def driver(self, joint: str) -> str:
        """Return the active joint that moves a joint: itself, or its mimic leader."""
        return self._rules.get(joint, MimicSpec(joint)).joint

    # -- kinematics

    def configuration_vector(self, q: Array) -> Array:
        """Return Pinocchio's configuration at positions of the active joints, shape (n,)."""
        return self.expansion.all_joints(q)

    def place_of(self, link: str, xyz: Array) -> Place:
        """Return a point on a link as one on a joint of the model."""
        frame = self.frames[link]
        return frame.parentJoint, frame.placement.act(xyz)

    def pose_in(self, link: str, other: str) -> Array:
        """Return a link's pose in another link's frame at `zero`, shape (4, 4)."""
        pose, frame = (self._data.oMf[self.model.getBodyId(n)] for n in (link, other))
        return frame.actInv(pose).homogeneous

    # -- surface

    def has_collision_shapes(self, body: int) -> bool:
        """Return whether a link of a body has a collision shape."""
        return any(
            self._elements[link].find("collision") is not None
            for link in self.links[body]
        )

    def balls(self, body: int) -> Array:
        """Return the centres of a body's spheres in its frame [m], shape (k, 3)."""
        found = [
            self.place_of(link, origin_of(shape)[:3, 3])[1]
            for link in self.links[body]
            for shape in self._elements[link]
            if shape.find("geometry/sphere") is not None
        ]
        return np.array(found).reshape(-1, 3)

    def _surface(self, body: int) -> Array:
        """Read what `surface` keeps."""
        clouds = [np.zeros((0, 3))]
        for link in self.links[body]:
            placement = self.frames[link].placement.homogeneous
            points = self._points(link, "visual") or self._points(link, "collision")
            clouds += [transform_points(placement, cloud) for cloud in points]
        return np.concatenate(clouds)

    def _points(self, link: str, kind: str) -> list[Array]:
        """Return points of each shape of a link in its frame, at most some of each mesh."""
        miss = partial(self._remark, what="is a mesh that cannot be read")
        return [
            np.array(mesh.vertices[:: max(1, len(mesh.vertices) // _MOST_POINTS)])
            for shape in self._elements[link].iterfind(kind)
            for mesh in shape_meshes(shape, self.file.parent, miss)
        ]

    # -- assumptions

    def _assume_limits(
        self, given: Mapping[str, _Limits], followers: Collection[str]
    ) -> dict[str, float]:
        """Assume limits that are missing or wrong; return positions of joints with equal ones."""
        turns = [
            one.upper - one.lower for one in given.values() if one.kind == "revolute"
        ]
        in_degrees = bool(turns and np.nanmedian(turns) > _LARGEST_TURN)
        self.assumed = dict[str, LimitSpec]()
        equal = dict[str, float]()
        for name, one in given.items():
            if name in followers:
                continue
            if one.lower == one.upper:
                equal[name] = one.lower
                self._remark(name, "has equal limits: it is locked")
                continue
            ends, what = _assumed_range(one, in_degrees=in_degrees)
            if what:
                self._remark(name, what)
            speed = None
            if math.isnan(one.speed):
                usual = [
                    other.speed
                    for other in given.values()
                    if other.kind == one.kind and other.speed > 0.0
                ]
                speed = float(np.median(usual or _ASSUMED_SPEED[one.kind]))
                self._remark(
                    name, f"has no speed limit in the URDF: {speed:.4g} is assumed"
                )
            if speed or None not in ends:
                self.assumed[name] = LimitSpec(*ends, speed)
        return equal


class _Limits(NamedTuple):
    """The type of a joint, its limits and its speed; NaN where it has none."""

    kind: str
    lower: float
    upper: float
    speed: float


def _limits(joint: Element) -> _Limits:
    """Return the limits that a joint has in the URDF."""
    kind = joint.get("type", "")
    given = child_of(joint, "limit").attrib
    lower, upper, speed = (
        float(given.get(key, 0.0)) for key in ("lower", "upper", "velocity")
    )
    if kind == "continuous" or not {"lower", "upper"} & given.keys():
        lower = upper = math.nan
    return _Limits(kind, lower, upper, speed if 0.0 < speed < math.inf else math.nan)


def _assumed_range(
    given: _Limits, *, in_degrees: bool
) -> tuple[tuple[float | None, float | None], str]:
    """Return a range in place of that of the URDF, and a remark if it is wrong or suspicious."""
    kind, lower, upper, _ = given
    if not math.isfinite(upper - lower):
        ends = _ASSUMED_RANGE[kind]
        what = "is continuous" if kind == "continuous" else "has no limits in the URDF"
    elif lower > upper:
        ends = (upper, lower)
        what = "has its limits swapped"
    elif kind == "revolute" and in_degrees:
        ends = math.radians(lower), math.radians(upper)
        return ends, "has limits in degrees, as it seems: written in radians"
    else:
        is_wide = kind == "revolute" and upper - lower > _LARGEST_TURN
        what = "has a range of more than two turns: is it in degrees?"
        return (None, None), what * is_wide
    return ends, f"{what}: [{ends[0]:.4g}, {ends[1]:.4g}] is assumed"
