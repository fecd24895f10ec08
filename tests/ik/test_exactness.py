"""Random steps, hostile ones included.

No limit is passed, no answer holds a NaN, no exception is undocumented.

A short run of `benchmarks/exactness.py`, which takes a million.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from handmap_qp import MissingExtraError, hand_names, load_hand

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def hostile() -> Iterator[ModuleType]:
    """The steps that the benchmark takes too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        yield importlib.import_module("hostile")


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
    assert not tally.violations.total(), tally.violations
    # The steps reach limits, so that the check is meaningful.
    assert tally.statuses["limited"] > 1000
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
