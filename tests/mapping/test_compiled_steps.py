"""Samples that the core maps in one call: the steps, and the errors, are those of Python."""

from __future__ import annotations

import pickle
from copy import deepcopy
from typing import Any

import numpy as np
import pytest

from handmap_core.mapping.step import Stages, StepSummary
from handmap_qp import (
    HandmapError,
    HandMapper,
    Homogeneous,
    HumanSample,
    IkOptions,
    InvalidInputError,
    MapStep,
    PublishedMethod,
    Teleoperation,
    load_hand,
    read_recording,
)
from handmap_qp.mapping.presets import get_preset

HUMAN = load_hand("human", points="landmarks")
ROBOT = load_hand("three_finger")
LANDMARKS = read_recording("demo", "right").landmarks


def pair(preset: str = "teleoperation") -> tuple[HandMapper, HandMapper]:
    """Return a mapper in the core and one in Python, both after their first sample."""
    method, ik, *_ = get_preset(preset)
    fast = HandMapper(HUMAN, ROBOT, method, ik=ik)
    assert isinstance(method, Homogeneous | Teleoperation)
    published = PublishedMethod(method)
    slow = HandMapper(HUMAN, ROBOT, published, ik=ik.replaced(formulation="direct"))
    for mapper in (fast, slow):
        mapper.map_landmarks(LANDMARKS[0])
    assert fast.core is not None
    assert slow.core is None
    return fast, slow


def assert_same_summary(one: StepSummary, other: StepSummary) -> None:
    assert one.flags == other.flags
    assert list(one.at_bound) == list(other.at_bound)
    for name in ("point_error", "wrist_error", "residual"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-9)


def assert_same(one: MapStep, other: MapStep) -> None:
    assert (one.status, one.out_of_range) == (other.status, other.out_of_range)
    assert one.asked.flags == other.asked.flags
    assert_same_summary(one.stages.summary, other.stages.summary)
    np.testing.assert_array_equal(one.at_bound, other.at_bound)
    for name in ("point_error", "points", "targets", "human_points", "human_wrist"):
        np.testing.assert_allclose(
            getattr(one, name), getattr(other, name), rtol=0.0, atol=1e-9
        )
    np.testing.assert_allclose(one.command.q, other.command.q, atol=1e-9)
    np.testing.assert_allclose(one.command.wrist, other.command.wrist, atol=1e-9)
    assert one.residual == pytest.approx(other.residual, abs=1e-12)


@pytest.mark.parametrize("preset", ["teleoperation", "object", "paper"])
def test_steps_are_those_of_python(preset: str) -> None:
    fast, slow = pair(preset)
    flags = set()
    for k, landmarks in enumerate(LANDMARKS[1:150]):
        # Some hands stretch beyond what the paper's method takes.
        given = landmarks * (4.0 if k % 20 == 7 else 1.0)
        one, other = (mapper.map_landmarks(given) for mapper in (fast, slow))
        assert fast.core is not None
        assert_same(one, other)
        flags.update(one.asked.flags)
        fast.motion = slow.motion
    assert flags == ({"stretch_clamped"} if preset != "teleoperation" else set())


@pytest.mark.parametrize(
    "kind",
    [
        np.float32,
        np.ndarray.tolist,
        np.asfortranarray,
        lambda a: np.repeat(a, 2, 1)[:, ::2],
    ],
    ids=["float32", "list", "fortran", "strided"],
)
def test_numbers_in_any_form_give_one_step(kind: Any) -> None:
    fast, slow = pair()
    landmarks = LANDMARKS[1].astype(np.float32).astype(float)
    assert_same(
        fast.map_landmarks(kind(landmarks), dt=1), slow.map_landmarks(landmarks, dt=1)
    )
    q = HUMAN.rest.astype(np.float32).astype(float)
    for mapper in (fast, slow):
        mapper.reset()
        mapper.map_step(q, np.eye(4))
    assert_same(
        fast.map_step(q, np.eye(4).tolist(), dt=np.float64(0.02)),
        slow.map_step(q, np.eye(4), dt=0.02),
    )


def test_hostile_samples_have_one_answer() -> None:
    fast, slow = pair()
    rng = np.random.default_rng(3)
    ends = [np.nan, np.inf, -np.inf, 1e308, 2e9, 1e3, -10.0, 1e-300, 0.0]
    refused = 0
    for _ in range(150):
        landmarks = LANDMARKS[rng.integers(200)] * 10.0 ** rng.uniform(-2, 2)
        landmarks[rng.integers(21), rng.integers(3)] = rng.choice(ends)
        wrist = None
        if rng.random() < 0.3:
            wrist = np.eye(4)
            wrist[rng.integers(4), rng.integers(4)] += 10.0 ** rng.uniform(-16, 0)
        dt = float(rng.choice([1e-9, 0.01, 1e6, 0.0, -1.0, np.nan]))
        found: list[Any] = []
        for mapper in (fast, slow):
            try:
                found.append(mapper.map_landmarks(landmarks, wrist, dt=dt))
            except HandmapError as error:
                found.append(str(error))
        if isinstance(found[0], str):
            assert found[0] == found[1]
            refused += 1
        else:
            np.testing.assert_allclose(
                found[0].command.q, found[1].command.q, atol=1e-9
            )
        fast.motion = slow.motion
    assert 20 < refused < 150


@pytest.mark.parametrize("way", [deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copied_step_is_one_of_python(way: Any) -> None:
    fast, _ = pair()
    step = fast.map_landmarks(LANDMARKS[1])
    copied = way(step)
    fast.map_landmarks(LANDMARKS[2])
    assert type(copied.stages) is Stages
    assert_same(copied, step)
    assert way(fast).core is None


def test_the_core_ends_with_its_reference_and_options() -> None:
    fast, _ = pair()
    for change in (
        fast.clutch,
        fast.reset,
        fast.release,
        lambda: fast.configure(ik=IkOptions()),
    ):
        change()
        assert fast.core is None
        step = fast.map_landmarks(LANDMARKS[3])
        assert (fast.core is None) == (change == fast.release)
        assert (step.status == "released") == (change == fast.release)
        fast.clutch()
        fast.map_landmarks(LANDMARKS[3])


def test_a_refused_sample_changes_nothing() -> None:
    fast, slow = pair()
    for mapper in (fast, slow):
        with pytest.raises(InvalidInputError, match="landmarks"):
            mapper.map_landmarks(np.full((21, 3), np.nan))
    assert_same(fast.map_landmarks(LANDMARKS[1]), slow.map_landmarks(LANDMARKS[1]))


def test_checked_values_make_the_sample_that_the_check_makes() -> None:
    values = {
        "time": 1.0,
        "side": "right",
        "wrist": None,
        "valid": True,
        "confidence": 0.5,
    }
    one = HumanSample.of_checked(landmarks=LANDMARKS[0], **values)
    other = HumanSample(landmarks=LANDMARKS[0], **values)
    for name in (*values, "landmarks"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
