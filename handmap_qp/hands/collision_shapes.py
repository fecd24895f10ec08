"""The collision shapes of a hand's URDF, as Pinocchio and coal measure distances between them."""

from __future__ import annotations

import pinocchio as pin

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.urdf.files import package_share


def read_collision_shapes(hand: Hand) -> pin.GeometryModel:
    """Read a hand's collision shapes; meshes become their convex hulls.

    Args:
        hand: The hand.

    Returns:
        Shapes on the joints of `hand.model`, with no pairs yet; the caller's own, to add to.

    Raises:
        HandError: If a shape cannot be read.
        MissingExtraError: If meshes live in a package that is not installed.
    """
    spec = hand.spec
    folders = [str(spec.directory or ".")]
    if spec.urdf.startswith("package://"):
        folders.append(str(package_share(spec.urdf.removeprefix("package://").partition("/")[0])))
    try:
        geometry = pin.buildGeomFromUrdfString(
            hand.model, hand.urdf_text, pin.GeometryType.COLLISION, package_dirs=folders
        )
    except (RuntimeError, ValueError) as error:
        raise spec.error(
            f"the collision shapes cannot be read: {' '.join(str(error).split())}", key="urdf"
        ) from error
    for part in geometry.geometryObjects:
        if hasattr(part.geometry, "buildConvexRepresentation"):
            # A bare mesh is a surface without an inside: what lies within it would go unnoticed,
            # and an overlap has no depth.
            part.geometry.buildConvexRepresentation(False)
            part.geometry = part.geometry.convex
    return geometry
