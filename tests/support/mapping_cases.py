"""Initial postures and poses for the tests of the mapping."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from strategies import motion_of

from handmap_core.ik.tasks import AttachedPoints, PointDistances
from handmap_qp import IkOptions, load_hand
from handmap_qp.hands.fingers import THUMB
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.hand_pair import hand_pair

HUMAN = load_hand("human", points="fingertips_middle")


def near_rest(
    generator: np.random.Generator, amount: float = 0.15, hand: Hand = HUMAN
) -> np.ndarray:
    """Draw a posture near rest."""
    room = np.minimum(hand.upper_limits - hand.rest, hand.rest - hand.lower_limits)
    return hand.rest + generator.uniform(-amount, amount, size=len(room)) * room


def little_pose(generator: np.random.Generator, size: float = 0.05) -> np.ndarray:
    """Draw a pose near the identity."""
    return motion_of(
        pin.exp3(generator.uniform(-size, size, size=3)),
        generator.uniform(-size, size, size=3),
    )


def pinched(finger: str, gap: float) -> np.ndarray:
    """Return a person's posture in which the tips of thumb and finger are a gap [m] apart."""
    human = load_hand("human")
    options = IkOptions(
        point_weight=0.0,
        wrist_position_weight=1e3,
        wrist_orientation_weight=1e3,
        rest_weight=0.1,
        max_iterations=200,
        step_tolerance=1e-6,
        has_velocity_limits=False,
    )
    ik = PointIk(human, options)
    ik.place(human.configuration_vector(human.rest))
    chains = hand_pair(human, human).chains
    ends = AttachedPoints(human, [chains[THUMB].tip, chains[finger].tip])
    ik.solve(
        ik.configuration.points.copy(),
        ik.configuration.wrist.homogeneous,
        1e3,
        tasks=[PointDistances(ends, [(0, 1)], [gap], [10.0])],
    )
    return ik.configuration.q[human.q_indices]
