"""Statics of a grasp: grasp matrix, and object motion and contact forces per synergy (Sec. IV).

Contacts are hard fingers: they transmit a force in any direction and no torque. A wrench or a twist
has three translational components, then three rotational ones about the object's centre, in world
axes. Any consistent units may be used.

Sources: Prattichizzo and Trinkle, Handbook of Robotics (2008), ch. 28 (G, J); Prattichizzo,
Malvezzi, Gabiccini and Bicchi, IEEE T-RO 29 (2013) 1282, the paper's [22] (soft synergies).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg
from checks import finite_array

from handmap_qp.errors import InvalidInputError
from handmap_qp.se3 import as_floats

Stiffness = float | npt.ArrayLike
"""A number k for k times the identity (infinity: rigid), or a positive definite matrix."""

# Relative tolerance on the rank of the grasp matrix; below it the contacts lie on one line.
_RANK_TOLERANCE = 1e-9
# Ratio of Cholesky pivots below which the contact forces have no significant digit.
_RIGID_TOLERANCE = 1e-14


class QuasiStatic(NamedTuple):
    """Response of a grasp in equilibrium to a unit of each synergy's reference, by column.

    Attributes:
        object_motion: Translation of the object's centre and rotation about it, world axes [m,
            rad], shape (6, n_z).
        contact_forces: Change of the forces of the hand on the object, world axes, x, y, z of each
            contact in turn [N], shape (3 n_c, n_z).
        joint_motion: Change of the joint angles [rad], shape (n_q, n_z).
        joint_torques: Change of the joint torques that balance the contact forces [N m], shape
            (n_q, n_z).
        synergy_motion: Change of the synergies, which are compliant too, shape (n_z, n_z).
    """

    object_motion: np.ndarray
    contact_forces: np.ndarray
    joint_motion: np.ndarray
    joint_torques: np.ndarray
    synergy_motion: np.ndarray


def grasp_matrix(points: npt.ArrayLike, centre: npt.ArrayLike) -> np.ndarray:
    """Grasp matrix of hard-finger contacts.

    G maps contact forces to the wrench on the object; its transpose maps the object's twist to
    velocities of the contacts.

    Args:
        points: Contacts [m], shape (n_c, 3).
        centre: Centre of the object, the reference point of torques [m], shape (3,).

    Returns:
        `G = [I .. I; [p_1 - o]x .. [p_n - o]x]`, shape (6, 3 n_c).

    Raises:
        InvalidInputError: On a wrong shape or a number that is not finite.
    """
    offsets = finite_array(points, ("n", 3), "points") - finite_array(
        centre, (3,), "centre"
    )
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
    """Object motion and contact forces per unit of synergy, with compliant contacts and joints.

    The object is in equilibrium before and after, without an external load. The unknown changes
    are those of the object's pose `du`, the contact forces `dl`, the joint torques `dtau`, the
    joints `dq` and the synergies `dz`, for a reference `dz_ref`:

        G dl = 0        dtau = J^T dl        dl = K_c (J dq - G^T du)
        dtau = K_q (S dz - dq)        S^T dtau = K_z (dz_ref - dz)

    Eliminating `dq` and `dz` leaves all springs in series at the contacts:

        C dl = J S dz_ref - G^T du        C = K_c^-1 + J K_q^-1 J^T + J S K_z^-1 S^T J^T

    With `G dl = 0` it follows that `du = (G C^-1 G^T)^-1 G C^-1 J S dz_ref`. This is the model of
    the paper's [22] in closed form. Unlike there, a stiffness may be infinite.

    Args:
        jacobian: J, shape (3 n_c, n_q).
        grasp_matrix: G, shape (6, 3 n_c).
        synergies: S, shape (n_q, n_z).
        contact_stiffness: K_c [N/m]; a matrix is (3 n_c, 3 n_c).
        joint_stiffness: K_q [N m/rad]; a matrix is (n_q, n_q).
        synergy_stiffness: K_z [N m per unit]; a matrix is (n_z, n_z).

    Returns:
        The response per unit of each synergy.

    Raises:
        InvalidInputError: On a wrong shape, a stiffness that is not positive, contacts on one line
            (the object could rotate freely about it), or infinite stiffnesses that leave the
            contact forces undetermined.
    """
    J = finite_array(jacobian, ("m", "n"), "jacobian")
    G = finite_array(grasp_matrix, (6, len(J)), "grasp_matrix")
    S = finite_array(synergies, (J.shape[1], "n"), "synergies")
    if S.shape[1] == 0:
        raise InvalidInputError(
            argument="synergies", expected="at least one column", got="none"
        )
    _check_rank(G)
    joint_compliance = _compliance(joint_stiffness, J.shape[1], "joint_stiffness")
    synergy_compliance = _compliance(synergy_stiffness, S.shape[1], "synergy_stiffness")
    JS = J @ S
    C = _compliance(contact_stiffness, len(J), "contact_stiffness")
    factor = _cholesky(C + J @ joint_compliance @ J.T + JS @ synergy_compliance @ JS.T)
    GC = scipy.linalg.cho_solve(factor, G.T).T
    object_motion = np.linalg.solve(GC @ G.T, GC @ JS)
    forces = scipy.linalg.cho_solve(factor, JS - G.T @ object_motion)
    torques = J.T @ forces
    synergy_motion = np.eye(S.shape[1]) - synergy_compliance @ S.T @ torques
    joint_motion = S @ synergy_motion - joint_compliance @ torques
    return QuasiStatic(object_motion, forces, joint_motion, torques, synergy_motion)


def _cholesky(compliance: np.ndarray) -> Any:
    """Cholesky factor of C: compliances of contacts, joints and synergies in series."""
    problem = InvalidInputError(
        argument="contact_stiffness",
        problem="the grasp is too rigid, so the contact forces are undetermined",
        advice="give a finite contact_stiffness",
    )
    try:
        factor = scipy.linalg.cho_factor(compliance)
    except np.linalg.LinAlgError as error:
        raise problem from error
    # Rounding can let a singular matrix pass the factorisation.
    pivots = np.square(np.diag(factor[0]))
    if pivots.min() < _RIGID_TOLERANCE * pivots.max():
        raise problem
    return factor


def _check_rank(G: np.ndarray) -> None:
    # Scale torques by the mean lever, so that the test does not depend on the unit of length.
    lever = max(
        float(np.linalg.norm(G[3:]) / np.linalg.norm(G[:3])), np.finfo(float).tiny
    )
    if (
        np.linalg.matrix_rank(np.vstack([G[:3], G[3:] / lever]), rtol=_RANK_TOLERANCE)
        < 6
    ):
        raise InvalidInputError(
            argument="grasp_matrix",
            expected="rank 6",
            got="a lower rank",
            advice="use at least three contacts that are not on one line",
        )


def _compliance(stiffness: Stiffness, size: int, name: str) -> np.ndarray:
    """Inverse of a stiffness, shape (size, size)."""
    value = as_floats(stiffness, name)
    if value.ndim == 0:
        # `not value > 0` also rejects NaN.
        if not value > 0.0:
            raise InvalidInputError(
                argument=name, expected="a number > 0", value=stiffness
            )
        return np.eye(size) / value
    matrix = finite_array(value, (size, size), name)
    if np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max():
        raise InvalidInputError(
            argument=name, expected="a symmetric matrix", value=stiffness
        )
    try:
        return scipy.linalg.cho_solve(scipy.linalg.cho_factor(matrix), np.eye(size))
    except np.linalg.LinAlgError as error:
        raise InvalidInputError(
            argument=name, expected="a positive definite matrix", value=stiffness
        ) from error
