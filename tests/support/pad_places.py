"""Where a hand's pads are, and how deep its links are in an object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import coal
import numpy as np
from holding import FINGERS

from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.hand_pair import robot_fingers


def pads_of(
    hand: Hand, q: np.ndarray, wrist: np.ndarray, fingers: Sequence[str] = FINGERS
) -> tuple[Any, np.ndarray]:
    """Return a hand as it is placed, and the middles of its pads [m], shape (f, 3)."""
    placed = hand.configuration()
    placed.place(hand.configuration_vector(q, wrist))
    pads = robot_fingers(hand).pads
    ends = [placed.data.oMi[pads[f].joint].act(pads[f].offset) for f in fingers]
    return placed, np.array(ends)


def depth(hand: Hand, placed: Any, shape: Any, pose: np.ndarray) -> float:
    """Return how deep the deepest link of a hand is in an object [m], < 0 outside."""
    there = coal.Transform3s(pose[:3, :3], pose[:3, 3])
    gaps = []
    for link in read_collision_shapes(hand).geometryObjects:
        own = placed.data.oMi[link.parentJoint] * link.placement
        here = coal.Transform3s(own.rotation, own.translation)
        request, result = coal.DistanceRequest(True, True), coal.DistanceResult()
        gaps.append(coal.distance(link.geometry, here, shape, there, request, result))
    return -min(gaps)
