"""A URDF for onboarding: links, bodies, active joints, forward kinematics and surface points.

A *body* is a set of links joined by fixed joints. Limits and speeds that the URDF lacks are assumed
and recorded, so that they can be written to the `hand.yaml` for its owner to correct.
"""

from __future__ import annotations

import copy
import io
import itertools
import math
import warnings
import xml.etree.ElementTree as ET
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError
from handmap_qp.hands.fingers import Place
from handmap_qp.hands.mimic import Expansion, expansion_matrix, read_mimic_rules, tighten_model
from handmap_qp.hands.spec import LimitSpec, MimicSpec
from handmap_qp.hands.urdf.check import check_tree
from handmap_qp.hands.urdf.compose import prepare_urdf
from handmap_qp.hands.urdf.elements import (
    axis_of,
    get_numbers,
    origin_of,
    parse_urdf,
    set_numbers,
)
from handmap_qp.hands.urdf.files import find_mesh
from handmap_qp.hands.urdf.joints import fix_free_joints
from handmap_qp.hands.urdf.tree import MOVABLE, cut_subtree, edges, link_names, root_links
from handmap_qp.transform import rpy_from_rotation, transform_points

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
        locked: Joints to lock, with their positions [rad or m].

    Attributes:
        file: The URDF's file.
        name: The robot's name.
        root: Link that it starts at.
        is_whole: Whether `root` is the root of the URDF.
        parent: Parent joint of each link, and that joint's parent link.
        children: Child joints of each link, each with its child link.
        kinds: Type of each joint: `revolute`, `prismatic` or `fixed`.
        axes: Axis of each movable joint in its child link's frame, a unit vector.
        balls: Centres of each link's spheres, in its frame [m], shape (k, 3).
        rules: Resolved mimic rules.
        carried: First link of the body on each joint of the model.
        active: The n joints that are neither fixed nor mimic joints, in the order of the file.
        lower_limits: Their lower limits, narrowed by mimic joints [rad or m], shape (n,).
        upper_limits: Their upper limits, shape (n,).
        endless: Joints of type `continuous` in the file.
        assumed: Limits that the URDF lacks, by joint.
        dropped_rules: Mimic rules whose leader is not in this part of the robot; these joints are
            treated as independent.

    Raises:
        HandError: If the URDF cannot be used, in one line.
    """

    def __init__(
        self,
        text: str,
        file: Path,
        *,
        root: str | None = None,
        locked: dict[str, float] | None = None,
    ) -> None:
        self.file = file
        try:
            robot = parse_urdf(text)
            check_tree(robot)
            self.is_whole = root is None or root_links(robot) == [root]
            if root is not None:
                cut_subtree(robot, root)
            if not any(joint.get("type") in MOVABLE for joint in robot.iterfind("joint")):
                raise HandError(f"no movable joint hangs from the link {root!r}", value=root)
            self.name = robot.get("name", "") or file.stem
            self._remarks: dict[str, list[str]] = {}
            self.endless = {
                joint.get("name", "")
                for joint in robot.iterfind("joint")
                if joint.get("type") == "continuous"
            }
            for name in fix_free_joints(robot):
                self._remark(name, "has more than one coordinate: it is taken as fixed")
            self.dropped_rules = self._drop_rules(robot)
            self.assumed = self._assume_limits(robot)
            self.locked = prepare_urdf(
                robot, None, {}, {**self._immovable(robot), **(locked or {})}, self.assumed
            )
            self.rules = read_mimic_rules(robot)
        except HandError as error:
            raise HandError(error.problem, file=file, key=error.key, value=error.value) from error
        (self.root,) = root_links(robot)
        self.links = link_names(robot)
        self.kinds = {
            joint.get("name", ""): joint.get("type", "") for joint in robot.iterfind("joint")
        }
        self.parent: dict[str, tuple[str, str]] = {}
        self._bodies: dict[str, str] = {}
        self._surfaces: dict[str, np.ndarray] = {}
        self.children: dict[str, list[tuple[str, str]]] = {link: [] for link in self.links}
        for joint, parent, child in edges(robot):
            self.parent[child] = (joint.get("name", ""), parent)
            self.children[parent].append((joint.get("name", ""), child))
        self.axes = {
            joint.get("name", ""): axis_of(joint)
            for joint in robot.iterfind("joint")
            if joint.get("type") in MOVABLE
        }
        self.balls = {
            link.get("name", ""): np.array(
                [
                    origin_of(shape)[:3, 3]
                    for shape in (*link.iterfind("visual"), *link.iterfind("collision"))
                    if shape.find("geometry/sphere") is not None
                ]
            ).reshape(-1, 3)
            for link in robot.iterfind("link")
        }
        self._rule_of = {rule.follower: rule for rule in self.rules}
        followers = set(self._rule_of)
        self.active = [
            name for name, kind in self.kinds.items() if kind in MOVABLE and name not in followers
        ]
        self.urdf_text = ET.tostring(robot, encoding="unicode")
        self._build(self._skeleton(robot))

    def _skeleton(self, robot: ET.Element) -> str:
        """Return a URDF of the bodies' first links: Pinocchio takes long for thousands of links."""
        origins = {joint.get("name", ""): origin_of(joint) for joint in robot.iterfind("joint")}
        self._in_body: dict[str, pin.SE3] = {}
        pending = [self.root]
        while pending:
            link = pending.pop()
            body = self.body(link)
            joint, parent = self.parent.get(link, ("", ""))
            self._in_body[link] = (
                pin.SE3.Identity()
                if link == body
                else self._in_body[parent] * pin.SE3(origins[joint])
            )
            pending.extend(child for _, child in self.children[link])
        skeleton = ET.Element("robot", {"name": "skeleton"})
        for link in self.links:
            if self.body(link) == link:
                ET.SubElement(skeleton, "link", {"name": link})
        for joint in robot.iterfind("joint"):
            if joint.get("type") == "fixed":
                continue
            moved = copy.deepcopy(joint)
            parent, origin = moved.find("parent"), moved.find("origin")
            if parent is None:
                continue
            link = parent.get("link", "")
            parent.set("link", self.body(link))
            pose = (self._in_body[link] * pin.SE3(origins[joint.get("name", "")])).homogeneous
            if origin is None:
                origin = ET.SubElement(moved, "origin")
            set_numbers(origin, "xyz", pose[:3, 3].tolist())
            set_numbers(origin, "rpy", rpy_from_rotation(pose[:3, :3]).tolist())
            skeleton.append(moved)
        return ET.tostring(skeleton, encoding="unicode")

    def _build(self, text: str) -> None:
        try:
            self.model = pin.buildModelFromXML(text)
        except (RuntimeError, ValueError) as error:
            raise HandError(
                f"Pinocchio cannot read the URDF: {' '.join(str(error).split())}", file=self.file
            ) from error
        for note in tighten_model(self.model, self.rules):
            self._remark("", note)
        names = list(self.model.names)[1:]
        columns = [self.model.joints[self.model.getJointId(name)].idx_q for name in names]
        matrix, offset = expansion_matrix(names, self.active, self.rules)
        order = np.argsort(columns)
        self.expansion = Expansion(matrix[order], offset[order])
        self.joint_columns = np.arange(len(self.active))
        at = [self.model.joints[self.model.getJointId(name)].idx_q for name in self.active]
        self.lower_limits, self.upper_limits = (
            self.model.lowerPositionLimit[at],
            self.model.upperPositionLimit[at],
        )
        try:
            self._data = self.model.createData()
        except MemoryError as error:
            problem = f"its {len(names)} movable joints need more memory than there is"
            advice = "name the link at which the hand begins by --root"
            raise HandError(f"{problem}: {advice}", file=self.file) from error
        joints = {name: i for i, name in enumerate(self.model.names)}
        self.carried = {joints[self.parent[body][0]]: body for body in self._bodies.values()
                        if body != self.root}
        # The frame of a body's first link is that of the joint that moves it.
        self._carriers = {
            link: joints[self.parent[self.body(link)][0]] if self.body(link) != self.root else 0
            for link in self.links
        }
        self.palm_frame_id = 0
        self.place(self.zero)

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
        passed = []
        while link not in self._bodies:
            joint, parent = self.parent.get(link, ("", ""))
            if self.kinds.get(joint) != "fixed":
                self._bodies[link] = link
                break
            passed.append(link)
            link = parent
        first = self._bodies[link]
        self._bodies.update(dict.fromkeys(passed, first))
        return first

    def body_links(self, body: str) -> list[str]:
        """Return all links of a body, from its first one outwards."""
        found = [body]
        for link in found:
            found.extend(
                child for joint, child in self.children[link] if self.kinds[joint] == "fixed"
            )
        return found

    def branches(self, body: str) -> list[tuple[str, str]]:
        """Return the movable joints attached to a body, each with its child link."""
        return [
            pair
            for link in self.body_links(body)
            for pair in self.children[link]
            if self.kinds[pair[0]] != "fixed"
        ]

    def leaves(self, body: str) -> list[str]:
        """Return the last bodies of all branches of a body; the body itself if it has none."""
        below = self.branches(body)
        return [leaf for _, child in below for leaf in self.leaves(child)] if below else [body]

    def chain(self, link: str, above: str) -> list[tuple[str, str]]:
        """Return the movable joints, with child links, from below `above` out to `link`."""
        passed = []
        while link != above and link in self.parent:
            joint, parent = self.parent[link]
            if self.kinds[joint] != "fixed":
                passed.append((joint, link))
            link = parent
        return passed[::-1]

    def drivers(self, joint: str) -> str:
        """Return the active joint that moves a joint: itself, or its mimic leader."""
        rule = self._rule_of.get(joint)
        return joint if rule is None else rule.leader

    def gear(self, joint: str) -> float:
        """Return a joint's motion per motion of the active joint that moves it."""
        rule = self._rule_of.get(joint)
        return 1.0 if rule is None else rule.multiplier

    # -- kinematics

    @cached_property
    def slides(self) -> np.ndarray:
        """Which active joints are prismatic, shape (n,)."""
        return np.array([self.kinds[name] == "prismatic" for name in self.active])

    @cached_property
    def zero(self) -> np.ndarray:
        """Zero clipped to the limits [rad or m], shape (n,)."""
        return np.clip(0.0, self.lower_limits, self.upper_limits)

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
        frame = pin.Frame("/palm", self._carriers[link], 0, self._in_body[link], pin.OP_FRAME)
        self.palm_frame_id = self.model.addFrame(frame)

    def place_of(self, link: str, xyz: np.ndarray) -> Place:
        """Return a point on a link as one on a joint of the model."""
        return self._carriers[link], self._in_body[link].act(xyz)

    def pose(self, link: str) -> np.ndarray:
        """Return a link's pose in the frame of `root` at the last `place`, shape (4, 4)."""
        return self._placed(link).homogeneous

    def pose_in(self, link: str, other: str) -> np.ndarray:
        """Return a link's pose in another link's frame at the last `place`, shape (4, 4)."""
        return self._placed(other).actInv(self._placed(link)).homogeneous

    def _placed(self, link: str) -> pin.SE3:
        return self._data.oMi[self._carriers[link]] * self._in_body[link]

    # -- surface

    @cached_property
    def _shapes(self) -> dict[str, Any]:
        """The parsed links by name; empty if the shapes cannot be read."""
        from yourdfpy import URDF

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                model = URDF.load(
                    io.BytesIO(self.urdf_text.encode()), build_scene_graph=False, load_meshes=False
                ).robot
        except Exception as error:
            self._remark(
                "the links' shapes",
                f"cannot be read and are ignored ({type(error).__name__}: {error})",
            )
            return {}
        return {link.name: link for link in model.links}

    def has_collision_shapes(self, body: str) -> bool:
        """Return whether a link of a body has a collision shape."""
        links = (self._shapes.get(link) for link in self.body_links(body))
        return any(link is not None and link.collisions for link in links)

    def surface(self, link: str) -> np.ndarray:
        """Return points on a link's visuals, else on its collision shapes [m], shape (k, 3)."""
        if link not in self._surfaces:
            parsed = self._shapes.get(link)
            groups = () if parsed is None else (parsed.visuals, parsed.collisions)
            self._surfaces[link] = np.zeros((0, 3))
            for shapes in groups:
                clouds = [cloud for shape in shapes if (cloud := self._cloud(shape)) is not None]
                if clouds:
                    self._surfaces[link] = np.concatenate(clouds)
                    break
        return self._surfaces[link]

    def body_surface(self, body: str) -> np.ndarray:
        """Return surface points of a body in its first link's frame [m], shape (k, 3)."""
        clouds = [
            transform_points(self.pose_in(link, body), points)
            for link in self.body_links(body)
            if len(points := self.surface(link))
        ]
        return np.concatenate(clouds) if clouds else np.zeros((0, 3))

    def _cloud(self, shape: Any) -> np.ndarray | None:
        """Return points on one shape in its link's frame; None if its mesh cannot be read."""
        import trimesh

        geometry = shape.geometry
        if geometry is None:
            return None
        if geometry.box is not None:
            points = _CORNERS * self._three(geometry.box.size, "size of a box")
        elif geometry.sphere is not None:
            points = np.array(
                trimesh.creation.icosphere(subdivisions=2, radius=geometry.sphere.radius).vertices
            )
        elif geometry.cylinder is not None:
            solid = trimesh.creation.cylinder(
                geometry.cylinder.radius, geometry.cylinder.length, sections=24
            )
            points = np.array(solid.vertices)
        elif geometry.mesh is not None:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    mesh = trimesh.load_mesh(find_mesh(geometry.mesh.filename, self.file.parent))
                    solid = mesh if isinstance(mesh, trimesh.Trimesh) else mesh.to_mesh()
            # Mesh readers raise many types; the end of a finger can be found without its mesh.
            except Exception:
                self._remark(f"the mesh {geometry.mesh.filename}", "cannot be read")
                return None
            points = np.array(solid.vertices)
            points = points[:: max(1, len(points) // _MOST_POINTS)]
            if geometry.mesh.scale is not None:
                points = points * self._three(geometry.mesh.scale, "scale of a mesh")
        else:
            return None
        if not len(points):
            return None
        return points if shape.origin is None else transform_points(shape.origin, points)

    def _three(self, numbers: Any, what: str) -> np.ndarray:
        """Return the numbers of a URDF's attribute as an array, shape (3,).

        Raises:
            HandError: If they are not three.
        """
        array = np.asarray(numbers, dtype=float)
        if array.shape not in ((), (3,)):
            found = " ".join(f"{number:g}" for number in array.ravel())
            raise HandError(f"the {what} has three numbers, got {found}", file=self.file)
        return np.broadcast_to(array, 3)

    # -- assumptions

    def _drop_rules(self, robot: ET.Element) -> dict[str, MimicSpec | None]:
        joints = {joint.get("name"): joint for joint in robot.iterfind("joint")}
        dropped: dict[str, MimicSpec | None] = {}
        leaders: dict[str | None, None] = {}
        for name, joint in joints.items():
            mimic = joint.find("mimic")
            if name is None or mimic is None or joint.get("type") not in MOVABLE:
                continue
            leader = joints.get(mimic.get("joint"))
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
            name, kind, limit = joint.get("name", ""), joint.get("type", ""), joint.find("limit")
            if kind not in MOVABLE or joint.find("mimic") is not None:
                continue
            changes = self._assumed_range(name, kind, limit, scale)
            speed = 0.0 if limit is None else _number(limit, "velocity")
            if not (math.isfinite(speed) and speed > 0.0):
                changes["velocity"] = (
                    float(np.median(speeds[kind])) if kind in speeds else _ASSUMED_SPEED[kind]
                )
                self._remark(
                    name, f"has no speed limit in the URDF: {changes['velocity']:.4g} is assumed"
                )
            if changes:
                assumed[name] = LimitSpec(**changes)
        return assumed

    def _assumed_range(
        self, name: str, kind: str, limit: ET.Element | None, scale: float
    ) -> dict[str, float]:
        """Return the range of a joint where that of the URDF is missing or wrong, else nothing."""
        has_range = limit is not None and ("lower" in limit.attrib or "upper" in limit.attrib)
        ends = (0.0, 0.0) if limit is None else (_number(limit, "lower"), _number(limit, "upper"))
        lower, upper = ends
        if kind == "continuous" or not has_range or not np.isfinite(ends).all():
            lower, upper = _ASSUMED_RANGE[kind]
            what = "is continuous" if kind == "continuous" else "has no limits in the URDF"
            self._remark(name, f"{what}: [{lower:.4g}, {upper:.4g}] is assumed")
        elif lower > upper:
            lower, upper = upper, lower
            self._remark(name, f"has its limits swapped: [{lower:.4g}, {upper:.4g}] is assumed")
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
        widths = [abs(_number(limit, "upper") - _number(limit, "lower")) for limit in limits]
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
            if is_set and limit is not None and _number(limit, "lower") == _number(limit, "upper"):
                still[name] = _number(limit, "lower")
                self._remark(name, "has equal limits: it is locked")
        return still


def _number(element: ET.Element, key: str) -> float:
    return get_numbers(element, key, 1, "0")[0]
