"""Saved hands hold what they meet as the library's do, where samples come with measured joints."""

from __future__ import annotations

import copy
import itertools
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from grip_cases import (
    HUMAN,
    WIDTH,
    BlockedHands,
    both_hands,
    grip_follower,
    run,
    samples,
)
from marks import rotated

from handmap_core.run import load
from handmap_core.run import load_robot as load_saved_robot
from handmap_qp import HandMapper, HumanSample, load_hand
from handmap_qp.apps.saving import saved_bytes
from handmap_qp.errors import InvalidInputError, MapperBusyError
from handmap_qp.hands import Side, load_robot
from handmap_qp.mapping import RobotMapper
from handmap_qp.stream import Follower, GripOptions, RobotFollower, RobotGripFollower

pytestmark = [
    pytest.mark.slow,
]


def saved_as(folder: Path, mapper: HandMapper | RobotMapper) -> Path:
    """Save a hand or a robot."""
    file = folder / "case.hand"
    file.write_bytes(saved_bytes(mapper))
    return file


def check_alike(found: Any, expected: Any, within: float) -> bool:
    """Check that two commands are alike; return whether they grip."""
    np.testing.assert_allclose(found.q, expected.q, atol=within)
    assert (found.effort is None) == (expected.effort is None)
    if expected.effort is not None:
        np.testing.assert_allclose(found.effort, expected.effort, atol=within)
    return expected.effort is not None


def middle_of(name: str) -> np.ndarray:
    """Return where the pads of a hand meet, midway between each other [m]."""
    hand = load_hand(name)
    grip = grip_follower(hand)
    # Later the hand carries what it holds elsewhere.
    step, _ = next(itertools.islice(run(grip, width=-1.0), 75, None))
    pads = grip.hand_grip._pairs[0]
    placed = hand.configuration()
    placed.place(step.ik.q)
    return pads.state(placed).middle


@pytest.mark.parametrize("sees", [False, True], ids=["touch", "place"])
@pytest.mark.parametrize("name", ["allegro_right", "panda_gripper", "dex3_right"])
def test_a_saved_hand_grips_as_the_library_does(
    tmp_path: Path, name: str, sees: bool
) -> None:
    hand = load_hand(name)
    centre = middle_of(name) if sees else None
    follower = load(
        saved_as(tmp_path, HandMapper(HUMAN, hand, "teleoperation")), smoothing=None
    )
    ran = run(grip_follower(hand), opens=True, centre=centre, deviation=0.003)
    efforts = []
    for sample, (step, measured) in zip(samples(opens=True), ran, strict=True):
        found = follower.map_sample(
            sample,
            measured_q=measured,
            object_centre=centre,
            object_deviation=0.003,
        )
        assert found.status == step.status
        efforts.append(check_alike(found.command, step.command, 1e-12))
    # It grips, and lets go with the person.
    assert any(efforts)
    assert not efforts[-1]
    assert follower.mapper.tasks == ()


def test_a_copy_goes_on_with_the_grip(tmp_path: Path) -> None:
    hand = load_hand("panda_gripper")
    follower = load(saved_as(tmp_path, HandMapper(HUMAN, hand, "teleoperation")))
    pick = [*samples()]
    ran = run(grip_follower(hand))
    *_, last = (
        follower.map_sample(sample, measured_q=measured)
        for sample, (_, measured) in zip(pick, ran, strict=True)
    )
    assert last.command.effort is not None
    again = copy.deepcopy(follower)
    later = HumanSample(pick[-1].time + 0.02, "right", pick[-1].landmarks)
    # Joints that were not read leave what is held.
    both = [each.map_sample(later).command for each in (follower, again)]
    assert check_alike(*both, within=0.0)


@pytest.mark.parametrize("name", rotated(["g1", "ur5_pair"], 2))
def test_a_saved_robot_grips_with_each_hand(tmp_path: Path, name: str) -> None:
    mapper = RobotMapper(load_robot(name), preset="teleoperation")
    follower = load_saved_robot(saved_as(tmp_path, mapper))
    robot = mapper.robot
    grip = RobotGripFollower(RobotFollower(mapper))
    plant = BlockedHands(robot, {"left": WIDTH, "right": WIDTH})
    gripping = np.zeros(len(robot.joint_names), dtype=bool)
    for hands in both_hands(opens=True):
        expected = grip.map_samples(hands, plant.q).command
        alike: Mapping[Side, Any] = {side: each for side, each in hands.items()}
        found = follower.map_samples(alike, measured_q=plant.q).command
        # Redundant arms amplify rounding.
        if check_alike(found, expected, within=1e-8):
            assert expected.effort is not None
            gripping |= expected.effort != 0.0
        plant.follow(expected.q)
    assert all((gripping & own).any() for own in robot.finger_joints)


def test_without_measured_joints_it_follows_as_without_a_grip(tmp_path: Path) -> None:
    hand = load_hand("panda_gripper")
    mapper = HandMapper(HUMAN, hand, "teleoperation")
    file = saved_as(tmp_path, mapper)
    plain = Follower(mapper)
    both = [load(file), load(file, grip=None)]
    for sample, (_, measured) in zip(samples(), run(grip_follower(hand)), strict=True):
        expected = plain.map_sample(sample).command
        bare = both[0].map_sample(sample).command
        unasked = both[1].map_sample(sample, measured_q=measured).command
        for found in (bare, unasked):
            assert found.effort is None
            np.testing.assert_allclose(found.q, expected.q, atol=1e-12)


def test_a_hand_that_cannot_grip_follows(tmp_path: Path) -> None:
    hand = load_hand("three_finger")
    follower = load(saved_as(tmp_path, HandMapper(HUMAN, hand, "paper")))
    assert follower.gripping is None
    for sample, _ in zip(samples(), range(3), strict=False):
        step = follower.map_sample(sample, measured_q=hand.rest)
        assert step.command.effort is None


def test_one_error_for_what_is_no_grip(tmp_path: Path) -> None:
    hand = load_hand("panda_gripper")
    file = saved_as(tmp_path, HandMapper(HUMAN, hand, "teleoperation"))
    wrong: Any = 5.0
    with pytest.raises(InvalidInputError, match=r"grip: .*GripOptions"):
        load(file, grip=wrong)
    follower = load(file, grip=GripOptions(force=2.0))
    first = next(iter(samples()))
    with pytest.raises(InvalidInputError, match="measured_q"):
        follower.map_sample(first, measured_q=[0.0, 0.0, 0.0])


def test_another_thread_leaves_no_terms_behind(tmp_path: Path) -> None:
    hand = load_hand("panda_gripper")
    follower = load(saved_as(tmp_path, HandMapper(HUMAN, hand, "teleoperation")))
    mapper = follower.mapper
    ran = run(grip_follower(hand))
    pick = [*samples()]
    *_, last = (
        follower.map_sample(sample, measured_q=measured)
        for sample, (_, measured) in zip(pick, ran, strict=True)
    )
    assert last.command.effort is not None
    gripping = follower.gripping
    assert gripping is not None
    assert gripping.hand_grip.terms
    inside = follower.follower.map_sample
    refused = []

    def interrupted(*given: Any, **named: Any) -> Any:
        def meddle() -> None:
            try:
                mapper.set_tasks(())
            except MapperBusyError as error:
                refused.append(error)

        thread = threading.Thread(target=meddle)
        thread.start()
        thread.join()
        return inside(*given, **named)

    later = replace(pick[-1], time=pick[-1].time + 0.02)
    with patch.object(follower.follower, "map_sample", interrupted):
        follower.map_sample(later, measured_q=hand.rest)
    # The whole sample is one thread's, so that its terms are taken back by the same.
    assert refused
    assert mapper.tasks == ()
