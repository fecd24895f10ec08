"""What the tests of the virtual sphere and ellipsoid share."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from handmap_qp import load_hand

HUMAN = load_hand("human", points="fingertips")


def rotation_of(*vector: float) -> np.ndarray:
    """A rotation by a vector [rad]."""
    return pin.exp3(np.array(vector))


def closing(share: float) -> np.ndarray:
    """The human's rest posture with all fingers flexed further, by a share of the room."""
    flexes = np.array(["flexion" in name for name in HUMAN.joint_names])
    flexes[:4] = False
    return HUMAN.rest + share * np.where(flexes, HUMAN.upper_limits - HUMAN.rest, 0.0)
