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

from handmap_qp import load_hand
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
    motion = gesture_tours.map_tour(hand, poses, order, "teleoperation")
    shown = np.array([poses[k].landmarks for k in order])
    lengths = HumanLengths.from_hand_length(0.19)
    errors = gesture_tours.compare(
        trace_human(shown, lengths), trace_robot(motion.robot, motion.q, motion.wrist)
    )
    fingers = [i for i, finger in enumerate(errors.names) if finger != "thumb"]
    off = np.maximum(errors.direction, np.abs(errors.bend))[:, fingers]
    caught = (off > gesture_tours.CAUGHT).any(axis=1)
    # 13 poses; what is left are detours on their way when the next gesture begins.
    assert caught.mean() <= 0.015
    assert motion.still <= 5


def test_an_open_thumb_is_straight_on_people_that_nothing_was_tuned_on() -> None:
    poses = gesture_tours.read_held_back()
    order = gesture_tours.tour(len(poses))[:160]
    hand = load_hand("allegro_right")
    motion = gesture_tours.map_tour(hand, poses, order, "teleoperation")
    shown = np.array([poses[k].landmarks for k in order])
    lengths = HumanLengths.from_hand_length(0.19)
    errors = gesture_tours.compare(
        trace_human(shown, lengths), trace_robot(motion.robot, motion.q, motion.wrist)
    )
    is_open = gesture_tours.thumb_away(shown) > 0.05
    assert is_open.sum() > 30
    last = errors.last[is_open, errors.names.index("thumb")]
    # Its change from rest, which was followed before, leaves it bent by 50 degrees.
    assert np.median(last) < 30.0
    assert motion.still == 0


def test_a_thumb_is_as_far_away_as_the_nearest_bone() -> None:
    landmarks = np.zeros((2, 21, 3))
    # Bones of four fingers in the plane z = 0, from y = 0.1 to 0.19.
    for finger in range(4):
        for joint in range(4):
            landmarks[:, 5 + 4 * finger + joint] = 0.02 * finger, 0.1 + 0.03 * joint, 0
    landmarks[0, 4] = -0.03, 0.115, 0.04  # beside the index finger's first bone
    landmarks[1, 4] = 0.02, 0.22, 0.0  # beyond the middle finger's tip
    np.testing.assert_allclose(
        gesture_tours.thumb_away(landmarks), [0.05, 0.03], atol=1e-12
    )
