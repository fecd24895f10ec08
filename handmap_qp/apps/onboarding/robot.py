"""A URDF for onboarding: its model, its links' places and surfaces, and its limits.

A *body* is a set of links joined by fixed joints; its number is that of the joint that moves it, 0
for the root's. Limits and speeds that the URDF lacks are assumed and recorded, so that they can be
written to the `hand.yaml` for its owner to correct.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import cache, partial
from itertools import chain, compress
from pathlib import Path
from xml.etree.ElementTree import Element, tostring

import numpy as np

from handmap_core.errors import HandError, reason_of
from handmap_core.se3 import Array, box_of, inverse_pose, lengths, transform_points
from handmap_qp.apps.drawing import shape_meshes
from handmap_qp.hands import (
    MOVABLE,
    NO_LIMIT,
    USUAL_SPEEDS,
    Hand,
    HandSpec,
    HeldReason,
    Interval,
    LimitSpec,
    MimicSpec,
    PalmSpec,
    PointSpec,
    WristSpec,
    check_tree,
    child_of,
    clipped_rule,
    cut_subtree,
    edges,
    fix_free_joints,
    held_joints,
    is_lfs_pointer,
    joints_by_name,
    mimics_of,
    parse_urdf,
    resolve_rule,
    root_links,
)
from handmap_qp.trackers import first_of

# Assumed ranges [rad or m] of joints without limits in the URDF.
_ASSUMED_RANGE = {
    "revolute": (-math.pi / 2, math.pi / 2),
    "continuous": (-math.pi, math.pi),
    "prismatic": (0.0, 0.04),
}
# A larger range is in degrees; joints of arms turn twice [rad].
_LARGEST_TURN = 4.0 * math.pi + 0.01
# Shapes of one body are not farther apart than this [m].
_STRAY = 0.02
# Most names in one note.
_MOST_NAMES = 12
# Most surface points kept of one mesh.
_MOST_POINTS = 3000


def carriers(parents: Mapping[str, str], link: str) -> Iterator[str]:
    """Yield a link and all that carry it, up to the root.

    Args:
        parents: Parent of each link but the root.
        link: The link.
    """
    yield link
    while link in parents:
        link = parents[link]
        yield link


class Robot(Hand):
    """A robot, or a part of one, in which a hand is looked for.

    Its palm is its root until one is found, and it rests at zero, clipped to its limits. Its spec
    has the limits that the URDF lacks, and drops the rules whose leader is outside this part of it:
    those joints are treated as independent.

    Args:
        file: The URDF's file, for messages and mesh paths.
        text: The URDF; that of the file if omitted.
        root: Link to start at; the URDF's own root if omitted.

    Attributes:
        file: The URDF's file.
        root: Link that it starts at.
        is_whole: Whether `root` is the root of the URDF.
        links: Links of each body, its first one first.
        surface: Points of a body's visuals, else of its collision shapes, by its number, in its
            frame [m], shape (k, 3); a `HandError` if a shape lacks its numbers.
        bodies: Bodies that a joint moves, in the order of the file.
        elements: The URDF's element of each link.
        parents: The link that carries each link but the root.
        endless: Names of the joints of type `continuous` in the file.

    Raises:
        HandError: If the URDF cannot be used, in one line.
    """

    def __init__(
        self,
        file: Path,
        text: str | bytes | None = None,
        *,
        root: str | None = None,
    ) -> None:
        self.file = file
        self._remarks = dict[str, dict[str, None]]()
        self.surface = cache(self._surface)
        try:
            robot = parse_urdf(_read(file, text))
            check_tree(robot)
            self.is_whole = root in (None, *root_links(robot))
            if root is not None:
                cut_subtree(robot, root)
            spec = self._provisional(robot)
            super().__init__(spec, urdf_text=tostring(robot, encoding="unicode"))
        except HandError as error:
            error.file = file
            raise
        robot = parse_urdf(self.urdf_text)
        self.elements = {link.get("name", ""): link for link in robot.iterfind("link")}
        self.parents = {child: parent for _, parent, child in edges(robot)}
        self.bodies = [*map(self.model.getJointId, joints_by_name(robot, MOVABLE))]
        self.links = [
            [link for link, frame in self.frames.items() if frame.parentJoint == body]
            for body in range(self.model.njoints)
        ]

    def _provisional(self, robot: Element) -> HandSpec:
        """Describe the robot as a hand whose palm is the root, and complete rules and limits."""
        (self.root,) = root_links(robot)
        for name in fix_free_joints(robot):
            self._remark(name, "has more than one coordinate: it is taken as fixed")
        joints = joints_by_name(robot, MOVABLE)
        rules = mimics_of(robot)
        # What is coupled is no wheel: its file only lacks the limits.
        coupled = {*rules, *(rule.joint for rule in rules.values())}
        self.endless = {*joints_by_name(robot, ["continuous"])} - coupled
        lost = [n for n in joints if n in rules and rules[n].joint not in joints]
        for name in lost:
            self._remark(
                f"{name} (mimics {rules[name].joint})",
                "has a leader that is missing or fixed here: taken as independent; couple what "
                "belongs together under `mimic` in the hand.yaml",
            )
        followers = rules.keys() - lost
        self._held = held_joints(robot)
        limits, locked = self._assume_limits(joints, followers)
        kept = {name: rules[name] for name in joints if name in followers}
        bent = self._rules_within_limits(joints, kept, limits)
        still = followers | locked.keys()
        active = tuple(name for name in joints if name not in still)
        if not active:
            problem = f"no movable joint hangs from the link {self.root!r}"
            advice = _locked_advice(locked, self._held)
            raise self.error(problem + advice, self.root)
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
            locked=locked,
            limits=limits,
            mimic={**dict.fromkeys(lost), **bent},
        )

    def _take_postures(self) -> None:
        self.rest = self.zero

    @property
    def remarks(self) -> list[str]:
        """Assumptions, one sentence each; those about several joints in one."""
        found = []
        for what, subjects in self._remarks.items():
            each = f" ({len(subjects)}): each" * (len(subjects) > 1)
            found.append(f"{first_of([*subjects], _MOST_NAMES)}{each} {what}")
        return [*found, *self.notes]

    @property
    def locked_advice(self) -> str:
        """What to do about joints with equal limits; empty if there are none."""
        return _locked_advice(self.spec.locked, self._held)

    def error(self, problem: str, value: object = None) -> HandError:
        """Return an error about the robot, with its file."""
        return HandError(problem, file=self.file, value=value)

    def _remark(self, subject: str, what: str) -> None:
        self._remarks.setdefault(what, {})[subject] = None

    # -- structure

    def below(self, body: int) -> list[int]:
        """Return the bodies that hang from a body, in the order of the file."""
        return [joint for joint in self.bodies if self.model.parents[joint] == body]

    def leaves(self, body: int) -> list[int]:
        """Return the last bodies of all branches of a body; the body itself if it has none."""
        leaves = map(self.leaves, self.below(body))
        return [*chain.from_iterable(leaves)] or [body]

    # -- kinematics

    def positions(self, q: Array) -> dict[str, float]:
        """Return the positions of all joints but followers by name [rad or m]."""
        values = self.all_joints(q)
        every = zip(self.all_joint_names, self.all_joint_roles, values, strict=True)
        return {name: at for name, role, at in every if role != "follower"}

    def pose_in(self, link: str, other: str, q: Array | None = None) -> Array:
        """Return a link's pose in another link's frame, at rest if q is omitted, (4, 4)."""
        frame, pose = self.link_poses([other, link], self.rest if q is None else q)
        return inverse_pose(frame) @ pose

    # -- surface

    def palm_surface(self) -> Array:
        """Return points of the surface of the palm's body in the palm link's frame [m], (k, 3)."""
        palm = self.palm_frame
        cloud = self.surface(palm.parentJoint)
        if not len(cloud):
            return cloud
        return transform_points(palm.placement.inverse().homogeneous, cloud)

    def _surface(self, body: int) -> Array:
        """Read what `surface` keeps: the shapes that hang together with the joint's nearest one."""
        clouds = []
        for link in self.links[body]:
            placement = self.frames[link].placement.homogeneous
            points = self.clouds(link, "visual") or self.clouds(link, "collision")
            clouds += [transform_points(placement, cloud) for cloud in points]
        if not clouds:
            return np.zeros((0, 3))
        # A mesh far from all others is misplaced, and no part of its body.
        boxes = np.array([*map(box_of, clouds)])
        gaps = (boxes[:, None, 0] - boxes[:, 1]).max(axis=-1)
        near = np.maximum(gaps, gaps.T) < _STRAY
        first = np.argmin([lengths(cloud).min() for cloud in clouds])
        is_joined = np.linalg.matrix_power(near, len(clouds))[first]
        return np.concatenate([*compress(clouds, is_joined)])

    def clouds(self, link: str, kind: str) -> list[Array]:
        """Return points of each shape of a link in its frame, at most some of each mesh."""
        return [
            np.array(mesh.vertices[:: max(1, len(mesh.vertices) // _MOST_POINTS)])
            for shape in self.elements[link].iterfind(kind)
            for mesh in shape_meshes(shape, partial(self._miss, shape))
        ]

    def _miss(self, shape: Element, name: str) -> None:
        """Remark that the mesh of a shape cannot be read."""
        files = [Path(mesh.get("filename", "")) for mesh in shape.iter("mesh")]
        what = "is a lost mesh: a simple shape stands for it"
        if any(map(is_lfs_pointer, files)):
            what = (
                "is a pointer of git-lfs in place of a mesh: run `git lfs pull` in its repository; "
                "a simple shape stands for it"
            )
        self._remark(name, what)

    # -- assumptions

    def _rules_within_limits(
        self,
        joints: dict[str, Element],
        rules: dict[str, MimicSpec],
        limits: dict[str, LimitSpec],
    ) -> dict[str, MimicSpec]:
        """Return other rules of followers whose limits would leave a leader too little range.

        Those whose limits contradict the rule in all of that range keep it: a sign is wrong.

        Args:
            joints: Elements of movable joints, by their names.
            rules: Rules by follower, whose leaders are among these joints.
            limits: Limits in place of those of the URDF.
        """
        found = dict[str, MimicSpec]()
        for name in rules:
            rule = resolve_rule(name, rules)
            own = _range_of(joints[name], None)
            leader = _range_of(joints[rule.joint], limits.get(rule.joint))
            if other := clipped_rule(rule, own, leader):
                found[name] = other
                self._remark(
                    name,
                    "is at a limit of its own in most of its leader's range: so that the leader "
                    "keeps its range, it follows on a line between both ends, under `mimic`",
                )
        return found

    def _assume_limits(
        self, joints: dict[str, Element], followers: set[str]
    ) -> tuple[dict[str, LimitSpec], dict[str, float]]:
        """Assume limits that are missing or wrong, and lock joints with equal ones; by joint."""
        given = {name: _limits(joint) for name, joint in joints.items()}
        turns = [
            high - low
            for kind, low, high, _ in given.values()
            if kind == "revolute" and math.isfinite(high - low)
        ]
        in_degrees = bool(np.median(turns or 0.0) > _LARGEST_TURN)
        limits = dict[str, LimitSpec]()
        locked = dict[str, float]()
        for name, (kind, low, high, given_speed) in given.items():
            if name in followers:
                continue
            if low == high:
                locked[name] = round(low, 6)
                what = "has equal limits: it is locked"
                reason = self._held.get(name)
                # A note of the conversion names all joints of a loop at once.
                if reason and reason.kind != "loop":
                    what = f"{reason.held_at(low)}; {reason.next_step}"
                self._remark(name, what)
                continue
            ends, what = _assumed_range(kind, low, high, in_degrees=in_degrees)
            if what:
                self._remark(name, what)
            speed = None
            if not given_speed:
                usual = [each for of, *_, each in given.values() if each and of == kind]
                speed = np.median(usual or USUAL_SPEEDS[kind])
                self._remark(
                    name, f"has no speed limit in the URDF: {speed:.4g} is assumed"
                )
            if speed or ends:
                limits[name] = LimitSpec(*ends, velocity=speed)
        return limits, locked


def _range_of(joint: Element, limit: LimitSpec | None) -> Interval:
    """Return a joint's limits, those of the description before those of the URDF."""
    _, low, high, _ = _limits(joint)
    if limit and limit.lower is not None and limit.upper is not None:
        low, high = limit.lower, limit.upper
    return Interval(low, high)


def _locked_advice(locked: Mapping[str, float], held: Mapping[str, HeldReason]) -> str:
    """Return what to do about joints that do not move because their limits are equal."""
    plain = [name for name in locked if name not in held]
    advice = ""
    if plain:
        names = first_of(plain, _MOST_NAMES)
        advice = f"; the limits of {names} are equal: give lower < upper in the file"
    for name in [name for name in locked if name in held][:1]:
        advice += f"; {name} {held[name].held_at(locked[name])}"
    return advice


def _read(file: Path, text: str | bytes | None) -> str | bytes:
    try:
        return text or file.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        raise HandError(f"cannot be read: {reason_of(error)}", file=file) from error


def _limits(joint: Element) -> tuple[str, float, float, float]:
    """Return a joint's type, its limits, NaN without any, and its speed, 0 without one."""
    kind = joint.get("type", "")
    given = child_of(joint, "limit").attrib
    lower, upper, speed = (
        float(given.get(key, 0.0)) for key in ("lower", "upper", "velocity")
    )
    if kind == "continuous" or not {"lower", "upper"} & given.keys():
        lower = upper = math.nan
    return kind, lower, upper, speed if 0.0 < speed < math.inf else 0.0


def _assumed_range(
    kind: str, lower: float, upper: float, *, in_degrees: bool
) -> tuple[tuple[float, ...], str]:
    """Return a range in place of the URDF's if need be, and a remark if that is suspicious."""
    if not max(abs(lower), abs(upper)) < NO_LIMIT:
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
        return (), what * is_wide
    return ends, f"{what}: [{ends[0]:.4g}, {ends[1]:.4g}] is assumed"
