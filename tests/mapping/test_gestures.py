"""Gestures of a person, one after the other, on a hand whose links lie flat on each other."""

from __future__ import annotations

import numpy as np
import pytest
from gesture_tours import RATE, read_poses, stream
from shared_hands import shared_hand_spec, shared_hands_folder

from handmap_qp import HandMapper, Recording, load_hand
from handmap_qp.human.measure import scaled_human

GESTURES = ("rest", "flare", "asl j", "grab", "asl x", "asl 7")


@pytest.mark.skipif(shared_hands_folder() is None, reason="set HANDMAP_HANDS")
def test_no_gesture_freezes_the_hand() -> None:
    # A thumb that lay flat on the palm, one pair of 1,812, held all joints for 85 samples.
    found = {pose.name: pose for pose in read_poses()}
    poses = [found[name] for name in GESTURES]
    landmarks = np.array([pose.landmarks for pose in poses])
    seen = Recording("poses", np.arange(6) / RATE, landmarks, np.ones(6, bool), "right")
    human = scaled_human(seen, points="landmarks")
    mapper = HandMapper(human, load_hand(shared_hand_spec("leap_right")), dt=1.0 / RATE)
    q = np.array(
        [mapper.map_landmarks(each).command.q for each in stream(poses, range(6))]
    )
    stands = np.abs(np.diff(q, axis=0)).max(axis=1) < 1e-9
    # The person moves in the first half of every second.
    moves = np.arange(1, len(q)) % 60 < 25
    assert not (stands & moves)[60:].any()
