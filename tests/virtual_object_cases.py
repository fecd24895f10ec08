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
