"""Files of options: round trip of every choice, and one line for invalid files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from handmap_qp import InvalidInputError, cli, load_hand
from handmap_qp.apps.arguments import MappingArguments, QpFlags
from handmap_qp.mapping.methods.homogeneous import MappingOptions
from handmap_qp.mapping.options_file import options_text, read_options
from handmap_qp.mapping.presets import IK_NAMES, PRESETS, preset_choice

HUMAN, ROBOT = load_hand("human"), load_hand("allegro_right")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return the path of a file that does not exist yet."""
    return tmp_path / "options.yaml"


@given(
    preset=st.sampled_from(sorted(PRESETS)),
    scale=st.floats(0.01, 1.0),
    damping=st.floats(0.01, 2.0),
)
def test_a_choice_comes_back_from_its_text(
    preset: str, scale: float, damping: float
) -> None:
    changes = {"scale": scale, "damping": damping}
    if preset == "joint-to-joint":
        del changes["scale"]
    choice = preset_choice(preset).with_changes(changes)
    again = yaml.safe_load(options_text(choice))
    assert preset_choice(again.pop("preset")).with_changes(again) == choice


def test_points_and_rotations_come_back_from_the_file(file: Path) -> None:
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    changes = {"pivot": "point", "pivot_point": (0.1, 0.2, 0.3), "alignment": rotation}
    choice = preset_choice("paper").with_changes(changes)
    file.write_text(options_text(choice))
    again = preset_choice("paper").with_changes(read_options(file))
    assert isinstance(again.method, MappingOptions)
    assert again.method.pivot_point == (0.1, 0.2, 0.3)
    np.testing.assert_array_equal(np.asarray(again.method.alignment), rotation)


def test_the_command_line_counts_more_than_the_file(file: Path) -> None:
    file.write_text(
        "preset: teleoperation\npinch_weight: 2.0\ndamping: 0.3\nrest_weight: 0.5\n"
    )
    arguments = MappingArguments(options=file, ik=QpFlags(damping=0.4))
    choice = arguments.preset_for(HUMAN, ROBOT)
    assert choice.preset == "teleoperation"
    assert choice == preset_choice("teleoperation").with_changes(
        {"pinch_weight": 2.0, "damping": 0.4, "rest_weight": 0.5}
    )
    assert replace(arguments, preset="teleoperation").preset_for(HUMAN, ROBOT) == choice
    file.write_text("preset: teleoperation\nrest_weight: 0.5\n")
    other = replace(arguments, preset="paper").preset_for(HUMAN, ROBOT)
    assert (other.preset, other.ik.rest_weight) == ("paper", 0.5)


def test_every_option_has_one_meaning_in_the_file() -> None:
    for preset in PRESETS:
        assert not IK_NAMES & preset_choice(preset).method.values.keys()


@pytest.mark.parametrize(
    ("text", "argument", "words"),
    [
        ("pinch_wieght: 2", "pinch_wieght", "did you mean pinch_weight?"),
        ("- 1", "options", "is not a table"),
        ("a: [", "options", "is not a table"),
        ("\x00", "options", "is not a table"),
        (None, "options", "cannot be read"),
    ],
)
def test_an_invalid_file_is_one_line(
    file: Path, text: str | None, argument: str, words: str
) -> None:
    if text is not None:
        file.write_text(text)
    with pytest.raises(InvalidInputError) as raised:
        read_options(file)
    assert raised.value.argument == argument
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "text",
    ["preset: claw", "preset: paper\npinch_weight: 1", "damping: much", "ridge: [1]"],
)
def test_values_are_checked_as_on_the_command_line(
    file: Path, text: str, capsys: pytest.CaptureFixture[str], recording_file: Any
) -> None:
    file.write_text(text)
    words = [
        "map",
        str(recording_file),
        "--robot",
        "allegro_right",
        "--options",
        str(file),
    ]
    assert cli.main(words) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("handmap: ")
    assert printed.err.count("\n") == 1


@pytest.fixture
def recording_file(tmp_path: Path) -> Path:
    """Write a recording of a hand at rest."""
    landmarks = load_hand("human", points="landmarks").points(HUMAN.rest)
    path = tmp_path / "rest.npz"
    np.savez(
        path, time=np.arange(3) / 60.0, landmarks=[landmarks] * 3, handedness="right"
    )
    return path
