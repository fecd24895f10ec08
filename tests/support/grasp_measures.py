"""Quality measures of grasps: `grasp_quality`, by the name of a measure.

Lengths are divided by a characteristic length L, so that forces and torques, and translations and
rotations, are comparable.

| name | definition | better |
|---|---|---|
| `ferrari_canny` | radius of the largest ball in the convex hull of contact wrenches | greater |
| `msvg` | smallest singular value of G | greater |
| `gii` | grasp isotropy index: smallest over largest singular value of G | greater |
| `vew` | volume of the wrench ellipsoid: product of the singular values of G | greater |
| `dtsc` | distance to singular configurations: smallest singular value of H | greater |
| `mev` | volume of the manipulability ellipsoid: product of the singular values of H | greater |
| `uot` | uniformity of transformation: largest over smallest singular value of H | smaller |
| `centroid` | distance from the contacts' centroid to the object's centre [m] | smaller |

G is the grasp matrix. `H = pinv(G^T) J` maps joint velocities to the object's twist.
`ferrari_canny` is the measure of Ferrari and Canny (ICRA 1992), which Miller et al. (the paper's
[23]) plan with. It bounds the sum of the normal forces, and is > 0 only with force closure. The
measures from `msvg` to `uot` are those of the paper's toolbox, where L is one millimetre.
"""

from __future__ import annotations

import numpy as np
from checks import (
    finite_array,
    one_of,
    positive_number,
    whole_number,
)
from scipy.spatial import ConvexHull, QhullError
from section_four.contacts import Grasp
from section_four.statics import grasp_matrix

QUALITIES = ("ferrari_canny", "msvg", "gii", "vew", "dtsc", "mev", "uot", "centroid")
"""Names of the measures."""

SMALLER_IS_BETTER = frozenset({"uot", "centroid"})
"""Measures for which a smaller value is better."""

FRICTION = 0.5
"""Default Coulomb coefficient of friction: skin or rubber on a smooth object."""

_EDGES = 8


def grasp_quality(
    grasp: Grasp,
    measure: str = "ferrari_canny",
    *,
    friction: float = FRICTION,
    length: float | None = None,
) -> float:
    """Rate a grasp.

    Args:
        grasp: The grasp.
        measure: Name of the measure; see the table of this module.
        friction: Coulomb coefficient of friction; used by `ferrari_canny` only.
        length: Characteristic length L [m]. If omitted, it is the distance from the object's centre
            to the farthest contact. All measures except `centroid` are then independent of the
            object's size.

    Returns:
        The value of the measure. With too few contacts it is 0, and infinite for `uot`. Without
        any contact it is infinite for `centroid` too.

    Raises:
        InvalidInputError: On an unknown name, friction < 0 or a length that is not > 0.
    """
    one_of(measure, QUALITIES, "measure")
    friction = positive_number(friction, "friction", or_zero=True)
    if length is not None:
        length = positive_number(length, "length")
    if not grasp.contacts:
        return np.inf if measure in SMALLER_IS_BETTER else 0.0
    offsets = grasp.points - grasp.centre
    if measure == "centroid":
        return float(np.linalg.norm(offsets.mean(axis=0)))
    scale = float(np.linalg.norm(offsets, axis=1).max()) if length is None else length
    if measure == "ferrari_canny":
        return ferrari_canny(offsets / scale, grasp.normals, friction)
    matrix = grasp_matrix(offsets / scale, np.zeros(3))
    if measure in ("dtsc", "mev", "uot"):
        # Contacts on one line: do not invert singular values of G that are rounding errors.
        matrix = np.linalg.pinv(matrix.T, rcond=1e-9) @ grasp.jacobian / scale
    # A matrix with fewer than six columns has fewer than six singular values; the others are 0.
    values = np.zeros(6)
    found = np.linalg.svd(matrix, compute_uv=False)
    values[: len(found)] = found
    most, least = float(values[0]), float(values[5])
    if measure == "uot":
        return most / least if least > 0.0 else np.inf
    if measure == "gii":
        return least / most
    return least if measure in ("msvg", "dtsc") else float(values.prod())


def ferrari_canny(
    points: np.ndarray, normals: np.ndarray, friction: float, *, edges: int = _EDGES
) -> float:
    """Radius of the largest ball about the origin in the convex hull of the contacts' wrenches.

    Source: Ferrari and Canny, ICRA 1992.

    Args:
        points: Contacts relative to the object's centre, in units of the characteristic length,
            shape (n_c, 3).
        normals: Unit normals into the object, shape (n_c, 3).
        friction: Coulomb coefficient of friction.
        edges: Edges of the pyramid that approximates a friction cone, >= 3.

    Returns:
        The radius; 0 without force closure, when the origin is not inside the hull.

    Raises:
        InvalidInputError: On a wrong shape, friction < 0 or fewer than 3 edges.
    """
    wrenches = cone_wrenches(points, normals, friction, edges=edges)
    # Rank below 6: the hull is flat. Qhull detects that only from rounding errors.
    if len(wrenches) < 7 or np.linalg.matrix_rank(wrenches, tol=1e-9) < 6:
        return 0.0
    try:
        hull = ConvexHull(wrenches)
    except QhullError:
        return 0.0
    return max(0.0, float(-hull.equations[:, -1].max()))


def cone_wrenches(
    points: np.ndarray, normals: np.ndarray, friction: float, *, edges: int = _EDGES
) -> np.ndarray:
    """Wrenches of forces along the edges of the friction cones, with unit normal components.

    Args:
        points: Contacts relative to the object's centre, shape (n_c, 3).
        normals: Unit normals into the object, shape (n_c, 3).
        friction: Coulomb coefficient of friction.
        edges: Edges of the pyramid that approximates a friction cone, >= 3.

    Returns:
        Wrenches, force then torque, shape (n_c * edges, 6).

    Raises:
        InvalidInputError: On a wrong shape, friction < 0 or fewer than 3 edges.
    """
    points = finite_array(points, ("n", 3), "points")
    normals = finite_array(normals, points.shape, "normals")
    friction = positive_number(friction, "friction", or_zero=True)
    edges = whole_number(edges, "edges", least=3)
    # First tangent: cross product with the axis of the normal's smallest component.
    first = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angles = 2.0 * np.pi * np.arange(edges) / edges
    around = (
        np.cos(angles)[:, None] * first[:, None]
        + np.sin(angles)[:, None] * second[:, None]
    )
    forces = normals[:, None] + friction * around
    torques = np.cross(points[:, None], forces)
    return np.concatenate([forces, torques], axis=2).reshape(-1, 6)
