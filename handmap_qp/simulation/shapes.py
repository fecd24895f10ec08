"""Objects by name and as surfaces: `named_shape`, `parse_object`, `surface`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.errors import InvalidInputError, MissingExtraError
from handmap_qp.grasp.objects import Box, Cylinder, Shape, Sphere
from handmap_qp.simulation.physics import MeshShape

KINDS = ("box", "sphere", "cylinder")
"""Names of shapes with one size."""


def named_shape(kind: str, size: float) -> Shape:
    """Return a cube, a sphere, or a cylinder as long as twice its width.

    Args:
        kind: One of `KINDS`.
        size: Its width [m].
    """
    if kind == "box":
        return Box((size, size, size))
    if kind == "sphere":
        return Sphere(size / 2.0)
    if kind == "cylinder":
        return Cylinder(size / 2.0, 2.0 * size)
    raise InvalidInputError(argument="shape", expected=f"one of {', '.join(KINDS)}", value=kind)


def parse_object(text: str) -> Shape | MeshShape:
    """Read an object as the command line gives it.

    Args:
        text: `box:0.05` or `box:0.03x0.04x0.1`, `sphere:0.04` (diameter), `cylinder:0.04x0.1`
            (diameter and length), or the path of a mesh file in metres.

    Raises:
        InvalidInputError: If it is none of these.
        MissingExtraError: If a mesh is given and trimesh is not installed.
    """
    kind, _, rest = text.partition(":")
    sizes = [float(word) for word in rest.split("x")] if re.fullmatch(r"[\d.x]+", rest) else []
    if kind == "box" and len(sizes) == 3:
        return Box((sizes[0], sizes[1], sizes[2]))
    if kind == "cylinder" and len(sizes) == 2:
        return Cylinder(sizes[0] / 2.0, sizes[1])
    if kind in KINDS and len(sizes) == 1:
        return named_shape(kind, sizes[0])
    if Path(text).is_file():
        return _mesh(Path(text))
    raise InvalidInputError(
        argument="--object",
        expected="box:0.05, box:0.03x0.04x0.1, sphere:0.04, cylinder:0.04x0.1 or a mesh file",
        value=text,
    )


def surface(shape: Shape | MeshShape) -> Any:
    """Return the surface of an object in its own frame, a `trimesh.Trimesh`.

    Raises:
        MissingExtraError: If trimesh is not installed.
    """
    trimesh = _trimesh()
    if isinstance(shape, Box):
        return trimesh.creation.box(extents=shape.size)
    if isinstance(shape, Sphere):
        return trimesh.creation.icosphere(subdivisions=3, radius=shape.radius)
    if isinstance(shape, Cylinder):
        return trimesh.creation.cylinder(shape.radius, shape.length, sections=40)
    return trimesh.Trimesh(shape.points).convex_hull


def turn_up(up: np.ndarray) -> np.ndarray:
    """Return the rotation that turns a direction to +z, for pictures, shape (3, 3)."""
    z = np.asarray(up, dtype=float) / np.linalg.norm(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


def _mesh(file: Path) -> MeshShape:
    trimesh = _trimesh()
    try:
        mesh = trimesh.load_mesh(file)
        hull = mesh.convex_hull
    # Mesh readers raise many types.
    except Exception as error:
        raise InvalidInputError(
            argument="--object", problem=f"{file}: cannot be read as a mesh ({error})"
        ) from error
    return MeshShape(np.asarray(hull.vertices) - np.asarray(hull.center_mass))


def _trimesh() -> Any:
    try:
        import trimesh
    except ImportError as error:
        raise MissingExtraError("trimesh", "plot") from error
    return trimesh
