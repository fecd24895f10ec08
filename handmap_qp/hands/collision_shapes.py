"""The collision shapes of a hand's URDF, between which Pinocchio and coal measure distances."""

from __future__ import annotations

from functools import lru_cache

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
        if hasattr(part.geometry, "buildConvexRepresentation"):
            # A mesh is a surface without an inside: an object within it would not be noticed, and
            # an overlap would have no depth.
            part.geometry.buildConvexRepresentation(False)
            part.geometry = part.geometry.convex
    return geometry
