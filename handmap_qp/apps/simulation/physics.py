"""What a simulation assumes: `Physics`."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.spec import Vector
from handmap_qp.options import Options, number, text


class Physics(Options, frozen=True):
    """Contacts, actuators and time steps.

    Links of the hand collide with the object, not with each other.

    Actuators of fingers press with `K (q_command - q) - D dq`, D critical. Beside servos
    (`position`), the hand's own weight is compensated; motors (`torque`) carry it themselves. An
    arm keeps its servos.
    """

    friction: Annotated[
        float, number("Coulomb coefficient between hand and object.")
    ] = 0.8
    torsion: Annotated[
        float,
        number(
            "Coefficient of friction against spinning about the contact normal [m]: the radius of "
            "a soft pad's patch times `friction`. 0 for hard fingers, as in Sec. IV."
        ),
    ] = 0.005
    actuators: Annotated[
        Literal["position", "torque"], text("Servos or motors, for the fingers.")
    ] = "position"
    joint_stiffness: Annotated[
        float, number("Stiffness of the fingers' actuators [N m/rad, N/m].", above=True)
    ] = 3.0
    arm_stiffness: Annotated[
        float, number("Stiffness of an arm's actuators [N m/rad].", above=True)
    ] = 3000.0
    effort_limit: Annotated[
        float,
        number("Largest torque at a finger's joint [N m].", 0.0, math.inf, above=True),
    ] = math.inf
    armature: Annotated[
        float, number("Inertia of each motor at its joint [kg m^2].")
    ] = 5e-4
    density: Annotated[
        float, number("Density of links whose URDF gives no mass [kg/m^3].", above=True)
    ] = 1000.0
    gravity: Annotated[Vector, text("Acceleration [m/s^2], in world axes.")] = (
        0.0,
        0.0,
        -9.81,
    )
    time_step: Annotated[float, number("Step of the simulation [s].", above=True)] = (
        2e-3
    )
    contact_time: Annotated[
        float,
        number("Time constant with which a penetration is corrected [s].", above=True),
    ] = 4e-3

    def check(self) -> None:
        """Reject infinite gravity, and contacts that are too stiff for the time step."""
        if not all(map(math.isfinite, self.gravity)):
            raise InvalidOptionsError(
                option="gravity", expected="3 finite numbers", value=self.gravity
            )
        if self.contact_time < 2.0 * self.time_step:
            raise InvalidOptionsError(
                option="contact_time",
                expected=f"at least two time steps, {2.0 * self.time_step:g} s",
                value=self.contact_time,
            )


def turn_up(up: np.ndarray, along: np.ndarray | None = None) -> np.ndarray:
    """Return the rotation that turns a direction to +z, shape (3, 3).

    Args:
        up: The direction, shape (3,).
        along: Direction that it turns to +x as far as it is horizontal, shape (3,).
    """
    z = up / np.linalg.norm(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    if along is not None and np.linalg.norm(level := along - (along @ z) * z) > 1e-6:
        x = level
    x = x / np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])
