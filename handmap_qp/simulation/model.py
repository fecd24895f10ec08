"""A hand and an object as a MuJoCo model: `build_model`.

Bodies and joints are those of the hand's Pinocchio model, so mirrored, mounted and cut URDFs need
no second reader. Shapes are its collision shapes; meshes are their convex hulls.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import coal
import mujoco
import numpy as np
import pinocchio as pin

from handmap_qp.grasp.objects import Box, Cylinder, Shape, Sphere
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.hand import Hand
from handmap_qp.simulation.actuators import Actuators, Drive, felt_inertia, install
from handmap_qp.simulation.physics import Body, MeshShape, Physics

OBJECT, BASE, MOCAP = "object", "base", "mocap"
"""Names of bodies and constraints of the model."""

# Who collides with whom: bits of (contype, conaffinity).
_HAND, _OBJECT = (1, 2), (2, 1)
# Least mass and inertia of a link [kg, kg m^2], and mass of a floating base [kg].
_LEAST_MASS, _LEAST_INERTIA, _BASE_MASS = 2e-3, 1e-6, 1.0
# Stiff enough for a lag of the wrist of a few milliseconds.
_WELD_TIME = 4e-3
_STIFF = [0.99, 0.999, 1e-3, 0.5, 2.0]
_IMPRATIO = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class PhysicalModel:
    """A compiled model and where its parts are.

    Attributes:
        hand: The hand.
        model: `mujoco.MjModel`.
        drive: The law of the actuators.
        base: Index of the body that carries the wrist; 0 on a hand that is fixed to the world.
        object: Index of the object's body.
        joint_q: Index in `qpos` of every joint of the hand, in the order of `hand.joint_names`.
        joint_v: Index in `qvel` of the same joints.
        all_q: Index in `qpos` of every joint in the order of `hand.all_joint_names`.
        object_q: Index of the object's first coordinate in `qpos`.
        base_q: Index of the base's first coordinate in `qpos`; -1 on a fixed hand.
    """

    hand: Hand
    model: Any
    drive: Drive
    base: int
    object: int
    joint_q: np.ndarray
    joint_v: np.ndarray
    all_q: np.ndarray
    object_q: int
    base_q: int


def build_model(hand: Hand, body: Body, physics: Physics, actuators: Actuators) -> PhysicalModel:
    """Build the model of a hand and an object.

    Args:
        hand: The hand; its root floats, or is fixed to the world.
        body: The object.
        physics: Contacts, stiffness and time steps.
        actuators: What moves the joints.

    Returns:
        The model, with one actuator for each joint of the hand.

    Raises:
        HandError: If the hand has no collision shapes, or they cannot be read.
    """
    geometry = read_collision_shapes(hand)
    if geometry.ngeoms == 0:
        raise hand.spec.error(
            "the URDF has no collision shapes to touch an object with",
            key="urdf",
            value=hand.spec.urdf,
        )
    spec = mujoco.MjSpec()
    _set_options(spec, physics)
    bodies = _add_hand(spec, hand, physics)
    _add_shapes(spec, bodies, geometry, physics)
    _add_object(spec, body, physics)
    _couple_followers(spec, hand)
    for name in hand.joint_names:
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    model = spec.compile()
    joints = [model.joint(name) for name in hand.joint_names]
    joint_v = np.array([joint.dofadr[0] for joint in joints])
    drive = actuators.drive(hand, physics, felt_inertia(model, joint_v))
    install(drive, model, hand, physics)
    return PhysicalModel(
        hand=hand,
        model=model,
        drive=drive,
        base=model.body(BASE).id if hand.is_floating else 0,
        object=model.body(OBJECT).id,
        joint_q=np.array([joint.qposadr[0] for joint in joints]),
        joint_v=joint_v,
        all_q=np.array([_address(model, name) for name in hand.all_joint_names]),
        object_q=int(model.joint(OBJECT).qposadr[0]),
        base_q=int(model.joint(BASE).qposadr[0]) if hand.is_floating else -1,
    )


def _address(model: Any, name: str) -> int:
    """Return where a joint is in `qpos`; -1 for a joint that is locked."""
    joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    return int(model.jnt_qposadr[joint]) if joint >= 0 else -1


def _set_options(spec: Any, physics: Physics) -> None:
    spec.option.timestep = physics.time_step
    spec.option.gravity = physics.gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = _IMPRATIO
    spec.option.noslip_iterations = 3
    spec.compiler.degree = False
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960


def _add_hand(spec: Any, hand: Hand, physics: Physics) -> list[Any]:
    """Add the hand's bodies and joints; return the body of each of Pinocchio's joints."""
    world = spec.worldbody
    bodies: list[Any] = [world]
    for index in range(1, hand.model.njoints):
        joint, name = hand.model.joints[index], hand.model.names[index]
        placement = hand.model.jointPlacements[index]
        if joint.nv == 6:
            mocap = world.add_body(name=MOCAP, mocap=True)
            body = world.add_body(name=BASE, gravcomp=1.0)
            body.add_freejoint(name=BASE)
            weld = spec.add_equality(
                name1=MOCAP, name2=BASE, type=mujoco.mjtEq.mjEQ_WELD,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
            )  # fmt: skip
            weld.data[10] = 1.0
            weld.solref, weld.solimp = [_WELD_TIME, 1.0], _STIFF
            assert mocap is not None
        else:
            parent = bodies[hand.model.parents[index]]
            body = parent.add_body(
                name=f"{name}_body",
                pos=placement.translation,
                quat=_wxyz(placement.rotation),
                gravcomp=1.0,
            )
            _add_joint(body, hand, index, physics)
        _set_inertia(body, hand.model.inertias[index], is_base=joint.nv == 6)
        bodies.append(body)
    return bodies


def _add_joint(body: Any, hand: Hand, index: int, physics: Physics) -> None:
    joint = hand.model.joints[index]
    subspace = np.array(joint.createData().S).reshape(6, -1)[:, 0]
    is_slide = np.linalg.norm(subspace[:3]) > 0.5
    lower, upper = (
        float(limits[joint.idx_q])
        for limits in (hand.model.lowerPositionLimit, hand.model.upperPositionLimit)
    )
    kind = mujoco.mjtJoint.mjJNT_SLIDE if is_slide else mujoco.mjtJoint.mjJNT_HINGE
    made = body.add_joint(
        name=hand.model.names[index],
        type=kind,
        axis=subspace[:3] if is_slide else subspace[3:],
        armature=physics.armature,
    )
    if np.isfinite([lower, upper]).all() and abs(lower) < 1e5 and abs(upper) < 1e5:
        made.limited, made.range = mujoco.mjtLimited.mjLIMITED_TRUE, [lower, upper]


def _set_inertia(body: Any, inertia: pin.Inertia, *, is_base: bool) -> None:
    """Set the inertia that the URDF gives; without one, it follows from the shapes' density."""
    least = _BASE_MASS if is_base else _LEAST_MASS
    if inertia.mass < 1e-6 and not is_base:
        return
    mass = max(inertia.mass, least)
    body.explicitinertial = True
    body.mass, body.ipos = mass, inertia.lever if inertia.mass > 0.0 else np.zeros(3)
    values, axes = np.linalg.eigh(inertia.inertia)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    body.iquat = _wxyz(axes)
    values = np.maximum(values, 1e-3 if is_base else _LEAST_INERTIA)
    # MuJoCo asks for the triangle inequality, which rounded URDFs miss.
    values[2] = min(values[2], values[0] + values[1])
    body.inertia = values


def _add_shapes(
    spec: Any, bodies: list[Any], geometry: pin.GeometryModel, physics: Physics
) -> None:
    counts = itertools.count()
    contype, conaffinity = _HAND
    for part in geometry.geometryObjects:
        geom = bodies[part.parentJoint].add_geom(
            pos=part.placement.translation,
            quat=_wxyz(part.placement.rotation),
            contype=contype,
            conaffinity=conaffinity,
            density=physics.density,
            rgba=[0.75, 0.77, 0.8, 1.0],
        )
        _set_contact(geom, physics)
        _set_geometry(spec, geom, part.geometry, counts)
    for body in bodies[1:]:
        if not body.explicitinertial and not body.geoms:
            body.explicitinertial = True
            body.mass, body.inertia = _LEAST_MASS, [_LEAST_INERTIA] * 3


def _set_geometry(spec: Any, geom: Any, shape: Any, counts: itertools.count[int]) -> None:
    kinds = mujoco.mjtGeom
    if isinstance(shape, coal.Box):
        geom.type, geom.size = kinds.mjGEOM_BOX, shape.halfSide
    elif isinstance(shape, coal.Sphere):
        geom.type, geom.size = kinds.mjGEOM_SPHERE, [shape.radius, 0.0, 0.0]
    elif isinstance(shape, coal.Capsule):
        geom.type, geom.size = kinds.mjGEOM_CAPSULE, [shape.radius, shape.halfLength, 0.0]
    elif isinstance(shape, coal.Cylinder):
        geom.type, geom.size = kinds.mjGEOM_CYLINDER, [shape.radius, shape.halfLength, 0.0]
    else:
        points = np.array([shape.point(i) for i in range(shape.num_points)])
        _set_mesh(spec, geom, points, f"hull{next(counts)}")


def _set_mesh(spec: Any, geom: Any, points: np.ndarray, name: str) -> None:
    spec.add_mesh(name=name, uservert=points.ravel().tolist())
    geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, name


def _add_object(spec: Any, body: Body, physics: Physics) -> None:
    held = spec.worldbody.add_body(name=OBJECT)
    held.add_freejoint(name=OBJECT)
    contype, conaffinity = _OBJECT
    geom = held.add_geom(
        name=OBJECT,
        contype=contype,
        conaffinity=conaffinity,
        mass=body.mass,
        rgba=[0.93, 0.55, 0.15, 1.0],
    )
    _set_contact(geom, physics)
    _set_shape(spec, geom, body.shape)


def _set_shape(spec: Any, geom: Any, shape: Shape | MeshShape) -> None:
    kinds = mujoco.mjtGeom
    if isinstance(shape, Box):
        geom.type, geom.size = kinds.mjGEOM_BOX, np.array(shape.size) / 2.0
    elif isinstance(shape, Sphere):
        geom.type, geom.size = kinds.mjGEOM_SPHERE, [shape.radius, 0.0, 0.0]
    elif isinstance(shape, Cylinder):
        geom.type, geom.size = kinds.mjGEOM_CYLINDER, [shape.radius, shape.length / 2.0, 0.0]
    else:
        _set_mesh(spec, geom, shape.points, "object_hull")


def _set_contact(geom: Any, physics: Physics) -> None:
    geom.condim = 4 if physics.torsion > 0.0 else 3
    geom.friction = [physics.friction, max(physics.torsion, 1e-5), 1e-5]
    geom.solref, geom.solimp = [physics.contact_time, 1.0], [0.95, 0.99, 5e-4, 0.5, 2.0]


def _couple_followers(spec: Any, hand: Hand) -> None:
    """Hold every mimic joint at the position that the hand's rules give it."""
    names = list(hand.all_joint_names)
    zero = hand.all_joints(np.zeros(len(hand.joint_names)))
    for row, name in enumerate(names):
        if hand.all_joint_roles[row] != "follower":
            continue
        factors = np.array(
            [hand.all_joints(unit)[row] - zero[row] for unit in np.eye(len(hand.joint_names))]
        )
        leader = int(np.argmax(np.abs(factors)))
        if not hand.model.existJointName(name):
            continue
        rule = spec.add_equality(
            name1=name,
            name2=hand.joint_names[leader],
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
        )
        rule.data[:2] = [zero[row], factors[leader]]
        rule.solref, rule.solimp = [_WELD_TIME, 1.0], _STIFF


def _wxyz(rotation: np.ndarray) -> np.ndarray:
    x, y, z, w = pin.Quaternion(rotation).normalized().coeffs()
    return np.array([w, x, y, z])
