"""A hand and an object as a MuJoCo model: `build_model`.

Bodies and joints are those of the hand's Pinocchio model, so mirrored, mounted and cut URDFs need
no second reader. Shapes are its collision shapes; meshes are their convex hulls.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import coal
import mujoco
import numpy as np
import pinocchio as pin

from handmap_core.se3 import Arrays, mirror_sign, quat_wxyz_from_rotation
from handmap_qp.hands import (
    Hand,
    Values,
    are_prismatic,
    read_collision_shapes,
    torque_limits,
)
from handmap_qp.mapping import Cylinder, Shape, geometry_of
from .physics import Physics

OBJECT = "/object"
WRIST = "/wrist"
TABLE = "/table"
"""Names of the object's body, of the wrist's site and of the table's shape; others bear the names
of joints."""

MOCAP = "/mocap"
"""Name of the body that leads the base of a hand that floats."""
# Who collides with whom.
_HAND = {"contype": 1, "conaffinity": 2}
_HELD = {"contype": 2, "conaffinity": 1}
# The table carries the object and lets the hand pass.
_CARRIES = {"contype": 1, "conaffinity": 0}
# Half the length of a side of the table, as far as it is drawn [m].
_TABLE_SIDE = 0.5
# Least mass and inertia of a link [kg, kg m^2], and those of a floating base.
_LEAST = (2e-3, 1e-6)
_LEAST_OF_BASE = (1.0, 1e-3)
# Stiff enough for a lag of the wrist of a few milliseconds.
_STIFF = {"solref": [4e-3, 1.0], "solimp": [0.99, 0.999, 1e-3, 0.5, 2.0]}
# Stiffness of an arm's actuators [N m/rad].
_ARM_STIFFNESS = 3000.0
# Limits beyond this stand for none [rad or m].
_UNLIMITED = 1e5


def build_model(
    hand: Hand,
    shape: Shape,
    physics: Physics,
    table: float | None = None,
    furnish: Callable[[mujoco.MjSpec], None] | None = None,
    others: Mapping[str, Hand] = MappingProxyType({}),
) -> Any:
    """Build the model of a hand and an object.

    Args:
        hand: The hand; its root floats, or is fixed to the world.
        shape: The object's shape.
        physics: Contacts, stiffness and time steps.
        table: Height of a level table that carries the object [m], in a world with z up. The hand
            passes through it. No table if omitted.
        furnish: Adds further parts to the specification before it is compiled.
        others: Further hands, by what the names of their bodies, joints and actuators begin with.

    Returns:
        The `mujoco.MjModel`, with one actuator for each of `hand.joint_names`, in their order, then
        those of the further hands.

    Raises:
        HandError: If the hand has no collision shapes, or they cannot be read.
    """
    spec = hand_spec(hand, physics)
    held = spec.worldbody.add_body(name=OBJECT)
    held.add_freejoint(name=OBJECT)
    match shape:
        # Not the prism that stands for it elsewhere.
        case Cylinder(radius, length):
            solid = coal.Cylinder(radius, length)
        case _:
            solid = geometry_of(shape)
    held.add_geom(name=OBJECT, mass=physics.mass, **_shape(spec, solid), **_HELD)
    if table is not None:
        spec.worldbody.add_geom(
            name=TABLE,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[_TABLE_SIDE, _TABLE_SIDE, 0.01],
            pos=[0.0, 0.0, table],
            **_CARRIES,
        )
    for prefix, other in others.items():
        frame = spec.worldbody.add_frame()
        spec.attach(hand_spec(other, physics), prefix=prefix, frame=frame)
    if furnish is not None:
        furnish(spec)
    model = spec.compile()
    # Critical for the inertia at each joint alone; that of MuJoCo's own ratio is less.
    inertia = model.dof_M0[model.jnt_dofadr[model.actuator_trnid[:, 0]]]
    damping = 2.0 * np.sqrt(model.actuator_gainprm[:, 0] * inertia)
    model.actuator_biasprm[:, 2] = -damping
    model.actuator_forcelimited[:] = True
    # In the order of the actuators: the hand's, then those of the others.
    torques = [
        torque_limits(one, physics.torque).values for one in (hand, *others.values())
    ]
    model.actuator_forcerange = np.outer(np.concatenate(torques), (-1.0, 1.0))
    return model


def hand_spec(hand: Hand, physics: Physics) -> Any:
    """Return the specification of a hand with its actuators and nothing else.

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
    spec = _empty_spec(physics)
    bodies = _add_hand(spec, hand)
    for part in geometry.geometryObjects:
        bodies[part.parentJoint].add_geom(
            **_shape(spec, part.geometry), **_placed(part.placement), **_HAND
        )
    _couple_followers(spec, hand)
    # A spring with critical damping for each joint of the hand, and of its arm.
    fingers = np.where(
        are_prismatic(hand), physics.sliding_stiffness, physics.joint_stiffness
    )
    stiffness = np.where(hand.moves_wrist, _ARM_STIFFNESS, fingers)
    for name, own in zip(hand.joint_names, stiffness.tolist(), strict=True):
        spec.add_actuator(
            name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        ).set_to_position(kp=own)
    return spec


def _empty_spec(physics: Physics) -> Any:
    """Return a specification with what holds for all bodies, joints and geoms."""
    # Least mass and inertia are for links without mass and shape.
    return mujoco.MjSpec.from_string(f"""
<mujoco>
  <compiler angle="radian" boundmass="1e-4" boundinertia="1e-9"/>
  <option integrator="implicitfast" cone="elliptic" impratio="100" noslip_iterations="3"
    timestep="{physics.time_step}" gravity="{" ".join(map(str, physics.gravity))}"/>
  <default>
    <joint armature="{physics.armature}"/>
    <geom density="{physics.density}" condim="{4 if physics.torsion > 0.0 else 3}"
      friction="{physics.friction} {max(physics.torsion, 1e-5)} 1e-5"
      solref="{physics.contact_time} 1" solimp="0.95 0.99 5e-4 0.5 2"/>
  </default>
</mujoco>
""")


def _add_hand(spec: Any, hand: Hand) -> list[Any]:
    """Add bodies, joints and the wrist; return the body of each of Pinocchio's joints."""
    model = hand.model
    bodies = [spec.worldbody]
    for index in range(1, model.njoints):
        name = model.names[index]
        inertia = model.inertias[index]
        joint = model.joints[index]
        if joint.nv == 6:
            # A floating base, and the body that leads it.
            spec.worldbody.add_body(name=MOCAP, mocap=True)
            body = spec.worldbody.add_body(name=name, gravcomp=1.0)
            body.add_freejoint(name=name)
            _add_equality(spec, "WELD", "BODY", MOCAP, name).data[10] = 1.0
            _set_inertia(body, inertia, *_LEAST_OF_BASE)
        else:
            body = bodies[model.parents[index]].add_body(
                name=name, gravcomp=1.0, **_placed(model.jointPlacements[index])
            )
            linear, angular = np.split(np.ravel(joint.createData().S), 2)
            kinds = mujoco.mjtJoint
            made = body.add_joint(
                name=name,
                type=kinds.mjJNT_SLIDE if linear.any() else kinds.mjJNT_HINGE,
                axis=linear + angular,
            )
            i = joint.idx_q
            ends = [model.lowerPositionLimit[i], model.upperPositionLimit[i]]
            if np.abs(ends).max() < _UNLIMITED:
                made.range = ends
            # Without one in the URDF, it follows from the shapes' density.
            if inertia.mass >= 1e-6:
                _set_inertia(body, inertia, *_LEAST)
        bodies.append(body)
    wrist = hand.wrist_frame
    bodies[wrist.parentJoint].add_site(name=WRIST, **_placed(wrist.placement))
    return bodies


def _set_inertia(
    body: Any, inertia: pin.Inertia, least_mass: float, least: float
) -> None:
    """Set an inertia, raised to the least that simulates well."""
    values, axes = np.linalg.eigh(inertia.inertia)
    axes[:, 0] *= mirror_sign(axes)
    values = np.maximum(values, least)
    # MuJoCo asks for the triangle inequality, which rounded URDFs miss.
    values[2] = min(values[2], values[0] + values[1])
    body.explicitinertial = True
    body.mass = max(inertia.mass, least_mass)
    body.ipos = inertia.lever
    body.iquat = quat_wxyz_from_rotation(axes)
    body.inertia = values


def _shape(spec: Any, shape: Any) -> Values:
    """Return what makes a geom of a shape of coal; of a mesh, its convex hull."""
    kind = type(shape).__name__.upper()
    match shape:
        case coal.Box():
            size = shape.halfSide
        case coal.Sphere() | coal.Capsule() | coal.Cylinder():
            size = [shape.radius, getattr(shape, "halfLength", 0.0), 0.0]
        case _:
            name = f"hull{len(spec.meshes)}"
            spec.add_mesh(name=name, uservert=np.ravel(shape.points()).tolist())
            return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name}
    return {"type": getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), "size": size}


def _couple_followers(spec: Any, hand: Hand) -> None:
    """Hold every mimic joint at the position that the hand's rules give it."""
    for follower, rule in hand.rules.items():
        made = _add_equality(spec, "JOINT", "JOINT", follower, rule.joint)
        made.data[:2] = rule.offset, rule.multiplier


def _add_equality(spec: Any, kind: str, of: str, one: str, other: str) -> Any:
    return spec.add_equality(
        name1=one,
        name2=other,
        type=getattr(mujoco.mjtEq, f"mjEQ_{kind}"),
        objtype=getattr(mujoco.mjtObj, f"mjOBJ_{of}"),
        **_STIFF,
    )


def _placed(pose: pin.SE3) -> Arrays:
    """Return a pose as what MuJoCo calls it."""
    return {"pos": pose.translation, "quat": quat_wxyz_from_rotation(pose.rotation)}
