"""The statics of a grasp as matrices.

The grasp matrix, and how object and contact forces answer to synergies (Sec. IV).

Contacts are hard fingers: they carry a force in any direction and no torque. A wrench or a twist is
three translational numbers, then three rotational ones about the object's centre, in world axes.
Any consistent units will do.

Sources: Prattichizzo and Trinkle, Handbook of Robotics (2008), ch. 28 (G, J); Prattichizzo,
Malvezzi, Gabiccini and Bicchi, IEEE T-RO 29 (2013) 1282, the paper's [22] (soft synergies).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg

from handmap_qp.errors import InvalidInputError
from handmap_qp.transform import as_floats

Stiffness = float | npt.ArrayLike
"""A number k for k times the identity, infinite for rigid, or a symmetric positive definite matrix."""

# Contacts whose grasp matrix is this close to losing a rank lie on one line, up to rounding.
_RANK_TOLERANCE = 1e-9
# Compliances this far apart leave no digit of the forces.
_RIGID_TOLERANCE = 1e-14


@dataclass(frozen=True, slots=True, eq=False)
class QuasiStatic:
    """What a unit of each synergy's reference does to a grasp at rest; columns are synergies.

    Attributes:
        object_motion: Translation of the object's centre and rotation about it, world axes [m,
            rad], shape (6, n_z).
        contact_forces: Change of the forces that the hand exerts on the object, world axes, x, y, z
            of each contact in turn [N], shape (3 n_c, n_z).
        joint_motion: Change of the joint angles [rad], shape (n_q, n_z).
        joint_torques: Change of the joint torques that balance the contact forces [N m], shape
            (n_q, n_z).
        synergy_motion: Change of the synergies themselves, which yield too, shape (n_z, n_z).
    """

    object_motion: np.ndarray
    contact_forces: np.ndarray
    joint_motion: np.ndarray
    joint_torques: np.ndarray
    synergy_motion: np.ndarray


def grasp_matrix(points: npt.ArrayLike, centre: npt.ArrayLike) -> np.ndarray:
    """The grasp matrix of hard-finger contacts: forces on the object to its wrench.

    Transposed, the object's twist to velocities.

    Args:
        points: Contacts [m], shape (n_c, 3).
        centre: The object's centre, about which torques are taken [m], shape (3,).

    Returns:
        `G = [I .. I; [p_1 - o]x .. [p_n - o]x]`, shape (6, 3 n_c).

    Raises:
        InvalidInputError: On a wrong shape or a number that is not finite.
    """
    places = as_floats(points, "points")
    if places.ndim != 2 or places.shape[1] != 3:
        raise InvalidInputError(f"points: expected shape (n, 3), got {places.shape}")
    offsets = finite_array(places, places.shape, "points") - finite_array(centre, (3,), "centre")
    matrix = np.zeros((6, 3 * len(offsets)))
    matrix[:3] = np.tile(np.eye(3), len(offsets))
    # The columns of [r]x are r x e_1, r x e_2, r x e_3.
    matrix[3:] = np.cross(offsets[:, None], np.eye(3)[None]).reshape(-1, 3).T
    return matrix


def quasistatic(
    jacobian: npt.ArrayLike,
    grasp_matrix: npt.ArrayLike,
    synergies: npt.ArrayLike,
    *,
    contact_stiffness: Stiffness,
    joint_stiffness: Stiffness,
    synergy_stiffness: Stiffness,
) -> QuasiStatic:
    """Object motion and contact forces when synergies are activated on a hand that yields at contacts, joints and synergies.

    The object is in balance before and after and no load acts on it. The unknown changes are those
    of the object's pose `du`, the contact forces `dl`, the joint torques `dtau`, the joints `dq`
    and the synergies `dz`, for a reference `dz_ref`:

        G dl = 0        dtau = J^T dl        dl = K_c (J dq - G^T du)
        dtau = K_q (S dz - dq)        S^T dtau = K_z (dz_ref - dz)

    Eliminating `dq` and `dz` leaves all springs in series at the contacts, `C dl = J S dz_ref - G^T
    du`, where `C = K_c^-1 + J K_q^-1 J^T + J S K_z^-1 S^T J^T`; and from `G dl = 0`, `du = (G C^-1
    G^T)^-1 G C^-1 J S dz_ref`. This is the paper's [22] with its chain of matrices closed up;
    unlike there, a stiffness may be infinite.

    Args:
        jacobian: J, shape (3 n_c, n_q).
        grasp_matrix: G, shape (6, 3 n_c).
        synergies: S, shape (n_q, n_z).
        contact_stiffness: K_c [N/m]; a matrix is (3 n_c, 3 n_c).
        joint_stiffness: K_q [N m/rad]; a matrix is (n_q, n_q).
        synergy_stiffness: K_z [N m per unit]; a matrix is (n_z, n_z).

    Returns:
        The answer per unit of each synergy.

    Raises:
        InvalidInputError: On a wrong shape, a stiffness that is not positive, contacts on one line
            (the object could turn about it freely), or infinite stiffnesses that leave the contact
            forces undetermined.
    """
    J, G, S = (
        _matrix(jacobian, "jacobian"),
        _matrix(grasp_matrix, "grasp_matrix"),
        _matrix(synergies, "synergies"),
    )
    _check_sizes(J, G, S)
    joint_compliance = _compliance(joint_stiffness, J.shape[1], "joint_stiffness")
    synergy_compliance = _compliance(synergy_stiffness, S.shape[1], "synergy_stiffness")
    JS = J @ S
    factor = _series_factor(
        J,
        JS,
        _compliance(contact_stiffness, len(J), "contact_stiffness"),
        joint_compliance,
        synergy_compliance,
    )
    GC = scipy.linalg.cho_solve(factor, G.T).T
    stiffness = GC @ G.T
    object_motion = np.linalg.solve(stiffness, GC @ JS)
    forces = scipy.linalg.cho_solve(factor, JS - G.T @ object_motion)
    torques = J.T @ forces
    synergy_motion = np.eye(S.shape[1]) - synergy_compliance @ S.T @ torques
    joint_motion = S @ synergy_motion - joint_compliance @ torques
    return QuasiStatic(object_motion, forces, joint_motion, torques, synergy_motion)


def grasp_stiffness(
    jacobian: npt.ArrayLike,
    grasp_matrix: npt.ArrayLike,
    *,
    contact_stiffness: Stiffness,
    joint_stiffness: Stiffness,
    synergies: npt.ArrayLike | None = None,
    synergy_stiffness: Stiffness = np.inf,
) -> np.ndarray:
    """Wrench on the object per displacement of it, while the references of joints and synergies stand still.

    Args:
        jacobian: J, shape (3 n_c, n_q).
        grasp_matrix: G, shape (6, 3 n_c).
        contact_stiffness: K_c, as for `quasistatic`.
        joint_stiffness: K_q.
        synergies: S, shape (n_q, n_z); none if omitted.
        synergy_stiffness: K_z.

    Returns:
        `K = G C^-1 G^T` with C of `quasistatic`: symmetric, positive definite, shape (6, 6).

    Raises:
        InvalidInputError: As `quasistatic`.
    """
    J, G = _matrix(jacobian, "jacobian"), _matrix(grasp_matrix, "grasp_matrix")
    S = np.zeros((J.shape[1], 1)) if synergies is None else _matrix(synergies, "synergies")
    _check_sizes(J, G, S)
    factor = _series_factor(
        J,
        J @ S,
        _compliance(contact_stiffness, len(J), "contact_stiffness"),
        _compliance(joint_stiffness, J.shape[1], "joint_stiffness"),
        _compliance(synergy_stiffness, S.shape[1], "synergy_stiffness"),
    )
    stiffness = G @ scipy.linalg.cho_solve(factor, G.T)
    return 0.5 * (stiffness + stiffness.T)


def finite_array(value: npt.ArrayLike, shape: tuple[int, ...], name: str) -> np.ndarray:
    """A write-protected copy of finite numbers of the right shape."""
    array = as_floats(value, name).copy()
    if array.shape != shape:
        raise InvalidInputError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InvalidInputError(f"{name}: expected finite numbers", value=value)
    array.setflags(write=False)
    return array


def _matrix(value: npt.ArrayLike, name: str) -> np.ndarray:
    matrix = as_floats(value, name)
    if matrix.ndim != 2:
        raise InvalidInputError(f"{name}: expected a matrix, got shape {matrix.shape}")
    return finite_array(matrix, matrix.shape, name)


def _series_factor(
    J: np.ndarray, JS: np.ndarray, contact: np.ndarray, joint: np.ndarray, synergy: np.ndarray
) -> Any:
    """Cholesky factor of the compliances of contacts, joints and synergies in series, as seen at the contacts."""
    problem = InvalidInputError(
        "stiffnesses: with so much of the grasp rigid, the contact forces are not determined"
    )
    try:
        factor = scipy.linalg.cho_factor(contact + J @ joint @ J.T + JS @ synergy @ JS.T)
    except np.linalg.LinAlgError as error:
        raise problem from error
    # A matrix that is singular but for rounding may get through.
    pivots = np.square(np.diag(factor[0]))
    if pivots.min() < _RIGID_TOLERANCE * pivots.max():
        raise problem
    return factor


def _check_sizes(J: np.ndarray, G: np.ndarray, S: np.ndarray) -> None:
    if G.shape != (6, len(J)):
        raise InvalidInputError(
            f"grasp_matrix: expected shape (6, {len(J)}), as the Jacobian has {len(J)} rows; got {G.shape}"
        )
    if len(S) != J.shape[1] or S.shape[1] == 0:
        raise InvalidInputError(
            f"synergies: expected shape ({J.shape[1]}, n), as there are {J.shape[1]} joints; got {S.shape}"
        )
    # Torques are weighed against forces by the mean lever, so that the test does not depend on the
    # unit of length.
    lever = max(float(np.linalg.norm(G[3:]) / np.linalg.norm(G[:3])), np.finfo(float).tiny)
    values = np.linalg.svd(np.vstack([G[:3], G[3:] / lever]), compute_uv=False)
    if len(values) < 6 or values[5] <= _RANK_TOLERANCE * values[0]:
        raise InvalidInputError(
            "grasp_matrix: its rank is below 6: at least three contacts that are not on one line are needed"
        )


def _compliance(stiffness: Stiffness, size: int, name: str) -> np.ndarray:
    """The inverse of a stiffness, shape (size, size)."""
    value = as_floats(stiffness, name)
    if value.ndim == 0:
        if not value > 0.0:
            raise InvalidInputError(
                f"{name}: expected a number > 0, got {stiffness}", value=stiffness
            )
        return np.eye(size) / value
    matrix = finite_array(value, (size, size), name)
    if np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max():
        raise InvalidInputError(f"{name}: expected a symmetric matrix")
    try:
        return scipy.linalg.cho_solve(scipy.linalg.cho_factor(matrix), np.eye(size))
    except np.linalg.LinAlgError as error:
        raise InvalidInputError(f"{name}: expected a positive definite matrix") from error
