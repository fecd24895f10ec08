"""Poses are found in landmarks of hands with known postures at known times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handmap_core.human.recording import Recording
from handmap_qp.apps.offline.poses import (
    CURLED,
    PINCH_GAP,
    POSES,
    STRAIGHT,
    find_poses,
    measure_posture,
)
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.library import load_hand
from handmap_qp.trackers.formats import read_recording

RATE = 50.0
TURN = Rotation.from_euler("XYZ", [0.4, -0.9, 2.0]).as_matrix()
# Knuckles of index, middle, ring and little finger in the palm: x to the little finger's side of a
# right hand, y distal, z dorsal.
KNUCKLES = np.array(
    [[-0.03, 0.09, 0.0], [-0.01, 0.095, 0.0], [0.01, 0.09, 0.0], [0.03, 0.08, 0.0]]
)
BONES = (0.045, 0.028, 0.022)


def hand(
    bend: tuple[float, ...], fan: float = 0.0, thumb: tuple[float, ...] = ()
) -> np.ndarray:
    """Return landmarks of a right hand, shape (21, 3).

    `bend` is the angle at each joint of the four fingers [deg]; straight fingers continue the
    metacarpals. `fan` turns index and little finger apart [deg each]. `thumb` is the thumb's tip.
    """
    landmarks = np.zeros((21, 3))
    tip = np.array(thumb or (-0.08, 0.06, -0.02))
    landmarks[1:5] = np.linspace([-0.02, 0.02, -0.01], tip, 4)
    for finger, (knuckle, angle) in enumerate(zip(KNUCKLES, bend, strict=True)):
        along = knuckle / np.linalg.norm(knuckle)
        aside = np.radians(fan) * (finger in (0, 3)) * (1.0 if finger == 0 else -1.0)
        along = Rotation.from_rotvec([0.0, 0.0, aside]).apply(along)
        point, chain = knuckle, [knuckle]
        for joint, length in enumerate(BONES):
            turn = np.radians(angle) * (joint + 1)
            point = point + length * (
                np.cos(turn) * along + np.sin(turn) * np.array([0, 0, -1.0])
            )
            chain.append(point)
        landmarks[5 + 4 * finger : 9 + 4 * finger] = chain
    return landmarks


OPEN = hand((5, 5, 5, 5))
FAN = hand((5, 5, 5, 5), fan=15.0)
POINTING = hand((5, 70, 70, 70))
FIST = hand((80, 80, 80, 80))
CLAW = hand((35, 35, 35, 35))


def pinch(finger: int, gap: float = 0.01) -> np.ndarray:
    bend = np.full(4, 25.0)
    bend[finger] = 40.0
    tip = hand(tuple(bend))[8 + 4 * finger]
    return hand(tuple(bend), thumb=(tip[0], tip[1], tip[2] - gap))


def recording_of(*parts: tuple[np.ndarray, float]) -> Recording:
    """Record postures, each held for a time [s], after 0.6 s of a claw."""
    samples = [np.tile(CLAW, (30, 1, 1))]
    samples += [np.tile(part, (round(RATE * time), 1, 1)) for part, time in parts]
    landmarks = np.concatenate(samples)
    time = np.arange(len(landmarks)) / RATE
    return Recording("made", time, landmarks, np.ones(len(time), dtype=bool), "right")


def test_flexion_is_the_sum_of_the_joint_angles() -> None:
    posture = measure_posture(np.stack([hand((0, 10, 45, 80)), FIST]))
    np.testing.assert_allclose(posture.flexion[0], [0, 30, 135, 240], atol=1e-4)
    assert (posture.flexion[1] > CURLED).all()


def test_spread_is_the_angle_between_index_and_little_finger() -> None:
    outward = [np.degrees(np.arctan2(knuckle[0], knuckle[1])) for knuckle in KNUCKLES]
    own = outward[3] - outward[0]
    spreads = measure_posture(
        np.stack([OPEN, FAN, hand((5, 5, 5, 5), fan=-30.0)])
    ).spread
    np.testing.assert_allclose(spreads, [own, own + 30.0, own - 60.0], atol=0.2)


def test_gaps_are_the_distances_of_the_tips() -> None:
    gaps = measure_posture(pinch(2, gap=0.012)[None]).gaps[0]
    np.testing.assert_allclose(gaps[2], 0.012)
    assert np.delete(gaps, 2).min() > 0.02


def test_measures_do_not_depend_on_place_or_side() -> None:
    hands = np.stack([OPEN, FAN, POINTING, FIST, pinch(0)])
    here = measure_posture(hands)
    for other in (hands @ TURN.T + [0.3, 1.0, -0.5], hands * (-1.0, 1.0, 1.0)):
        there = measure_posture(other)
        np.testing.assert_allclose(there.flexion, here.flexion, atol=1e-6)
        np.testing.assert_allclose(there.gaps, here.gaps, atol=1e-12)
        np.testing.assert_allclose(there.spread, here.spread, atol=1e-6)


def test_every_pose_is_found_in_its_own_stretch() -> None:
    parts = {"open": OPEN, "spread": FAN, "pointing": POINTING, "fist": FIST}
    parts |= {
        f"{name} pinch": pinch(i) for i, name in enumerate(("index", "middle", "ring"))
    }
    parts["little pinch"] = pinch(3)
    assert tuple(parts) == POSES
    recording = recording_of(*((part, 0.4) for part in parts.values()))
    found = find_poses(recording)
    assert tuple(found) == POSES
    for name, part in parts.items():
        i = found[name]
        assert i is not None, name
        np.testing.assert_array_equal(recording.landmarks[i], part, err_msg=name)


def test_poses_that_are_not_shown_are_none() -> None:
    assert find_poses(recording_of((CLAW, 1.0))) == dict.fromkeys(POSES)
    found = find_poses(recording_of((FIST, 1.0)))
    assert [name for name, i in found.items() if i is not None] == ["fist"]


def test_touch_in_a_fist_or_of_two_fingers_is_no_pinch() -> None:
    fist = FIST.copy()
    fist[4] = fist[8] + [-0.01, 0.0, 0.0]
    both = pinch(0)
    both[12] = both[8] + [0.0, 0.009, 0.0]
    for touch in (fist, both, pinch(0, gap=PINCH_GAP + 0.001)):
        assert find_poses(recording_of((touch, 1.0)))["index pinch"] is None
    assert find_poses(recording_of((pinch(0, gap=PINCH_GAP - 0.001), 1.0)))[
        "index pinch"
    ]


def test_clearest_sample_wins() -> None:
    middling = hand((5, 58, 58, 58))
    recording = recording_of((middling, 0.5), (POINTING, 0.5), (middling, 0.5))
    found = find_poses(recording)["pointing"]
    assert found is not None
    np.testing.assert_array_equal(recording.landmarks[found], POINTING)
    assert STRAIGHT < CURLED


def test_pose_that_is_held_wins_over_one_in_passing() -> None:
    passing, held = pinch(0, gap=0.004), pinch(0, gap=0.010)
    recording = recording_of((passing, 0.04), (CLAW, 0.3), (held, 0.5))
    found = find_poses(recording)["index pinch"]
    assert found is not None
    np.testing.assert_array_equal(recording.landmarks[found], held)
    # If no posture is held, a passing one is used.
    alone = find_poses(recording_of((passing, 0.04), (CLAW, 0.3)))["index pinch"]
    assert alone is not None


def test_start_and_lost_samples_are_not_used() -> None:
    recording = recording_of((OPEN, 0.5))
    valid, landmarks = recording.valid.copy(), recording.landmarks.copy()
    valid[:10] = False
    landmarks[:60] = POINTING
    # Valid from 0.2 s on, so used from 0.7 s on: only two samples of pointing remain.
    landmarks[33:] = OPEN
    late = replace(recording, valid=valid, landmarks=landmarks)
    assert find_poses(late)["pointing"] is None
    lost = recording_of((POINTING, 0.5))
    valid, landmarks = lost.valid.copy(), lost.landmarks.copy()
    valid[30:] = False
    landmarks[30:] = np.nan
    lost = replace(lost, valid=valid, landmarks=landmarks)
    assert find_poses(lost) == dict.fromkeys(POSES)


def test_wrong_shape_is_named() -> None:
    with pytest.raises(
        InvalidInputError, match=r"landmarks: expected numbers of shape \(T, 21, 3\)"
    ) as error:
        measure_posture(np.zeros((21, 3)))
    assert error.value.argument == "landmarks"


def test_poses_of_the_model_of_the_human() -> None:
    human = load_hand("human", points="landmarks")
    q = {name: 0.0 for name in human.joint_names}
    for name in q:
        if "flexion" in name.lower() and not name.startswith(("index", "thumb")):
            q[name] = 1.2
    angles = np.clip(list(q.values()), human.lower_limits, human.upper_limits)
    found = find_poses(recording_of((human.points(angles), 0.5)))
    assert [name for name, i in found.items() if i is not None] == ["pointing"]


def test_real_recordings_show_what_their_notes_say(recordings: Path) -> None:
    poses = {
        name: find_poses(read_recording(recordings / f"{name}.npz"))
        for name in (
            "quest3_webxr_right",
            "leap110_free_right",
            "leap_pinch_move_right",
        )
    }
    assert poses["quest3_webxr_right"]["pointing"] is not None
    assert poses["leap110_free_right"]["fist"] is not None
    assert poses["leap110_free_right"]["pointing"] is None
    assert poses["leap_pinch_move_right"]["index pinch"] is not None
    assert poses["leap_pinch_move_right"]["fist"] is None
