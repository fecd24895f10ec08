"""From an MJCF file to a URDF with the same kinematics: `ConvertedMjcf`, `cached_urdf`.

A link is a body and has its frame. A body with several joints gets a massless link between each two
of them, a ball joint becomes three hinges. Anchors, axes and frames are those that MuJoCo computes
where all joints are at zero, so that a joint's position is MuJoCo's.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import math
import os
import re
import tempfile
from collections.abc import Iterator
from functools import cache, cached_property
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import mujoco
import numpy as np
import pinocchio as pin
import trimesh

from handmap_core.errors import HandError, reason_of
from handmap_core.hands import Names
from handmap_core.se3 import Array, affine, inverse_pose, rotation_from_quat_wxyz
from .mjcf_couplings import read_couplings
from .mjcf_speeds import top_speeds
from .sources import find_mesh, is_lfs_pointer, root_tag
from .urdf import LOOP_END, USUAL_SPEEDS, add_held, add_mimic, set_numbers, set_origin

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
# Last group of geoms that MuJoCo's viewer shows unless it is asked for more.
_LAST_SHOWN_GROUP = 2
# Effort [N or N m] of a joint whose actuators have no limit.
_NO_EFFORT_LIMIT = 1e6
# Counts changes of the conversion, so that URDFs of an earlier one are not used.
_CONVERSION = 10
# In a file that this one names, the message has other words before these.
_UNKNOWN = re.compile(
    r"XML Error: Schema violation: unrecognized attribute: '(\w+)'\s+"
    r"Element '(\w+)', line (\d+)"
)
# Radius of a ball in the place of a lost mesh [m].
_RADIUS = 0.006
# A range of this size in radians is one of pi in degrees [rad].
_SMALL_RANGE = 0.06


def _compile(file: Path) -> tuple[mujoco.MjModel, str, Names]:
    """Return a compiled file, its name, and a note if its unit of angles was guessed.

    Parts of robots often rely on the `compiler` element of files that include them for radians:
    where every hinge would move by a few degrees at most, angles are taken as radians.
    """
    try:
        if root_tag(file.read_bytes()) == "mujocoinclude":
            problem = "is a part that other MJCF files include"
            raise HandError(f"{problem}: give the file that includes it", file=file)
        spec, notes = _parse(file)
        # Keep bodies without joints, and shapes that only show.
        spec.compiler.fusestatic = spec.compiler.discardvisual = False
        notes += _find_assets(spec, file.parent)
        model = spec.compile()
        is_hinge = model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)
        ranges = model.jnt_range[is_hinge & (model.jnt_limited != 0)]
        widest = np.ptp(ranges, axis=1).max(initial=0.0)
        if spec.compiler.degree and 0.0 < widest < _SMALL_RANGE:
            what = f"ranges of at most {math.degrees(widest):.2g} deg make no sense"
            notes += (f"{what}: angles are taken as radians",)
            spec.compiler.degree = False
            model = spec.compile()
        # Bindings decode names only when they are asked for them.
        bytes(model.names).decode()
    except OSError as error:
        raise HandError(f"cannot be read: {reason_of(error)}", file=file) from error
    except UnicodeDecodeError as error:
        raise HandError("a word in the MJCF is not UTF-8", file=file) from error
    except (ValueError, RuntimeError) as error:
        problem = f"MuJoCo cannot compile the MJCF: {reason_of(error)}"
        raise HandError(problem, file=file) from error
    if (model.jnt_type == _FREE).all():
        raise HandError("no joint moves in the MJCF", file=file)
    _check_finite(model, file)
    is_unnamed = spec.modelname in ("", "MuJoCo Model")
    return model, file.stem if is_unnamed else spec.modelname, notes


def _check_finite(model: mujoco.MjModel, file: Path) -> None:
    """Reject numbers that MuJoCo takes, and a URDF cannot have."""
    numbers = {
        "pos": (model.body_pos, model.geom_pos, model.jnt_pos, model.body_ipos),
        "quat": (model.body_quat, model.geom_quat, model.body_iquat),
        "range": (model.jnt_range,),
        "axis": (model.jnt_axis,),
        "ref": (model.qpos0,),
        "size": (model.geom_size,),
        "mass": (model.body_mass, model.body_inertia),
        "damping": (model.dof_damping, model.dof_frictionloss),
        "forcerange": (model.actuator_forcerange, model.jnt_actfrcrange),
    }
    for key, arrays in numbers.items():
        if not all(np.isfinite(values).all() for values in arrays):
            problem = f"a number in an attribute `{key}` of the MJCF is not finite"
            raise HandError(problem, file=file)


def _parse(file: Path) -> tuple[mujoco.MjSpec, Names]:
    """Parse a file without attributes that only older versions of MuJoCo know, which are noted."""
    text = ""
    notes = dict[str, None]()
    while True:
        try:
            parse = mujoco.MjSpec
            spec = parse.from_string(text) if text else parse.from_file(str(file))
            return spec, (*notes,)
        except ValueError as error:
            unknown = _UNKNOWN.match(str(error))
            # MuJoCo names a line: every element gets one of its own.
            known = text or " ".join(file.read_text().splitlines()).replace("<", "\n<")
            if not unknown or "<include" in known:
                raise
            if text:
                name, element, line = unknown.groups()
                start = rf"\A((?:.*\n){{{int(line) - 1}}}.*?)"
                known = re.sub(rf"{start}\s{name}\s*=\s*(['\"]).*?\2", r"\1", text)
                if known == text:
                    raise
                note = f"{name} of {element} is unknown to MuJoCo: it is left out"
                notes[note] = None
            text = known


def _find_assets(spec: mujoco.MjSpec, folder: Path) -> Names:
    """Find meshes by their names, with balls for lost ones, which are noted; drop what colours."""
    for element in (*spec.geoms, *spec.sites, *spec.tendons):
        element.material = ""
    for asset in (*spec.materials, *spec.textures):
        spec.delete(asset)
    lost = set()
    pointers = set()
    for mesh in [mesh for mesh in spec.meshes if mesh.file]:
        path = find_mesh(mesh.file, folder / spec.meshdir)
        if is_lfs_pointer(path):
            pointers.add(mesh.name)
        if path.exists() and mesh.name not in pointers:
            mesh.file = str(path.resolve())
        else:
            lost.add(mesh.name)
            spec.delete(mesh)
    for geom in spec.geoms:
        if geom.meshname in lost:
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
            geom.meshname = ""
            geom.size[0] = _RADIUS
    if not lost:
        return ()
    note = f"balls are in the place of missing meshes: {', '.join(sorted(lost))}"
    advice = (
        "; pointers of git-lfs are in their place: run `git lfs pull` in the repository"
    )
    return (note + advice * bool(pointers),)


def write_converted(converted: ConvertedMjcf, urdf: Path) -> None:
    """Write a URDF and its meshes; folders are made where they are missing.

    Raises:
        OSError: If a file cannot be written.
    """
    urdf.parent.mkdir(parents=True, exist_ok=True)
    urdf.write_text(converted.text, encoding="utf-8")
    for name, mesh in converted.meshes.items():
        file = urdf.parent / name
        file.parent.mkdir(exist_ok=True)
        mesh.export(file)


def kinematics_difference(converted: ConvertedMjcf, postures: int = 20) -> float:
    """Return the largest difference of an entry of any link's pose from MuJoCo's; [m] of positions.

    Hinges and slides are at random positions, independent of couplings; balls are at rest.
    """
    model = converted.model
    random = np.random.default_rng(0)
    data = mujoco.MjData(model)
    robot = pin.buildModelFromXML(converted.text)
    robot_data = robot.createData()
    worst = 0.0
    for _ in range(postures):
        turns = np.zeros(robot.nv)
        for joint, name in converted.joints.items():
            column = robot.idx_vs[robot.getJointId(name)]
            turns[column] = random.uniform(-1.0, 1.0)
            data.qpos[model.jnt_qposadr[joint]] = turns[column]
        mujoco.mj_kinematics(model, data)
        q = pin.integrate(robot, pin.neutral(robot), turns)
        pin.framesForwardKinematics(robot, robot_data, q)
        for body, link in converted.links.items():
            placed = robot_data.oMf[robot.getBodyId(link)].homogeneous
            apart = placed - _body_pose(data, body)
            worst = max(worst, np.abs(apart).max())
    return worst


@cache
def _version(package: str) -> str:
    """Return the version of an installed package, which takes 2 ms to read."""
    return importlib.metadata.version(package)


def cached_urdf(file: Path, converted: ConvertedMjcf | None = None) -> Path:
    """Return the URDF of an MJCF file in the user's cache; its meshes lie beside it.

    It is converted again if an XML file beside the MJCF has changed. The cache is in
    `$XDG_CACHE_HOME`, else in `~/.cache`.

    Args:
        file: The MJCF file.
        converted: Its conversion, if there is one already.

    Raises:
        HandError: If MuJoCo cannot compile the file, or the cache cannot be written.
    """
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    cache = Path(home) / "handmap_qp/mjcf"
    versions = [_version(name) for name in ("handmap-qp", "mujoco")]
    others = sorted(file.parent.glob("*.xml"))
    files = [(o.name, o.stat().st_size, o.stat().st_mtime_ns) for o in others]
    key = repr((file.resolve(), versions, _CONVERSION, files))
    digest = hashlib.sha256(key.encode()).hexdigest()[:16]
    folder = cache / f"{file.stem}-{digest}"
    urdf = folder / f"{file.stem}.urdf"
    if urdf.is_file():
        return urdf
    converted = converted or ConvertedMjcf(file)
    try:
        cache.mkdir(parents=True, exist_ok=True)
        # Another process may convert the same file: the first complete folder stays.
        temporary = Path(tempfile.mkdtemp(dir=cache))
        write_converted(converted, temporary / urdf.name)
        temporary.rename(folder)
    except OSError as error:
        if not urdf.is_file():
            problem = f"the cache {folder} cannot be written"
            raise HandError(f"{problem}: {reason_of(error)}", file=file) from error
    return urdf


class ConvertedMjcf:
    """An MJCF model as a URDF, not yet written.

    Bodies that hang from the world and have no joints, or only a free joint, are scenery and
    objects: they are left out. A free joint under a robot is left out too, because the wrist of a
    `hand.yaml` floats without it.

    Args:
        file: The MJCF file.
        folder: Folder of the meshes, relative to the URDF.

    Attributes:
        text: The URDF.
        meshes: Its meshes [m] by file, relative to the URDF.
        notes: What a URDF cannot express, one sentence each.
        model: The compiled model.
        links: Name of the link of each body, by the body's index.
        joints: Name of each hinge and slide joint, by its index.

    Raises:
        HandError: If MuJoCo cannot compile the file, in its words, or no joint moves in it.
    """

    def __init__(self, file: Path, folder: str = "meshes") -> None:
        self.model, name, self.notes = _compile(file)
        model = self.model
        self.meshes: dict[str, trimesh.Trimesh] = {}
        self._folder = folder
        self._taken = set[tuple[str, str]]()
        self._files = [
            self._unique("mesh", _file_name(model.mesh(i).name or f"mesh{i}"))
            for i in range(model.nmesh)
        ]
        self.links = {
            body: self._unique("link", model.body(body).name or f"body{body}")
            for body in self._kept()
        }
        self.joints = {
            joint: self._unique("joint", _joint_name(model, joint))
            for joint in range(model.njnt)
            if model.jnt_type[joint] not in (_FREE, _BALL)
            and model.jnt_bodyid[joint] in self.links
        }
        self._data = mujoco.MjData(model)
        self._data.qpos[model.jnt_qposadr[[*self.joints]]] = 0.0
        mujoco.mj_kinematics(model, self._data)
        self._couplings = read_couplings(model, self.joints)
        speeds = "{revolute:g} rad/s and {prismatic:g} m/s".format(**USUAL_SPEEDS)
        self.notes += (
            f"MuJoCo has no speed limits: the URDF has {speeds}",
            *self._couplings.notes,
        )
        # Kinds of geoms that have no counterpart in URDF.
        self._omitted = set[str]()
        self.text = self._described(name)

    def _described(self, name: str) -> str:
        """Return the URDF with all links and joints."""
        robot = Element("robot", name=_file_name(name))
        for body, link in self.links.items():
            if body == 0:
                SubElement(robot, "link", name=link)
            else:
                self._add_body(robot, body, link)
        if self._omitted:
            kinds = ", ".join(sorted(self._omitted))
            self.notes += (
                f"shapes without a counterpart in URDF are left out: {kinds}",
            )
        indent(robot)
        return tostring(robot, encoding="unicode") + "\n"

    def _unique(self, kind: str, name: str) -> str:
        """Return a name that no other thing of a kind has, whatever its case."""
        found = name
        number = 1
        while (kind, found.lower()) in self._taken:
            number += 1
            found = f"{name}_{number}"
        self._taken.add((kind, found.lower()))
        return found

    @cached_property
    def speeds(self) -> dict[str, float]:
        """Top speed of each hinge and slide under its actuators (`top_speeds`) by name.

        In rad/s or m/s; the URDF does not have it. Joints without one get the median of their type;
        it is empty if no actuator of that type tells one.
        """
        known = top_speeds(self.model)
        kinds = self.model.jnt_type
        usual = dict[int, list[float]]()
        for joint, speed in known.items():
            usual.setdefault(int(kinds[joint]), []).append(speed)
        return {
            name: known.get(joint, float(np.median(usual[int(kinds[joint])])))
            for joint, name in self.joints.items()
            if int(kinds[joint]) in usual
        }

    def _kept(self) -> list[int]:
        """Return the world and the bodies of all trees with a hinge, a slide or a ball."""
        model = self.model
        roots = model.body_rootid[model.jnt_bodyid[model.jnt_type != _FREE]]
        is_kept = np.isin(model.body_rootid, [0, *roots])
        left = np.flatnonzero(~is_kept & (model.body_parentid == 0)).tolist()
        if left:
            names = ", ".join(model.body(b).name or f"body {b}" for b in left)
            self.notes += (f"bodies without joints of their own are left out: {names}",)
        return np.flatnonzero(is_kept).tolist()

    def _add_body(self, robot: Element, body: int, name: str) -> None:
        """Add a body's link, the joints that move it, and the links between these."""
        above = self.model.body_parentid[body]
        pose = _body_pose(self._data, body)
        parent = self.links[above]
        placed = _body_pose(self._data, above)
        steps = [*self._steps(body)]
        inner = [self._unique("link", f"{name}_{k}") for k in range(len(steps) - 1)]
        for (joint, title, direction), link in zip(steps, [*inner, name], strict=True):
            element = SubElement(robot, "joint", name=title, type="fixed")
            frame = pose
            if joint is not None:
                self._describe(element, joint, direction)
                if self.model.jnt_type[joint] != _SLIDE:
                    frame = affine(pose[:3, :3], self._data.xanchor[joint])
            set_origin(element, inverse_pose(placed) @ frame)
            SubElement(element, "parent", link=parent)
            SubElement(element, "child", link=link)
            SubElement(robot, "link", name=link)
            placed = frame
            parent = link
        # The last link is the body's own.
        if body in self._couplings.bars:
            SubElement(robot[-1], LOOP_END)
        self._add_inertial(robot[-1], body)
        self._add_shapes(robot[-1], body)

    def _steps(self, body: int) -> Iterator[tuple[int | None, str, Array]]:
        """Iterate over the axes that move a body: joint, name, unit vector in the body's frame.

        A ball joint is three hinges, `q = q_x q_y q_z`. Without a joint, a last step leads to a
        frame beside that of the last axis.
        """
        model = self.model
        to_body = self._data.xmat[body].reshape(3, 3).T
        is_own = (model.jnt_bodyid == body) & (model.jnt_type != _FREE)
        is_there = False
        for joint in np.flatnonzero(is_own).tolist():
            is_there = model.jnt_type[joint] == _SLIDE or not model.jnt_pos[joint].any()
            if joint in self.joints:
                yield joint, self.joints[joint], to_body @ self._data.xaxis[joint]
                continue
            name = _joint_name(model, joint)
            names = [self._unique("joint", f"{name}_{letter}") for letter in "xyz"]
            hinges = ", ".join(names)
            self.notes += (f"the ball joint {name} is three hinges: {hinges}",)
            for axis in zip(names, np.eye(3), strict=True):
                yield joint, *axis
        if not is_there:
            name = self._unique("joint", f"{self.links[body]}_fixed")
            yield None, name, np.zeros(3)

    def _describe(self, element: Element, joint: int, direction: Array) -> None:
        """Write an axis of a joint, its limits, dynamics and mimic rule."""
        model = self.model
        kind = model.jnt_type[joint]
        name = element.get("name", "")
        rule = self._couplings.rules.get(name)
        low, high = self._couplings.ranges.get(name, model.jnt_range[joint])
        ends: dict[str, float] = {}
        if rule and not rule.joint:
            ends = {"lower": rule.offset, "upper": rule.offset}
        elif model.jnt_limited[joint] or name in self._couplings.ranges:
            # MuJoCo's range of a ball is [0, largest angle].
            ends = {"lower": -high if kind == _BALL else low, "upper": high}
        turning = "revolute" if ends else "continuous"
        turning = "prismatic" if kind == _SLIDE else turning
        element.set("type", turning)
        set_numbers(SubElement(element, "axis"), xyz=np.round(direction, 14))
        ends |= {"effort": self._effort(joint), "velocity": USUAL_SPEEDS[turning]}
        set_numbers(SubElement(element, "limit"), **ends)
        dof = model.jnt_dofadr[joint]
        damping = np.ravel(model.dof_damping[dof])[:1]
        friction = model.dof_frictionloss[dof]
        set_numbers(SubElement(element, "dynamics"), damping=damping, friction=friction)
        if rule and rule.joint:
            add_mimic(element, rule)
        if reason := self._couplings.reasons.get(name):
            add_held(element, reason)

    def _effort(self, joint: int) -> float:
        """Return the largest force or torque of a joint's actuators [N or N m]."""
        model = self.model
        is_own = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
        is_own &= model.actuator_trnid[:, 0] == joint
        ranges = model.actuator_forcerange[is_own & (model.actuator_forcelimited != 0)]
        if model.jnt_actfrclimited[joint]:
            ranges = model.jnt_actfrcrange[joint]
        return float(np.abs(ranges).max(initial=0.0)) or _NO_EFFORT_LIMIT

    def _add_inertial(self, link: Element, body: int) -> None:
        model = self.model
        if not model.body_mass[body] > 0.0:
            return
        element = SubElement(link, "inertial")
        # Along the principal axes, in which the inertia is diagonal.
        turn = rotation_from_quat_wxyz(model.body_iquat[body])
        set_origin(element, affine(turn, model.body_ipos[body]))
        set_numbers(SubElement(element, "mass"), value=model.body_mass[body])
        xx, yy, zz = model.body_inertia[body]
        inertia = SubElement(element, "inertia")
        set_numbers(inertia, ixx=xx, ixy=0, ixz=0, iyy=yy, iyz=0, izz=zz)

    def _add_shapes(self, link: Element, body: int) -> None:
        """Add the geoms of a body to its `<link>`, whose frame is the body's.

        A geom with `contype = conaffinity = 0` is visual. The others collide; they also show if
        their body has no visual geom, or if they are meshes that MuJoCo's viewer shows (groups 0 to
        2).
        """
        model = self.model
        geoms = np.flatnonzero(model.geom_bodyid == body)
        collides = (model.geom_contype | model.geom_conaffinity)[geoms] != 0
        is_mesh = model.geom_type[geoms] == _MESH
        is_seen = ~collides | (is_mesh & (model.geom_group[geoms] <= _LAST_SHOWN_GROUP))
        shown = geoms[is_seen | collides.all()]
        for tag, chosen in (("visual", shown), ("collision", geoms[collides])):
            for geom in chosen:
                for pose, geometry in self._geometries(geom):
                    element = SubElement(link, tag, name=model.geom(geom).name)
                    set_origin(element, pose)
                    SubElement(element, "geometry").append(geometry)

    def _geometries(self, geom: int) -> Iterator[tuple[Array, Element]]:
        """Iterate over the URDF geometries of a geom, with their poses in the link."""
        model = self.model
        size = model.geom_size[geom]
        turn = rotation_from_quat_wxyz(model.geom_quat[geom])
        pose = affine(turn, model.geom_pos[geom])
        kind = mujoco.mjtGeom(int(model.geom_type[geom])).name
        ball = set_numbers(Element("sphere"), radius=size[0])
        match kind := kind.removeprefix("mjGEOM_").lower():
            case "mesh" | "sdf":
                yield pose, self._mesh(int(model.geom_dataid[geom]))
            case "box":
                yield pose, set_numbers(Element("box"), size=2.0 * size)
            case "sphere":
                yield pose, ball
            case "cylinder" | "capsule":
                cylinder = Element("cylinder")
                yield pose, set_numbers(cylinder, radius=size[0], length=2.0 * size[1])
                # URDF has no capsules.
                for sign in (-1.0, 1.0) if kind == "capsule" else ():
                    yield pose @ affine(np.eye(3), (0.0, 0.0, sign * size[1])), ball
            case "ellipsoid":
                file = f"{self._folder}/unit_sphere.stl"
                self.meshes.setdefault(file, trimesh.creation.icosphere())
                yield pose, set_numbers(Element("mesh", filename=file), scale=size)
            case _:
                self._omitted.add(kind)

    def _mesh(self, mesh: int) -> Element:
        own = self.model.mesh(mesh)
        vertices = self.model.mesh_vert[own.vertadr[0] :][: own.vertnum[0]]
        faces = self.model.mesh_face[own.faceadr[0] :][: own.facenum[0]]
        file = f"{self._folder}/{self._files[mesh]}.stl"
        self.meshes[file] = trimesh.Trimesh(vertices, faces, process=False)
        return Element("mesh", filename=file)


def _body_pose(data: mujoco.MjData, body: int) -> Array:
    """Return the pose of a body in the world, shape (4, 4)."""
    return affine(data.xmat[body].reshape(3, 3), data.xpos[body])


def _joint_name(model: mujoco.MjModel, joint: int) -> str:
    return model.joint(joint).name or f"joint{joint}"


def _file_name(name: str) -> str:
    """Return a name as that of a file, without unusual characters."""
    return re.sub(r"[^\w.-]", "_", name).lstrip(".") or "mesh"
