"""Three reaches show how a tracker's world lies: the function, and `handmap align`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reach_cases import WAYS, reaching_hand

from handmap_core.mapping.alignment import alignment_from_gestures, rotation_of
from handmap_qp import InvalidInputError, cli
from handmap_qp.trackers.formats.archive import NpzFormat


@given(
    turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    length=st.floats(0.06, 1.0),
    tilt=st.floats(-0.25, 0.25),
)
def test_gestures_show_how_a_tracker_lies(
    turn: tuple[float, ...], length: float, tilt: float
) -> None:
    rotation = pin.exp3(np.array(turn))
    # Forward and up lean by the same angle, so that the best rotation is the true one.
    ways = length * np.array(
        [
            [np.cos(tilt), 0.0, np.sin(tilt)],
            [0.0, 1.0, 0.0],
            [np.sin(tilt), 0.0, np.cos(tilt)],
        ]
    )
    found = alignment_from_gestures(ways @ rotation)
    np.testing.assert_allclose(found, rotation, atol=1e-9)


@pytest.mark.parametrize(
    ("reaches", "message"),
    [
        (0.1 * WAYS, "5 cm or more"),
        (WAYS[[0, 0, 2]], "within 20 degrees"),
        (WAYS + 0.4 * WAYS[[1, 2, 0]] + 0.4 * WAYS[[2, 0, 1]], "within 20 degrees"),
        (WAYS * [[1.0], [-1.0], [1.0]], "to your left"),
        (np.full((3, 3), np.nan), "finite"),
        (np.ones((3, 2)), "shape"),
    ],
)
def test_other_gestures_are_refused(reaches: npt.ArrayLike, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        alignment_from_gestures(reaches)


def test_align_prints_the_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "reaches.npz"
    NpzFormat().write([reaching_hand()], file)
    align = ["align", str(file), "--at", "0", "1", "2"]
    assert cli.main([*align, "2.9"]) == 0
    option, _, line = capsys.readouterr().out.splitlines()
    rotation = rotation_of("y-up")
    values = [float(word) for word in option.split()[1:]]
    np.testing.assert_allclose(values, rotation.ravel(), atol=1e-6)
    np.testing.assert_allclose(json.loads(line.partition(": ")[2]), rotation, atol=1e-6)
    # Both are taken, and no number is one that YAML takes for a text.
    assert "e-" not in line
    (tmp_path / "options.yaml").write_text(line)
    out = ["--out", str(tmp_path / "out.npz"), "--json"]
    mapping = ["map", str(file), "--robot", "ur5_allegro", *out]
    for words in (option.split(), ["--options", str(tmp_path / "options.yaml")]):
        assert cli.main([*mapping, *words]) == 0
        said = json.loads(capsys.readouterr().out)["alignment"]
        np.testing.assert_allclose(said, rotation, atol=1e-6)
    assert cli.main([*align, "2.1"]) == 2
    assert "5 cm or more" in capsys.readouterr().err
    assert cli.main([*align, "1.5"]) == 2
    assert "instants from 0 on, in order" in capsys.readouterr().err
    assert cli.main([*align, "8"]) == 2
    assert "at which the hand is seen" in capsys.readouterr().err
    NpzFormat().write([reaching_hand(valid=np.arange(180) < 90)], file)
    assert cli.main([*align, "2.9"]) == 2
    assert "at which the hand is seen" in capsys.readouterr().err
