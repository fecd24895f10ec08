"""From a compiled MuJoCo model to a URDF with the same kinematics: `convert_mjcf`.

A link is a body and has its frame. A body with several joints gets a massless link between each two
of them, a ball joint becomes three hinges. A joint's position is MuJoCo's, `ref` included: the
origin of the URDF's joint is turned back by it.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from handmap_qp.errors import HandError
from handmap_qp.hands.mjcf.compile import (
    SMALL_RANGE,
    CompiledMjcf,
    compile_mjcf,
    widest_range,
)
from handmap_qp.hands.mjcf.couplings import Coupling, read_couplings
from handmap_qp.hands.mjcf.loops import close_loops
from handmap_qp.hands.mjcf.shapes import ShapeWriter, add_origin, binary_stl, file_name
from handmap_qp.hands.urdf import set_numbers
from handmap_qp.se3 import affine, rotation_from_quat_wxyz

_FREE, _BALL, _SLIDE = (
    int(kind)
    for kind in (
        mujoco.mjtJoint.mjJNT_FREE,
        mujoco.mjtJoint.mjJNT_BALL,
        mujoco.mjtJoint.mjJNT_SLIDE,
    )
)
# Effort [N or N m] of a joint whose actuators have no limit.
_NO_EFFORT_LIMIT = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class ConvertedMjcf:
    """An MJCF model as a URDF.

    Attributes:
        text: The URDF.
        meshes: Triangles of its meshes by file, relative to the URDF [m], shape (k, 3, 3).
        notes: What a URDF cannot express, one sentence each.
        model: The compiled `mujoco.MjModel`.
        links: Name of the link of each body, by the body's index.
        joints: Name of each hinge and slide joint, by its index.
    """

    text: str
    meshes: dict[str, np.ndarray]
    notes: tuple[str, ...]
    model: Any
    links: dict[int, str]
    joints: dict[int, str]


def convert_mjcf(file: Path, meshes: str = "meshes") -> ConvertedMjcf:
    """Compile an MJCF file and describe it as a URDF.

    Bodies that hang from the world and have no joints, or only a free joint, are scenery and
    objects: they are left out. A free joint under a robot is left out too, because the wrist of a
    `hand.yaml` floats without it.

    Args:
        file: The MJCF file.
        meshes: Folder of the mesh files, relative to the URDF.

    Returns:
        The URDF, not yet written.

    Raises:
        HandError: If MuJoCo cannot compile the file, or no joint moves in it.
    """
    compiled = compile_mjcf(file)
    if not (compiled.model.jnt_type != _FREE).any():
        raise HandError("no joint moves in the MJCF", file=file)
    return _Converter(compiled, meshes).convert()


def write_converted(converted: ConvertedMjcf, urdf: Path) -> None:
    """Write a URDF and its meshes.

    Args:
        converted: The URDF.
        urdf: Its file; folders are made where they are missing.

    Raises:
        OSError: If a file cannot be written.
    """
    urdf.parent.mkdir(parents=True, exist_ok=True)
    for name, triangles in converted.meshes.items():
        file = urdf.parent / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(binary_stl(triangles))
    urdf.write_text(converted.text, encoding="utf-8")


class _Axis(NamedTuple):
    """One hinge or slide of the URDF.

    Attributes:
        joint: Index of MuJoCo's joint.
        suffix: Addition to its name; not empty for the axes of a ball.
        kind: `revolute`, `continuous` or `prismatic`.
        anchor: Point on the axis in the body's frame [m], shape (3,).
        direction: Unit vector in the body's frame, shape (3,).
        reference: Position in `qpos0` [rad or m].
        limits: Lower and upper limit [rad or m]; None if there is none.
    """

    joint: int
    suffix: str
    kind: str
    anchor: np.ndarray
    direction: np.ndarray
    reference: float
    limits: tuple[float, float] | None


class _Converter:
    """Writes the links and joints of one model."""

    def __init__(self, compiled: CompiledMjcf, meshes: str) -> None:
        self.model = model = compiled.model
        self.robot = ET.Element("robot", name=file_name(compiled.name).removesuffix(".stl"))
        self.shapes = ShapeWriter(model, meshes)
        self.notes: list[str] = [*compiled.notes]
        used: set[str] = set()
        kept = self._kept()
        self.links = {
            body: _unique(model.body(body).name or f"body{body}", used) for body in sorted(kept)
        }
        self.joints: dict[int, str] = {}
        taken: set[str] = set()
        for joint in range(model.njnt):
            is_axis = int(model.jnt_type[joint]) not in (_FREE, _BALL)
            if is_axis and int(model.jnt_bodyid[joint]) in kept:
                self.joints[joint] = _unique(model.joint(joint).name or f"joint{joint}", taken)
        self._used, self._taken = used, taken
        self.rules, coupled = read_couplings(model, self.joints)
        loops, closed, omitted = close_loops(model, self.rules, self.joints)
        self.rules.update(loops)
        self.notes += [*coupled, *closed]
        if omitted:
            self.notes.append(
                f"{omitted} connect constraint(s) close loops, which a URDF cannot: left out"
            )

    def convert(self) -> ConvertedMjcf:
        """Write all links and joints."""
        for body, name in self.links.items():
            if body == 0:
                ET.SubElement(self.robot, "link", name=name)
            else:
                self._add_body(body, name)
        self.notes += self._suspicious_ranges()
        if self.shapes.omitted:
            kinds = ", ".join(sorted(self.shapes.omitted))
            self.notes.append(f"shapes without a counterpart in URDF are left out: {kinds}")
        ET.indent(self.robot)
        text = ET.tostring(self.robot, encoding="unicode") + "\n"
        return ConvertedMjcf(
            text, self.shapes.meshes, tuple(self.notes), self.model, self.links, self.joints
        )

    def _kept(self) -> set[int]:
        """Return the world and the bodies of all trees with a hinge, a slide or a ball."""
        model = self.model
        roots = {
            int(model.body_rootid[body])
            for joint, body in enumerate(model.jnt_bodyid)
            if int(model.jnt_type[joint]) != _FREE
        }
        kept = {0} | {b for b in range(1, model.nbody) if int(model.body_rootid[b]) in roots}
        left = [b for b in range(1, model.nbody) if b not in kept and model.body_parentid[b] == 0]
        if left:
            names = ", ".join(model.body(b).name or f"body {b}" for b in left[:4])
            more = f" and {len(left) - 4} more" if len(left) > 4 else ""
            self.notes.append(f"bodies without joints of their own are left out: {names}{more}")
        return kept

    def _suspicious_ranges(self) -> list[str]:
        """Return a note if all hinges have a range so small that radians were read as degrees."""
        if (widest := widest_range(self.model)) > SMALL_RANGE:
            return []
        return [
            f"no hinge has a range of more than {np.degrees(widest):.2g} deg: if the file "
            'means radians, write <compiler angle="radian"/> into it'
        ]

    def _add_body(self, body: int, name: str) -> None:
        """Add a body's link, the joints that move it, and the links between these."""
        model = self.model
        parent = self.links[int(model.body_parentid[body])]
        start = affine(
            rotation_from_quat_wxyz(model.body_quat[body]), np.array(model.body_pos[body])
        )
        axes = list(self._axes(body))
        at = np.zeros(3)  # origin of the link before, in the body's frame
        for number, axis in enumerate(axes):
            origin = start @ _reference_pose(axis, axis.anchor - at)
            start, at = np.eye(4), axis.anchor
            is_last = number == len(axes) - 1 and not axis.anchor.any()
            child = name if is_last else _unique(f"{name}_{number}", self._used)
            self._add_joint(axis, parent, child, origin)
            if not is_last:
                ET.SubElement(self.robot, "link", name=child)
            parent = child
        if not axes or at.any():
            joint = ET.SubElement(
                self.robot, "joint", name=_unique(f"{name}_fixed", self._taken), type="fixed"
            )
            _connect(joint, parent, name, start @ affine(np.eye(3), -at))
        link = ET.SubElement(self.robot, "link", name=name)
        self._add_inertial(link, body)
        self.shapes.add_shapes(link, body)

    def _axes(self, body: int) -> Iterator[_Axis]:
        model = self.model
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        for joint in range(first, first + count):
            kind, anchor = int(model.jnt_type[joint]), np.array(model.jnt_pos[joint])
            limits = None
            if model.jnt_limited[joint]:
                limits = (float(model.jnt_range[joint, 0]), float(model.jnt_range[joint, 1]))
            if kind == _FREE:
                continue
            if kind == _BALL:
                yield from self._ball(joint, anchor, limits)
                continue
            reference = float(model.qpos0[model.jnt_qposadr[joint]])
            direction = np.array(model.jnt_axis[joint])
            if kind == _SLIDE:
                yield _Axis(joint, "", "prismatic", np.zeros(3), direction, reference, limits)
            else:
                moves = "continuous" if limits is None else "revolute"
                yield _Axis(joint, "", moves, anchor, direction, reference, limits)

    def _ball(
        self, joint: int, anchor: np.ndarray, limits: tuple[float, float] | None
    ) -> Iterator[_Axis]:
        """Return a ball joint as three hinges: `q = q_x q_y q_z`."""
        name = self.model.joint(joint).name or f"joint{joint}"
        self.notes.append(f"the ball joint {name} is three hinges: {name}_x, {name}_y, {name}_z")
        span = None if limits is None else (-limits[1], limits[1])
        for suffix, direction in zip("xyz", np.eye(3), strict=True):
            kind = "continuous" if span is None else "revolute"
            yield _Axis(joint, f"_{suffix}", kind, anchor, direction, 0.0, span)

    def _add_joint(self, axis: _Axis, parent: str, child: str, origin: np.ndarray) -> None:
        model, joint = self.model, axis.joint
        if axis.suffix:
            base = model.joint(joint).name or f"joint{joint}"
            name = _unique(f"{base}{axis.suffix}", self._taken)
        else:
            name = self.joints[joint]
        rule = None if axis.suffix else self.rules.get(joint)
        limits, kind = axis.limits, axis.kind
        if rule is not None and rule.leader is None:
            limits = (rule.offset, rule.offset)
            kind = "revolute" if kind == "continuous" else kind
        element = ET.SubElement(self.robot, "joint", name=name, type=kind)
        _connect(element, parent, child, origin)
        set_numbers(ET.SubElement(element, "axis"), "xyz", axis.direction.tolist())
        limit = ET.SubElement(element, "limit")
        if limits is not None:
            set_numbers(limit, "lower", [limits[0]])
            set_numbers(limit, "upper", [limits[1]])
        set_numbers(limit, "effort", [self._effort(joint)])
        dof = int(model.jnt_dofadr[joint])
        dynamics = ET.SubElement(element, "dynamics")
        set_numbers(dynamics, "damping", [float(np.ravel(model.dof_damping[dof])[0])])
        set_numbers(dynamics, "friction", [float(model.dof_frictionloss[dof])])
        if rule is not None and rule.leader is not None:
            self._add_mimic(element, rule)

    def _add_mimic(self, element: ET.Element, rule: Coupling) -> None:
        assert rule.leader is not None
        mimic = ET.SubElement(element, "mimic", joint=self.joints[rule.leader])
        set_numbers(mimic, "multiplier", [rule.multiplier])
        set_numbers(mimic, "offset", [rule.offset])

    def _effort(self, joint: int) -> float:
        """Return the largest force or torque of a joint's actuators [N or N m]."""
        model = self.model
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).max())
        of_joint = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)) & (
            model.actuator_trnid[:, 0] == joint
        )
        limited = of_joint & (model.actuator_forcelimited != 0)
        if not limited.any():
            return _NO_EFFORT_LIMIT
        return float(np.abs(model.actuator_forcerange[limited]).max())

    def _add_inertial(self, link: ET.Element, body: int) -> None:
        model = self.model
        mass = float(model.body_mass[body])
        if mass <= 0.0:
            return
        rotation = rotation_from_quat_wxyz(model.body_iquat[body])
        inertia = rotation @ np.diag(model.body_inertia[body]) @ rotation.T
        element = ET.SubElement(link, "inertial")
        add_origin(element, affine(np.eye(3), np.array(model.body_ipos[body])))
        set_numbers(ET.SubElement(element, "mass"), "value", [mass])
        tensor = ET.SubElement(element, "inertia")
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            set_numbers(tensor, f"i{'xyz'[i]}{'xyz'[j]}", [float(inertia[i, j])])


def _reference_pose(axis: _Axis, place: np.ndarray) -> np.ndarray:
    """Return the pose of a joint's frame at position zero, in the link before.

    Args:
        axis: The joint.
        place: Its anchor there [m], shape (3,).
    """
    if axis.kind == "prismatic":
        return affine(np.eye(3), place - axis.reference * axis.direction)
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, axis.direction, -axis.reference)
    return affine(rotation_from_quat_wxyz(quat), place)


def _connect(joint: ET.Element, parent: str, child: str, origin: np.ndarray) -> None:
    add_origin(joint, origin)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)


def _unique(name: str, used: set[str]) -> str:
    """Return a name that is not used yet, and count it as used."""
    candidate, count = name, 2
    while candidate in used:
        candidate = f"{name}_{count}"
        count += 1
    used.add(candidate)
    return candidate
