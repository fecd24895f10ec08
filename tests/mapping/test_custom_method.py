"""Methods of one's own: the base class, functions of landmarks, and what is missing."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from handmap_qp import (
    PRESETS,
    CustomMethod,
    HandMapper,
    InvalidInputError,
    InvalidOptionsError,
    JointFunction,
    load_hand,
    scaled_human,
)
from handmap_qp.human import Recording
from handmap_qp.mapping.method import HumanPose, Targets
from handmap_qp.trackers import read_recording

ROBOT = load_hand("allegro_right")
SPAN = ROBOT.upper_limits - ROBOT.rest


@dataclass(frozen=True)
class Closing(CustomMethod):
    """Close all joints by a share, also as a frozen dataclass."""

    share: float = 0.2

    def targets(self, sample: HumanPose) -> Targets:
        return self.place_joints(sample, ROBOT.rest + self.share * SPAN)


class Pointing(CustomMethod):
    """Hold the robot's points in its palm."""

    def targets(self, sample: HumanPose) -> Targets:
        return self.place_points(sample, self.palm.robot_points)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_recording("demo", "right").part(slice(0, 60))


def follow(method: Any, recording: Recording, points: str = "landmarks") -> Any:
    """Return the last step of a recording."""
    human = scaled_human(recording, points=points)
    mapper = HandMapper(human, ROBOT, method, dt=1 / 30)
    return [mapper.map_landmarks(sample.landmarks) for sample in recording][-1]


def test_joints_that_the_robot_can_reach_are_reached(recording: Recording) -> None:
    q = ROBOT.rest + 0.2 * SPAN
    by_name = dict(zip(ROBOT.joint_names, q.tolist(), strict=True))
    for method in (Closing(), lambda _: q, lambda _: by_name):
        step = follow(method, recording)
        np.testing.assert_allclose(step.command.q, q, atol=1e-3)
        np.testing.assert_allclose(step.diagnostics["q"], q)


def test_joints_beyond_the_limits_are_kept_within_them(recording: Recording) -> None:
    step = follow(lambda _: ROBOT.upper_limits + 1.0, recording)
    assert (step.command.q <= ROBOT.upper_limits + 1e-9).all()


def test_the_palm_follows_as_by_the_methods_of_the_package(
    recording: Recording,
) -> None:
    own = follow(Pointing(), recording, "joints")
    theirs = follow("finger-vectors", recording, "joints")
    np.testing.assert_allclose(own.wrist_target, theirs.wrist_target, atol=1e-12)
    # Points at rest on a palm that moves stay at rest.
    np.testing.assert_allclose(own.command.q, ROBOT.rest, atol=1e-2)


def test_a_function_gets_the_landmarks(recording: Recording) -> None:
    seen = []

    def note(landmarks: np.ndarray) -> np.ndarray:
        seen.append(landmarks.copy())
        landmarks[:] = np.nan
        return ROBOT.rest

    follow(note, recording)
    np.testing.assert_allclose(seen, recording.landmarks)


def test_state_of_a_method_is_that_of_its_mapper(recording: Recording) -> None:
    method = Closing()
    before = copy.deepcopy(vars(method))
    follow(method, recording)
    assert vars(method) == before


class Empty(CustomMethod):
    """Has no targets."""


class BindsNothing:
    """Has no stages."""

    def bind(self, human: Any, robot: Any) -> None:
        return None


class StartsNothing(Pointing):
    """Starts no map."""

    def start(self, sample: Any, robot: Any) -> Any:
        return object()


class Returns(CustomMethod):
    """Returns what it is given as targets."""

    def __init__(self, made: Any) -> None:
        self.made = made

    def targets(self, sample: HumanPose) -> Any:
        return self.made


def joints(answer: Any) -> JointFunction:
    return JointFunction(lambda _: answer)


@pytest.mark.parametrize(
    ("method", "said"),
    [
        (Closing, r"Closing is a class: give an object: Closing\(\)"),
        (Empty, "Empty is a class without targets"),
        (BindsNothing(), "lacks robot, contacts, needs_wrist, .*start_palm, start"),
        (StartsNothing(), "start.* returned object, which lacks rest, targets"),
        (Returns(None), "returned NoneType, expected Targets"),
        (Returns(np.zeros((4, 3))), "returned ndarray, expected Targets"),
        (Returns(Targets(np.zeros((2, 3)), np.eye(4))), r"expected \(4, 3\)"),
        (Returns(Targets(np.zeros((4, 3)), np.eye(3))), r"expected \(4, 4\)"),
        (3, "a function from landmarks to joint angles"),
    ],
)
def test_what_is_missing_is_said(method: Any, said: str, recording: Recording) -> None:
    with pytest.raises(InvalidOptionsError, match=said) as caught:
        follow(method, recording)
    assert caught.value.option == "method"


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (np.zeros(4), r"shape \(4,\)"),
        (None, "got None"),
        ("text", "got 'text'"),
        ({"joint_0": 1.0}, "unknown joint_0: did you mean joint_0.0"),
        ({name: 0.0 for name in ROBOT.joint_names[1:]}, "got none for joint_0.0"),
    ],
)
def test_joints_that_are_not_the_robots_are_rejected(
    answer: Any, said: str, recording: Recording
) -> None:
    with pytest.raises(InvalidInputError, match=said):
        follow(joints(answer), recording)


def test_a_function_needs_all_landmarks() -> None:
    with pytest.raises(InvalidOptionsError, match="points='landmarks'"):
        HandMapper(load_hand("human"), ROBOT, lambda _: ROBOT.rest)


def test_targets_that_are_not_finite_hold_the_robot(recording: Recording) -> None:
    step = follow(joints(np.full(16, np.nan)), recording)
    assert step.status == "failed"
    np.testing.assert_allclose(step.command.q, ROBOT.rest)


@pytest.mark.parametrize("name", ["object", "teleoperation"])
def test_a_preset_may_be_given_as_such(name: str) -> None:
    human = load_hand("human")
    preset = PRESETS[name]
    for mapper in (
        HandMapper(human, ROBOT, preset=name),
        HandMapper(human, ROBOT, preset=preset),
    ):
        assert mapper.method == preset.method
        assert mapper.ik == preset.ik
