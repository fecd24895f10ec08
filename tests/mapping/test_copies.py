"""Copies of a mapper and of what it is made of: they do the same, and are independent."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from marks import crossed
from oracles.shape_distances import MeasuredPairs

from handmap_core.human.recording import sample_columns
from handmap_core.stream.rejoin import RejoinKind
from handmap_qp import (
    METHODS,
    PRESETS,
    AttachedPoints,
    Hand,
    HandMapper,
    HumanLengths,
    HumanSample,
    PointDistances,
    Smoothing,
    load_hand,
    read_recording,
)
from handmap_qp.stream.follower import Follower

SAMPLES = tuple(sample_columns(read_recording("demo", "right")))[60:115]
FIRST, REST = SAMPLES[:30], SAMPLES[30:]
HUMAN = load_hand("human", points="landmarks")
ROBOT = load_hand("three_finger")
ALLEGRO = load_hand("allegro_right")
WAYS: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
}
each_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
# GJK starts from its last result, which a copy does not have: distances differ by rounding.
TOLERANCE = 1e-11


def follow(mapper: Follower, samples: Sequence[HumanSample]) -> np.ndarray:
    """Map samples and return joints and wrist of each command, one row a sample."""
    steps = [mapper.map_sample(sample) for sample in samples]
    return np.array([[*step.command.q, *step.command.wrist.ravel()] for step in steps])


def check_copy(mapper: Follower, way: Callable[[Any], Any]) -> None:
    """Check that a copy maps the rest as the mapper does, whichever of both goes first."""
    copied, other = way(mapper), way(mapper)
    ahead = follow(copied, REST)
    expected = follow(mapper, REST)
    np.testing.assert_allclose(ahead, expected, rtol=0.0, atol=TOLERANCE)
    np.testing.assert_allclose(follow(other, REST), expected, rtol=0.0, atol=TOLERANCE)
    # A robot that does not move would pass the rest of this test.
    assert (
        np.ptp(expected, axis=0).max() > 0.05 or mapper.mapper.moving_robot.is_released
    )


# All ways read and write the same state, so that one of them shows what is part of it.
@pytest.mark.parametrize(
    ("name", "kind"),
    crossed([*PRESETS], ["plain", "smoothed", "accelerating"], every=3),
)
def test_every_preset_goes_on_the_same(name: str, kind: str) -> None:
    ik = PRESETS[name].ik
    ik = ik.replaced(max_acceleration=20.0) if kind == "accelerating" else ik
    mapper = Follower(
        # With pairs of links near each other, which are part of the state.
        HandMapper(HUMAN, ALLEGRO, name, ik=ik),
        smoothing=Smoothing() if kind == "smoothed" else None,
    )
    follow(mapper, FIRST)
    check_copy(mapper, WAYS["pickle"])


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_goes_on_the_same(method: str) -> None:
    mapper = Follower(HandMapper(HUMAN, ALLEGRO, METHODS[method]()))
    follow(mapper, FIRST)
    check_copy(mapper, WAYS["pickle"])


@each_way
@pytest.mark.parametrize("reference", ["previous", "rest"])
def test_references_go_along(reference: Any, way: Callable[[Any], Any]) -> None:
    mapper = Follower(HandMapper(HUMAN, ROBOT, reference=reference))
    follow(mapper, FIRST)
    check_copy(mapper, way)


def hold(mapper: Follower) -> None:
    """Let the guard hold the robot."""
    for sample in FIRST[-5:]:
        mapper.map_sample(replace(sample, valid=False))


def glide(mapper: Follower) -> None:
    """Leave the robot on its way back to the human, after a hold of half a second."""
    hold(mapper)
    shifted = replace(REST[20], time=FIRST[-1].time + 0.6)
    for k in range(12):
        step = mapper.map_sample(replace(shifted, time=shifted.time + k / 60.0))
    assert step.is_gliding


def use_joints(mapper: Follower) -> None:
    """Have a workspace of the human hand too."""
    mapper.mapper.map_step(mapper.mapper.human.rest, np.eye(4))


STATES: dict[str, Callable[[Follower], None]] = {
    "held": hold,
    "gliding": glide,
    "released": lambda mapper: mapper.mapper.release(),
    "clutched": lambda mapper: mapper.mapper.clutch(),
    "reset": lambda mapper: mapper.mapper.reset(robot_q=ROBOT.rest + 0.05),
    "configured": lambda mapper: mapper.mapper.configure("object"),
    "by joints": use_joints,
}


@pytest.mark.parametrize("state", STATES)
def test_every_state_goes_along(state: str) -> None:
    rejoin: RejoinKind = "clutch" if state == "clutched" else "glide"
    mapper = Follower(HandMapper(HUMAN, ROBOT), rejoin=rejoin)
    follow(mapper, FIRST)
    STATES[state](mapper)
    check_copy(mapper, WAYS["pickle"])


@each_way
def test_a_mapper_that_has_not_begun_is_copied(
    way: Callable[[Any], Any],
) -> None:
    points = AttachedPoints(ROBOT, [(1, np.zeros(3)), (2, np.full(3, 0.01))])
    task = PointDistances(points, [(0, 1)], 0.02)
    mapper = HandMapper(
        HUMAN,
        ROBOT,
        "object",
        tasks=[task],
        dt=0.02,
        quat_order="xyzw",
        joint_tolerance=0.1,
    )
    copied = way(mapper)
    assert (copied.dt, copied.quat_order, copied.joint_tolerance) == (0.02, "xyzw", 0.1)
    assert (copied.method, copied.ik) == (mapper.method, mapper.ik)
    check_copy(Follower(mapper), way)


@each_way
def test_joint_angles_and_points_are_mapped_the_same(way: Callable[[Any], Any]) -> None:
    human = load_hand("human", points="fingertips")
    mapper = HandMapper(human, ROBOT)
    q, wrist = human.rest.copy(), np.eye(4)
    mapper.map_step(q, wrist)
    copied = way(mapper)
    for k in range(10):
        q[1::4] = human.rest[1::4] + 0.05 * k
        expected, found = mapper.map_step(q, wrist), copied.map_step(q, wrist)
        np.testing.assert_allclose(found.command.q, expected.command.q, atol=TOLERANCE)
        np.testing.assert_allclose(
            found.human_points, human.points(q, wrist), atol=1e-12
        )
        found = copied.map_points(expected.human_points, wrist)
        expected = mapper.map_points(expected.human_points, wrist)
        np.testing.assert_allclose(found.command.q, expected.command.q, atol=TOLERANCE)


def _mapped_elsewhere(mapper: Follower) -> np.ndarray:
    return follow(mapper, REST)


@pytest.mark.slow
def test_a_spawned_process_goes_on_the_same() -> None:
    mapper = Follower(HandMapper(HUMAN, ALLEGRO, "teleoperation"))
    follow(mapper, FIRST)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found = pool.apply(_mapped_elsewhere, (mapper,))
    np.testing.assert_allclose(found, follow(mapper, REST), rtol=0.0, atol=TOLERANCE)


@each_way
def test_a_workspace_is_copied_where_it_is(way: Callable[[Any], Any]) -> None:
    workspace = ROBOT.configuration()
    q = ROBOT.configuration_vector(ROBOT.rest + 0.1)
    workspace.place(q)
    copied, expected = way(workspace), workspace.point_jacobian()
    workspace.place(ROBOT.configuration_vector(ROBOT.rest))
    np.testing.assert_array_equal(copied.q, q)
    np.testing.assert_array_equal(copied.points, ROBOT.points(ROBOT.rest + 0.1))
    np.testing.assert_array_equal(copied.point_jacobian(), expected)
    copied.place(q)
    np.testing.assert_array_equal(workspace.points, ROBOT.points(ROBOT.rest))


@pytest.mark.parametrize(
    "way", [copy.deepcopy, WAYS["pickle"]], ids=["deepcopy", "pickle"]
)
def test_a_solver_goes_on_from_a_posture_of_its_own(way: Callable[[Any], Any]) -> None:
    mapper = Follower(HandMapper(HUMAN, ALLEGRO, "teleoperation"))
    follow(mapper, FIRST)
    solver = mapper.mapper.point_ik
    copied, q = way(solver), solver.configuration.q.copy()
    targets = solver.configuration.points + 0.02
    found = copied.solve(targets, None, 0.02)
    np.testing.assert_array_equal(solver.configuration.q, q)
    expected = solver.solve(targets, None, 0.02)
    assert found.status == expected.status
    np.testing.assert_allclose(
        found.displacement, expected.displacement, atol=TOLERANCE
    )
    apart, expected_apart = (
        MeasuredPairs.of(each).within(each.configuration.q).found[:, 0]
        for each in (copied, solver)
    )
    np.testing.assert_allclose(apart, expected_apart, atol=TOLERANCE)


@cache
def named_hand(name: str) -> Hand:
    if name == "person":
        return load_hand("human", lengths=HumanLengths.from_hand_length(0.17))
    return load_hand(name)


@pytest.mark.parametrize(
    "name",
    [
        "person",
        "three_finger",
        "hey5",
        "ur5_allegro",
        "g1_left",
        "tiago_arm",
        "human_left",
    ],
)
@each_way
def test_a_hand_is_the_same_hand(name: str, way: Callable[[Any], Any]) -> None:
    hand = named_hand(name)
    hand.points(hand.rest)
    copied = way(hand)
    assert copied.spec == hand.spec
    assert copied.model == hand.model
    assert copied.urdf_text == hand.urdf_text
    assert copied.reference_points == hand.reference_points
    q = hand.rest + 0.02
    np.testing.assert_array_equal(copied.points(q), hand.points(q))
    np.testing.assert_array_equal(copied.point_jacobian(q), hand.point_jacobian(q))
    np.testing.assert_array_equal(copied.all_joints(q), hand.all_joints(q))
    other = copied.with_points("fingertips_middle").points(q)
    np.testing.assert_array_equal(
        other, hand.with_points("fingertips_middle").points(q)
    )
    for array in (
        copied.rest,
        copied.lower_limits,
        copied.joint_columns,
        copied.wrist_to_palm,
    ):
        assert not array.flags.writeable
    assert not copied.spread.flags.writeable
    assert copied._scratch is not hand._scratch


def test_a_step_is_pickled() -> None:
    step = Follower(HandMapper(HUMAN, ROBOT)).map_sample(FIRST[0])
    found = pickle.loads(pickle.dumps(step))
    assert found.status == step.status
    np.testing.assert_array_equal(found.command.q, step.command.q)
