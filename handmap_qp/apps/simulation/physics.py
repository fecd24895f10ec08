"""What a simulation assumes: `Physics`."""

import math

import numpy as np

from handmap_core.errors import InvalidOptionsError
from handmap_core.options import NotNegative, Options, Positive
from handmap_core.se3 import Array, lengths, unit
from handmap_qp.hands import SLIDING_STIFFNESS, STIFFNESS, Vector
from handmap_qp.human import axis_direction

_GRAVITY = 9.81  # m/s^2
# As in the worlds of Leap Motion, OpenXR and WebXR.
_USUAL_UP = "+y"


class Physics(Options, frozen=True):
    """The object's mass, contacts, actuators and time steps.

    Links of the hand collide with the object, not with each other.

    Actuators press with `K (q_command - q) - D dq`, D critical, up to their limits; the hand's own
    weight is compensated beside them.

    Attributes:
        mass: Mass of the object, spread evenly over its shape [kg].
        friction: Coulomb coefficient between hand and object.
        torsion: Coefficient of friction against spinning about the contact normal [m]: the radius
            of a soft pad's patch times `friction`. 0 for hard fingers, as in Sec. IV.
        joint_stiffness: Stiffness of the fingers' actuators [N m/rad].
        sliding_stiffness: The same of joints that slide, such as those of jaws [N/m].
        torque: Largest torque of the fingers' actuators [N m, N], beside the effort limits of the
            URDF; the maker's if omitted, as in `torque_limits`.
        armature: Inertia of each motor at its joint [kg m^2].
        density: Density of links whose URDF gives no mass [kg/m^3].
        gravity: Acceleration [m/s^2], in world axes.
        time_step: Step of the simulation [s].
        contact_time: Time constant with which a penetration is corrected [s].
    """

    mass: Positive = 0.1
    friction: NotNegative = 0.8
    torsion: NotNegative = 0.005
    joint_stiffness: Positive = STIFFNESS
    sliding_stiffness: Positive = SLIDING_STIFFNESS
    torque: Positive | None = None
    armature: NotNegative = 5e-4
    density: Positive = 1000.0
    gravity: Vector = (0.0, 0.0, -9.81)
    time_step: Positive = 2e-3
    contact_time: Positive = 4e-3

    @property
    def up(self) -> Array:
        """Direction against gravity, shape (3,); z if there is none."""
        gravity = np.array(self.gravity)
        return -gravity if gravity.any() else np.array([0.0, 0.0, 1.0])

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


def choose_gravity(
    given: str | None, upright: str, whose: str
) -> tuple[tuple[float, float, float], str]:
    """Return the acceleration of gravity [m/s^2] in world axes, and in words which way is up.

    Args:
        given: The axis against gravity that was asked for, such as `z` or `-y`; None if none was.
        upright: The axes of the world that are up and forward; empty if they are not known.
        whose: Whose world it is, for the words.
    """
    if given:
        axis, text = f"{given:+>2}", "as asked for"
    elif upright:
        axis, text = upright.split()[0], f"{whose}, which says so"
    else:
        axis, text = _USUAL_UP, f"assumed: the world {whose} is not described; see --up"
    # An axis without a sign is the positive one, and 0 has none.
    x, y, z = (0.0 - _GRAVITY * axis_direction(axis)).tolist()
    return (x, y, z), f"{axis}, {text}"


def turn_up(up: Array, along: Array | None = None) -> Array:
    """Return the rotation that turns a direction to +z, shape (3, 3).

    Args:
        up: The direction, shape (3,).
        along: Direction that it turns to +x as far as it is horizontal, shape (3,).
    """
    z = unit(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    if along is not None and lengths(level := along - (along @ z) * z) > 1e-6:
        x = level
    x = unit(x)
    return np.array([x, np.cross(z, x), z])
