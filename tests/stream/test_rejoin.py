"""`map_sample`: the robot holds where samples make no sense, and never snaps on the way back."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from injection import inject, parse_faults
from oracles.hand_place import Place

from handmap_core.core import core
from handmap_core.human.sample import UNPROVEN_SPEED, HumanSample
from handmap_core.mapping.step import MapStep
from handmap_core.stream.rejoin import (
    FINGER_SPEED,
    PALM_SPEED,
    TURN_SPEED,
    Rejoin,
    RejoinKind,
)
from handmap_qp import (
    Follower,
    HandMapper,
    IkOptions,
    InvalidInputError,
    InvalidOptionsError,
    load_hand,
    read_recording,
)
from handmap_qp.mapping.method import HumanPose
from handmap_qp.se3 import affine, transform_points

RATE = 60.0
HUMAN = load_hand("human", points="landmarks")
ROBOT = load_hand("three_finger")


@cache
def still(count: int = 180, shift: float = 0.0, turn: float = 0.0) -> list[HumanSample]:
    """Return a hand that trembles; in the second half displaced and turned."""
    samples = []
    for i in range(count):
        share = 1.0 if i >= count // 2 else 0.0
        q = HUMAN.rest + share * 0.3 * (HUMAN.upper_limits - HUMAN.rest)
        wrist = affine(
            pin.exp3(np.array([0.0, share * turn, 0.0])), np.array([0.1, 0.2, 0.3])
        )
        wrist[0, 3] += share * shift + 1e-7 * (i % 2)
        samples.append(HumanSample(i / RATE, "right", HUMAN.points(q, wrist)))
    return samples


def mapped(
    samples: list[HumanSample],
    rejoin: RejoinKind = "glide",
    method: Any = "teleoperation",
) -> list[MapStep]:
    follower = Follower(HandMapper(HUMAN, ROBOT, method), rejoin=rejoin)
    return [follower.map_sample(sample) for sample in samples]


def teleoperation(**options: Any) -> Follower:
    return Follower(HandMapper(HUMAN, ROBOT, "teleoperation", **options))


def lost_between(shift: float = 0.0, turn: float = 0.0) -> list[HumanSample]:
    """Return a hand that is not seen for 0.5 s, and is elsewhere then."""
    return list(inject(still(240, shift, turn), parse_faults("dropout@1.75+0.5")))


@pytest.mark.parametrize("rejoin", ["glide", "clutch"])
@pytest.mark.parametrize("method", ["teleoperation", "object", "paper"])
def test_the_robot_holds_and_comes_back_at_a_limited_speed(
    rejoin: RejoinKind, method: str
) -> None:
    steps = mapped(lost_between(0.15, 1.0), rejoin, method)
    status = [step.status for step in steps]
    held = [i for i, each in enumerate(status) if each == "held"]
    assert held == list(range(held[0], held[-1] + 1))
    assert held[0] == round(1.75 * RATE)
    for i in held:
        np.testing.assert_array_equal(steps[i].command.q, steps[held[0] - 1].command.q)
        np.testing.assert_array_equal(
            steps[i].command.wrist, steps[held[0] - 1].command.wrist
        )
        assert steps[i].rule in ("missing", "settling")
    assert status[held[-1] + 1] == "gliding"
    after = steps[held[-1] :]
    for before, step in pairwise(after):
        travel = step.command.wrist[:3, 3] - before.command.wrist[:3, 3]
        turned = pin.log3(before.command.wrist[:3, :3].T @ step.command.wrist[:3, :3])
        # The wrist may lag a little behind its target: 1.5 times what fading adds.
        assert np.linalg.norm(travel) * RATE < 1.5 * (PALM_SPEED + 0.1 * TURN_SPEED)
        assert np.linalg.norm(turned) * RATE < 1.5 * TURN_SPEED
        points = step.human_points - before.human_points
        assert (
            np.linalg.norm(points, axis=1).max() * RATE
            < FINGER_SPEED + PALM_SPEED + 0.4
        )
    assert status[-1] != "gliding" or rejoin == "clutch"


def test_gliding_ends_at_the_human_and_a_clutch_stays_where_it_is() -> None:
    samples = lost_between(0.15, 1.0)
    glided = mapped(samples)[-1]
    np.testing.assert_allclose(glided.human_points, samples[-1].landmarks, atol=1e-12)
    clutched = mapped(samples, "clutch")
    held = next(step for step in clutched if step.is_held)
    np.testing.assert_allclose(
        clutched[-1].command.wrist[:3, 3], held.command.wrist[:3, 3], atol=2e-3
    )
    # The fingers show what the human's show, wherever the palm is.
    assert clutched[-1].human_wrist is not None
    assert glided.human_wrist is not None
    for step in (clutched[-1], glided):
        wrist = step.human_wrist
        assert wrist is not None
        in_wrist = (step.human_points - wrist[:3, 3]) @ wrist[:3, :3]
        actual = samples[-1].landmarks - samples[-1].landmarks[0]
        distances = np.linalg.norm(actual[:, None] - actual, axis=2)
        np.testing.assert_allclose(
            np.linalg.norm(in_wrist[:, None] - in_wrist, axis=2), distances, atol=1e-9
        )


def test_a_glide_sets_out_and_arrives_gently() -> None:
    """It begins and ends with no speed (minimum jerk), so that the robot does not jerk."""
    points = HUMAN.points(HUMAN.rest)
    here, there = np.eye(4), affine(np.eye(3), np.array([0.2, 0.0, 0.0]))
    pose = HumanPose(points, here)
    state = Rejoin(seen=HumanPose(points + there[:3, 3], there)).start(pose)
    places = []
    while state.offset is not None:
        moved, state = state.advance(pose, 0.005)
        assert moved.wrist is not None
        places.append(moved.wrist[0, 3])
    speeds = -np.diff(places) / 0.005
    assert places[0] == pytest.approx(0.2, abs=1e-12)
    assert places[-1] == pytest.approx(0.0, abs=1e-12)
    assert (speeds >= -1e-12).all()
    assert max(speeds[0], speeds[-1]) < 0.02 * speeds.max()
    assert speeds.max() == pytest.approx(PALM_SPEED, rel=0.01)


@pytest.mark.parametrize("kind", ["glide", "clutch"])
def test_a_return_adds_what_numpy_says(kind: RejoinKind) -> None:
    random = np.random.default_rng(17103)
    poses = []
    for _ in range(2):
        wrist = affine(core.exp3(random.normal(size=3)), random.normal(size=3))
        points = HUMAN.points(HUMAN.rest) + 0.01 * random.normal(size=(21, 3))
        poses.append(HumanPose(transform_points(wrist, points), wrist))
    pose, seen = poses
    state = Rejoin(kind, seen).start(pose)
    offset = Place.of(pose).to(Place.of(seen))
    assert state.offset is not None
    np.testing.assert_allclose(state.offset, offset, atol=1e-12)
    for _ in range(3):
        share = state.elapsed / state.duration
        left = 1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        kept = left * offset
        if kind == "clutch":
            kept[-2:] = offset[-2:]
        moved, state = state.advance(pose, 0.2 * state.duration)
        expected = Place.of(pose).moved(kept).pose()
        np.testing.assert_allclose(moved.points, expected.points, atol=1e-12)
        assert moved.wrist is not None
        assert expected.wrist is not None
        np.testing.assert_allclose(moved.wrist, expected.wrist, atol=1e-12)


def test_a_step_of_the_hand_takes_50_ms_however_small_or_brief() -> None:
    points = HUMAN.points(HUMAN.rest)
    pose = HumanPose(points, np.eye(4))
    near = HumanPose(points + 1e-4, affine(np.eye(3), np.full(3, 1e-4)))
    far = HumanPose(points + 0.2, affine(np.eye(3), np.full(3, 0.2)))
    for seen, lost in ((near, np.inf), (far, 0.01)):
        assert Rejoin(seen=seen).start(pose, lost).duration == 0.05


def test_a_second_hold_during_the_glide_goes_on_from_there() -> None:
    samples = list(
        inject(still(300, 0.2), parse_faults("dropout@2.2+0.5,dropout@3.0+0.3"))
    )
    steps = mapped(samples)
    assert any(
        step.status == "gliding"
        for step in steps[round(2.9 * RATE) : round(3.0 * RATE)]
    )
    travel = np.diff([step.command.wrist[0, 3] for step in steps])
    assert np.abs(travel).max() * RATE < 1.5 * PALM_SPEED
    np.testing.assert_allclose(
        steps[-1].human_points, samples[-1].landmarks, atol=1e-12
    )


def test_without_faults_samples_are_mapped_as_landmarks() -> None:
    mapper, samples = HandMapper(HUMAN, ROBOT, "teleoperation"), still(200)[:60]
    for i, (sample, step) in enumerate(zip(samples, mapped(samples), strict=True)):
        expected = mapper.map_landmarks(sample.landmarks, dt=1.0 / RATE)
        np.testing.assert_allclose(step.command.q, expected.command.q, atol=1e-9)
        assert (step.status, step.rule, step.is_held) == (expected.status, "", False), i
        assert step.consistency < 1e-9


def test_before_the_hand_is_seen_the_robot_rests_and_nothing_is_taken_for_the_reference() -> (
    None
):
    samples = still(60)
    follower = teleoperation()
    for sample in samples[:5]:
        step = follower.map_sample(replace(sample, valid=False))
        assert (step.status, step.rule) == ("held", "missing")
        np.testing.assert_array_equal(step.command.q, ROBOT.rest)
        assert np.isnan(step.human_points).all()
    seen = follower.map_sample(samples[5])
    fresh = teleoperation().map_sample(samples[5])
    np.testing.assert_allclose(seen.command.wrist, fresh.command.wrist, atol=1e-9)
    assert not seen.is_held


def test_a_step_that_fails_leaves_guard_and_mapper_as_they_were(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    samples = still(60)
    follower, calm = (teleoperation() for _ in range(2))
    for sample in samples[:10]:
        follower.map_sample(sample)
        calm.map_sample(sample)
    with pytest.raises(InvalidInputError, match="dt"):
        follower.map_sample(samples[10], dt=-1.0)
    with pytest.raises(InvalidInputError, match="side"):
        follower.map_sample(replace(samples[10], side="left"))
    with monkeypatch.context() as patch:
        # After the guard has let the sample pass.
        patch.setattr(follower.mapper, "core", None)
        patch.setattr(follower.mapper, "map", _failing)
        with pytest.raises(InvalidInputError, match="refused"):
            follower.map_sample(samples[10])
    for sample in samples[10:20]:
        step, expected = follower.map_sample(sample), calm.map_sample(sample)
        assert step.verdict == expected.verdict
        np.testing.assert_array_equal(step.command.q, expected.command.q)


def _failing(*_: Any, **__: Any) -> MapStep:
    raise InvalidInputError(argument="sample", problem="refused")


def test_confidence_and_rule_travel_in_the_step() -> None:
    follower = teleoperation()
    samples = still(10)
    assert follower.map_sample(replace(samples[0], confidence=0.6)).confidence == 0.6
    step = follower.map_sample(replace(samples[1], confidence=0.0))
    assert (step.confidence, step.rule, step.status) == (0.0, "missing", "held")
    # Joint angles are judged by their limits alone.
    assert follower.mapper.map_landmarks(samples[2].landmarks).verdict is None


def test_another_way_back_is_an_error() -> None:
    with pytest.raises(
        InvalidOptionsError, match="rejoin: expected one of glide, clutch"
    ) as caught:
        Follower(HandMapper(HUMAN, ROBOT), rejoin="leap")  # ty: ignore[invalid-argument-type]
    assert caught.value.option == "rejoin"
    wrong: Any = "x"
    with pytest.raises(InvalidInputError, match="smoothing: expected a Smoothing"):
        Follower(HandMapper(HUMAN, ROBOT), smoothing=wrong)
    # A recording in place of a sample, too: it left times of all samples in the guard.
    recording: Any = read_recording("demo", "right")
    sample: Any = recording.sample(0)
    follower = Follower(HandMapper(HUMAN, ROBOT))
    for other in (wrong, recording):
        with pytest.raises(InvalidInputError, match="sample: expected a HumanSample"):
            follower.map_sample(other)
    with pytest.raises(InvalidInputError, match="sample: expected a Recording"):
        follower.map_samples(sample)
    assert not follower.map_sample(sample).is_held


@pytest.mark.parametrize("max_acceleration", [None, 60.0])
@pytest.mark.parametrize("is_identity", [False, True])
def test_the_robot_is_slow_until_the_wrist_is_proven(
    max_acceleration: float | None, is_identity: bool
) -> None:
    robot = load_hand("three_finger")
    ik = IkOptions(max_acceleration=max_acceleration)
    follower, random = (
        Follower(HandMapper(HUMAN, robot, "object", ik=ik)),
        np.random.default_rng(4),
    )
    q, rules = [], []
    for i in range(180):
        t = i / RATE
        closed = 0.5 - 0.5 * np.cos(8.0 * t)
        # The palm turns from 0.75 s on.
        wrist = affine(
            pin.exp3(np.array([0.0, min(2.0 * max(t - 0.75, 0.0), 1.0), 0.0])),
            np.zeros(3),
        )
        points = HUMAN.points(
            HUMAN.rest + closed * 0.6 * (HUMAN.upper_limits - HUMAN.rest), wrist
        )
        points += random.normal(0.0, 1e-4, points.shape)
        given = np.eye(4) if is_identity else wrist
        step = follower.map_sample(HumanSample(t, "right", points, given))
        q.append(step.command.q)
        rules.append(step.rule)
    speeds = np.diff(np.array(q), axis=0) * RATE
    shares = np.abs(speeds / robot.velocity_limits).max(axis=1)
    # docs/faults.md promises a quarter of the speed limits.
    assert UNPROVEN_SPEED == 0.25
    is_slow = np.array(rules[1:]) == "unproven"
    assert is_slow[:60].all()
    assert shares[is_slow].max() <= UNPROVEN_SPEED * (1.0 + 1e-9)
    # The fingers ask for more than that, before and after.
    assert shares[is_slow].max() == pytest.approx(UNPROVEN_SPEED)
    if is_identity:
        assert {"", "wrist"} & set(rules) == {"wrist"}
        return
    assert rules[-1] == ""
    assert shares[~is_slow].max() > 1.5 * UNPROVEN_SPEED
    if max_acceleration is not None:
        changes = np.abs(np.diff(speeds, axis=0)) * RATE
        assert changes.max() <= max_acceleration * (1.0 + 1e-6)


def test_a_held_robot_brakes_within_its_acceleration_limit() -> None:
    most = 20.0
    options = IkOptions(max_acceleration=most, avoids_self_collision=True)
    follower = teleoperation(ik=options)
    samples = []
    for i in range(150):
        share = 0.5 - 0.5 * np.cos(2.0 * np.pi * i / 50.0)
        q = HUMAN.rest + share * 0.6 * (HUMAN.upper_limits - HUMAN.rest)
        is_seen = not 62 <= i < 110
        samples.append(
            HumanSample(i / RATE, "right", HUMAN.points(q, np.eye(4)), valid=is_seen)
        )
    steps = [follower.map_sample(sample) for sample in samples]
    speed = np.diff([step.command.q for step in steps], axis=0) * RATE
    assert np.abs(np.diff(speed, axis=0)).max() * RATE <= most * (1.0 + 1e-6)
    held = [i for i, step in enumerate(steps) if step.is_held]
    # It moves on for some samples, and stands then.
    assert np.abs(speed[held[0] - 1]).max() > 0.1
    assert np.abs(speed[held[-1] - 1]).max() < 1e-12


def test_a_clutch_ends_the_way_back() -> None:
    """The next sample is the reference as the tracker sees it, and the robot stays where it is."""
    samples = lost_between(0.15, 1.0)
    follower = teleoperation()
    steps = (follower.map_sample(sample) for sample in samples)
    gliding = next(step for step in steps if step.is_gliding)
    follower.mapper.clutch()
    after = list(steps)
    assert not any(step.is_gliding for step in after)
    seen = samples[-len(after) :]
    for sample, step in zip(seen, after, strict=True):
        np.testing.assert_allclose(step.human_points, sample.landmarks, atol=1e-12)
    for step in (after[0], after[-1]):
        np.testing.assert_allclose(
            step.wrist_target[:3, 3], gliding.command.wrist[:3, 3], atol=1e-6
        )
