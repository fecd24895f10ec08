"""The human's side alone makes targets, and the robot's side alone owns where the robot is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from handmap_core.ik.motion import Motion
from handmap_core.ik.tasks import TaskRows
from handmap_core.mapping.reference import Placement
from handmap_core.mapping.robot_step import RequestStep
from handmap_qp import HandMapper, load_hand
from handmap_qp.errors import DegeneratePointsError, InvalidInputError
from handmap_qp.hands import Configuration
from handmap_qp.hands.robot import load_robot
from handmap_qp.mapping.method import HumanPose
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.mapping.target_source import TargetSource

HUMAN = load_hand("human", points="landmarks")
FLOATING = load_hand("allegro_right", mount="floating")
LANDMARKS = HUMAN.points(HUMAN.rest)
POSE = HumanPose(LANDMARKS, np.eye(4))
DT = 1.0 / 60.0


class Standing(NamedTuple):
    """A robot that stands at a configuration: all that a source has to know of it."""

    q: np.ndarray
    placement: Placement = Placement.KNOWN


def source_of(preset: str = "teleoperation") -> TargetSource:
    return TargetSource(HUMAN, FLOATING, preset, options={})


def standing(placement: Placement = Placement.KNOWN) -> Standing:
    return Standing(FLOATING.configuration_vector(FLOATING.rest, np.eye(4)), placement)


@pytest.mark.parametrize("preset", ["teleoperation", "paper", "fingertip-vectors"])
def test_a_source_makes_the_targets_of_a_mapper(preset: str) -> None:
    source = source_of(preset)
    source.take(source.prepare(POSE, standing(Placement.UNKNOWN)))
    mapper = HandMapper(HUMAN, FLOATING, preset)
    mapper.map(POSE)
    moved = HumanPose(LANDMARKS + np.array([0.02, 0.0, 0.01]), POSE.wrist)
    request = source.request(moved, source.prepare(moved, standing()), DT, 1.0)
    step = mapper.map(moved)
    np.testing.assert_allclose(request.targets.wrist, step.wrist_target, atol=1e-9)
    assert request.map is source.target_map


def test_what_prepares_a_sample_changes_nothing() -> None:
    source = source_of()
    before = dict(vars(source))
    reference = source.prepare(POSE, standing())
    source.request(POSE, reference, DT, 1.0)
    source.binding("paper")
    assert vars(source) == before
    source.take(reference)
    assert source.reference is not POSE
    np.testing.assert_array_equal(reference.sample.points, POSE.points)
    assert source.prepare(POSE, standing()) is reference


def test_a_sample_that_cannot_be_the_reference_changes_nothing() -> None:
    source = source_of("paper")
    flat = HumanPose(np.zeros_like(LANDMARKS), np.eye(4))
    with pytest.raises(DegeneratePointsError):
        source.prepare(flat, standing())
    # The robot is put on the palm, which needs a wrist.
    with pytest.raises(InvalidInputError, match="placing the robot"):
        source.prepare(HumanPose(LANDMARKS, None), standing(Placement.UNKNOWN))
    assert source.counted_from is None


def test_a_robot_is_put_on_the_palm_unless_it_has_a_place() -> None:
    source = source_of()
    known = source.prepare(POSE, standing())
    np.testing.assert_allclose(known.posture.wrist, np.eye(4), atol=1e-12)
    on_palm = source.prepare(POSE, standing(Placement.UNKNOWN))
    palm = on_palm.posture.wrist @ FLOATING.wrist_to_palm
    np.testing.assert_allclose(palm, source.bound.start_palm(POSE), atol=1e-9)


# -- one owner of the robot's state


def test_a_floating_robot_has_no_place_before_the_first_sample() -> None:
    mapper = HandMapper(HUMAN, FLOATING)
    assert mapper.placement is Placement.UNKNOWN
    assert np.isfinite(mapper.motion.dt)
    # A stop in between does not say where the robot is.
    mapper.hold(DT)
    assert mapper.placement is Placement.UNKNOWN
    mapper.configure("paper")
    assert mapper.placement is Placement.UNKNOWN
    step = mapper.map(POSE)
    assert mapper.placement is Placement.KNOWN
    palm = step.command.wrist @ FLOATING.wrist_to_palm
    np.testing.assert_allclose(palm, mapper.bound.start_palm(POSE), atol=1e-3)


def test_what_moves_the_robot_says_where_it_is() -> None:
    mapper = HandMapper(HUMAN, FLOATING)
    wrist = np.eye(4)
    wrist[:3, 3] = 0.3, 0.2, 0.1
    q = FLOATING.configuration_vector(FLOATING.rest, wrist)
    mapper.motion = Motion.at_rest(q, len(FLOATING.active_columns))
    assert mapper.placement is Placement.KNOWN
    step = mapper.map(POSE)
    np.testing.assert_allclose(step.command.wrist[:3, 3], wrist[:3, 3], atol=1e-3)


def test_a_place_that_is_given_is_known() -> None:
    mapper = HandMapper(HUMAN, FLOATING)
    mapper.reset(robot_wrist=np.eye(4))
    assert mapper.placement is Placement.KNOWN
    mapper.reset()
    assert mapper.placement is Placement.UNKNOWN
    assert HandMapper(HUMAN, load_hand("ur5_allegro")).placement is Placement.KNOWN


class Failing:
    """A task that cannot be linearised."""

    def linearise(self, hand: Configuration) -> TaskRows:
        raise ZeroDivisionError(hand)


def test_a_sample_that_moves_nothing_is_no_reference() -> None:
    mapper = HandMapper(HUMAN, load_hand("ur5_allegro"), tasks=[Failing()])
    stamp = mapper.point_ik.gate.stamp
    with pytest.raises(ZeroDivisionError):
        mapper.map(POSE)
    assert mapper.reference is None
    assert mapper.point_ik.gate.stamp == stamp
    mapper.configure(tasks=())
    mapper.map(POSE)
    assert mapper.reference is not None


# -- two sources and one robot


def samples() -> dict:
    """Return landmarks of both hands."""
    return {"right": LANDMARKS, "left": LANDMARKS * (-1.0, 1.0, 1.0)}


def test_an_error_of_any_kind_leaves_all_hands_as_they_were() -> None:
    mapper = RobotMapper(load_robot("g1"))
    mapper.map_landmarks(samples(), dt=DT)
    before = {side: hand.snapshot() for side, hand in mapper.hands.items()}
    stamp = mapper.point_ik.gate.stamp

    def request_of(side: str) -> RequestStep:
        if side == "right":
            hand = mapper.hands["right"]
            return hand.read(hand.source.landmarks, samples()["right"], None, DT)
        raise ZeroDivisionError

    mapper.clutch()
    engaged = {side: hand.snapshot() for side, hand in mapper.hands.items()}
    with pytest.raises(ZeroDivisionError):
        mapper.step(["right", "left"], request_of)
    for side, hand in mapper.hands.items():
        assert hand.snapshot() == engaged[side]
        assert hand.snapshot() != before[side]
    assert mapper.point_ik.gate.stamp == stamp


def test_a_hand_that_asks_to_stay_changes_nothing_by_itself() -> None:
    mapper = RobotMapper(load_robot("g1"))
    mapper.map_landmarks(samples(), dt=DT)
    hand = mapper.hands["left"]
    before = hand.snapshot()
    held = hand.hold(DT)
    assert held.request.map is None
    assert hand.snapshot() == before
    assert not hand.is_staying
    # It moves nothing either.
    np.testing.assert_allclose(
        held.request.targets.wrist,
        hand.source.robot.frame_pose("wrist", held.request.rest),
    )
