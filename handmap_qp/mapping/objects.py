"""Objects that hands hold: their shapes, and the nearest places of their surfaces."""

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from handmap_core.errors import InvalidInputError, expect, require
from handmap_core.options import Options, Positive
from handmap_core.se3 import Array, as_floats
from handmap_qp.hands import Configuration, convex_hull, prism_around

KINDS = ("box", "sphere", "cylinder")
"""Names of shapes with one size."""
# A point, as a ball [m].
_POINT = coal.Sphere(1e-6)


class Box(Options, frozen=True):
    """A box.

    Attributes:
        size: Lengths of its sides along x, y and z [m].

    Raises:
        InvalidOptionsError: If a side is not > 0.
    """

    size: tuple[Positive, Positive, Positive]


class Sphere(Options, frozen=True):
    """A sphere.

    Attributes:
        radius: Radius [m].

    Raises:
        InvalidOptionsError: If the radius is not > 0.
    """

    radius: Positive


class Cylinder(Options, frozen=True):
    """A cylinder along z.

    Attributes:
        radius: Radius [m].
        length: Length [m].

    Raises:
        InvalidOptionsError: If radius or length is not > 0.
    """

    radius: Positive
    length: Positive


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
        points = as_floats(self.points, "vertices", shape=("n", 3), is_finite=True)
        rank = np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6)
        expect(rank == 3, "vertices", "points [m] that span a volume, shape (n, 3)")
        object.__setattr__(self, "points", points)


Shape = Box | Sphere | Cylinder | MeshShape


def parse_object(
    text: str, argument: str = "--object", is_centred: bool = False
) -> Shape:
    """Read an object as the command line gives it.

    Args:
        text: `box:0.05` or `box:0.03x0.04x0.1`, `sphere:0.04` (diameter), `cylinder:0.04x0.1`
            (diameter and length, twice the diameter if omitted), or the path of a mesh file in
            metres.
        argument: What to call it in an error.
        is_centred: Whether the origin of a mesh becomes its hull's centre of mass; it is that of
            the file otherwise, as poses of tracked objects mean it.

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
        os.path.isfile(text),
        argument,
        "box:0.05, box:0.03x0.04x0.1, sphere:0.04, cylinder:0.04x0.1 or a mesh file",
        value=text,
    )
    trimesh = require("trimesh", "plot")
    # Mesh readers raise many types.
    try:
        hull = trimesh.load_mesh(file).convex_hull
    except Exception as error:
        raise InvalidInputError(
            f"{file}: cannot be read as a mesh ({error})", argument=argument
        ) from error
    return MeshShape(hull.vertices - is_centred * hull.center_mass)


def surface(shape: Shape) -> Any:
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


class Nearest(NamedTuple):
    """The places of a surface that are nearest to n points, in the object's frame.

    Attributes:
        places: The places [m], shape (n, 3).
        normals: Outward unit normals there, shape (n, 3).
        distances: How far the points are outside [m], < 0 inside, shape (n,).
    """

    places: Array
    normals: Array
    distances: Array


def nearest(shape: Shape, points: Array) -> Nearest:
    """Find the places of an object's surface that are nearest to points, (n, 3) [m]."""
    here = geometry_of(shape), pin.SE3.Identity()
    found = []
    for point in points:
        gap, near = distance(*here, _POINT, pin.SE3(np.eye(3), point))
        found.append((near.getNearestPoint1(), near.normal, gap + _POINT.radius))
    return Nearest(*map(np.array, zip(*found, strict=True)))


def distance(
    first: Any, here: pin.SE3, second: Any, there: pin.SE3
) -> tuple[float, coal.DistanceResult]:
    """Return the signed distance of two shapes of coal at their poses [m], and what coal found."""
    found = coal.DistanceResult()
    ends = [coal.Transform3s(pose.rotation, pose.translation) for pose in (here, there)]
    request = coal.DistanceRequest(True, True)
    return coal.distance(first, ends[0], second, ends[1], request, found), found


def distances_to(
    shape: Shape, pose: Array, placed: Configuration, links: pin.GeometryModel
) -> list[tuple[float, coal.DistanceResult]]:
    """Return `distance` of an object at its pose, (4, 4), to each shape of a placed hand."""
    here = geometry_of(shape), pin.SE3(pose)
    poses = placed.data.oMi
    return [
        distance(*here, link.geometry, poses[link.parentJoint] * link.placement)
        for link in links.geometryObjects
    ]


@lru_cache(maxsize=8)
def geometry_of(shape: Shape) -> Any:
    """Return an object's shape for coal."""
    match shape:
        case Box():
            return coal.Box(*shape.size)
        case Sphere():
            return coal.Sphere(shape.radius)
        case Cylinder():
            return prism_around(coal.Cylinder(shape.radius, shape.length))
    return convex_hull(shape.points)
