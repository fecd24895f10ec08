"""Forces that hold an object, and the commands that make them: `holding_forces`, `squeeze`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.checks import finite_array, positive_number
from handmap_qp.grasp.contacts import Grasp
from handmap_qp.grasp.statics import Stiffness

# Share of the cost of tangential forces; they use up friction, normal forces do not.
_TANGENTIAL = 4.0


def holding_forces(grasp: Grasp, load: npt.ArrayLike, normal_force: float) -> np.ndarray:
    """Find contact forces that balance a load and press on the object.

    The forces minimise `sum_c (f_n - f_0)^2 + 4 |f_t|^2` subject to `G f + w = 0`.

    Args:
        grasp: The grasp, with at least three contacts that are not on one line.
        load: Wrench on the object about its centre, w, world axes [N, N m], shape (6,).
        normal_force: Wanted normal force at every contact, f_0 [N].

    Returns:
        Forces of the hand on the object, world axes [N], shape (n_c, 3).

    Raises:
        InvalidInputError: If the grasp cannot balance every load.
    """
    wrench = finite_array(load, (6,), "load")
    force = positive_number(normal_force, "normal_force")
    G, normals = grasp.matrix, grasp.normals
    count = len(normals)
    if count < 3 or np.linalg.matrix_rank(G, tol=1e-6) < 6:
        raise InvalidInputError(
            argument="grasp", expected="three contacts that are not on one line", got=f"{count}"
        )
    projector = np.einsum("ci,cj->cij", normals, normals)
    weight = np.zeros((3 * count, 3 * count))
    for c in range(count):
        weight[3 * c : 3 * c + 3, 3 * c : 3 * c + 3] = projector[c] + _TANGENTIAL * (
            np.eye(3) - projector[c]
        )
    # Lengths of the order of the object keep the rows of G alike.
    system = np.block([[weight, G.T], [G, np.zeros((6, 6))]])
    right = np.concatenate([force * normals.ravel(), -wrench])
    return np.linalg.solve(system, right)[: 3 * count].reshape(-1, 3)


def squeeze(grasp: Grasp, forces: np.ndarray, stiffness: Stiffness) -> np.ndarray:
    """Return the displacement of a command that makes contact forces.

    Actuators of stiffness K give the torques `J^T f` if they are commanded `K^-1 J^T f` beyond the
    posture in which the hand is held up by the object.

    Args:
        grasp: The grasp.
        forces: Forces of the hand on the object [N], shape (n_c, 3).
        stiffness: Stiffness of the actuators [N m/rad], one number or shape (n, n).

    Returns:
        Displacement of the joints [rad], shape (n,).

    Raises:
        InvalidInputError: If the stiffness is not positive.
    """
    torques = grasp.jacobian.T @ forces.ravel()
    if isinstance(stiffness, float | int):
        return torques / positive_number(stiffness, "stiffness")
    return np.linalg.solve(finite_array(stiffness, (len(torques),) * 2, "stiffness"), torques)
