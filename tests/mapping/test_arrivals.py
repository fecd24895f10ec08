"""When fingers arrive, at which pace they are asked to, and why some stay caught."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import cast

import gesture_tours
import numpy as np
import pytest
from arrivals import (
    ARRIVED,
    FingerMeter,
    FingerShapes,
    are_under_way,
    arrival_time,
    shapes_of,
)
from caught_fingers import (
    EVERYWHERE,
    FROM_HERE,
    ON_THE_WAY,
    OUT_OF_REACH,
    find_caught,
)
from gesture_tours import PACES, RATE, Pose, TourMotion, map_tour, samples_of_move
from hypothesis import given
from hypothesis import strategies as st

from handmap_qp import Hand, load_hand
from handmap_qp.apps.offline.hand_trace import HandTrace, trace_robot

PERIOD = 1.0 / RATE
FOLDING = ("joint_1.0", "joint_2.0", "joint_3.0")
"""Joints of the Allegro's index finger that fold it."""


def turned(degrees: np.ndarray) -> FingerShapes:
    """Return a finger of 80 mm that points so far off an axis, and is straight."""
    angle = np.radians(degrees)
    aim = 0.08 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    return FingerShapes(aim[:, None], np.zeros((len(angle), 1)))


def bent(degrees: np.ndarray) -> FingerShapes:
    """Return a finger that keeps its direction, and bends."""
    return FingerShapes(turned(0.0 * degrees).aim, degrees[:, None])


def time_of(seconds: float) -> np.ndarray:
    return np.arange(round(RATE * seconds) + 1) / RATE


@given(st.floats(20.0, 150.0), st.floats(0.02, 0.5), st.sampled_from([turned, bent]))
def test_a_lag_arrives_when_it_has_decayed(far: float, constant: float, shape) -> None:
    time = time_of(12.0 * constant)
    found = arrival_time(time, shape(far * np.exp(-time / constant)))
    exact = constant * np.log(far / ARRIVED)
    # The end of twelve time constants is a thousandth of a degree from the limit of the lag.
    assert exact - 1e-3 <= found <= exact + PERIOD + 1e-3


@given(st.floats(0.0, 150.0), st.floats(30.0, 400.0), st.sampled_from([turned, bent]))
def test_a_ramp_arrives_when_its_speed_has_covered_the_rest(far, speed, shape) -> None:
    time = time_of(far / speed + 0.2)
    found = arrival_time(time, shape(np.maximum(0.0, far - speed * time)))
    exact = max(0.0, (far - ARRIVED) / speed)
    assert exact - 1e-9 <= found <= exact + PERIOD + 1e-9
    assert found == 0.0 or far > ARRIVED


def test_the_last_finger_counts_and_one_that_leaves_again_has_not_arrived() -> None:
    time = time_of(2.0)
    soon = np.maximum(0.0, 90.0 - 180.0 * time)
    late = np.maximum(0.0, 90.0 - 90.0 * time)
    both = FingerShapes(
        np.concatenate([turned(soon).aim, turned(late).aim], axis=1),
        np.zeros((len(time), 2)),
    )
    assert arrival_time(time, both) == arrival_time(time, turned(late))
    again = soon + 40.0 * ((time > 1.0) & (time < 1.25))
    assert arrival_time(time, turned(again)) == pytest.approx(1.25, abs=PERIOD)


def test_a_finger_that_still_turns_at_the_end_arrives_never() -> None:
    time = time_of(0.5)
    ramp = turned(90.0 - 60.0 * time)
    assert are_under_way(time, ramp).tolist() == [True]
    assert arrival_time(time, ramp) == np.inf
    # Creeping by less than ten degrees a second, it is where it ends to within what counts.
    creep = turned(5.0 - 9.0 * time)
    assert not are_under_way(time, creep).any()
    assert arrival_time(time, creep) == 0.0
    assert arrival_time(time[:1], turned(np.zeros(1))) == 0.0


@pytest.fixture(scope="module")
def robot() -> Hand:
    return load_hand("allegro_right")


def test_fingers_are_measured_as_the_trace_of_the_hand_has_them(robot: Hand) -> None:
    q = np.random.default_rng(0).uniform(*robot.limits, (5, len(robot.joint_names)))
    meter = FingerMeter(robot)
    trace = trace_robot(robot, q)
    assert meter.names == trace.names
    for found, wanted in zip(meter.shapes(q), shapes_of(trace.local), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-6)


@given(st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=2), st.floats(0.2, 10.0))
def test_a_motion_at_the_robots_own_pace_keeps_its_speed(ends, limit) -> None:
    before, now = (np.array([end, 0.0]) for end in ends)
    limits = np.array([limit, np.inf])
    count = samples_of_move(before, now, limits)
    way = gesture_tours.moving(before.reshape(2, 1), now.reshape(2, 1), count)
    fastest = np.abs(np.diff(way[:, 0, 0], prepend=before[0])).max() * RATE
    assert fastest <= limit * (1.0 + 1e-9)
    # It is no slower than it has to be.
    assert count == 30 or fastest > 0.9 * limit


def test_random_tours_repeat_by_their_seed_and_no_pose_follows_itself() -> None:
    order = gesture_tours.random_tour(5, 300, 1)
    assert order == gesture_tours.random_tour(5, 300, 1)
    assert order != gesture_tours.random_tour(5, 300, 2)
    assert len(order) == 301
    assert {*order} == {*range(5)}
    pairs = {*pairwise(order)}
    assert len(pairs) == 20
    assert all(a != b for a, b in pairs)


class Chaser:
    """A mapper whose one joint chases the x of a landmark, at its speed limit."""

    def __init__(self, human: object, robot, preset: str, dt: float) -> None:
        self.robot = robot
        self._step = robot.velocity_limits * dt
        self._q = np.zeros(1)

    def map_landmarks(self, landmarks: np.ndarray) -> SimpleNamespace:
        step = np.clip(landmarks[8, :1] - self._q, -self._step, self._step)
        self._q = self._q + step
        command = SimpleNamespace(q=self._q, wrist=np.eye(4))
        return SimpleNamespace(command=command)


def one_joint(speed: float) -> Hand:
    """Return what `Chaser` and the pace need of a robot."""
    return cast("Hand", SimpleNamespace(velocity_limits=np.array([speed])))


def test_who_waits_sees_a_slow_robot_arrive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gesture_tours, "HandMapper", Chaser)
    monkeypatch.setattr(gesture_tours, "scaled_to", lambda poses: None)
    robot = one_joint(0.5)
    poses = []
    for x in (0.0, 1.5):
        landmarks = np.zeros((21, 3))
        landmarks[8, 0] = x
        poses.append(Pose(None, str(x), landmarks))
    order = [0, 1, 0]
    motions = {
        name: map_tour(robot, poses, order, "any", pace) for name, pace in PACES.items()
    }
    # 1.5 rad take 3 s, of which the motion of half a second is at most one sixth.
    assert [len(rows) for rows in motions["half-second"].held] == [31, 31, 31]
    assert motions["half-second"].q[1, 0] < 0.51
    np.testing.assert_allclose(motions["wait"].q[:, 0], [0.0, 1.5, 0.0], atol=1e-9)
    longer = len(motions["wait"].held[1]) / RATE
    assert 2.5 + 0.5 - 0.1 <= longer <= 3.0 + 0.5
    # At its own pace, the robot is there when the person is.
    for rows in motions["own"].held:
        assert len(rows) == 31
        assert np.ptp(rows) < 0.02
    # A robot that never comes is waited for no longer than that.
    slower = one_joint(0.1)
    waited = map_tour(slower, poses, order, "any", PACES["wait"]).held[1]
    assert len(waited) == round(gesture_tours.LONGEST_HOLD * RATE) + 1


def test_the_reason_says_what_holds_a_finger(robot: Hand) -> None:
    straight = robot.rest[None]
    index = [i for i, name in enumerate(robot.joint_names) if name in FOLDING]
    folded = straight.copy()
    folded[0, index] = robot.upper_limits[index]
    human = trace_robot(robot, straight)

    def reason(wanted: HandTrace, q, settled, held) -> dict[str, str]:
        motion = TourMotion(robot, q, np.eye(4)[None], [held], 0)
        found = find_caught(wanted, motion, settled)
        assert all(each.pose == 0 for each in found)
        return {each.finger: each.reason for each in found}

    still = folded.repeat(31, axis=0)
    share = np.linspace(0.4, 0.8, 31)[:, None]
    moving = straight + share * (folded - straight)
    assert reason(human, straight, straight, straight.repeat(31, axis=0)) == {}
    assert reason(human, folded, straight, still) == {"index": FROM_HERE}
    assert reason(human, folded, folded, still) == {"index": EVERYWHERE}
    assert reason(human, moving[-1:], folded, moving) == {"index": ON_THE_WAY}
    # Through the back of the hand: nothing shows that.
    points = human.points.copy()
    knuckle, tip = points[0, human.names.index("index"), [0, 2]]
    points[0, human.names.index("index"), 1:] = knuckle - (tip - knuckle)
    backwards = human._replace(points=points)
    assert reason(backwards, straight, straight, straight.repeat(31, axis=0)) == {
        "index": OUT_OF_REACH
    }
