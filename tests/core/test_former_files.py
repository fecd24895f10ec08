"""Files that version 0.2 wrote are read as before: `tests/data/former` has one of each kind."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handmap_qp import cli, load_hand, load_layout, read_recording
from handmap_qp.apps.datasets.manifest import read_manifests
from handmap_qp.human.person import read_person
from handmap_qp.mapping.options_file import read_options
from handmap_qp.mapping.presets import preset_choice

FOLDER = Path(__file__).parents[1] / "data" / "former"
EXPECTED: dict[str, Any] = json.loads(
    (FOLDER / "expected.json").read_text(encoding="utf-8")
)
"""What version 0.2 read from the files."""


@pytest.mark.parametrize("file", EXPECTED["tolerance"])
def test_recordings(file: str) -> None:
    recording, expected = read_recording(FOLDER / file), EXPECTED["recordings"]
    assert recording.side == expected["side"]
    assert recording.valid.all()
    np.testing.assert_allclose(recording.time[:3], expected["time"], atol=1e-9)
    tolerance = EXPECTED["tolerance"][file]
    np.testing.assert_allclose(
        recording.landmarks[:3], expected["landmarks"], atol=tolerance
    )


@pytest.mark.parametrize("preset", EXPECTED["options"])
def test_options(preset: str) -> None:
    found = read_options(FOLDER / f"options_{preset}.yaml")
    assert found.pop("preset") == preset
    choice = preset_choice(preset).with_changes(found)
    values = choice.method.values | choice.ik.values
    for name, value in EXPECTED["options"][preset].items():
        assert values[name] == (tuple(value) if isinstance(value, list) else value), (
            name
        )


def test_a_person() -> None:
    person = read_person(FOLDER / "person.yaml")
    assert person.hand_length == pytest.approx(
        EXPECTED["person"]["hand_length"], abs=1e-9
    )
    assert person.contact_gap == EXPECTED["person"]["contact_gap"]


def test_a_hand() -> None:
    hand, expected = load_hand(FOLDER / "hand" / "hand.yaml"), EXPECTED["hand"]
    assert list(hand.joint_names) == expected["joints"]
    np.testing.assert_array_equal(hand.lower_limits, expected["lower"])
    np.testing.assert_array_equal(hand.upper_limits, expected["upper"])
    np.testing.assert_allclose(hand.points(hand.rest), expected["points"], atol=1e-12)


def test_a_former_key_of_a_hand_is_read(tmp_path: Path) -> None:
    hand = load_hand(FOLDER / "hand" / "hand.yaml")
    match = dict(zip(hand.joint_names, hand.rest.tolist(), strict=True))
    urdf = json.dumps(str(FOLDER / "hand" / hand.spec.urdf))
    text = (FOLDER / "hand" / "hand.yaml").read_text(encoding="utf-8")
    text = re.sub(r"^urdf: .*$", f"urdf: {urdf}", text, flags=re.MULTILINE)
    file = tmp_path / "hand.yaml"
    file.write_text(f"{text}matched: {json.dumps(match)}\n", encoding="utf-8")
    found = load_hand(file).neutral_match
    assert found is not None
    np.testing.assert_allclose(found, hand.rest, atol=1e-12)


@pytest.mark.parametrize("kind", ["unity26", "manus25", "markers13", "angles20"])
def test_layouts(kind: str) -> None:
    former, own = load_layout(FOLDER / f"layout_{kind}.yaml"), load_layout(kind)
    assert former.shapes == own.shapes
    human = load_hand("human")
    posture = 0.6 * human.rest + 0.4 * human.upper_limits
    values = own.write_posture(human, posture, np.eye(4))
    np.testing.assert_array_equal(
        former.write_posture(human, posture, np.eye(4)), values
    )
    found, expected = (
        layout.read(values, time=0.0, side="right") for layout in (former, own)
    )
    np.testing.assert_array_equal(found.landmarks, expected.landmarks)


def test_the_manifest_of_a_batch() -> None:
    assert sorted(read_manifests(FOLDER / "batch")) == EXPECTED["batch"]


def test_a_command_takes_them_together(tmp_path: Path) -> None:
    out = tmp_path / "motion.npz"
    words = [
        "map",
        FOLDER / "demo.csv",
        "--robot",
        FOLDER / "hand" / "hand.yaml",
        "--out",
        out,
    ]
    words += [
        "--options",
        FOLDER / "options_teleoperation.yaml",
        "--person",
        FOLDER / "person.yaml",
    ]
    assert cli.main([str(word) for word in words]) == 0
    with np.load(out) as motion:
        assert len(motion["q"]) == 12
