"""A URDF for onboarding: links, bodies, active joints, forward kinematics and surface points.

A *body* is a set of links joined by fixed joints. Limits and speeds that the URDF lacks are assumed
and recorded, so that they can be written to the `hand.yaml` for its owner to correct.
"""

from __future__ import annotations

import itertools
import math
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError
from handmap_qp.hands.fingers import Place
from handmap_qp.hands.mimic import expansion_matrix, read_mimic_rules, tighten_model
from handmap_qp.hands.sources import find_mesh
from handmap_qp.hands.spec import LimitSpec, MimicSpec
from handmap_qp.hands.urdf import (
    MOVABLE,
    axis_of,
    check_tree,
    cut_subtree,
    edges,
    fix_free_joints,
    get_numbers,
    joints_by_name,
    link_names,
    origin_of,
    parse_urdf,
    prepare_urdf,
    root_links,
)
from handmap_qp.se3 import transform_points

# Assumed ranges [rad or m] and speeds [per s] of joints without limits in the URDF.
_ASSUMED_RANGE = {
    "revolute": (-math.pi / 2, math.pi / 2),
    "continuous": (-math.pi, math.pi),
    "prismatic": (0.0, 0.04),
}
_ASSUMED_SPEED = {"revolute": 5.0, "continuous": 5.0, "prismatic": 0.1}
# A larger range is in degrees; joints of arms turn twice [rad].
_LARGEST_TURN = 4.0 * math.pi + 0.01
# Corners of a box of size 1.
_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
_NONE = np.zeros((0, 3))
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
        links: Names of all links, in the order of the file.
        parent: Parent joint of each link, and that joint's parent link.
        children: Child joints of each link, each with its child link.
        kinds: Type of each joint: `revolute`, `prismatic` or `fixed`.
        axes: Axis of each movable joint in its child link's frame, a unit vector.
        balls: Centres of each link's spheres, in its frame [m], shape (k, 3).
        model: Pinocchio model of the movable joints.
        carried: First link of the body on each joint of the model.
        active: The n joints that are neither fixed nor mimic joints, in the order of the file.
        lower_limits: Their lower limits, narrowed by mimic joints [rad or m], shape (n,).
        upper_limits: Their upper limits, shape (n,).
        zero: Zero clipped to the limits [rad or m], shape (n,).
        slides: Which of them are prismatic, shape (n,).
        endless: Joints of type `continuous` in the file.
        assumed: Limits that the URDF lacks, by joint.
        locked: Positions of joints that are locked [rad or m].
        dropped_rules: Mimic rules whose leader is not in this part of the robot; these joints are
            treated as independent.

    Raises:
        HandError: If the URDF cannot be used, in one line.
    """

    def __init__(
        self, text: str | bytes, file: Path, *, root: str | None = None
    ) -> None:
        self.file = file
        self._remarks: dict[str, list[str]] = {}
        try:
            robot = parse_urdf(text)
            check_tree(robot)
            self.is_whole = root is None or root_links(robot) == [root]
            if root is not None:
                cut_subtree(robot, root)
            if not any(
                joint.get("type") in MOVABLE for joint in robot.iterfind("joint")
            ):
                raise HandError(
                    f"no movable joint hangs from the link {root!r}", value=root
                )
            self.name = robot.get("name", "") or file.stem
            joints = joints_by_name(robot)
            self.endless = {
                name for name in joints if joints[name].get("type") == "continuous"
            }
            for name in fix_free_joints(robot):
                self._remark(name, "has more than one coordinate: it is taken as fixed")
            self.dropped_rules = self._drop_rules(joints)
            self.assumed = self._assume_limits(robot)
            self.locked = prepare_urdf(
                robot, None, {}, self._immovable(robot), self.assumed
            )
            self._follow = {rule.follower: rule for rule in read_mimic_rules(robot)}
            self._read(robot)
        except HandError as error:
            raise HandError(
                error.problem, file=file, key=error.key, value=error.value
            ) from error
        for note in tighten_model(self.model, self._follow.values()):
            self._remark("", note)
        names = list(self.model.names)[1:]
        self.expansion = expansion_matrix(names, self.active, self._follow.values())
        self.joint_columns = np.arange(len(self.active))
        at = [names.index(name) for name in self.active]
        self.lower_limits = self.model.lowerPositionLimit[at]
        self.upper_limits = self.model.upperPositionLimit[at]
        self.zero = np.clip(0.0, self.lower_limits, self.upper_limits)
        self.slides = np.array(
            [self.kinds[name] == "prismatic" for name in self.active]
        )
        self.palm_frame_id = 0
        try:
            self._data = self.model.createData()
        except MemoryError as error:
            problem = f"its {len(names)} movable joints need more memory than there is"
            advice = "name the link at which the hand begins by --root"
            raise HandError(f"{problem}: {advice}", file=self.file) from error
        self.place(self.zero)

    def _read(self, robot: ET.Element) -> None:
        """Read links and joints, and build the model."""
        (self.root,) = root_links(robot)
        self.links, self._surfaces = link_names(robot), dict[str, np.ndarray]()
        self._elements = {link.get("name", ""): link for link in robot.iterfind("link")}
        self.balls = {
            name: np.array(
                [
                    origin_of(shape)[:3, 3]
                    for shape in (*link.iterfind("visual"), *link.iterfind("collision"))
                    if shape.find("geometry/sphere") is not None
                ]
            ).reshape(-1, 3)
            for name, link in self._elements.items()
        }
        joints = joints_by_name(robot)
        self.kinds = {name: joint.get("type", "") for name, joint in joints.items()}
        movable = [name for name, kind in self.kinds.items() if kind in MOVABLE]
        self.axes = {name: axis_of(joints[name]) for name in movable}
        self.active = [name for name in movable if name not in self._follow]
        self.parent: dict[str, tuple[str, str]] = {}
        self.children: dict[str, list[tuple[str, str]]] = {
            link: [] for link in self.links
        }
        for joint, parent, child in edges(robot):
            self.parent[child] = (joint.get("name", ""), parent)
            self.children[parent].append((joint.get("name", ""), child))
        try:
            self.model = pin.buildModelFromXML(ET.tostring(robot, encoding="unicode"))
        except (RuntimeError, ValueError) as error:
            problem = f"Pinocchio cannot read the URDF: {' '.join(str(error).split())}"
            raise HandError(problem) from error
        # Copies: a placement is a view into frames that move when one is added.
        self._placed_on = {
            frame.name: (frame.parentJoint, frame.placement.copy())
            for frame in self.model.frames
            if frame.type == pin.FrameType.BODY
        }
        self.carried = {0: self.root} | {
            self.model.getJointId(name): child
            for child, (name, _) in self.parent.items()
            if name in self.axes
        }

    @property
    def notes(self) -> list[str]:
        """Assumptions, one sentence each; those about several joints in one."""
        found = []
        for what, subjects in self._remarks.items():
            shown = ", ".join(subjects[:_MOST_NAMES])
            if len(subjects) > _MOST_NAMES:
                shown += f" and {len(subjects) - _MOST_NAMES} more"
            each = f"{shown}: each" if len(subjects) > 1 else shown
            found.append(f"{each} {what}".strip())
        return found

    def _remark(self, subject: str, what: str) -> None:
        self._remarks.setdefault(what, []).append(subject)

    # -- structure

    def body(self, link: str) -> str:
        """Return the first link of a link's body."""
        return self.carried[self._placed_on[link][0]]

    def body_links(self, body: str) -> list[str]:
        """Return all links of a body, from its first one outwards."""
        found = [body]
        for link in found:
            found += [
                child for joint, child in self.children[link] if joint not in self.axes
            ]
        return found

    def branches(self, body: str) -> list[tuple[str, str]]:
        """Return the movable joints attached to a body, each with its child link."""
        pairs = (pair for link in self.body_links(body) for pair in self.children[link])
        return [pair for pair in pairs if pair[0] in self.axes]

    def leaves(self, body: str) -> list[str]:
        """Return the last bodies of all branches of a body; the body itself if it has none."""
        below = self.branches(body)
        return (
            [leaf for _, child in below for leaf in self.leaves(child)]
            if below
            else [body]
        )

    def chain(self, link: str, above: str) -> list[tuple[str, str]]:
        """Return the movable joints, with child links, from below `above` out to `link`."""
        passed = []
        while link != above and link in self.parent:
            joint, parent = self.parent[link]
            if joint in self.axes:
                passed.append((joint, link))
            link = parent
        return passed[::-1]

    def drivers(self, joint: str) -> str:
        """Return the active joint that moves a joint: itself, or its mimic leader."""
        return self._follow[joint].leader if joint in self._follow else joint

    # -- kinematics

    def place(self, q: np.ndarray) -> None:
        """Place the active joints at `q`, shape (n,), and their mimic joints accordingly."""
        pin.forwardKinematics(self.model, self._data, self.configuration_vector(q))

    def configuration_vector(self, q: np.ndarray) -> np.ndarray:
        """Return Pinocchio's configuration at positions of the active joints, shape (n,)."""
        return self.expansion.matrix @ q + self.expansion.offset

    def write_configuration(self, vector: np.ndarray, q: np.ndarray) -> None:
        """Write a configuration into an array of the caller's."""
        vector[:] = self.configuration_vector(q)

    def set_palm(self, link: str) -> None:
        """Add the frame of the palm's link to the model; before that, the root is the palm."""
        carrier, placement = self._placed_on[link]
        frame = pin.Frame("/palm", carrier, 0, placement, pin.OP_FRAME)
        self.palm_frame_id = self.model.addFrame(frame)

    def place_of(self, link: str, xyz: np.ndarray) -> Place:
        """Return a point on a link as one on a joint of the model."""
        carrier, placement = self._placed_on[link]
        return carrier, placement.act(xyz)

    def pose_in(self, link: str, other: str) -> np.ndarray:
        """Return a link's pose in another link's frame at the last `place`, shape (4, 4)."""
        return self._placed(other).actInv(self._placed(link)).homogeneous

    def _placed(self, link: str) -> pin.SE3:
        carrier, placement = self._placed_on[link]
        return self._data.oMi[carrier] * placement

    # -- surface

    def has_collision_shapes(self, body: str) -> bool:
        """Return whether a link of a body has a collision shape."""
        return any(
            self._elements[link].find("collision") is not None
            for link in self.body_links(body)
        )

    def surface(self, link: str) -> np.ndarray:
        """Return points on a link's visuals, else on its collision shapes [m], shape (k, 3)."""
        if link not in self._surfaces:
            groups = (
                self._elements[link].iterfind(kind) for kind in ("visual", "collision")
            )
            try:
                clouds = (
                    np.vstack([_NONE, *map(self._cloud, shapes)]) for shapes in groups
                )
                self._surfaces[link] = next(
                    (cloud for cloud in clouds if len(cloud)), _NONE
                )
            except HandError as error:
                raise HandError(error.problem, file=self.file, key=error.key) from error
        return self._surfaces[link]

    def body_surface(self, body: str) -> np.ndarray:
        """Return surface points of a body in its first link's frame [m], shape (k, 3)."""
        clouds = [
            transform_points(self.pose_in(link, body), self.surface(link))
            for link in self.body_links(body)
        ]
        return np.concatenate(clouds)

    def _cloud(self, shape: ET.Element) -> np.ndarray:
        """Return points on one shape in its link's frame; none if its mesh cannot be read."""
        import trimesh

        solid = shape.find("geometry/*")
        kind, points = None if solid is None else solid.tag, _NONE
        if solid is None:
            return points
        if kind == "box":
            points = _CORNERS * get_numbers(solid, "size", 3)
        elif kind == "sphere":
            points = trimesh.creation.icosphere(2, _number(solid, "radius")).vertices
        elif kind == "cylinder":
            radius, length = _number(solid, "radius"), _number(solid, "length")
            points = trimesh.creation.cylinder(radius, length, sections=24).vertices
        elif kind == "mesh":
            name, scale = (
                solid.get("filename", ""),
                get_numbers(solid, "scale", 3, "1 1 1"),
            )
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    mesh = trimesh.load_mesh(find_mesh(name, self.file.parent))
                    points = (
                        mesh if isinstance(mesh, trimesh.Trimesh) else mesh.to_mesh()
                    ).vertices
            # Mesh readers raise many types; the end of a finger can be found without its mesh.
            except Exception:
                self._remark(f"the mesh {name}", "cannot be read")
                return _NONE
            points = points[:: max(1, len(points) // _MOST_POINTS)] * np.array(scale)
        return transform_points(origin_of(shape), np.array(points))

    # -- assumptions

    def _drop_rules(self, joints: dict[str, ET.Element]) -> dict[str, MimicSpec | None]:
        dropped: dict[str, MimicSpec | None] = {}
        leaders: dict[str | None, None] = {}
        for name, joint in joints.items():
            mimic = joint.find("mimic")
            if mimic is None or joint.get("type") not in MOVABLE:
                continue
            leader = joints.get(mimic.get("joint", ""))
            if leader is None or leader.get("type") not in MOVABLE:
                joint.remove(mimic)
                dropped[name] = None
                leaders[mimic.get("joint")] = None
        if dropped:
            missing = ", ".join(str(leader) for leader in leaders)
            self._remark(
                ", ".join(dropped),
                f"would mimic {missing}, missing or fixed here: taken as independent; couple what "
                "belongs together under `mimic` in the hand.yaml",
            )
        return dropped

    def _assume_limits(self, robot: ET.Element) -> dict[str, LimitSpec]:
        speeds: dict[str, list[float]] = {}
        for joint in robot.iterfind("joint"):
            if (
                (limit := joint.find("limit")) is not None
                and (speed := _number(limit, "velocity")) > 0.0
                and math.isfinite(speed)
            ):
                speeds.setdefault(joint.get("type", ""), []).append(speed)
        assumed = {}
        scale = self._limit_scale(robot)
        for joint in robot.iterfind("joint"):
            name, kind, limit = (
                joint.get("name", ""),
                joint.get("type", ""),
                joint.find("limit"),
            )
            if kind not in MOVABLE or joint.find("mimic") is not None:
                continue
            changes = self._assumed_range(name, kind, limit, scale)
            speed = 0.0 if limit is None else _number(limit, "velocity")
            if not (math.isfinite(speed) and speed > 0.0):
                changes["velocity"] = (
                    float(np.median(speeds[kind]))
                    if kind in speeds
                    else _ASSUMED_SPEED[kind]
                )
                self._remark(
                    name,
                    f"has no speed limit in the URDF: {changes['velocity']:.4g} is assumed",
                )
            if changes:
                assumed[name] = LimitSpec(**changes)
        return assumed

    def _assumed_range(
        self, name: str, kind: str, limit: ET.Element | None, scale: float
    ) -> dict[str, float]:
        """Return the range of a joint where that of the URDF is missing or wrong, else nothing."""
        has_range = limit is not None and (
            "lower" in limit.attrib or "upper" in limit.attrib
        )
        ends = (
            (0.0, 0.0)
            if limit is None
            else (_number(limit, "lower"), _number(limit, "upper"))
        )
        lower, upper = ends
        if kind == "continuous" or not has_range or not np.isfinite(ends).all():
            lower, upper = _ASSUMED_RANGE[kind]
            what = (
                "is continuous" if kind == "continuous" else "has no limits in the URDF"
            )
            self._remark(name, f"{what}: [{lower:.4g}, {upper:.4g}] is assumed")
        elif lower > upper:
            lower, upper = upper, lower
            self._remark(
                name, f"has its limits swapped: [{lower:.4g}, {upper:.4g}] is assumed"
            )
        elif kind == "revolute" and scale != 1.0:
            lower, upper = scale * lower, scale * upper
            self._remark(name, "has limits in degrees, as it seems: written in radians")
        elif kind == "revolute" and upper - lower > _LARGEST_TURN:
            self._remark(name, "has a range of more than two turns: is it in degrees?")
        return {} if (lower, upper) == ends else {"lower": lower, "upper": upper}

    def _limit_scale(self, robot: ET.Element) -> float:
        """Return the factor to radians: limits are in degrees if most span more than two turns."""
        limits = [
            limit
            for joint in robot.iterfind("joint[@type='revolute']")
            if (limit := joint.find("limit")) is not None
        ]
        widths = [
            abs(_number(limit, "upper") - _number(limit, "lower")) for limit in limits
        ]
        is_wide = bool(widths) and float(np.median(widths)) > _LARGEST_TURN
        return math.radians(1.0) if is_wide else 1.0

    def _immovable(self, robot: ET.Element) -> dict[str, float]:
        """Return joints whose limits are equal, with their positions."""
        still = {}
        for joint in robot.iterfind("joint"):
            limit, name = joint.find("limit"), joint.get("name", "")
            is_set = (
                joint.get("type") in MOVABLE
                and joint.find("mimic") is None
                and name not in self.assumed
            )
            if (
                is_set
                and limit is not None
                and _number(limit, "lower") == _number(limit, "upper")
            ):
                still[name] = _number(limit, "lower")
                self._remark(name, "has equal limits: it is locked")
        return still


def _number(element: ET.Element, key: str) -> float:
    return get_numbers(element, key, 1, "0")[0]
