"""Labelled gestures of people, one after the other: no finger stays caught, none freezes.

`benchmarks/fidelity/bench_gestures.py` brings every pair of them. Here are those
of each fifth pose.
"""

from __future__ import annotations

import gesture_tours
import numpy as np
import pytest
import shared_hands
from marks import full

from handmap_qp.apps.offline.hand_trace import trace_human, trace_robot
from handmap_qp.errors import MissingPackageError
from handmap_qp.hands.human import HumanLengths

# Python takes a minute a hand for it.
HANDS = ("allegro_right", "shadow_right", full("leap_right"))


@pytest.mark.parametrize("name", HANDS)
def test_no_finger_stays_caught_from_one_gesture_to_the_next(name: str) -> None:
    if name in shared_hands.NAMES and shared_hands.shared_hands_folder() is None:
        pytest.skip("set HANDMAP_HANDS")
    try:
        hand = shared_hands.load(name)
    except MissingPackageError as error:
        pytest.skip(str(error))
    poses = gesture_tours.read_poses()[::5]
    order = gesture_tours.tour(len(poses))
    robot, q, wrist, still = gesture_tours.map_tour(hand, poses, order, "teleoperation")
    shown = np.array([poses[k].landmarks for k in order])
    lengths = HumanLengths.from_hand_length(0.19)
    errors = gesture_tours.compare(
        trace_human(shown, lengths), trace_robot(robot, q, wrist)
    )
    fingers = [i for i, finger in enumerate(errors.names) if finger != "thumb"]
    off = np.maximum(errors.direction, np.abs(errors.bend))[:, fingers]
    caught = (off > gesture_tours.CAUGHT).any(axis=1)
    # 13 poses; what is left are detours on their way when the next gesture begins.
    assert caught.mean() <= 0.015
    assert still <= 5
