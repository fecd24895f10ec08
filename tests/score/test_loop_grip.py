"""Mappings with a grip in closed loop: joints and places reach the mapper, and the hand presses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from handmap_score.tasks.attempt import attempt
from handmap_score.tasks.gripping import Gripping
from handmap_score.tasks.mapping import (
    Mapped,
    Mapping,
    SensingMapping,
    check_mapping,
    make_mapping,
)
from handmap_score.tasks.operator import HumanHand, Joints
from handmap_score.tasks.person import Person
from handmap_score.tasks.picking import PickTask
from handmap_score.tasks.task import Scene, Signals
from marks import rotated

from handmap_qp import load_hand, read_recording
from handmap_qp.apps.simulation.commands import GripName
from handmap_qp.errors import InvalidInputError
from handmap_qp.human import scaled_human
from handmap_qp.se3 import Array, affine, rotation_from_rpy, transform_points

DT = 1.0 / 60.0
UNTOUCHED = Signals(False, frozenset(), False, 0.0, 0.0)
RECORDING = read_recording(Path("pinch"), "right")
ROBOT = load_hand("allegro_right")


def gripping(name: str) -> Gripping:
    grip = GripName.parse(name)
    assert grip
    return Gripping(scaled_human(RECORDING), ROBOT, grip)


def scene_of(joints: Joints, wrist: Array, place: Array) -> Scene:
    faces = place + np.array([[-0.01, 0.0, 0.0], [0.01, 0.0, 0.0]])
    points = {"faces": faces}
    return Scene(0.0, np.zeros(0), {"wrist": wrist}, points, UNTOUCHED, joints)


def told_centre(mapping: Gripping, wrist: Array, place: Array) -> Array:
    """Return where the mapper is told that the object is, at its second sample."""
    hand = HumanHand(RECORDING.landmarks[0], wrist)
    scene = scene_of(
        dict(zip(ROBOT.joint_names, ROBOT.rest, strict=True)), wrist, place
    )
    mapping.reset()
    for _ in range(2):
        mapping.sense(scene)
        mapping.map(hand, DT)
    assert mapping.object_centre is not None
    return mapping.object_centre


@pytest.mark.parametrize(
    ("name", "preset", "deviation"),
    [
        ("teleoperation+grip", "teleoperation", None),
        ("teleoperation+grip+place", "teleoperation", 0.0),
        ("picking+grip+place5", "picking", 0.005),
        ("a+b+grip+place10", "a+b", 0.01),
    ],
)
def test_names_say_what_is_known(
    name: str, preset: str, deviation: float | None
) -> None:
    grip = GripName.parse(name)
    assert grip == GripName(preset, deviation)
    assert grip.sees == (deviation is not None)


@pytest.mark.parametrize("name", ["teleoperation", "+grip", "teleoperation+grip+"])
def test_other_names_say_nothing_of_a_grip(name: str) -> None:
    assert GripName.parse(name) is None


def test_a_mapping_with_a_grip_is_made_by_its_name() -> None:
    check_mapping("picking+grip+place5")
    person = Person(ROBOT)
    mapping = make_mapping("picking+grip+place5", person, ROBOT, 0)
    assert isinstance(mapping, SensingMapping)
    assert not isinstance(make_mapping("picking", person, ROBOT, 0), SensingMapping)


def test_two_hands_have_no_grip() -> None:
    other = load_hand("allegro_left")
    with pytest.raises(InvalidInputError, match="without a grip for two hands"):
        make_mapping("teleoperation+grip", Person(ROBOT), ROBOT, 0, other)


def test_a_task_without_measured_joints_is_rejected() -> None:
    scene = scene_of({}, np.eye(4), np.zeros(3))
    with pytest.raises(InvalidInputError, match="measures the robot's joints"):
        gripping("teleoperation+grip").sense(scene)


def test_a_robot_that_meets_nothing_follows_as_without_a_grip() -> None:
    """Joints that are where they were commanded are behind nothing."""
    plain: Mapping = Mapped(scaled_human(RECORDING), ROBOT, "teleoperation")
    mapping = gripping("teleoperation+grip")
    q: Joints = dict(zip(ROBOT.joint_names, ROBOT.rest, strict=True))
    for landmarks in RECORDING.landmarks[::2]:
        hand = HumanHand(landmarks, np.eye(4))
        mapping.sense(scene_of(q, np.eye(4), np.zeros(3)))
        q = mapping.map(hand, DT)
        expected = plain.map(hand, DT)
        assert [*q.values()] == pytest.approx([*expected.values()], abs=1e-9)
        assert mapping.effort is None


def test_the_error_of_a_place_is_that_of_the_seed() -> None:
    mapping = gripping("teleoperation+grip+place5")
    errors = []
    for seed in range(400):
        mapping.draw_errors(seed)
        errors.append(mapping.place_error)
    mapping.reset()
    mapping.draw_errors(0)
    assert np.array_equal(mapping.place_error, errors[0])
    assert np.std(errors, axis=0) == pytest.approx([0.005] * 3, rel=0.1)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.001
    exact = gripping("teleoperation+grip+place")
    exact.draw_errors(0)
    assert not exact.place_error.any()


def test_the_place_is_told_from_the_wrist_where_it_really_is() -> None:
    """A hand and an object that move together are told the same; else the error and the way."""
    wrist = affine(rotation_from_rpy((0.3, 0.2, 0.1)), np.array([0.1, 0.2, 0.3]))
    place = np.array([0.15, 0.3, 0.25])
    exact = gripping("teleoperation+grip+place")
    told = told_centre(exact, wrist, place)
    moved = affine(rotation_from_rpy((0.0, 0.5, -0.4)), np.array([0.0, -0.2, 0.1]))
    again = told_centre(exact, moved @ wrist, transform_points(moved, place))
    assert again == pytest.approx(told, abs=1e-9)
    way = np.array([0.02, -0.01, 0.03])
    beside = told_centre(exact, wrist, place + way)
    assert np.linalg.norm(beside - told) == pytest.approx(np.linalg.norm(way))
    wrong = gripping("teleoperation+grip+place5")
    wrong.draw_errors(7)
    off = told_centre(wrong, wrist, place) - told
    assert np.linalg.norm(off) == pytest.approx(np.linalg.norm(wrong.place_error))


class Noted:
    """A mapping whose efforts are noted beside what is measured."""

    def __init__(self, mapping: Gripping) -> None:
        self._mapping = mapping
        self.efforts: list[float] = []
        self.measured: list[Joints] = []

    def reset(self) -> None:
        self._mapping.reset()

    def draw_errors(self, seed: int) -> None:
        self._mapping.draw_errors(seed)

    def sense(self, scene: Scene) -> None:
        self.measured.append(scene.joints)
        self._mapping.sense(scene)

    def map(self, hand: HumanHand, dt: float) -> Joints:
        command = self._mapping.map(hand, dt)
        effort = self._mapping.effort
        self.efforts.append(0.0 if effort is None else float(np.abs(effort).max()))
        return command


@pytest.mark.slow
@pytest.mark.parametrize("ending", rotated(["+place5", ""], 2))
def test_pads_that_press_have_an_effort(ending: str) -> None:
    """An attempt with a grip picks the die of the plain one, and presses while it carries it."""
    task = PickTask(ROBOT)
    person = Person(ROBOT)
    mapping = make_mapping(f"teleoperation+grip{ending}", person, ROBOT, 0)
    assert isinstance(mapping, Gripping)
    noted = Noted(mapping)
    outcome = attempt(task, person, noted, 2)
    assert outcome.is_success
    assert all({*joints} == {*ROBOT.joint_names} for joints in noted.measured)
    lifted = [one.is_lifted for one in task.course[: len(noted.efforts)]]
    efforts = np.array(noted.efforts)
    assert (efforts[lifted] > 0.0).all()
    # Pads that practise in the air meet nothing.
    first = next(i for i, one in enumerate(task.course) if one.is_touched)
    assert not efforts[:first].any()
