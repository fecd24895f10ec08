"""Contacts with a held object: what is measured, and that aware mappings have more of them."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np
import pytest
from holding import hold
from marks import rotated

from handmap_qp import Recording, load_hand
from handmap_qp.apps.offline.comparison import (
    Run,
    Take,
    compare_methods,
    own_method,
    prepare_take,
)
from handmap_qp.apps.offline.contacts import contact_metrics
from handmap_qp.apps.offline.hand_trace import HandTrace, trace_robot
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands import Values
from handmap_qp.se3 import affine, inverse_pose, rotation_from_rpy, transform_points

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

ALLEGRO = load_hand("allegro_right")
HELD = ("contact_precision", "contact_recall", "object_depth_mm", "contact_slip_mm")


@lru_cache
def take() -> Take:
    return prepare_take(hold("cube", "move +1x").recording)


@lru_cache
def runs() -> dict[str, Run]:
    methods = [own_method(name) for name in ("teleoperation", "object")]
    return {run.method: run for run in compare_methods([take()], ALLEGRO, methods).runs}


def moved(trace: HandTrace, pose: np.ndarray) -> HandTrace:
    points = transform_points(pose, trace.points.reshape(-1, 3))
    return trace._replace(
        points=points.reshape(trace.points.shape), palm=pose @ trace.palm
    )


def measure(robot: HandTrace, recording: Recording, human: HandTrace) -> Values:
    motion = runs()["teleoperation"].motion
    assert motion is not None
    shape = take().shape
    assert shape is not None
    wrist = robot.palm @ inverse_pose(ALLEGRO.wrist_to_palm)
    motion = dataclasses.replace(motion, wrist=wrist)
    return contact_metrics(human, robot, recording, shape, motion)


def robot_trace() -> HandTrace:
    motion = runs()["teleoperation"].motion
    assert motion is not None
    return trace_robot(ALLEGRO, motion.q, motion.wrist)


def test_fingertips_that_move_as_the_persons_do_not_slip_and_carry_the_object() -> None:
    whole = take().trace
    trace = whole.part(np.arange(len(whole.palm)), ("thumb", "index", "middle", "ring"))
    found = measure(trace, take().recording, trace)
    assert found["contact_slip_mm"] == pytest.approx(0.0, abs=1e-9)
    # The person's fingertips stay at their places of the surface, but for noise and the last 2 mm
    # of closing.
    assert found["object_carried"] == pytest.approx(1.0, abs=0.2)
    still = trace._replace(
        points=np.broadcast_to(trace.local[60:61], trace.points.shape)
    )
    still = still._replace(palm=np.broadcast_to(np.eye(4), trace.palm.shape))
    found = measure(still, take().recording, trace)
    assert found["object_carried"] == pytest.approx(0.0, abs=1e-9)
    assert found["contact_slip_mm"] > 2.0


def test_numbers_do_not_depend_on_the_world() -> None:
    recording, human, robot = take().recording, take().trace, robot_trace()
    pose = affine(rotation_from_rpy((0.3, -0.7, 1.1)), (0.4, -0.2, 0.9))
    elsewhere = dataclasses.replace(
        recording,
        landmarks=transform_points(pose, recording.landmarks.reshape(-1, 3)).reshape(
            recording.landmarks.shape
        ),
        object_pose=pose @ np.asarray(recording.object_pose),
    )
    one = measure(robot, recording, human)
    other = measure(moved(robot, pose), elsewhere, moved(human, pose))
    assert one.keys() == other.keys()
    for key, value in one.items():
        assert other[key] == pytest.approx(value, abs=1e-3)


def test_a_mapping_that_knows_the_object_touches_it_where_the_person_does() -> None:
    aware, plain = runs()["teleoperation"].values, runs()["object"].values
    assert aware["contact_recall"] > 0.7 > plain["contact_recall"]
    assert aware["contact_precision"] > 0.8
    assert aware["object_depth_mm"] < 2.0


@pytest.mark.parametrize("ending", rotated(["+look-ahead", "+smooth"], 2))
def test_smoother_mappings_touch_the_object_too(ending: str) -> None:
    method = own_method(f"teleoperation{ending}")
    (run,) = compare_methods([take()], ALLEGRO, [method]).runs
    plain = runs()["teleoperation"].values
    for key in HELD:
        assert run.values[key] == pytest.approx(plain[key], rel=0.2, abs=0.5)
    assert run.values["contact_recall"] > 0.7


def test_an_object_that_is_far_or_not_seen_asks_no_question() -> None:
    recording = take().recording
    poses = np.array(recording.object_pose)
    far = poses.copy()
    far[:, 0, 3] += 5.0
    for wrong in (far, poses * np.nan):
        lost = dataclasses.replace(recording, object_pose=wrong)
        assert measure(robot_trace(), lost, take().trace) == {}
    alone = dataclasses.replace(recording, object_pose=None, object_shape="")
    (run,) = compare_methods(
        [prepare_take(alone)], ALLEGRO, [own_method("teleoperation")]
    ).runs
    assert all(np.isnan(run.values[key]) for key in HELD)


def test_an_object_that_cannot_be_read_is_refused_before_any_mapping() -> None:
    wrong = dataclasses.replace(take().recording, object_shape="mug.stl")
    with pytest.raises(InvalidInputError, match=r"mug\.stl"):
        prepare_take(wrong)
