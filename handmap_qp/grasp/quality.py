"""How good a grasp is: `grasp_quality`, by the name of a measure.

Forces and torques, translations and rotations are brought to one scale by a characteristic length
L: lengths count in units of L.

| name | what | better |
|---|---|---|
| `ferrari_canny` | radius of the largest ball of wrenches that contacts of unit normal force and
friction resist | greater | | `msvg` | smallest singular value of G | greater |
| `gii` | grasp isotropy index: smallest over largest singular value of G | greater |
| `vew` | volume of the ellipsoid of wrenches: product of the singular values of G | greater |
| `dtsc` | distance to singular configurations: smallest singular value of H | greater |
| `mev` | volume of the manipulability ellipsoid: product of the singular values of H | greater |
| `uot` | uniformity of transformation: largest over smallest singular value of H | smaller |
| `centroid` | distance of the contacts' centroid from the object's centre [m] | smaller |

G is the grasp matrix, `H = pinv(G^T) J` the twist of the object that moves with the joints.
`ferrari_canny` is the measure of Ferrari and Canny, ICRA 1992, that Miller et al. (the paper's
[23]) plan with, in its form for a bounded sum of normal forces; it is > 0 only for force closure.
The others but the last are the toolbox's that the paper was computed with, where L is a millimetre.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.contacts import Grasp
from handmap_qp.grasp.statics import grasp_matrix

QUALITIES = ("ferrari_canny", "msvg", "gii", "vew", "dtsc", "mev", "uot", "centroid")
"""Names of the measures."""

SMALLER_IS_BETTER = frozenset({"uot", "centroid"})
"""The measures of which less is better."""

FRICTION = 0.5
"""Coulomb's coefficient of friction where none is given: skin or rubber on a smooth object."""

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
        measure: Name of the measure; see the table above.
        friction: Coulomb's coefficient of friction; only `ferrari_canny` uses it.
        length: Characteristic length L [m]; the distance of the farthest contact from the object's
            centre if omitted, which makes the measures (but `centroid`) independent of the object's
            size.

    Returns:
        The measure. A grasp with no contact, or with too few, has 0 (`uot` and `centroid`:
        infinity, for none).

    Raises:
        InvalidInputError: On an unknown name, friction < 0 or a length that is not > 0.
    """
    if measure not in QUALITIES:
        raise InvalidInputError(
            f"measure: expected one of {', '.join(QUALITIES)}, got {measure!r}", value=measure
        )
    if length is not None and not (np.isfinite(length) and length > 0.0):
        raise InvalidInputError(
            f"length: expected a length > 0 in metres, got {length}", value=length
        )
    if not grasp.contacts:
        return np.inf if measure in SMALLER_IS_BETTER else 0.0
    offsets = grasp.points - grasp.centre
    if measure == "centroid":
        return float(np.linalg.norm(offsets.mean(axis=0)))
    scale = float(np.linalg.norm(offsets, axis=1).max()) if length is None else length
    if measure == "ferrari_canny":
        return ferrari_canny(offsets / scale, grasp.normals, friction)
    G = grasp_matrix(offsets / scale, np.zeros(3))
    if measure in ("msvg", "gii", "vew"):
        values = _singular_values(G)
    else:
        # Of contacts on one line, the part of G that is only rounding must not be inverted.
        values = _singular_values(np.linalg.pinv(G.T, rcond=1e-9) @ grasp.jacobian / scale)
    if measure in ("vew", "mev"):
        return float(values.prod())
    if measure in ("msvg", "dtsc"):
        return float(values[5])
    least, most = float(values[5]), float(values[0])
    if measure == "gii":
        return least / most
    return most / least if least > 0.0 else np.inf


def ferrari_canny(
    points: np.ndarray, normals: np.ndarray, friction: float, *, edges: int = _EDGES
) -> float:
    """Radius of the largest ball round the origin inside the convex hull of the contacts' wrenches (Ferrari and Canny 1992).

    Args:
        points: Contacts relative to the object's centre, in units of the characteristic length,
            shape (n_c, 3).
        normals: Unit normals into the object, shape (n_c, 3).
        friction: Coulomb's coefficient of friction.
        edges: Edges of the pyramid in place of a friction cone.

    Returns:
        The radius; 0 without force closure, where the origin is not inside.

    Raises:
        InvalidInputError: If friction < 0.
    """
    wrenches = cone_wrenches(points, normals, friction, edges=edges)
    # Without a rank of 6 the hull is flat; Qhull would find that out from rounding errors only.
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
    """Wrenches of forces along the edges of the friction cones, each with a unit normal part.

    Args:
        points: Contacts relative to the object's centre, shape (n_c, 3).
        normals: Unit normals into the object, shape (n_c, 3).
        friction: Coulomb's coefficient of friction.
        edges: Edges of the pyramid in place of a cone.

    Returns:
        Wrenches, force then torque, shape (n_c * edges, 6).

    Raises:
        InvalidInputError: If friction < 0.
    """
    if not (np.isfinite(friction) and friction >= 0.0):
        raise InvalidInputError(f"friction: expected a number >= 0, got {friction}", value=friction)
    # Any tangent will do to start from; the axis that the normal has least of is never parallel to
    # it.
    first = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angles = 2.0 * np.pi * np.arange(edges) / edges
    around = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    forces = normals[:, None] + friction * around
    torques = np.cross(points[:, None], forces)
    return np.concatenate([forces, torques], axis=2).reshape(-1, 6)


def _singular_values(matrix: np.ndarray) -> np.ndarray:
    """The six singular values of a matrix of six rows, largest first.

    Those that it has too few columns for are 0.
    """
    values = np.linalg.svd(matrix, compute_uv=False)
    return np.concatenate([values, np.zeros(6 - len(values))])
