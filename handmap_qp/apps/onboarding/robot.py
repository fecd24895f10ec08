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
from handmap_qp.errors import HandError
from handmap_qp.hands import (
    MOVABLE,
    Hand,
    HandSpec,
    LimitSpec,
    PalmSpec,
    PointSpec,
    WristSpec,
    check_tree,
    child_of,
    cut_subtree,
    edges,
    fix_free_joints,
    joints_by_name,
    mimics_of,
    parse_urdf,
    prepare_urdf,
    read_mimic_rules,
    root_links,
    zero_posture,
)
from handmap_qp.se3 import Array, inverse_pose, transform_points

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


class Robot(Hand):
    """A robot, or a part of one, in which a hand is looked for.

    Its palm is its root until one is found, and it rests at zero, clipped to its limits.

    Args:
        text: The URDF.
        file: The URDF's file, for messages and mesh paths.
        root: Link to start at; the URDF's own root if omitted.

    Attributes:
        file: The URDF's file.
        root: Link that it starts at.
        is_whole: Whether `root` is the root of the URDF.
        frames: Frame of the model for each link.
        links: Links of each body, its first one first.
        surface: Points of a body's visuals, else of its collision shapes, by its number, in its
            frame [m], shape (k, 3); a `HandError` if a shape lacks its numbers.
        joints: Movable joints of the model, in the order of the file.
        rules: Rules of those that follow another one, by name.
        elements: The URDF's element of each link.
        parents: The link that carries each link but the root.
        endless: Names of the joints of type `continuous` in the file.
        assumed: Limits that the URDF lacks, by joint.
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
            self.is_whole = root in (None, *root_links(robot))
            if root is not None:
                cut_subtree(robot, root)
            movable = self._complete(robot)
            spec = self._provisional(robot, movable)
            super().__init__(spec, urdf_text=tostring(robot, encoding="unicode"))
        except HandError as error:
            error.file = file
            raise
        self.joints = [self.model.getJointId(name) for name in movable]
        bodies = [f for f in self.model.frames if f.type == pin.FrameType.BODY]
        self.frames = {frame.name: frame for frame in bodies}
        self.links = [
            [frame.name for frame in bodies if frame.parentJoint == body]
            for body in range(self.model.njoints)
        ]

    def _complete(self, robot: Element) -> list[str]:
        """Complete rules and limits in a URDF; return its movable joints, in its order."""
        for name in fix_free_joints(robot):
            self._remark(name, "has more than one coordinate: it is taken as fixed")
        given = {
            name: _limits(joint)
            for name, joint in joints_by_name(robot, MOVABLE).items()
        }
        self.endless = {n for n, one in given.items() if one.kind == "continuous"}
        rules = {n: rule for n, rule in mimics_of(robot).items() if n in given}
        lost = [n for n, rule in rules.items() if rule.joint not in given]
        self.dropped_rules = dict.fromkeys(lost)
        for name in lost:
            self._remark(
                f"{name} (mimics {rules[name].joint})",
                "has a leader that is missing or fixed here: taken as independent; couple what "
                "belongs together under `mimic` in the hand.yaml",
            )
        equal = self._assume_limits(given, rules.keys() - lost)
        locked = prepare_urdf(robot, None, self.dropped_rules, equal, self.assumed)
        self._locked_at = {name: round(at, 6) for name, at in locked.items()}
        return [name for name in given if name not in locked]

    def _provisional(self, robot: Element, movable: list[str]) -> HandSpec:
        """Describe the robot as a hand whose palm is the root."""
        (self.root,) = root_links(robot)
        if not movable:
            problem = f"no movable joint hangs from the link {self.root!r}"
            raise self.error(problem, self.root)
        self.rules = read_mimic_rules(robot)
        self.elements = {link.get("name", ""): link for link in robot.iterfind("link")}
        self.parents = {child: parent for _, parent, child in edges(robot)}
        active = tuple(name for name in movable if name not in self.rules)
        return HandSpec(
            name=robot.get("name") or self.file.stem,
            urdf=str(self.file),
            side="right",
            palm=PalmSpec(self.root, (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
            wrist=WristSpec(self.root, "fixed"),
            joints=active,
            rest=dict.fromkeys(active, 0.0),
            points=(PointSpec("root", self.root),),
            sets={"root": ("root",)},
            reference="root",
        )

    def _take_postures(self) -> None:
        self.rest = zero_posture(self)

    @property
    def remarks(self) -> list[str]:
        """Assumptions, one sentence each; those about several joints in one."""
        found = []
        for what, subjects in self._remarks.items():
            shown = ", ".join(subjects[:_MOST_NAMES])
            if len(subjects) > _MOST_NAMES:
                shown += f" and {len(subjects) - _MOST_NAMES} more"
            shown += ": each" * (len(subjects) > 1)
            found.append(f"{shown} {what}")
        return [*found, *self.notes]

    def error(self, problem: str, value: object = None) -> HandError:
        """Return an error about the robot, with its file."""
        return HandError(problem, file=self.file, value=value)

    def _remark(self, subject: str, what: str) -> None:
        self._remarks.setdefault(what, []).append(subject)

    # -- structure

    def leaves(self, body: int) -> list[int]:
        """Return the last bodies of all branches of a body; the body itself if it has none."""
        below = [j for j in self.joints if self.model.parents[j] == body]
        return [leaf for j in below for leaf in self.leaves(j)] or [body]

    # -- kinematics

    def positions(self, q: Array) -> dict[str, float]:
        """Return the positions of all joints by name, also of locked ones [rad or m]."""
        return self._locked_at | dict(zip(self.joint_names, q.tolist(), strict=True))

    def pose_in(self, link: str, other: str, q: Array | None = None) -> Array:
        """Return a link's pose in another link's frame, at rest if q is omitted, (4, 4)."""
        frame, pose = self.link_poses([other, link], self.rest if q is None else q)
        return inverse_pose(frame) @ pose

    # -- surface

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
            for shape in self.elements[link].iterfind(kind)
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
