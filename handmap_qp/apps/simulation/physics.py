"""What a simulation assumes: `Physics`, and the object with its shape and mass, `Body`."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from handmap_qp.errors import InvalidInputError, InvalidOptionsError, expect, require
from handmap_qp.hands import Vector
from handmap_qp.options import Options, number
from handmap_qp.se3 import Array, as_floats, lengths, unit

KINDS = ("box", "sphere", "cylinder")
"""Names of shapes with one size."""
Length = Annotated[float, number("Length [m].", above=True)]


class Box(Options, frozen=True):
    """A box.

    Attributes:
        size: Lengths of its sides along x, y and z [m].

    Raises:
        InvalidOptionsError: If a side is not > 0.
    """

    size: tuple[Length, Length, Length]

    @property
    def width(self) -> float:
        """Width along x [m]."""
        return self.size[0]


class _Round(Options, frozen=True):
    """A shape that is round about z."""

    radius: Length

    @property
    def width(self) -> float:
        """Width along x [m]."""
        return 2.0 * self.radius


class Sphere(_Round, frozen=True):
    """A sphere.

    Attributes:
        radius: Radius [m].

    Raises:
        InvalidOptionsError: If the radius is not > 0.
    """


class Cylinder(_Round, frozen=True):
    """A cylinder along z.

    Attributes:
        radius: Radius [m].
        length: Length [m].

    Raises:
        InvalidOptionsError: If radius or length is not > 0.
    """

    length: Length


@dataclass(frozen=True, slots=True, eq=False)
class MeshShape:
    """The convex hull of points.

    Attributes:
        points: Vertices [m], shape (n, 3), n >= 4.

    Raises:
        InvalidInputError: If they do not span a volume.
    """

    points: Array

    def __post_init__(self) -> None:
        points = as_floats(self.points, "points", shape=("n", 3), is_finite=True)
        rank = np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6)
        expect(rank == 3, "points", "points [m] that span a volume, shape (n, 3)")
        object.__setattr__(self, "points", points)

    @property
    def width(self) -> float:
        """Width along x [m]."""
        return float(np.ptp(self.points[:, 0]))


Shape = Box | Sphere | Cylinder


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A free object.

    Attributes:
        shape: Its shape.
        mass: Its mass, spread evenly over the shape [kg].

    Raises:
        InvalidInputError: If the mass is not > 0, or the shape is none.
    """

    shape: Shape | MeshShape
    mass: float = 0.1

    def __post_init__(self) -> None:
        is_shape = isinstance(self.shape, Shape | MeshShape)
        expect(is_shape, "shape", "a shape", value=self.shape)
        mass = as_floats(self.mass, "mass", shape=(), is_finite=True)
        expect(mass > 0.0, "mass", "a number > 0", value=self.mass)


def parse_object(text: str) -> Shape | MeshShape:
    """Read an object as the command line gives it.

    Args:
        text: `box:0.05` or `box:0.03x0.04x0.1`, `sphere:0.04` (diameter), `cylinder:0.04x0.1`
            (diameter and length, twice the diameter if omitted), or the path of a mesh file in
            metres.

    Raises:
        InvalidInputError: If it is none of these.
        InvalidOptionsError: If a size is not positive.
        MissingExtraError: If a mesh is given and trimesh is not installed.
    """
    kind, _, rest = text.partition(":")
    try:
        sizes = [float(word) for word in rest.split("x")]
    except ValueError:
        sizes = []
    match kind, *sizes:
        case "box", size:
            return Box((size, size, size))
        case "box", x, y, z:
            return Box((x, y, z))
        case "sphere", diameter:
            return Sphere(diameter / 2.0)
        case "cylinder", diameter:
            return Cylinder(diameter / 2.0, 2.0 * diameter)
        case "cylinder", diameter, length:
            return Cylinder(diameter / 2.0, length)
    file = Path(text)
    expect(
        file.is_file(),
        "--object",
        "box:0.05, box:0.03x0.04x0.1, sphere:0.04, cylinder:0.04x0.1 or a mesh file",
        value=text,
    )
    trimesh = require("trimesh", "plot")
    # Mesh readers raise many types.
    try:
        hull = trimesh.load_mesh(file).convex_hull
    except Exception as error:
        raise InvalidInputError(
            f"{file}: cannot be read as a mesh ({error})", argument="--object"
        ) from error
    return MeshShape(hull.vertices - hull.center_mass)


def surface(shape: Shape | MeshShape) -> Any:
    """Return the surface of an object in its own frame, a `trimesh.Trimesh`.

    Raises:
        MissingExtraError: If trimesh is not installed.
    """
    trimesh = require("trimesh", "plot")
    match shape:
        case Box():
            return trimesh.creation.box(extents=shape.size)
        case Sphere():
            return trimesh.creation.icosphere(radius=shape.radius)
        case Cylinder():
            return trimesh.creation.cylinder(shape.radius, shape.length, sections=40)
    return trimesh.Trimesh(shape.points).convex_hull


class Physics(Options, frozen=True):
    """Contacts, actuators and time steps.

    Links of the hand collide with the object, not with each other.

    Actuators press with `K (q_command - q) - D dq`, D critical, up to their limits; the hand's own
    weight is compensated beside them.
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
    joint_stiffness: Annotated[
        float, number("Stiffness of the fingers' actuators [N m/rad, N/m].", above=True)
    ] = 3.0
    torque: Annotated[
        float,
        number(
            "Largest torque of the fingers' actuators [N m, N], and at most the effort limits of "
            "the URDF; 1000 stands for none.",
            above=True,
        ),
    ] = 1e3
    armature: Annotated[
        float, number("Inertia of each motor at its joint [kg m^2].")
    ] = 5e-4
    density: Annotated[
        float, number("Density of links whose URDF gives no mass [kg/m^3].", above=True)
    ] = 1000.0
    gravity: Annotated[
        Vector, Meta(description="Acceleration [m/s^2], in world axes.")
    ] = (
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
