"""Functions shared by the tests of the virtual sphere and ellipsoid."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from handmap_qp import load_hand

HUMAN = load_hand("human", points="fingertips")


def rotation_of(*vector: float) -> np.ndarray:
    """Return the rotation by a vector [rad]."""
    return pin.exp3(np.array(vector))


def closing(share: float) -> np.ndarray:
    """Return the human's rest posture with all fingers flexed by a share of the remaining range."""
    flexes = np.array(["flexion" in name for name in HUMAN.joint_names])
    flexes[:4] = False
    return HUMAN.rest + share * np.where(flexes, HUMAN.upper_limits - HUMAN.rest, 0.0)


def sphere_matrix(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Compose A: the velocities of points on a sphere that moves, turns and grows.

    Args:
        points: The points [m], shape (n, 3).
        centre: The sphere's centre [m], shape (3,).

    Returns:
        A, from the sphere's velocity [m/s], angular velocity [rad/s] and relative growth of its
        radius [1/s] to the points' velocities [m/s]: rows x, y, z of each point in turn, shape
        (3 n, 7).
    """
    matrix = np.zeros((len(points), 3, 7))
    offsets = points - centre
    matrix[:, :, :3] = np.eye(3)
    # Columns of -[d]x are e_k x d.
    matrix[:, :, 3:6] = np.cross(np.eye(3)[None], offsets[:, None]).transpose(0, 2, 1)
    matrix[:, :, 6] = offsets
    return matrix.reshape(-1, 7)
