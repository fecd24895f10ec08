"""Summary of a mapped motion: the share of samples that speed limits held."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import msgspec
import numpy as np
import pytest

from handmap_core.human.recording import Recording
from handmap_qp import HandMapper, IkOptions, load_hand
from handmap_qp.apps.offline.summary import (
    compare_closing,
    notes,
    summarise,
    table_rows,
)
from handmap_qp.apps.offline.trajectory import Trajectory, map_recording
from handmap_qp.hands.robot import load_robot
from handmap_qp.hands.spec import LimitSpec
from handmap_qp.human import standard_postures

HUMAN = load_hand("human", points="landmarks")


def closing(count: int = 40) -> Recording:
    """Record a hand that closes within half the recording, then hardly moves; one gap."""
    closed = HUMAN.rest + 0.5 * (HUMAN.upper_limits - HUMAN.rest)
    # Landmarks that repeat exactly would be frozen data.
    shares = np.minimum(np.arange(count) / (count / 2), 1.0 + 1e-9 * np.arange(count))
    landmarks = [
        HUMAN.points(HUMAN.rest + share * (closed - HUMAN.rest)) for share in shares
    ]
    valid = np.ones(count, dtype=bool)
    valid[10:13] = False
    return Recording(
        "closing", np.arange(count) / 60.0, np.array(landmarks), valid, "right"
    )


def mapped(
    speed: float, ik: IkOptions | None = None, upper: float | None = None
) -> Trajectory:
    spec = load_hand("three_finger").spec
    limits = {joint: LimitSpec(velocity=speed, upper=upper) for joint in spec.joints}
    robot = load_hand(msgspec.structs.replace(spec, limits=limits))
    return map_recording(HandMapper(HUMAN, robot, "teleoperation", ik=ik), closing())


def test_a_slow_hand_is_held_and_a_quick_one_is_not() -> None:
    slow, quick = mapped(0.3), mapped(1000.0)
    moved = np.abs(np.diff(slow.q, axis=0)) * 60.0
    held = slow.at_speed_limit[1:]
    np.testing.assert_allclose(moved[held], 0.3, rtol=1e-6)
    # Few joints at their speed limit have a target at exactly that speed.
    assert (held[moved > 0.3 - 1e-9]).mean() > 0.95
    summary = summarise(slow)
    assert summary["speed_limited_share"] > 0.5
    assert (
        summary["speed_limited_share"]
        == slow.at_speed_limit[slow.valid].any(axis=1).mean()
    )
    assert not slow.at_speed_limit[~slow.valid].any()
    assert not quick.at_speed_limit.any()
    assert summarise(quick)["speed_limited_joints"] == []


def test_a_joint_at_a_position_limit_is_not_held_by_its_speed() -> None:
    trajectory = mapped(0.3, IkOptions(has_velocity_limits=False), upper=0.75)
    assert trajectory.at_limit.any()
    assert not trajectory.at_speed_limit.any()


@pytest.mark.parametrize(("speed", "is_noted"), [(0.3, True), (1000.0, False)])
def test_a_large_share_is_one_line_with_joint_and_limit(
    speed: float, is_noted: bool
) -> None:
    summary = summarise(mapped(speed))
    assert len(notes(summary)) == is_noted
    assert table_rows(summary)["samples held by a speed limit"].endswith(" %")
    if is_noted:
        (note,) = notes(summary)
        assert "\n" not in note
        worst = summary["speed_limited_joints"][0]
        assert f"{worst['joint']} (0.3 per s)" in note
        assert "hand.yaml" in note


@pytest.mark.parametrize("speeds", [None, "assumed"])
def test_a_hand_slower_than_this_person_is_one_line_with_both_times(
    speeds: Literal["assumed"] | None,
) -> None:
    postures = standard_postures(HUMAN)
    flat, fist = postures["flat hand"], postures["fist"]
    shares = np.clip(np.linspace(-1.0, 2.0, 91), 0.0, 1.0)  # 1 s of 3 s, at 30 Hz
    landmarks = np.array([HUMAN.points(flat + x * (fist - flat)) for x in shares])
    seen = np.ones(91, dtype=bool)
    person = Recording("closing", np.arange(91) / 30.0, landmarks, seen, "right")
    spec = load_hand("three_finger").spec
    summary = summarise(mapped(0.3))
    found = {}
    for speed in (0.3, 10.0):
        limits = {joint: LimitSpec(velocity=speed) for joint in spec.joints}
        changed = msgspec.structs.replace(spec, limits=limits, speeds=speeds)
        robot = load_hand(changed)
        closing = compare_closing(HUMAN, robot, [person])
        assert closing is not None
        assert closing["closings"] == 4
        assert closing["person_s"] == pytest.approx(1.0, rel=0.05)
        found[speed] = closing
        (line,) = notes(summary | {"closing": closing})
        is_slower = closing["robot_s"] > closing["person_s"]
        assert ("follows late" in line) == is_slower == (speed == 0.3)
        # The share and the joints are said in both cases.
        assert f"{100.0 * summary['speed_limited_share']:.0f} % of the samples" in line
        assert ("assumed speed limits" in line) == (is_slower and speeds is not None)
    rare = summary | {"speed_limited_share": 0.01}
    assert len(notes(rare | {"closing": found[0.3]})) == 1
    assert notes(rare | {"closing": found[10.0]}) == notes(rare) == []
    still = replace(person, landmarks=np.repeat(landmarks[:1], 91, axis=0))
    assert compare_closing(HUMAN, robot, [still]) is None


def test_samples_that_an_assumed_speed_held_are_counted() -> None:
    """Of two joints that are held, only the one whose speed is assumed counts."""
    trajectory = mapped(1000.0)
    count, joints = trajectory.q.shape
    held = np.zeros((count, joints), dtype=bool)
    held[: count // 2, 0] = True
    held[:, 1] = True
    held &= trajectory.valid[:, None]
    found = {}
    for words in (None, "urdf", "assumed"):
        spec = load_hand("three_finger").spec
        limits = {spec.joints[0]: LimitSpec(velocity=5.0)}
        spec = msgspec.structs.replace(spec, limits=limits, speeds=words)
        known = replace(trajectory, robot=load_hand(spec), at_speed_limit=held)
        found[words] = summarise(known)
    share = held[trajectory.valid, 0].mean()
    assert found["assumed"]["assumed_speed_share"] == pytest.approx(share)
    assert found["assumed"]["speed_limited_share"] == 1.0
    (line,) = notes(found["assumed"])
    assert f"assumed ones in {100.0 * share:.0f} %" in line
    assert "handmap hands init --speed" in line
    row = table_rows(found["assumed"])["samples held by a speed limit"]
    assert row == f"100.0 %, by an assumed one {100.0 * share:.1f} %"
    for words in (None, "urdf"):
        assert found[words]["assumed_speed_share"] is None
        (line,) = notes(found[words])
        assert (
            "assumed"
            not in line + table_rows(found[words])["samples held by a speed limit"]
        )
    # A smaller share than of other limits is worth a line: the robot may be faster.
    rare = {"speed_limited_share": 0.1, "closing": None}
    assert notes(found["assumed"] | rare | {"assumed_speed_share": 0.1}) != []
    assert notes(found["assumed"] | rare | {"assumed_speed_share": 0.0}) == []


def test_an_arm_that_is_too_short_is_one_line_with_a_scale() -> None:
    """A wrist that stops 50 mm short of a target 100 mm away: half the scale."""
    trajectory = mapped(1.0)
    seen = len(trajectory.time)
    wrist = np.repeat(np.eye(4)[None], seen, axis=0)
    wrist[1:, 0, 3] = 0.05
    error = np.where(np.arange(seen) > 0, 0.05, 0.0)
    arm = load_hand("ur5_allegro")
    free = np.zeros((seen, len(arm.joint_names)), dtype=bool)
    at_limit, at_speed_limit = free.copy(), free.copy()
    (joint, *_), (finger, *_) = map(np.flatnonzero, (arm.moves_wrist, ~arm.moves_wrist))
    at_speed_limit[: seen // 4, joint] = True
    at_limit[: seen // 2, joint] = True
    at_speed_limit[:, finger] = True
    late = replace(
        trajectory,
        robot=arm,
        q=np.tile(arm.rest, (seen, 1)),
        at_speed_limit=at_speed_limit,
        at_limit=at_limit,
        wrist=wrist,
        wrist_error=error,
    )
    summary = summarise(late)
    found = summary["arm_out_of_reach"]
    assert found is not None
    assert found["scale"] == pytest.approx(0.5)
    assert found["motion_mm"] == pytest.approx(100.0)
    assert set(found["held_by"]) == {"reach", "limit", "speed"}
    assert sum(found["held_by"].values()) == pytest.approx(1.0)
    (note,) = [note for note in notes(summary) if "arm" in note]
    assert "held by reach 5" in note
    assert "try --scale 0.5" in note
    # Palms of a robot that are near each other are not scaled, so none is advised.
    pair = load_robot("ur5_pair")
    columns = np.zeros((seen, len(pair.joint_names)))
    off = columns.astype(bool)
    both = replace(late, robot=pair, q=columns, at_speed_limit=off, at_limit=off)
    (note,) = [note for note in notes(summarise(both)) if "arm" in note]
    assert "try --scale" not in note
    # A floating hand, and an arm that arrives, need no line.
    assert summarise(replace(trajectory, wrist_error=error))["arm_out_of_reach"] is None
    near = notes(summarise(replace(late, wrist_error=0.1 * error)))
    assert not [note for note in near if "arm" in note]


def test_a_waist_at_its_limit_is_one_line_and_says_how_far_it_bends() -> None:
    robot = load_robot("g1")
    waist = robot.joint_names.index("waist_pitch_joint")
    trajectory = mapped(1000.0)
    seen = len(trajectory.time)
    q = np.tile(robot.rest, (seen, 1))
    at_limit = np.zeros(q.shape, dtype=bool)
    upright = replace(
        trajectory, robot=robot, q=q, at_speed_limit=at_limit, at_limit=at_limit
    )
    assert not [note for note in notes(summarise(upright)) if "may fall" in note]
    assert "waist_pitch_joint by up to 0 deg" in table_rows(summarise(upright))["leans"]
    q, at_limit = q.copy(), at_limit.copy()
    q[seen // 2 :, waist] = robot.upper_limits[waist]
    at_limit[seen // 2 :, waist] = True
    bent = summarise(replace(upright, q=q, at_limit=at_limit))
    (row,) = [row for row in bent["leaning"] if row["joint"] == "waist_pitch_joint"]
    assert row["most"] == pytest.approx(robot.upper_limits[waist])
    assert 0.4 < row["at_limit_share"] < 0.6
    (note,) = [note for note in notes(bent) if "may fall" in note]
    assert "waist_pitch_joint in 5" in note
    assert "waist_pitch_joint by up to 30 deg" in table_rows(bent)["leans"]
    # A hand alone cannot lean.
    assert summarise(trajectory)["leaning"] == []
    assert "leans" not in table_rows(summarise(trajectory))


@pytest.mark.parametrize("size", [1, 7, 38])
def test_parts_say_the_same_of_a_motion(
    size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    motion = mapped(0.3)
    # Beyond a limit in one sample, and quickest and most accelerated at the end.
    motion = replace(motion, q=np.append(motion.q[:-1], motion.q[-1:] + 9.0, axis=0))
    expected = summarise(motion)
    assert expected["limit_violation_max"] > 1.0
    monkeypatch.setattr("handmap_qp.apps.offline.summary._AT_ONCE", size)
    monkeypatch.setattr("handmap_qp.human.measure._AT_ONCE", size)
    assert summarise(motion) == expected
    rates = np.abs(motion.speeds) / motion.robot.velocity_limits
    assert expected["speed_over_limit_max"] == rates.max()
    assert expected["acceleration_max"] == np.abs(motion.accelerations).max()
