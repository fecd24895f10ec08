"""Furniture of tasks: rings of boxes, and mechanisms that an object rides on."""

from collections.abc import Sequence

import mujoco
import numpy as np

from handmap_qp.apps.simulation.model import OBJECT
from handmap_qp.se3 import Array

STANDS = {"contype": 1, "conaffinity": 0}
"""Collides with objects, and lets the hand pass."""
TOUCHED = {"contype": 2, "conaffinity": 1}
"""Collides with the hand and with what stands, as objects do."""
LOOSE = {"contype": 1, "conaffinity": 1}
"""Collides with everything."""
SHOWN = {"contype": 0, "conaffinity": 0}
"""Only drawn."""
_FORWARD = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
_MOVER = "/mover"


def ring(
    radius: float, height: float, thickness: float, sides: int, tilt: float = 0.0
) -> list[tuple[Array, Array, Array]]:
    """Return boxes that make a wall around z.

    Args:
        radius: Distance of the inner faces from the axis, at half the height [m].
        height: Height of the wall [m]; its middle is at 0.
        thickness: Its thickness [m].
        sides: Number of boxes.
        tilt: Angle by which the wall opens upward [rad].

    Returns:
        Of each box its place (3,), its orientation as quaternion wxyz (4,), half its sides (3,).
    """
    outer = (radius + thickness) * np.tan(np.pi / sides)
    size = np.array([thickness / 2.0, outer, height / 2.0])
    boxes = []
    for turn in np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False).tolist():
        middle = radius + thickness / 2.0
        place = np.array([middle * np.cos(turn), middle * np.sin(turn), 0.0])
        about_z = np.array([np.cos(turn / 2.0), 0.0, 0.0, np.sin(turn / 2.0)])
        about_y = np.array([np.cos(tilt / 2.0), 0.0, np.sin(tilt / 2.0), 0.0])
        quat = np.zeros(4)
        mujoco.mju_mulQuat(quat, about_z, about_y)
        boxes.append((place, quat, size))
    return boxes


def add_ring(
    body: mujoco.MjsBody,
    boxes: Sequence[tuple[Array, Array, Array]],
    height: float,
    collides: dict[str, int],
    mass: float = 0.0,
) -> None:
    """Add a ring of boxes to a body, with its middle at a height [m] and each of a mass [kg]."""
    for place, quat, size in boxes:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=place + height * np.array([0.0, 0.0, 1.0]),
            quat=quat,
            size=size,
            mass=mass,
            **collides,
        )


def add_mover(
    spec: mujoco.MjSpec,
    parent: mujoco.MjsBody,
    joint: mujoco.mjtJoint,
    friction: float = 0.0,
    stiffness: float = 0.0,
    damping: float = 0.0,
    limits: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Let the object ride on a joint along or about z, at the origin of a body.

    The object keeps its free joint, and is welded to a body that moves by the joint.

    Args:
        spec: Specification of the model.
        parent: Body that carries the joint; it faces forward, as objects do.
        joint: Its kind.
        friction: Friction of the joint [N or N m].
        stiffness: Stiffness of its spring [N/m or N m/rad].
        damping: Damping [N s/m or N m s/rad].
        limits: Its range [m or rad].
    """
    mover = parent.add_body(name=_MOVER)
    mover.add_joint(
        name=_MOVER,
        type=joint,
        axis=[0.0, 0.0, 1.0],
        frictionloss=friction,
        stiffness=stiffness,
        damping=damping,
        range=limits,
        armature=1e-3,
    )
    mover.mass = 0.02
    mover.inertia = [1e-5, 1e-5, 1e-5]
    mover.explicitinertial = True
    weld = spec.add_equality(
        name1=_MOVER,
        name2=OBJECT,
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        solref=[4e-3, 1.0],
        solimp=[0.99, 0.999, 1e-3, 0.5, 2.0],
    )
    # Anchor, relative position, relative orientation from 6 on, and weight of the orientation.
    weld.data[:] = 0.0
    weld.data[6] = 1.0
    weld.data[10] = 1.0


def forward(body: mujoco.MjsBody) -> None:
    """Turn a body as objects stand: its x axis is forward."""
    body.quat = _FORWARD


def moved(data: mujoco.MjData) -> float:
    """Return the position of the joint that the object rides on [m or rad]."""
    return float(data.joint(_MOVER).qpos[0])
