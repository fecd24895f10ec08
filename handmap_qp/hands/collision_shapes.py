"""The collision shapes of a hand's URDF, between which Pinocchio and coal measure distances."""

from collections.abc import Callable
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, tostring

import coal
import numpy as np
import pinocchio as pin

from handmap_core.errors import reason_of
from handmap_core.models import BodyModel, ShapeModel
from handmap_core.se3 import Array, affine
from .big_meshes import extremes_of, is_many, outermost_corners, stl_triangles
from .hand import Hand
from .urdf import (
    edges,
    get_numbers,
    origin_of,
    parse_urdf,
    set_numbers,
    set_origin,
)

_OTHER = {"collision": "visual", "visual": "collision"}
_PLACEHOLDER = "0.001"
"""Radius of the sphere in the place of a mesh [m]."""
_SIZES = (5e-4, 2.0)
"""Sizes that a link's mesh may have [m]; others are in another unit."""
_RADIUS = 0.006
"""Radius of cylinders and balls in the place of a link's shapes [m]."""


def read_collision_shapes(hand: Hand) -> pin.GeometryModel:
    """Read a hand's collision shapes; meshes become their convex hulls, cylinders prisms.

    Stand-ins take the place of meshes that cannot be read, see `add_stand_ins`.

    Returns:
        Shapes on the joints of `hand.model`, without collision pairs; a new model, which the caller
        may change.

    Raises:
        HandError: If a shape cannot be read.
    """
    return pin.GeometryModel(_read(hand))


@lru_cache(maxsize=32)
def _read(hand: Hand) -> pin.GeometryModel:
    """Read the shapes, and each mesh by itself.

    Pinocchio reads all meshes in one call, which lets no other thread run for up to a third of a
    second. So it reads placeholders in their places.
    """
    robot = parse_urdf(hand.urdf_text)
    try:
        add_stand_ins(robot, "collision", is_lost)
        meshes = _take_meshes(robot)
        geometry = pin.buildGeomFromUrdfString(
            hand.model, tostring(robot, "unicode"), pin.GeometryType.COLLISION
        )
    except (OSError, RuntimeError, ValueError) as error:
        problem = f"the collision shapes cannot be read: {reason_of(error)}"
        raise hand.spec.error(problem, "urdf") from error
    for part in geometry.geometryObjects:
        if part.name in meshes:
            part.geometry = _hull_of(meshes.pop(part.name))
        elif isinstance(part.geometry, coal.Cylinder):
            part.geometry = prism_around(part.geometry)
    if meshes:
        problem = f"the collision shape {min(meshes)!r} cannot be read"
        raise hand.spec.error(problem, "urdf")
    return geometry


def add_stand_ins(
    robot: Element, kind: str, is_gone: Callable[[Element], bool]
) -> None:
    """Replace shapes whose mesh is gone: a hand can be mapped and drawn without its files.

    A link that has none left of this kind gets those of the other kind. Without them, it gets
    cylinders from its joint to those that it carries, or a ball.

    Args:
        robot: The URDF, changed in place.
        kind: `collision` or `visual`.
        is_gone: `is_lost` or `is_missing`.
    """

    def is_whole(shape: Element) -> bool:
        return not any(map(is_gone, shape.iterfind("geometry/mesh")))

    for link in robot.iterfind("link"):
        lost = [shape for shape in link.iterfind(kind) if not is_whole(shape)]
        for shape in lost:
            link.remove(shape)
        if lost and link.find(kind) is None:
            name = link.get("name")
            ends = [
                origin_of(e)[:3, 3] for e, parent, _ in edges(robot) if parent == name
            ]
            others = deepcopy([*filter(is_whole, link.iterfind(_OTHER[kind]))])
            for shape in others or map(_along, ends or [np.zeros(3)]):
                shape.tag = kind
                link.append(shape)


def _along(end: Array) -> Element:
    """Return a cylinder from a joint to another, shape (3,) [m]; a ball where they coincide."""
    shape = Element("collision")
    # A cylinder is along z.
    turn = pin.Quaternion.FromTwoVectors(np.eye(3)[2], end)
    set_origin(shape, affine(turn.matrix(), end / 2.0))
    geometry = SubElement(shape, "geometry")
    solid = SubElement(geometry, "cylinder" if end.any() else "sphere")
    set_numbers(solid, radius=_RADIUS, length=np.linalg.norm(end))
    return shape


def _take_meshes(robot: Element) -> dict[str, Element]:
    """Replace meshes by spheres, and return each by its shape's name."""
    meshes = {}
    for link in robot.iterfind("link"):
        for i, shape in enumerate(link.iterfind("collision/geometry")):
            mesh = shape.find("mesh")
            if mesh is not None:
                meshes[f"{link.get('name')}_{i}"] = mesh
                shape.remove(mesh)
                SubElement(shape, "sphere", radius=_PLACEHOLDER)
    return meshes


def is_missing(mesh: Element) -> bool:
    """Return whether the file of a `<mesh>`, an absolute path, does not exist."""
    return not Path(mesh.get("filename", "")).is_file()


def is_lost(mesh: Element) -> bool:
    """Return whether a `<mesh>`, by its absolute path, is missing, unreadable, flat or absurd."""
    return _hull_of(mesh) is None


def _hull_of(mesh: Element) -> coal.Convex | None:
    """Read a `<mesh>` as its convex hull; None if it is lost."""
    file = mesh.get("filename", "")
    try:
        scale = get_numbers(mesh, "scale", 3, "1 1 1")
        stat = Path(file).stat()
        return _hull_in(file, tuple(scale), stat.st_mtime_ns, stat.st_size)
    except (OSError, RuntimeError, ValueError):
        return None


# The meshes of a hand are those of all its sessions, as long as the file does not change.
@lru_cache(maxsize=256)
def _hull_in(file: str, scale: tuple[float, ...], *_: int) -> coal.Convex | None:
    """Read a file as its convex hull, which has an inside; None if it is flat or no link's size."""
    corners = _vertices(file) * scale
    size = np.ptp(corners, axis=0).max()
    return convex_hull(corners) if _SIZES[0] < size < _SIZES[1] else None


def _vertices(file: str) -> Array:
    """Return the corners of a file's meshes, of a big one the outermost, shape (n, 3) [m].

    Most meshes are binary STL files, which numpy reads: coal takes up to 80 ms for one, and
    meanwhile no other thread runs. Corners that triangles share are repeated there.
    """
    outermost = outermost_corners(file)
    if outermost is not None:
        return outermost
    triangles = stl_triangles(file)
    if triangles is not None:
        return triangles["corners"].reshape(-1, 3).astype(float)
    corners = np.array(coal.MeshLoader().load(file, np.ones(3)).vertices())
    return extremes_of(corners) if is_many(len(corners)) else corners


# Sides of a prism in the place of a cylinder, and its least radius and half length [m].
_SIDES = 48
_THINNEST = 1e-5


def prism_around(cylinder: coal.Cylinder) -> coal.Convex | None:
    """Return a prism around a cylinder, 20 um thick at least; its edges stand out by 0.2 %.

    On curved surfaces coal's normals are exact to 1e-5 only, and searches for them take long. On a
    polyhedron they end at a face, an edge or a corner, and are exact to rounding.
    """
    angles = 2.0 * np.pi / _SIDES * np.arange(_SIDES)
    across = max(cylinder.radius, _THINNEST) / np.cos(np.pi / _SIDES)
    half = np.full(_SIDES, max(cylinder.halfLength, _THINNEST))
    rim = np.column_stack([across * np.cos(angles), across * np.sin(angles), half])
    return convex_hull(np.vstack([rim, -rim]))


def convex_hull(points: Array) -> coal.Convex | None:
    """Return the convex hull of a mesh's vertices; None if they lie in a plane.

    coal's own `buildConvexRepresentation` keeps the vertices inside the hull. They disturb the
    search along edges for the farthest vertex, and distances are then wrong by millimetres.
    """
    # Importing scipy takes twice as long as all of this package: only meshes need it.
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    # The indices of its corners are in order. Distances need no side of a triangle, only its edges.
    triangles = np.searchsorted(hull.vertices, hull.simplices)
    vertices = coal.StdVec_Vec3s()
    faces = coal.StdVec_Triangle()
    vertices.extend([*points[hull.vertices]])
    faces.extend([coal.Triangle(*triangle) for triangle in triangles.tolist()])
    return coal.Convex(vertices, faces)


def body_models(geometry: pin.GeometryModel) -> tuple[BodyModel, ...]:
    """Return all shapes as the core has them.

    Raises:
        ValueError: If one is not convex.
    """
    return tuple(map(_body_model, geometry.geometryObjects))


def _body_model(body: pin.GeometryObject) -> BodyModel:
    placement = body.placement
    return BodyModel(
        joint=body.parentJoint - 1,
        placement=placement.homogeneous,
        shape=shape_model(body.geometry),
        centre=placement.act(np.ravel(body.geometry.aabb_center)),
        radius=body.geometry.aabb_radius,
    )


def shape_model(shape: coal.CollisionGeometry) -> ShapeModel:
    """Return a shape as the core has it.

    Raises:
        ValueError: If it is not convex.
    """
    half, radius, corners = np.zeros(3), 0.0, np.zeros((0, 3))
    match shape:
        case coal.Box():
            kind, half = "box", np.ravel(shape.halfSide)
        case coal.Sphere():
            kind, radius = "sphere", shape.radius
        case coal.Capsule():
            kind, radius = "capsule", shape.radius
            half = np.array([0.0, 0.0, shape.halfLength])
        case coal.Convex():
            kind, corners = "convex", np.array(shape.points())
        case _:
            raise ValueError(f"a shape that is not convex: {type(shape).__name__}")
    return ShapeModel(kind=kind, half=half, radius=radius, corners=corners)
