"""What a simulation assumes: `Physics`, `Body`."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.objects import Box, Cylinder, Shape, Sphere
from handmap_qp.hands.spec import Vector


@dataclass(frozen=True, slots=True, eq=False)
class MeshShape:
    """The convex hull of points, in the object's own frame.

    Attributes:
        points: Vertices [m], shape (n, 3), n >= 4.

    Raises:
        InvalidInputError: If they do not span a volume.
    """

    points: np.ndarray

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=float)
        is_solid = (
            points.ndim == 2
            and points.shape[1:] == (3,)
            and bool(np.isfinite(points).all())
            and np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6) == 3
        )
        if not is_solid:
            raise InvalidInputError(
                argument="points", expected="points [m] that span a volume, shape (n, 3)"
            )
        object.__setattr__(self, "points", points)

    @property
    def circumradius(self) -> float:
        """Distance of the farthest vertex from the origin [m]."""
        return float(np.linalg.norm(self.points, axis=1).max())


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A free object.

    Attributes:
        shape: Its shape.
        mass: Its mass, spread evenly over the shape [kg].
    """

    shape: Shape | MeshShape
    mass: float = 0.1

    def __post_init__(self) -> None:
        if not isinstance(self.shape, Box | Sphere | Cylinder | MeshShape):
            raise InvalidInputError(argument="shape", expected="a shape", value=self.shape)
        _check(self, "mass", lower=0.0)


@dataclass(frozen=True, slots=True)
class Physics:
    """Contacts, actuators and time steps.

    Links of the hand collide with the object, not with each other. The hand's own weight is
    compensated, as its controller would.

    Attributes:
        friction: Coulomb coefficient of sliding friction between hand and object.
        torsion: Coefficient of friction against spinning about the contact normal [m]; the radius
            of the patch that a soft pad makes, times `friction`. 0 for hard fingers, as in Sec. IV.
        joint_stiffness: Stiffness of the fingers' actuators [N m/rad, N/m].
        arm_stiffness: Stiffness of an arm's actuators [N m/rad].
        effort_limit: Largest torque at a finger's joint [N m]; none if infinite.
        armature: Inertia of each motor, as felt at its joint [kg m^2].
        density: Density of links whose URDF gives no mass [kg/m^3].
        gravity: Acceleration [m/s^2], in world axes.
        time_step: Step of the simulation [s].
        contact_time: Time constant with which a penetration is corrected [s]; smaller is stiffer.
    """

    friction: float = 0.8
    torsion: float = 0.005
    joint_stiffness: float = 3.0
    arm_stiffness: float = 3000.0
    effort_limit: float = math.inf
    armature: float = 5e-4
    density: float = 1000.0
    gravity: Vector = (0.0, 0.0, -9.81)
    time_step: float = 2e-3
    contact_time: float = 4e-3

    def __post_init__(self) -> None:
        for item in fields(self):
            if item.name == "gravity":
                if len(self.gravity) != 3 or not all(map(math.isfinite, self.gravity)):
                    raise InvalidInputError(
                        argument="gravity", expected="three finite numbers", value=self.gravity
                    )
            else:
                has_zero = item.name in ("friction", "torsion", "armature")
                _check(self, item.name, lower=0.0, has_lower=has_zero)
        if self.contact_time < 2.0 * self.time_step:
            raise InvalidInputError(
                argument="contact_time",
                expected=f"at least two time steps, {2.0 * self.time_step:g} s",
                value=self.contact_time,
            )


def _check(owner: object, name: str, *, lower: float, has_lower: bool = False) -> None:
    """Reject a number that is not above a bound; infinity is allowed for efforts only."""
    value = getattr(owner, name)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    is_valid = is_number and (value > lower or (has_lower and value == lower))
    if not is_valid or (math.isinf(value) and name != "effort_limit"):
        sign = ">=" if has_lower else ">"
        raise InvalidInputError(argument=name, expected=f"a number {sign} {lower:g}", value=value)
