"""The weights of `IkOptions` as costs per metre and per radian, for every formulation."""

from __future__ import annotations

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.ik.options import ANGLE_UNIT, LENGTH_UNIT, IkOptions


def point_costs(hand: Hand, options: IkOptions) -> np.ndarray:
    """Return the cost of every reference point's error [cost]/[m], shape (m,)."""
    return options.point_weight / LENGTH_UNIT * np.sqrt(hand.point_weights)


def wrist_costs(options: IkOptions) -> tuple[float, float]:
    """Return the costs of the wrist's position [cost]/[m] and orientation [cost]/[rad]."""
    return (
        options.wrist_position_weight / LENGTH_UNIT,
        options.wrist_orientation_weight / ANGLE_UNIT,
    )
