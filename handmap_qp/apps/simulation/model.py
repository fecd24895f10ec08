"""A hand and an object as a MuJoCo model: `build_model`.

Bodies and joints are those of the hand's Pinocchio model, so mirrored, mounted and cut URDFs need
no second reader. Shapes are its collision shapes; meshes are their convex hulls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import coal
import mujoco
import numpy as np
import pinocchio as pin

from handmap_qp.apps.simulation.objects import Box, Cylinder, Sphere
from handmap_qp.apps.simulation.physics import Body, MeshShape, Physics
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.hand import Hand

OBJECT = "object"
BASE = "base"
MOCAP = "mocap"
"""Names of bodies and constraints of the model."""

# Who collides with whom.
_HAND = {"contype": 1, "conaffinity": 2}
_HELD = {"contype": 2, "conaffinity": 1}
# Least mass and inertia of a link [kg, kg m^2], and those of a floating base.
_LEAST = (2e-3, 1e-6)
_LEAST_OF_BASE = (1.0, 1e-3)
# Stiff enough for a lag of the wrist of a few milliseconds.
_STIFF = {"solref": [4e-3, 1.0], "solimp": [0.99, 0.999, 1e-3, 0.5, 2.0]}
# Limits beyond this stand for none [rad or m].
_UNLIMITED = 1e5


@dataclass(frozen=True, slots=True, eq=False)
class PhysicalModel:
    """A compiled model, the law of its actuators, and where its parts are.

    Attributes:
        model: `mujoco.MjModel`.
        stiffness: K of the actuators [N m/rad, N/m for slides], shape (n, n).
        damping: D, critical for every mode of K and the joints' inertias [N m s/rad], shape (n, n).
        is_torque: Whether each joint's control is a torque, not a position, shape (n,).
        object: Index of the object's body.
        joint_q: Index in `qpos` of every joint of the hand, in the order of `hand.joint_names`.
        joint_v: Index in `qvel` of the same joints.
        all_q: Index in `qpos` of every joint in the order of `hand.all_joint_names`; -1 if locked.
    """

    model: Any
    stiffness: np.ndarray
    damping: np.ndarray
    is_torque: np.ndarray
    object: int
    joint_q: np.ndarray
    joint_v: np.ndarray
    all_q: np.ndarray

    def controls(
        self, command: np.ndarray, q: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return what the actuators are told, shape (n,).

        Args:
            command: Commanded joint angles [rad], shape (n,).
            q: Joint angles now [rad], shape (n,).
            velocity: Joint velocities now [rad/s], shape (n,).

        Returns:
            Torques [N m], or positions [rad] for servos.
        """
        if not self.is_torque.any():
            return command
        torques = self.stiffness @ (command - q) - self.damping @ velocity
        return np.where(self.is_torque, torques, command)


def build_model(
    hand: Hand, body: Body, physics: Physics, compliance: np.ndarray | None = None
) -> PhysicalModel:
    """Build the model of a hand and an object.

    Args:
        hand: The hand; its root floats, or is fixed to the world.
        body: The object.
        physics: Contacts, stiffness and time steps.
        compliance: Compliance in series with that of the joints [rad/(N m)], shape (n, n).

    Returns:
        The model, with one actuator for each joint of the hand.

    Raises:
        HandError: If the hand has no collision shapes, or they cannot be read.
        InvalidInputError: If the compliance is of another shape.
    """
    geometry = read_collision_shapes(hand)
    if geometry.ngeoms == 0:
        raise hand.spec.error(
            "the URDF has no collision shapes to touch an object with",
            key="urdf",
            value=hand.spec.urdf,
        )
    spec = _empty_spec(physics)
    bodies = _add_hand(spec, hand, physics)
    _add_shapes(spec, bodies, geometry, physics)
    held = spec.worldbody.add_body(name=OBJECT)
    held.add_freejoint(name=OBJECT)
    geom = held.add_geom(name=OBJECT, mass=body.mass, **_HELD)
    _set_geom(spec, geom, body.shape, physics)
    _couple_followers(spec, hand)
    for name in hand.joint_names:
        actuator = spec.add_actuator(
            name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    model = spec.compile()
    found = {model.joint(i).name: model.joint(i) for i in range(model.njnt)}
    joints = [found[name] for name in hand.joint_names]
    joint_v = np.array([joint.dofadr[0] for joint in joints])
    return PhysicalModel(
        model,
        *_install_actuators(model, joint_v, hand, physics, compliance),
        object=model.body(OBJECT).id,
        joint_q=np.array([joint.qposadr[0] for joint in joints]),
        joint_v=joint_v,
        all_q=np.array(
            [
                found[name].qposadr[0] if name in found else -1
                for name in hand.all_joint_names
            ]
        ),
    )


def _empty_spec(physics: Physics) -> Any:
    spec = mujoco.MjSpec()
    spec.option.timestep = physics.time_step
    spec.option.gravity = physics.gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 100.0
    spec.option.noslip_iterations = 3
    spec.compiler.degree = False
    return spec


def _add_hand(spec: Any, hand: Hand, physics: Physics) -> list[Any]:
    """Add the hand's bodies and joints; return the body of each of Pinocchio's joints."""
    world, model = spec.worldbody, hand.model
    bodies: list[Any] = [world]
    for index in range(1, model.njoints):
        is_base = model.joints[index].nv == 6
        if is_base:
            world.add_body(name=MOCAP, mocap=True)
            body = world.add_body(name=BASE, gravcomp=1.0)
            body.add_freejoint(name=BASE)
            _add_equality(spec, "WELD", "BODY", MOCAP, BASE).data[10] = 1.0
        else:
            placement = model.jointPlacements[index]
            body = bodies[model.parents[index]].add_body(
                name=model.names[index],
                pos=placement.translation,
                quat=_wxyz(placement.rotation),
                gravcomp=1.0,
            )
            _add_joint(body, model, index, physics.armature)
        _set_inertia(body, model.inertias[index], is_base=is_base)
        bodies.append(body)
    return bodies


def _add_joint(body: Any, model: pin.Model, index: int, armature: float) -> None:
    joint = model.joints[index]
    subspace = np.array(joint.createData().S).reshape(6, -1)[:, 0]
    is_slide = np.linalg.norm(subspace[:3]) > 0.5
    kinds = mujoco.mjtJoint
    made = body.add_joint(
        name=model.names[index],
        type=kinds.mjJNT_SLIDE if is_slide else kinds.mjJNT_HINGE,
        axis=subspace[:3] if is_slide else subspace[3:],
        armature=armature,
    )
    ends = [
        model.lowerPositionLimit[joint.idx_q],
        model.upperPositionLimit[joint.idx_q],
    ]
    if np.abs(ends).max() < _UNLIMITED:
        made.limited, made.range = mujoco.mjtLimited.mjLIMITED_TRUE, ends


def _set_inertia(body: Any, inertia: pin.Inertia, *, is_base: bool) -> None:
    """Set the inertia that the URDF gives; without one, it follows from the shapes' density."""
    if inertia.mass < 1e-6 and not is_base:
        return
    mass, least = _LEAST_OF_BASE if is_base else _LEAST
    body.explicitinertial = True
    body.mass = max(inertia.mass, mass)
    body.ipos = inertia.lever if inertia.mass > 0.0 else np.zeros(3)
    values, axes = np.linalg.eigh(inertia.inertia)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    body.iquat = _wxyz(axes)
    values = np.maximum(values, least)
    # MuJoCo asks for the triangle inequality, which rounded URDFs miss.
    values[2] = min(values[2], values[0] + values[1])
    body.inertia = values


def _add_shapes(
    spec: Any, bodies: list[Any], geometry: pin.GeometryModel, physics: Physics
) -> None:
    for part in geometry.geometryObjects:
        place = {
            "pos": part.placement.translation,
            "quat": _wxyz(part.placement.rotation),
        }
        geom = bodies[part.parentJoint].add_geom(
            density=physics.density, **place, **_HAND
        )
        _set_geom(spec, geom, part.geometry, physics)
    for link in bodies[1:]:
        if not link.explicitinertial and not link.geoms:
            link.explicitinertial = True
            link.mass, link.inertia = _LEAST[0], [_LEAST[1]] * 3


def _set_geom(spec: Any, geom: Any, shape: Any, physics: Physics) -> None:
    """Give a geom its shape and how it touches: one of ours, or one of coal's."""
    geom.condim = 4 if physics.torsion > 0.0 else 3
    geom.friction = [physics.friction, max(physics.torsion, 1e-5), 1e-5]
    geom.solref, geom.solimp = [physics.contact_time, 1.0], [0.95, 0.99, 5e-4, 0.5, 2.0]
    match shape:
        case coal.Box():
            kind, size = "BOX", shape.halfSide
        case Box():
            kind, size = "BOX", np.array(shape.size) / 2.0
        case coal.Sphere() | Sphere():
            kind, size = "SPHERE", [shape.radius, 0.0, 0.0]
        case coal.Capsule():
            kind = "CAPSULE"
            size = [shape.radius, shape.halfLength, 0.0]
        case coal.Cylinder():
            kind = "CYLINDER"
            size = [shape.radius, shape.halfLength, 0.0]
        case Cylinder():
            kind = "CYLINDER"
            size = [shape.radius, shape.length / 2.0, 0.0]
        case _:
            _set_hull(spec, geom, shape)
            return
    geom.type, geom.size = getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), size


def _set_hull(spec: Any, geom: Any, shape: Any) -> None:
    """Give a geom the convex hull of a mesh."""
    points = (
        shape.points
        if isinstance(shape, MeshShape)
        else np.array([shape.point(i) for i in range(shape.num_points)])
    )
    name = f"hull{len(spec.meshes)}"
    spec.add_mesh(name=name, uservert=points.ravel().tolist())
    geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, name


def _couple_followers(spec: Any, hand: Hand) -> None:
    """Hold every mimic joint at the position that the hand's rules give it."""
    # A row each: all joints at zero, and with one joint of the hand at 1.
    positions = hand.all_joints(np.eye(len(hand.joint_names) + 1)[:, 1:]).T
    rules = zip(hand.all_joint_names, hand.all_joint_roles, positions, strict=True)
    for name, role, (zero, *others) in rules:
        if role == "follower" and hand.model.existJointName(name):
            factors = np.array(others) - zero
            leader = int(np.argmax(np.abs(factors)))
            rule = _add_equality(spec, "JOINT", "JOINT", name, hand.joint_names[leader])
            rule.data[:2] = [zero, factors[leader]]


def _add_equality(spec: Any, kind: str, of: str, one: str, other: str) -> Any:
    return spec.add_equality(
        name1=one,
        name2=other,
        type=getattr(mujoco.mjtEq, f"mjEQ_{kind}"),
        objtype=getattr(mujoco.mjtObj, f"mjOBJ_{of}"),
        **_STIFF,
    )


def _install_actuators(
    model: Any,
    joint_v: np.ndarray,
    hand: Hand,
    physics: Physics,
    compliance: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Set up the actuators of a compiled model; return stiffness, damping and `is_torque`."""
    arm = () if hand.spec.arm is None else hand.spec.arm.joints
    is_arm = np.array([name in arm for name in hand.joint_names])
    stiffness = np.diag(
        np.where(is_arm, physics.arm_stiffness, physics.joint_stiffness)
    )
    if compliance is not None:
        if compliance.shape != stiffness.shape:
            expected = f"shape {stiffness.shape}, as {hand.name} has joints"
            raise InvalidInputError(
                argument="compliance",
                expected=expected,
                got=f"shape {compliance.shape}",
            )
        stiffness = np.linalg.inv(np.linalg.inv(stiffness) + compliance)
    damping = _critical(stiffness, model.dof_M0[joint_v])
    is_torque = ~is_arm & (physics.actuators == "torque")
    gains = np.diag(stiffness)
    joints = model.dof_jntid[joint_v]
    bias = np.column_stack([np.zeros_like(gains), -gains, -np.diag(damping)])
    model.actuator_gainprm[:, 0] = np.where(is_torque, 1.0, gains)
    model.actuator_biasprm[:, :3] = np.where(is_torque[:, None], 0.0, bias)
    # The torque that carries the hand's own weight is a motor's, beside a servo a passive one.
    model.jnt_actgravcomp[joints] = is_torque
    if np.isfinite(physics.effort_limit):
        limited = joints[~is_arm]
        model.jnt_actfrclimited[limited] = 1
        model.jnt_actfrcrange[limited] = -physics.effort_limit, physics.effort_limit
    return stiffness, damping, is_torque


def _critical(stiffness: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return `2 M^1/2 (M^-1/2 K M^-1/2)^1/2 M^1/2`: critical damping of each mode.

    M is diagonal: the inertia felt at each joint in the model's own posture [kg m^2], shape (n,).
    """
    root = np.sqrt(np.outer(inertia, inertia))
    squares, modes = np.linalg.eigh(stiffness / root)
    return 2.0 * root * ((modes * np.sqrt(squares)) @ modes.T)


def _wxyz(rotation: np.ndarray) -> np.ndarray:
    x, y, z, w = pin.Quaternion(rotation).normalized().coeffs()
    return np.array([w, x, y, z])
