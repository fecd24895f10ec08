"""Random steps, hostile ones included.

No limit is passed, no answer holds a NaN, no exception is undocumented.

A short run of `benchmarks/exactness.py`, which takes a million.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from handmap_qp import MissingExtraError, hand_names, load_hand

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def hostile() -> ModuleType:
    """The steps that the benchmark takes too."""
    spec = importlib.util.spec_from_file_location("hostile", BENCHMARKS / "hostile.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["hostile"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_every_hand_is_driven(hostile: ModuleType) -> None:
    runs = hostile.hostile_runs()
    names = " ".join(next(runs).name for _ in range(4 * len(hand_names())))
    for name in hand_names():
        try:
            hand = load_hand(name)
        except MissingExtraError:
            continue
        for mount in ("floating", "fixed") if hand.is_floating else ("fixed",):
            assert f"ik on {name}, {mount}" in names
            assert f"to {name}, {mount}" in names


@pytest.mark.slow
def test_limits_hold_and_answers_are_numbers(hostile: ModuleType) -> None:
    # All hands, free and held, by the inverse kinematics and the mapping: 20 runs of each kind.
    # Warnings count as exceptions here.
    (*_, tally) = hostile.drive(hostile.hostile_runs(), 8000, steps_per_run=200)
    assert tally.steps == 8000
    assert not tally.undocumented
    assert tally.not_finite == 0
    assert max(tally.position, tally.speed, tally.wrist_speed) < hostile.TOLERANCE
    # The steps reach limits, so that the check is meaningful.
    assert tally.statuses["limited"] > 1000
    assert tally.refused["InvalidInputError"] > 10
    assert tally.refused["DegeneratePointsError"] > 10
    assert "failed" not in tally.statuses


def test_a_violation_would_be_seen(hostile: ModuleType) -> None:
    hand, tally = load_hand("three_finger"), hostile.Tally()
    rest = hand.configuration_vector(hand.rest, np.eye(4))
    beyond = hand.configuration_vector(hand.upper_limits + 1e-6, np.eye(4))
    tally.check_motion(hand, rest, rest, 0.01)
    tally.check_finite(np.zeros(3))
    assert tally.is_exact
    tally.check_motion(hand, rest, beyond, 0.01)
    assert tally.position == pytest.approx(1e-6, abs=1e-9)
    assert tally.speed > 0.1
    tally.check_finite(np.array([np.nan]))
    assert tally.not_finite == 1
    assert not tally.is_exact


@pytest.mark.slow
def test_the_command_reports_in_json() -> None:
    command = [
        sys.executable,
        str(BENCHMARKS / "exactness.py"),
        "--steps",
        "400",
        "--seed",
        "3",
        "--json",
        "-",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout)
    assert results["is_exact"]
    assert results["steps"] == 400
    assert results["memory_last_mb"] > 10.0
