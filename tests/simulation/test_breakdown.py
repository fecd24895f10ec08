"""Success of trials over the properties of their objects."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.image import imread

from handmap_qp import cli
from handmap_qp.simulation.breakdown import draw_splits, split_rows, splits
from handmap_qp.simulation.pinch import PinchTrial
from handmap_qp.simulation.trials import describe_trial, random_trials


@given(st.integers(1, 60), st.integers(0, 9), st.sampled_from(["varied", "nominal"]))
@settings(max_examples=25, deadline=None)
def test_every_trial_is_in_one_part_of_each_quantity(count: int, seed: int, objects: str) -> None:
    trials = random_trials(count, seed, "varied" if objects == "varied" else "nominal")
    found = splits(trials)
    for quantity in {split.quantity for split in found}:
        parts = np.array([split.members for split in found if split.quantity == quantity])
        np.testing.assert_array_equal(parts.sum(axis=0), 1)
        if quantity != "shape":
            assert np.ptp(parts.sum(axis=1)) <= 1


def test_what_all_trials_share_is_no_quantity() -> None:
    trials = random_trials(30, 0, "nominal", PinchTrial(mass=0.1, friction=0.6))
    assert {(trial.mass, trial.friction) for trial in trials} == {(0.1, 0.6)}
    assert {split.quantity for split in splits(trials)} == {"displaced by [mm]", "turned by [deg]"}
    assert splits([PinchTrial()] * 3) == []
    assert splits([]) == []


def test_a_mapping_that_holds_the_light_ones_holds_all_of_the_lightest() -> None:
    trials = random_trials(90, 1)
    heaviest = sorted(trial.mass for trial in trials)[30]
    held = {"light": [trial.mass < heaviest for trial in trials], "none": [False] * 90}
    rows = [row for row in split_rows(trials, held) if "mass" in row["of the object"]]
    assert [(row["trials"], row["light, held %"]) for row in rows] == [(30, 100), (30, 0), (30, 0)]
    assert {row["none, held %"] for row in split_rows(trials, held)} == {0}


def test_the_picture_has_the_intervals(tmp_path: Path) -> None:
    trials = random_trials(30, 2)
    for name, is_held in (("all", True), ("none", False)):
        draw_splits(tmp_path / f"{name}.png", "title", trials, {"mapping": [is_held] * 30})
    full, none = (imread(tmp_path / f"{name}.png")[..., :3] for name in ("all", "none"))
    assert full.shape == none.shape
    drawn = [np.nonzero(np.ptp(picture, axis=2) > 0.3)[0].mean() for picture in (full, none)]
    # Upwards is towards the first row.
    assert drawn[0] < drawn[1] - 50


def test_the_command_counts_every_trial(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["simulate", "demo::right", "--robot", "panda_gripper", "--trials", "2", "--json"]
    picture = tmp_path / "held.png"
    assert cli.main([*words, "--methods", "fingertip-vectors", "--picture", str(picture)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["trials"] for row in found["rows"]] == [2]
    drawn = [describe_trial(trial) for trial in random_trials(2, 0)]
    assert [{k: v for k, v in trial.items() if k != "held"} for trial in found["trials"]] == drawn
    assert picture.stat().st_size > 1000
    assert cli.main([*words, "--mass", "0.2"]) == 2
    assert "--trials: draws object, mass and friction" in capsys.readouterr().err
