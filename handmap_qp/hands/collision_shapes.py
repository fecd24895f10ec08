"""The collision shapes of a hand's URDF, between which Pinocchio and coal measure distances."""

from __future__ import annotations

from functools import lru_cache

import coal
import numpy as np
import pinocchio as pin

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.urdf.files import urdf_with_mesh_paths


def read_collision_shapes(hand: Hand) -> pin.GeometryModel:
    """Read a hand's collision shapes; meshes become their convex hulls.

    Args:
        hand: The hand.

    Returns:
        Shapes on the joints of `hand.model`, without collision pairs; a new model, which the caller
        may change.

    Raises:
        HandError: If a shape cannot be read.
        MissingExtraError: If meshes lie in a package that is not installed.
    """
    return pin.GeometryModel(_read(hand))


# Reading meshes takes up to a second, and the copies share them.
@lru_cache(maxsize=32)
def _read(hand: Hand) -> pin.GeometryModel:
    text = urdf_with_mesh_paths(hand.spec, hand.urdf_text)
    try:
        geometry = pin.buildGeomFromUrdfString(hand.model, text, pin.GeometryType.COLLISION)
    except (RuntimeError, ValueError) as error:
        message = f"the collision shapes cannot be read: {' '.join(str(error).split())}"
        raise hand.spec.error(message, key="urdf") from error
    for part in geometry.geometryObjects:
        if isinstance(part.geometry, coal.BVHModelBase):
            # A mesh is a surface without an inside: an object within it would not be noticed, and
            # an overlap would have no depth.
            hull = _convex_hull(np.array(part.geometry.vertices()))
            if hull is None:
                message = f"the collision shape {part.name!r} is flat: it has no convex hull"
                raise hand.spec.error(message, key="urdf")
            part.geometry = hull
    return geometry


def _convex_hull(points: np.ndarray) -> coal.Convex | None:
    """Return the convex hull of a mesh's vertices; None if they lie in a plane.

    coal's own `buildConvexRepresentation` keeps the vertices inside the hull. They disturb the
    search along edges for the farthest vertex, and distances are then wrong by millimetres.

    Args:
        points: Vertices [m], shape (n, 3).
    """
    # Importing scipy takes twice as long as all of this package: only meshes need it.
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    corners = hull.points[hull.vertices]
    index = np.zeros(len(points), dtype=int)
    index[hull.vertices] = np.arange(len(corners))
    triangles = index[hull.simplices]
    first, second, third = corners[triangles].transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    is_inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0.0
    triangles[is_inward] = triangles[is_inward, ::-1]
    vertices, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for corner in corners:
        vertices.append(corner)
    for triangle in triangles.tolist():
        faces.append(coal.Triangle(*triangle))
    return coal.Convex(vertices, faces)
