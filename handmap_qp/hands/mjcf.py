"""From an MJCF file to a URDF with the same kinematics: `convert_mjcf`, `cached_urdf`.

A link is a body and has its frame. A body with several joints gets a massless link between each two
of them, a ball joint becomes three hinges. A joint's position is MuJoCo's, `ref` included: the
origin of the URDF's joint is turned back by it.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError
from handmap_qp.hands.mjcf_compile import CompiledMjcf, compile_mjcf, small_range_notes
from handmap_qp.hands.mjcf_couplings import read_couplings
from handmap_qp.hands.mjcf_shapes import ShapeWriter, binary_stl, file_name, pose_of
from handmap_qp.hands.urdf import joints_by_name, parse_urdf, set_numbers, set_origin
from handmap_qp.se3 import affine

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
# Effort [N or N m] of a joint whose actuators have no limit.
_NO_EFFORT_LIMIT = 1e6
# Counts changes of the conversion, so that URDFs of an earlier one are not used.
_CONVERSION = 2
_WITHOUT_RANGE = (-1.0, 1.0)


class ConvertedMjcf(NamedTuple):
    """An MJCF model as a URDF.

    Attributes:
        text: The URDF.
        meshes: Triangles of its meshes by file, relative to the URDF [m], shape (k, 3, 3).
        notes: What a URDF cannot express, one sentence each.
        model: The compiled model.
        links: Name of the link of each body, by the body's index.
        joints: Name of each hinge and slide joint, by its index.
    """

    text: str
    meshes: dict[str, np.ndarray]
    notes: tuple[str, ...]
    model: mujoco.MjModel
    links: dict[int, str]
    joints: dict[int, str]


def convert_mjcf(file: Path, meshes: str = "meshes") -> ConvertedMjcf:
    """Compile an MJCF file and describe it as a URDF, not yet written.

    Bodies that hang from the world and have no joints, or only a free joint, are scenery and
    objects: they are left out. A free joint under a robot is left out too, because the wrist of a
    `hand.yaml` floats without it. `meshes` is the folder of the meshes, relative to the URDF.

    Raises:
        HandError: If MuJoCo cannot compile the file, or no joint moves in it.
    """
    compiled = compile_mjcf(file)
    if not (compiled.model.jnt_type != _FREE).any():
        raise HandError("no joint moves in the MJCF", file=file)
    return _Converter(compiled, meshes).convert()


def write_converted(converted: ConvertedMjcf, urdf: Path) -> None:
    """Write a URDF and its meshes; folders are made where they are missing.

    Raises:
        OSError: If a file cannot be written.
    """
    files = {
        urdf.parent / name: binary_stl(mesh) for name, mesh in converted.meshes.items()
    }
    for file, content in (files | {urdf: converted.text.encode()}).items():
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)


def cached_urdf(file: Path) -> Path:
    """Return the URDF of an MJCF file in the user's cache; its meshes lie beside it.

    It is converted again if an XML file beside the MJCF has changed. The cache is in
    `$XDG_CACHE_HOME`, else in `~/.cache`.

    Raises:
        HandError: If MuJoCo cannot compile the file, or the cache cannot be written.
    """
    cache = (
        Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        / "handmap_qp/mjcf"
    )
    versions = [importlib.metadata.version(name) for name in ("handmap-qp", "mujoco")]
    parts = [str(file.resolve()), *versions, str(_CONVERSION)]
    for other in sorted(file.parent.glob("*.xml")):
        stat = other.stat()
        parts.append(f"{other.name} {stat.st_size} {stat.st_mtime_ns}")
    digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    folder = cache / f"{file.stem}-{digest}"
    urdf = folder / f"{file.stem}.urdf"
    if urdf.is_file():
        return urdf
    converted = convert_mjcf(file)
    try:
        cache.mkdir(parents=True, exist_ok=True)
        # Another process may convert the same file: the first complete folder stays.
        temporary = Path(tempfile.mkdtemp(dir=cache))
        write_converted(converted, temporary / urdf.name)
        try:
            temporary.rename(folder)
        except OSError:
            if not urdf.is_file():
                raise
    except OSError as error:
        reason = error.strerror or error
        raise HandError(
            f"the cache {folder} cannot be written: {reason}", file=file
        ) from error
    return urdf


class _Axis(NamedTuple):
    """One hinge or slide of the URDF.

    Attributes:
        name: Its name.
        joint: Index of MuJoCo's joint.
        kind: `revolute`, `continuous` or `prismatic`.
        anchor: Point on the axis in the body's frame [m], shape (3,).
        direction: Unit vector in the body's frame, shape (3,).
        reference: Position in `qpos0` [rad or m].
        limits: Lower and upper limit [rad or m]; None if there is none.
    """

    name: str
    joint: int
    kind: str
    anchor: np.ndarray
    direction: np.ndarray
    reference: float
    limits: tuple[float, float] | None


class _Names(set[str]):
    """Names that are used already."""

    def unique(self, name: str) -> str:
        """Return a name that is not used yet, and count it as used."""
        candidate, count = name, 2
        while candidate in self:
            candidate, count = f"{name}_{count}", count + 1
        self.add(candidate)
        return candidate


class _Converter:
    """Writes the links and joints of one model."""

    def __init__(self, compiled: CompiledMjcf, meshes: str) -> None:
        self.model = model = compiled.model
        self.robot = ET.Element("robot", name=file_name(compiled.name))
        self.shapes = ShapeWriter(model, meshes)
        self.notes = compiled.notes
        self._link_names, self._joint_names = _Names(), _Names()
        self.links = {
            body: self._link_names.unique(model.body(body).name or f"body{body}")
            for body in self._kept()
        }
        self.joints = {
            joint: self._joint_names.unique(self._joint_name(joint))
            for joint in range(model.njnt)
            if model.jnt_type[joint] not in (_FREE, _BALL)
            and int(model.jnt_bodyid[joint]) in self.links
        }
        self.rules, notes = read_couplings(model, self.joints)
        self.notes += notes

    def convert(self) -> ConvertedMjcf:
        """Write all links and joints."""
        for body, name in self.links.items():
            if body == 0:
                ET.SubElement(self.robot, "link", name=name)
            else:
                self._add_body(body, name)
        self.notes += small_range_notes(self.model)
        if self.shapes.omitted:
            kinds = ", ".join(sorted(self.shapes.omitted))
            self.notes.append(
                f"shapes without a counterpart in URDF are left out: {kinds}"
            )
        ET.indent(self.robot)
        text, notes = (
            ET.tostring(self.robot, encoding="unicode") + "\n",
            tuple(self.notes),
        )
        meshes = self.shapes.meshes
        return ConvertedMjcf(text, meshes, notes, self.model, self.links, self.joints)

    def _joint_name(self, joint: int) -> str:
        return self.model.joint(joint).name or f"joint{joint}"

    def _kept(self) -> list[int]:
        """Return the world and the bodies of all trees with a hinge, a slide or a ball."""
        model = self.model
        roots = model.body_rootid[model.jnt_bodyid[model.jnt_type != _FREE]]
        is_kept = np.isin(model.body_rootid, roots)
        is_kept[0] = True
        left = np.flatnonzero(~is_kept & (model.body_parentid == 0)).tolist()
        if left:
            names = ", ".join(model.body(b).name or f"body {b}" for b in left[:4])
            more = f" and {len(left) - 4} more" if len(left) > 4 else ""
            self.notes.append(
                f"bodies without joints of their own are left out: {names}{more}"
            )
        return np.flatnonzero(is_kept).tolist()

    def _add_body(self, body: int, name: str) -> None:
        """Add a body's link, the joints that move it, and the links between these."""
        model = self.model
        parent = self.links[int(model.body_parentid[body])]
        start = pose_of(model.body_pos[body], model.body_quat[body])
        axes = list(self._axes(body))
        at = np.zeros(3)  # origin of the link before, in the body's frame
        for number, axis in enumerate(axes):
            origin = start @ _reference_pose(axis, axis.anchor - at)
            start, at = np.eye(4), axis.anchor
            is_last = number == len(axes) - 1 and not axis.anchor.any()
            child = name if is_last else self._link_names.unique(f"{name}_{number}")
            self._add_joint(axis, parent, child, origin)
            if not is_last:
                ET.SubElement(self.robot, "link", name=child)
            parent = child
        if not axes or at.any():
            fixed = self._joint_names.unique(f"{name}_fixed")
            joint = ET.SubElement(self.robot, "joint", name=fixed, type="fixed")
            _connect(joint, parent, name, start @ affine(np.eye(3), -at))
        link = ET.SubElement(self.robot, "link", name=name)
        self._add_inertial(link, body)
        self.shapes.add_shapes(link, body)

    def _axes(self, body: int) -> Iterator[_Axis]:
        """Iterate over the joints of a body; a ball joint is three hinges, `q = q_x q_y q_z`."""
        model = self.model
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        for joint in range(first, first + count):
            kind, anchor = model.jnt_type[joint], np.array(model.jnt_pos[joint])
            low, high = model.jnt_range[joint].tolist()
            limits = (low, high) if model.jnt_limited[joint] else None
            turns = "continuous" if limits is None else "revolute"
            if kind == _BALL:
                base, span = (
                    self._joint_name(joint),
                    None if limits is None else (-high, high),
                )
                self.notes.append(
                    f"the ball joint {base} is three hinges: {base}_x, {base}_y, {base}_z"
                )
                for letter, direction in zip("xyz", np.eye(3), strict=True):
                    name = self._joint_names.unique(f"{base}_{letter}")
                    yield _Axis(name, joint, turns, anchor, direction, 0.0, span)
            elif kind != _FREE:
                name, direction = self.joints[joint], np.array(model.jnt_axis[joint])
                reference = float(model.qpos0[model.jnt_qposadr[joint]])
                if kind == _SLIDE:
                    turns, anchor = "prismatic", np.zeros(3)
                yield _Axis(name, joint, turns, anchor, direction, reference, limits)

    def _add_joint(
        self, axis: _Axis, parent: str, child: str, origin: np.ndarray
    ) -> None:
        model, joint = self.model, axis.joint
        rule = self.rules.get(joint) if joint in self.joints else None
        limits, kind = axis.limits, axis.kind
        if rule is not None and rule.leader is None:
            limits = (rule.offset, rule.offset)
            kind = "revolute" if kind == "continuous" else kind
        element = ET.SubElement(self.robot, "joint", name=axis.name, type=kind)
        _connect(element, parent, child, origin)
        set_numbers(ET.SubElement(element, "axis"), "xyz", axis.direction)
        limit = ET.SubElement(element, "limit")
        for key, number in zip(("lower", "upper"), limits or (), strict=False):
            set_numbers(limit, key, [number])
        set_numbers(limit, "effort", [self._effort(joint)])
        dof = int(model.jnt_dofadr[joint])
        dynamics = ET.SubElement(element, "dynamics")
        set_numbers(dynamics, "damping", np.ravel(model.dof_damping[dof])[:1])
        set_numbers(dynamics, "friction", [model.dof_frictionloss[dof]])
        if rule is not None and rule.leader is not None:
            mimic = ET.SubElement(element, "mimic", joint=self.joints[rule.leader])
            set_numbers(mimic, "multiplier", [rule.multiplier])
            set_numbers(mimic, "offset", [rule.offset])

    def _effort(self, joint: int) -> float:
        """Return the largest force or torque of a joint's actuators [N or N m]."""
        model = self.model
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).max())
        is_motor = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
        is_motor &= (model.actuator_trnid[:, 0] == joint) & (
            model.actuator_forcelimited != 0
        )
        return float(
            np.abs(model.actuator_forcerange[is_motor]).max()
            if any(is_motor)
            else _NO_EFFORT_LIMIT
        )

    def _add_inertial(self, link: ET.Element, body: int) -> None:
        model = self.model
        mass, pose = (
            float(model.body_mass[body]),
            pose_of(np.zeros(3), model.body_iquat[body]),
        )
        if mass <= 0.0:
            return
        rotation = pose[:3, :3]
        inertia = rotation @ np.diag(model.body_inertia[body]) @ rotation.T
        element = ET.SubElement(link, "inertial")
        set_origin(element, affine(np.eye(3), np.array(model.body_ipos[body])))
        set_numbers(ET.SubElement(element, "mass"), "value", [mass])
        tensor = ET.SubElement(element, "inertia")
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            set_numbers(tensor, f"i{'xyz'[i]}{'xyz'[j]}", [inertia[i, j]])


def _reference_pose(axis: _Axis, place: np.ndarray) -> np.ndarray:
    """Return the pose of a joint's frame at position zero, `place` being its anchor [m]."""
    if axis.kind == "prismatic":
        return affine(np.eye(3), place - axis.reference * axis.direction)
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, axis.direction, -axis.reference)
    return pose_of(place, quat)


def _connect(joint: ET.Element, parent: str, child: str, origin: np.ndarray) -> None:
    set_origin(joint, origin)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)


def kinematics_difference(
    converted: ConvertedMjcf, postures: int = 20, seed: int = 0
) -> float:
    """Return the largest difference of an entry of any link's pose from MuJoCo's; [m] of positions.

    Hinges, slides and balls are at random positions in their ranges, independent of couplings.
    """
    model, random = converted.model, np.random.default_rng(seed)
    data, robot = (
        mujoco.MjData(model),
        pin.buildModelFromXML(_open_chain(converted.text)),
    )
    robot_data = robot.createData()
    bodies = list(converted.links)
    frames = [
        robot.getFrameId(name, pin.FrameType.BODY) for name in converted.links.values()
    ]
    worst = 0.0
    for _ in range(postures):
        data.qpos[:], q = model.qpos0, pin.neutral(robot)
        for joint in range(model.njnt):
            at = int(model.jnt_qposadr[joint])
            if model.jnt_type[joint] == _BALL:
                base, rotation = model.joint(joint).name or f"joint{joint}", np.eye(3)
                for axis, letter in zip(np.eye(3), "xyz", strict=True):
                    angle = random.uniform(*_WITHOUT_RANGE)
                    rotation = rotation @ pin.exp3(angle * axis)
                    _set_position(robot, q, f"{base}_{letter}", angle)
                mujoco.mju_mat2Quat(data.qpos[at : at + 4], rotation.ravel())
            elif joint in converted.joints:
                limits = (
                    model.jnt_range[joint]
                    if model.jnt_limited[joint]
                    else _WITHOUT_RANGE
                )
                data.qpos[at] = random.uniform(*limits)
                _set_position(robot, q, converted.joints[joint], data.qpos[at])
        mujoco.mj_kinematics(model, data)
        pin.framesForwardKinematics(robot, robot_data, q)
        for body, frame in zip(bodies, frames, strict=True):
            pose = robot_data.oMf[frame].homogeneous
            pose[:3] -= np.column_stack(
                [data.xmat[body].reshape(3, 3), data.xpos[body]]
            )
            worst = max(worst, float(np.abs(pose[:3]).max()))
    return worst


def _open_chain(text: str) -> str:
    """Return the URDF without mimic rules, each joint with all limits that Pinocchio asks for."""
    robot = parse_urdf(text)
    for joint in joints_by_name(robot).values():
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
        for limit in joint.iterfind("limit"):
            limit.attrib = (
                dict.fromkeys(("lower", "upper", "velocity"), "0") | limit.attrib
            )
    return ET.tostring(robot, encoding="unicode")


def _set_position(robot: pin.Model, q: np.ndarray, name: str, position: float) -> None:
    """Set a joint's coordinate; Pinocchio holds a continuous one as cosine and sine."""
    joint = robot.joints[robot.getJointId(name)]
    is_circle = joint.nq == 2
    q[joint.idx_q : joint.idx_q + joint.nq] = (
        (np.cos(position), np.sin(position)) if is_circle else position
    )
