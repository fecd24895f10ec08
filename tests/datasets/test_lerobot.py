"""A data set in the form of LeRobot v3, opened by LeRobot itself.

It needs an environment with `lerobot`: this one, or that of the interpreter which the variable
`HANDMAP_LEROBOT_PYTHON` names.
"""

from __future__ import annotations

import json
import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_runs import run_lerobot

from handmap_qp.trackers.formats import lerobot
from handmap_qp.trackers.formats.lerobot import Feature, writing_set

PYTHON = os.environ.get("HANDMAP_LEROBOT_PYTHON") or (
    sys.executable if find_spec("lerobot") else ""
)
READER = Path(__file__).parents[1] / "support" / "lerobot_reader.py"
FPS, LENGTHS, TASKS = 30.0, (5, 9, 4), ("pour", "stack", "pour")


@pytest.mark.slow
@pytest.mark.skipif(
    not PYTHON, reason="lerobot is not installed (HANDMAP_LEROBOT_PYTHON)"
)
def test_lerobot_reads_what_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    # Each episode begins a new file.
    monkeypatch.setattr(lerobot, "DATA_FILE_SIZE", 1)
    rng, names = np.random.default_rng(0), ("a", "b", "c")
    features = {
        "observation.state": Feature("float32", names),
        "action": Feature("float32", names),
        "observation.valid": Feature("bool", ("left", "right")),
    }
    states = [rng.normal(size=(count, 3)).astype(np.float32) for count in LENGTHS]
    valid = [rng.random((count, 2)) > 0.3 for count in LENGTHS]
    with writing_set(
        tmp_path / "set", fps=FPS, features=features, robot_type="hand"
    ) as writer:
        for state, seen, task in zip(states, valid, TASKS, strict=True):
            columns = {
                "observation.state": state,
                "action": np.vstack([state[1:], state[-1:]]),
                "observation.valid": seen,
            }
            writer.add(columns, task, {"source": "file.hdf5::left"})
    assert len(list((tmp_path / "set/data/chunk-000").glob("*.parquet"))) == len(
        LENGTHS
    )
    found = read(tmp_path / "set", tmp_path)
    assert (found["fps"], found["episodes"], found["lengths"]) == (
        FPS,
        3,
        list(LENGTHS),
    )
    assert found["features"]["observation.state"] == ["float32", [3], list(names)]
    assert found["features"]["observation.valid"] == ["bool", [2], ["left", "right"]]
    everything = np.vstack(states)
    np.testing.assert_array_equal(found["state"], everything)
    np.testing.assert_array_equal(found["valid"], np.vstack(valid))
    episode = np.repeat(range(3), LENGTHS)
    np.testing.assert_array_equal(found["episode"], episode)
    assert found["task"] == [TASKS[i] for i in episode]
    frames = np.concatenate([np.arange(count) for count in LENGTHS])
    np.testing.assert_allclose(found["time"], frames / FPS, atol=1e-6)
    # The state before, of the same episode, and the state itself.
    before = np.where(frames[:, None] > 0, np.roll(everything, 1, axis=0), everything)
    np.testing.assert_array_equal(
        found["pairs"], np.stack([before, everything], axis=1)
    )
    after = np.roll(everything, -1, axis=0)
    ends = np.cumsum(LENGTHS) - 1
    after[ends] = everything[ends]
    np.testing.assert_array_equal(found["action"], after)
    assert found["last"] == list(range(sum(LENGTHS[:2]), sum(LENGTHS)))
    stats = found["stats"]["observation.state"]
    np.testing.assert_allclose(stats["mean"], everything.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(stats["std"], everything.std(axis=0), atol=1e-6)
    assert stats["count"] == [sum(LENGTHS)]
    shares = np.array(LENGTHS) / sum(LENGTHS)
    for key, share in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
        own = [np.quantile(state, share, axis=0) for state in states]
        np.testing.assert_allclose(stats[key], shares @ own, atol=1e-6)


def read(root: Path, home: Path) -> dict[str, Any]:
    """Return what LeRobot sees."""
    said = run_lerobot(home, PYTHON, str(READER), str(root))
    return json.loads(said.splitlines()[-1])
