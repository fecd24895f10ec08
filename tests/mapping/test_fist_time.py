"""The time that a robot hand takes for a fist, at the speed limits of its joints."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from handmap_qp import Hand, HandMapper, load_hand
from handmap_qp.hands import HUMAN_HANDS, HumanLengths, hand_names, joined, load_robot
from handmap_qp.hands.spec import LimitSpec, MimicSpec
from handmap_qp.human import standard_postures
from handmap_qp.mapping import PERSON_FIST_TIME, FistTime, fist_time, slow_note

HUMANS = {"right": load_hand("human"), "left": load_hand("human_left")}
BOTH = joined("human", *HUMANS.values())
RATE = 90.0  # Hz


def with_speeds(name: str, **speeds: float) -> Hand:
    """Return a hand with other speed limits of joints; `every` is that of all others."""
    spec = load_hand(name).spec
    every = speeds.pop("every", 4.0)
    limits = {
        joint: msgspec.structs.replace(
            spec.limits.get(joint, LimitSpec()), velocity=speeds.get(joint, every)
        )
        for joint in [*spec.joints, *speeds]
    }
    return load_hand(msgspec.structs.replace(spec, limits=spec.limits | limits))


def timed(robot: Hand) -> FistTime:
    return fist_time(HUMANS["right"], robot)


@pytest.mark.parametrize("name", ["three_finger", "allegro_right"])
def test_a_hand_twice_as_fast_takes_half_the_time(name: str) -> None:
    slow, fast = (timed(with_speeds(name, every=speed)) for speed in (0.7, 1.4))
    assert slow.time > 0.5
    np.testing.assert_allclose(slow.joint_times, 2.0 * fast.joint_times, rtol=1e-9)
    assert slow.joint == fast.joint


def test_a_slower_joint_slows_itself_alone() -> None:
    usual = timed(with_speeds("three_finger"))
    robot = with_speeds("three_finger", f1_distal=0.1)
    found = timed(robot)
    is_slow = np.array(robot.joint_names) == "f1_distal"
    np.testing.assert_allclose(found.joint_times[~is_slow], usual.joint_times[~is_slow])
    np.testing.assert_allclose(
        found.joint_times[is_slow], 40.0 * usual.joint_times[is_slow]
    )
    assert found.joint == "f1_distal"
    assert found.time == found.joint_times.max()


def following(ratio: float, speed: float) -> Hand:
    """Return a hand with a joint that follows another one, and its own speed limit."""
    spec = load_hand("three_finger").spec
    joints = tuple(joint for joint in spec.joints if joint != "f2_distal")
    limits = {joint: LimitSpec(velocity=2.0) for joint in joints}
    changes: dict[str, Any] = {
        "joints": joints,
        "rest": {joint: spec.rest[joint] for joint in joints},
        "mimic": {"f2_distal": MimicSpec("f1_distal", ratio)},
        "limits": limits | {"f2_distal": LimitSpec(velocity=speed)},
    }
    return load_hand(msgspec.structs.replace(spec, **changes))


def test_a_follower_slows_its_leader_by_its_ratio() -> None:
    quick, slow, slowest = (timed(following(0.8, v)) for v in (50.0, 0.4, 0.2))
    leader = following(0.8, 50.0).joint_names.index("f1_distal")
    # The follower goes 0.8 of the leader's way at 0.4 rad/s, the leader its own at 2 rad/s.
    ratio = 0.8 / 0.4 * 2.0
    assert slow.joint_times[leader] == pytest.approx(ratio * quick.joint_times[leader])
    assert slowest.joint_times[leader] == pytest.approx(2.0 * slow.joint_times[leader])
    assert slow.joint == "f1_distal"
    others = np.arange(len(quick.joint_times)) != leader
    np.testing.assert_allclose(slow.joint_times[others], quick.joint_times[others])


def test_locked_joints_take_no_time() -> None:
    spec = load_hand("three_finger").spec
    slow = timed(with_speeds("three_finger", f3_distal=0.1))
    assert slow.joint == "f3_distal"
    joints = tuple(joint for joint in spec.joints if joint != "f3_distal")
    locked = load_hand(
        msgspec.structs.replace(
            spec,
            joints=joints,
            rest={joint: spec.rest[joint] for joint in joints},
            locked={"f3_distal": 0.3},
        )
    )
    found = timed(locked)
    assert found.joint_times.shape == (len(joints),)
    assert found.joint in joints
    assert found.time < 0.5 * slow.time


def test_joints_of_an_arm_take_no_time() -> None:
    arm = load_hand("ur5_allegro")
    found = timed(arm)
    assert not found.joint_times[arm.moves_wrist].any()
    bare = timed(load_hand("allegro_right"))
    np.testing.assert_allclose(
        found.joint_times[~arm.moves_wrist], bare.joint_times, atol=0.01
    )


def test_a_robot_takes_as_long_as_its_slowest_hand() -> None:
    robot = load_robot("ur5_pair")
    found = fist_time(BOTH, robot)
    hands = [
        fist_time(human, load_hand(f"allegro_{side}")).time
        for side, human in HUMANS.items()
    ]
    assert found.time == pytest.approx(max(hands), abs=0.001)
    assert found.joint_times.shape == (len(robot.joint_names),)
    assert robot.joint_names[int(np.argmax(found.joint_times))] == found.joint


def test_the_persons_size_does_not_matter() -> None:
    robot = load_hand("svh_right")
    for length in (0.15, 0.22):
        lengths = HumanLengths.from_hand_length(length)
        human = load_hand("human", lengths=lengths)
        assert fist_time(human, robot).time == timed(robot).time
        assert human.unscaled is not None


@pytest.mark.slow
def test_every_hand_has_a_time() -> None:
    slow = set()
    for name in hand_names():
        if name in HUMAN_HANDS:
            continue
        robot = load_hand(name)
        found = fist_time(BOTH, robot)
        assert 0.02 < found.time < 5.0, name
        assert found.time == found.joint_times.max()
        assert robot.joint_names[int(np.argmax(found.joint_times))] == found.joint
        assert found.is_assumed == (robot.spec.speeds == "assumed")
        if found.is_slow:
            slow.add(name)
    assert {"svh_right", "inspire_left", "inspire_right"} <= slow
    assert not {"allegro_right", "leap_right", "shadow_right"} & slow


@pytest.mark.parametrize("name", ["svh_right", "inspire_right"])
def test_a_mapped_fist_arrives_no_sooner_and_not_much_later(name: str) -> None:
    """A person whose flat hand is a fist at once: the robot follows at its speed limits."""
    robot = load_hand(name)
    human = HUMANS["right"]
    postures = standard_postures(human)
    mapper = HandMapper(human, robot, dt=1.0 / RATE)
    opening, path = (
        np.array(
            [
                mapper.map_step(postures[name], np.eye(4)).command.q
                for _ in range(int(8.0 * RATE))
            ]
        )
        for name in ("flat hand", "fist")
    )
    assert np.abs(path[-1] - path[-10]).max() < 1e-4
    arrived = np.abs(path - path[-1]).max(axis=1) < 0.02
    time = (int(np.argmax(arrived)) + 1) / RATE
    found = timed(robot)
    # The last 0.02 rad are not waited for.
    least = found.time - 0.02 / robot.velocity_limits.min() - 1.0 / RATE
    assert least <= time <= 1.5 * found.time
    assert np.abs(path[-1] - opening[-1]).max() > 0.5


def test_a_slow_hand_has_a_line_that_says_whether_speeds_are_known() -> None:
    times = np.zeros(1)
    quick = FistTime(PERSON_FIST_TIME, "joint", times, is_assumed=False)
    slow = FistTime(1.44, "joint", times, is_assumed=False)
    assert slow_note(quick) == ""
    assert slow_note(slow) == "This hand needs 1.4 s for a fist: a person is faster."
    assert "assumed speeds" in slow_note(slow._replace(is_assumed=True))
