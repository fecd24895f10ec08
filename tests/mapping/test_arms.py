"""Hands on arms: the fingers belong to the palm, wherever the arm ends."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pinocchio as pin
import pytest

from handmap_qp import HandMapper, MapStep, load_hand
from handmap_qp.mapping.presets import get_preset
from handmap_qp.reference.problem import point_rows

HUMAN = load_hand("human", points="landmarks")
DT = 1.0 / 60.0
FORMULATIONS = ("compiled", "direct")


def motion(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """A person who opens and closes the hand, and reaches much farther than an arm."""
    found = []
    for i in range(count):
        share = 0.5 - 0.5 * np.cos(0.05 * i)
        q = HUMAN.rest + share * (0.6 * HUMAN.upper_limits - HUMAN.rest)
        wrist = np.eye(4)
        wrist[:3, 3] = 0.0, 0.02 * i, 0.5 * share
        found.append((np.clip(q, HUMAN.lower_limits, HUMAN.upper_limits), wrist))
    return found


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    ("arm", "bare"), [("ur5_allegro", "allegro_right"), ("g1_arm_left", "g1_left")]
)
def test_fingers_do_on_an_arm_what_they_do_without(
    arm: str, bare: str, formulation: str
) -> None:
    ik = get_preset("teleoperation").ik.replaced(formulation=formulation)
    robots = load_hand(arm), load_hand(bare)
    mappers = [HandMapper(HUMAN, robot, "teleoperation", ik=ik) for robot in robots]
    names = [name for name in robots[0].joint_names if name in robots[1].joint_names]
    columns = [[robot.joint_names.index(name) for name in names] for robot in robots]
    assert len(names) == len(robots[1].joint_names)
    assert robots[0].moves_wrist.sum() == len(robots[0].joint_names) - len(names)
    apart = []
    steps: list[MapStep] = []
    for sample in motion(150):
        steps = [mapper.map_step(*sample) for mapper in mappers]
        q, other = (
            step.command.q[column] for step, column in zip(steps, columns, strict=True)
        )
        apart.append(np.abs(q - other).max())
    # The arm is left behind by metres, and the fingers are not.
    missed = steps[0].command.wrist[:3, 3] - steps[0].wrist_target[:3, 3]
    assert np.linalg.norm(missed) > 1.0
    assert np.percentile(apart, 95) < 0.02
    # Targets go with the palm.
    off = np.linalg.norm(steps[0].ik.errors, axis=1)
    other = np.linalg.norm(steps[1].ik.errors, axis=1)
    np.testing.assert_allclose(off, other, atol=2e-3)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_an_arm_says_how_far_it_is_off_and_what_holds_it(formulation: str) -> None:
    # Fingers within 50 mm have arrived, so that the status is that of the wrist.
    ik = get_preset("teleoperation").ik.replaced(
        formulation=formulation, point_tolerance=0.05
    )
    arm = load_hand("ur5_allegro")
    mapper = HandMapper(HUMAN, arm, "teleoperation", ik=ik)
    wrist = np.eye(4)
    step = mapper.map_step(HUMAN.rest, wrist)
    assert (step.arm_held_by, step.status) == ("", "converged")
    np.testing.assert_allclose(step.wrist_error, 0.0, atol=1e-3)
    # Near enough, but not in one sample; the fingers are there all the time.
    wrist[1, 3] = 0.1
    step = mapper.map_step(HUMAN.rest, wrist)
    assert step.arm_held_by == "speed"
    assert step.status != "converged"
    assert 0.05 < step.wrist_error[0] < 0.1
    for _ in range(120):
        step = mapper.map_step(HUMAN.rest, wrist)
    assert (step.arm_held_by, step.status) == ("", "converged")
    # Too far away for any posture.
    wrist[1, 3] = 5.0
    for _ in range(300):
        step = mapper.map_step(HUMAN.rest, wrist)
    assert step.arm_held_by in ("reach", "limit")
    assert step.status != "converged"
    assert step.wrist_error[0] == pytest.approx(
        np.linalg.norm(step.command.wrist[:3, 3] - step.wrist_target[:3, 3]), rel=1e-9
    )
    mapper.release()
    assert mapper.map_step(HUMAN.rest, wrist).arm_held_by == ""
    hand = load_hand("allegro_right")
    assert HandMapper(HUMAN, hand).map_step(HUMAN.rest, wrist).arm_held_by == ""


@pytest.mark.parametrize("name", ["ur5_allegro", "allegro_right"])
def test_rows_that_go_with_the_wrist_are_derivatives(name: str) -> None:
    hand = load_hand(name)
    placed = hand.configuration()
    rng = np.random.default_rng(0)
    q = rng.uniform(hand.lower_limits, hand.upper_limits)
    wrist = pin.exp6(rng.normal(size=6))
    vector = hand.configuration_vector(
        q, wrist.homogeneous if hand.is_floating else None
    )
    placed.place(vector)
    targets = placed.points + 0.05 * rng.normal(size=placed.points.shape)
    goal = pin.exp6(0.3 * rng.normal(size=6)) * placed.wrist
    # In the axes of the wrist, which turn with what moves it.
    error, jacobian = point_rows(placed, targets, goal)
    turn = placed.wrist.rotation.copy()
    local = error.reshape(-1, 3) @ turn
    for column in range(placed.nv):
        step = np.zeros(placed.nv)
        step[column] = 1e-6
        ends = []
        for sign in (1.0, -1.0):
            placed.displace(vector, sign * step)
            there, _ = point_rows(placed, targets, goal)
            ends.append(there.reshape(-1, 3) @ placed.wrist.rotation)
        slope = (ends[0] - ends[1]) / 2e-6
        wanted = jacobian[:, column].reshape(-1, 3) @ turn
        np.testing.assert_allclose(slope, wanted, atol=1e-7)
    assert np.abs(local).max() > 0.01


@pytest.mark.parametrize(
    ("error", "is_off"),
    [
        ((0.0, 0.0), False),
        ((0.0, 0.5), True),
        ((0.5, 0.0), True),
        ((np.nan, 0.0), True),
        ((0.0, np.nan), True),
    ],
)
def test_an_arm_is_off_by_its_place_or_its_turn(
    error: tuple[float, float], is_off: bool
) -> None:
    mapper = HandMapper(HUMAN, load_hand("ur5_allegro"), "teleoperation")
    step = mapper.map_step(HUMAN.rest, np.eye(4))
    at_bound = np.zeros(len(step.command.q), dtype=bool)
    summary = SimpleNamespace(wrist_error=error, at_bound=at_bound)
    command = step.command
    stages: Any = SimpleNamespace(
        status="limited", summary=summary, ik=step.ik, command=command
    )
    assert bool(msgspec.structs.replace(step, stages=stages).arm_held_by) == is_off
