"""Random steps, hostile ones included.

No limit is passed, no answer holds a NaN, no exception is undocumented.

A short run of `tests/judges/exactness.py`, which takes a million.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from handmap_qp import MissingExtraError, hand_names, load_hand
from handmap_qp.hands.shape_pairs import all_pairs

JUDGES = Path(__file__).parents[1] / "judges"


@pytest.fixture(scope="module")
def hostile() -> ModuleType:
    """The steps that the judge's long mode takes too."""
    return importlib.import_module("hostile")


@pytest.mark.slow
def test_every_hand_is_driven(
    hostile: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    # To prepare runs takes long; to know their hands does not.
    def named(kind: str) -> Any:
        return lambda robot, *_: (kind, robot.name, robot.mount)

    monkeypatch.setattr(hostile, "IkRun", named("ik"))
    monkeypatch.setattr(hostile, "mapper_run", named("mapping"))
    runs = hostile.hostile_runs()
    driven = {next(runs) for _ in range(4 * len(hand_names()))}
    for name in hand_names():
        try:
            hand = load_hand(name)
        except MissingExtraError:
            continue
        for mount in ("floating", "fixed") if hand.is_floating else ("fixed",):
            assert ("ik", name, mount) in driven
            assert ("mapping", name, mount) in driven


@pytest.mark.slow
def test_limits_hold_and_answers_are_numbers(hostile: ModuleType) -> None:
    # 20 hands, free and held, by the inverse kinematics and the mapping each.
    # Warnings count as exceptions here.
    (*_, tally) = hostile.drive(hostile.hostile_runs(), 3200, steps_per_run=80)
    assert tally.steps == 3200
    assert not tally.undocumented
    assert tally.not_finite == 0
    assert not tally.violations.total(), tally.violations
    # The steps reach limits, so that the check is meaningful.
    assert tally.statuses["limited"] > 400
    assert tally.refused["InvalidInputError"] > 10
    assert tally.refused["DegeneratePointsError"] > 10
    assert "failed" not in tally.statuses


def test_a_violation_would_be_seen(hostile: ModuleType) -> None:
    tally, checker = hostile.Tally(), hostile.Checker(load_hand("three_finger"))
    tally.check_finite(np.zeros(3))
    tally.add(checker)
    assert tally.is_exact
    checker.violations["speed"] += 1
    tally.add(checker)
    assert not tally.is_exact
    tally = hostile.Tally()
    tally.check_finite(np.array([np.nan]))
    assert tally.not_finite == 1
    assert not tally.is_exact


@pytest.fixture
def planted(hostile: ModuleType) -> Any:
    """Return a judge, a robot that starts at rest, and its rest posture."""
    hand = load_hand("three_finger", mount="fixed")
    checker = hostile.Checker(hand, all_pairs(hand))
    checker.start(hand.rest)
    return checker, hand, hand.rest


def found(checker: Any) -> set[str]:
    return {what for what, count in checker.violations.items() if count}


def test_the_judge_finds_nothing_in_a_motion_within_all_limits(planted: Any) -> None:
    checker, _, q = planted
    steps = [0.5 * 0.01**2 * k for k in (1, 2, 3, 2, 1, 0)]
    for k, step in enumerate(steps, 1):
        q = q + step
        checker.take(q, 0.01 * k, 0.5)
    assert checker.commands == len(steps)
    assert not found(checker)
    assert checker.worst["acceleration"] == pytest.approx(1.0, abs=1e-6)


def test_the_judge_finds_a_position_beyond_a_limit_by_one_rounding(
    planted: Any,
) -> None:
    checker, hand, q = planted
    at = q.copy()
    at[0] = hand.upper_limits[0]
    checker.take(at, 10.0)
    assert not found(checker)
    at[0] = np.nextafter(at[0], np.inf)
    checker.take(at, 20.0)
    assert found(checker) == {"position"}
    # A robot that starts outside may stay, but not go on.
    checker.violations.clear()
    checker.take(at, 30.0)
    assert not found(checker)


def test_the_judge_finds_speed_and_acceleration(planted: Any) -> None:
    checker, hand, q = planted
    checker.take(q + hand.velocity_limits * 0.01 * (1.0 + 1e-5), 0.01)
    assert found(checker) == {"speed"}
    checker.start(q)
    checker.violations.clear()
    checker.take(q + 2.0 * 0.01**2 * (1.0 + 1e-5), 0.01, 2.0)
    assert found(checker) == {"acceleration"}
    # A stop within one sample, after two samples at the limit.
    checker.start(q)
    checker.violations.clear()
    checker.take(q + 2.0 * 0.01**2, 0.01, 2.0)
    checker.take(q + 6.0 * 0.01**2, 0.02, 2.0)
    assert not found(checker)
    checker.take(q + 6.0 * 0.01**2, 0.03, 2.0)
    assert found(checker) == {"acceleration"}


def test_the_judge_goes_by_time_stamps_alone(planted: Any) -> None:
    checker, hand, q = planted
    # Two commands of 10 ms each, 5 ms apart: twice the speed.
    step = hand.velocity_limits * 0.01
    checker.take(q + step, 0.01)
    assert not found(checker)
    checker.take(q + 1.5 * step, 0.015)
    assert not found(checker)
    checker.take(q + 2.5 * step, 0.02)
    assert found(checker) == {"speed"}
    assert checker.worst["speed"] == pytest.approx(2.0)
    # Stamps that repeat or go back leave 1 us, and what is behind them is judged from there.
    checker.start(q, 1.0)
    checker.violations.clear()
    checker.take(np.array([q, q]), [1.0, 0.5])
    assert checker.time == pytest.approx(1.0 + 2e-6, abs=1e-12)
    checker.take(q + step, 1.01)
    assert found(checker) == {"speed"}
    assert checker.worst["speed"] == pytest.approx(2.0)
    # A gap makes nothing up, and unequal steps count in the time of the later one.
    checker.start(q)
    checker.violations.clear()
    checker.take(q + 0.5 * step, 1.0, 2.0)
    checker.take(q + 0.5 * step + 2.0 * 0.01**2, 1.01, 2.0)
    assert found(checker) == set()
    checker.take(q + 0.5 * step + 2.0 * 0.01**2 * 3.0, 1.015, 2.0)
    assert found(checker) == {"acceleration"}


def test_the_judge_counts_by_the_largest_limit_since_the_robot_stood(
    planted: Any,
) -> None:
    checker, _, q = planted
    checker.take(q + 20.0 * 0.01**2, 0.01, 20.0)
    checker.take(q + 20.0 * 0.01**2, 0.02, 1.0)
    assert not found(checker)
    checker.take(q + 20.0 * 0.01**2, 0.03, 1.0)
    checker.take(q + 22.0 * 0.01**2, 0.04, 1.0)
    assert found(checker) == {"acceleration"}


def test_the_judge_finds_overlaps_between_commands_too(planted: Any) -> None:
    checker, hand, _ = planted
    rng = np.random.default_rng(0)
    meter = checker.meter
    while True:
        ends = [rng.uniform(hand.lower_limits, hand.upper_limits) for _ in range(2)]
        middle = 0.5 * (ends[0] + ends[1])
        if max(map(meter.depth, ends)) == 0.0 and meter.depth(middle) > 2e-3:
            break
    checker.start(ends[0])
    checker.take(ends[1], 10.0)
    assert found(checker) == {"overlap"}


def test_the_judge_finds_a_number_that_is_none(planted: Any) -> None:
    checker, _, q = planted
    checker.meter = None
    checker.take(q * np.nan, 0.01)
    assert {"position", "speed"} <= found(checker)


def test_the_judge_finds_a_wrist_that_jumps(hostile: ModuleType) -> None:
    hand = load_hand("three_finger")
    checker, wrist = hostile.Checker(hand), np.eye(4)
    checker.start(hand.configuration_vector(hand.rest, wrist))
    wrist[0, 3] = hand.spec.wrist.max_linear_speed * 0.01 * 1.01
    checker.take(hand.configuration_vector(hand.rest, wrist), 0.01)
    assert found(checker) == {"speed"}
    # In a sample in which the wrist may turn by more than half a turn, its twist is ambiguous.
    checker.violations.clear()
    for time in (10.01, 10.02):
        checker.take(hand.configuration_vector(hand.rest, wrist), time, 1e-3)
    assert not found(checker)


@pytest.mark.slow
def test_the_command_reports_in_json() -> None:
    command = [
        sys.executable,
        str(JUDGES),
        "exactness",
        "--hands",
        "three_finger",
        "romeo_right",
        "--steps",
        "50",
        "--seed",
        "3",
        "--processes",
        "1",
        "--json",
        "-",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout)
    assert results["is_exact"]
    assert results["steps"] == 50
    assert results["memory_last_mb"] > 10.0


def test_a_wrist_whose_turn_is_ambiguous_is_not_at_rest(hostile: ModuleType) -> None:
    hand = load_hand("three_finger")
    judge = hostile.Checker(hand)
    q = hand.configuration_vector(hand.rest)
    judge.start(q)
    # Half a second may hide half a turn; the wrist goes on at .6 m/s, then stops at 60 m/s^2.
    for dt, moved, limit in [(0.5, 0.3, 100.0), (0.01, 0.006, 0.5), (0.01, 0.0, 0.5)]:
        q[0] += moved
        judge.take(q, judge.time + dt, limit)
    assert not judge.violations["acceleration"]
    # From rest, it may not.
    q[0] += 0.006
    judge.take(q, judge.time + 0.01, 0.5)
    assert judge.violations["acceleration"] == 1
