"""`handmap layouts`, and recordings in layouts, of the other hand and with mistakes in commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from marks import rotated
from PIL import Image

from handmap_qp import HumanLengths, cli
from handmap_qp.apps.drawing.raster import render
from handmap_qp.human.person import Person, write_person
from handmap_qp.se3 import affine
from handmap_qp.trackers.layouts import LAYOUTS
from handmap_qp.trackers.layouts.base import sized_human
from handmap_qp.trackers.layouts.tables import load_layout

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow


def write_hand(
    path: Path, name: str = "webxr25", *, count: int = 30, side: str = "right"
) -> Path:
    """Half a second of a right hand that closes, in a layout's own form."""
    layout, human = load_layout(name), sized_human("right")
    values = [
        layout.write_posture(
            human, (0.4 + share) * human.rest, affine(np.eye(3), np.zeros(3))
        )
        for share in np.linspace(0.0, 0.8, count)
    ]
    arrays: dict[str, Any] = {"time": np.arange(count) / 60.0}
    arrays[layout.arrays[0]] = np.array(values)
    np.savez(path, handedness=np.array(side), **arrays)
    return path


def run(*words: str | Path) -> int:
    return cli.main([str(word) for word in words])


def test_layouts_are_listed_and_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("layouts", "--json") == 0
    rows = json.loads(capsys.readouterr().out)
    assert tuple(row["name"] for row in rows) == tuple(LAYOUTS)
    assert run("layouts", "openxr26", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["entries"][10] == {
        "index": 10,
        "joint": "index tip",
        "landmark": "index_tip",
    }
    assert "back of the hand along +y" in shown["wrist pose"][1]
    assert run("layouts", "manus") == 0
    text = capsys.readouterr().out
    assert "IndexPIPStretch" in text
    assert "index_PIP_flexion" in text


def test_a_template_reads_what_the_original_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own.yaml"
    assert run("layouts", "manus", "--template", own) == 0
    assert own.read_text().startswith("kind: angles")
    assert load_layout(own).rows() == load_layout("manus").rows()
    assert run("layouts", "manus", "--template", own) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", rotated(["openxr26", "manus"], 2))
def test_every_convention_is_drawn(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def coarse(*given: Any, marks: Any, **_: Any) -> np.ndarray:
        return render(*given, marks=marks, supersampling=1)

    # With a sample a pixel: what is drawn, and where, is the same.
    monkeypatch.setattr("handmap_qp.apps.drawing.hands.render", coarse)
    assert run("layouts", name, "--picture", tmp_path / "hand.png") == 0
    picture = np.asarray(Image.open(tmp_path / "hand.png").convert("RGB")).astype(int)
    blue = (picture[..., 2] - picture[..., 0] > 25).sum()
    assert blue > 300  # landmarks of both hands


def test_a_file_in_a_layout_is_mapped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = write_hand(tmp_path / "hand.npz")
    out = tmp_path / "out.npz"
    command = (
        "map",
        hand,
        "--layout",
        "webxr25",
        "--robot",
        "three_finger",
        "--out",
        out,
    )
    assert run(*command, "--json") == 0
    assert json.loads(capsys.readouterr().out)["samples"] == 30
    assert np.load(out)["q"].shape[0] == 30
    assert (
        run("calibrate", hand, "--layout", "webxr25", "--out", tmp_path / "me.yaml")
        == 0
    )
    assert "hand length" in capsys.readouterr().out


def test_angles_are_of_the_person(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = write_hand(tmp_path / "hand.npz", "angles20")
    person = Person("large", HumanLengths.from_hand_length(0.23), 0.015)
    write_person(person, tmp_path / "large.yaml")
    out = tmp_path / "out.npz"
    command = (
        "map",
        hand,
        "--layout",
        "angles20",
        "--robot",
        "allegro_right",
        "--out",
        out,
    )
    assert run(*command, "--person", tmp_path / "large.yaml", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    # Bones are those of the person, to the millionth part of a millimetre.
    assert summary["consistency_mm_mean"] < 1e-6
    assert summary["held"] == 0


MISTAKES = {
    "no layout": (("--layout", "webxr"), "did you mean webxr25?"),
    "another layout": (
        ("--layout", "openxr26"),
        "has the shape of --layout manus25 or visionpro25 or webxr25",
    ),
    "no landmarks": ((), "the shape of --layout manus25 or visionpro25 or webxr25"),
    "other side": (("--layout", "webxr25", "--side", "left"), "is of a right hand"),
    "mirror of the same": (("--layout", "webxr25", "--mirror"), "leave it out"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_are_one_line(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, expected = MISTAKES[case]
    hand = write_hand(tmp_path / "hand.npz")
    assert run("map", hand, "--robot", "three_finger", *words) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert expected in message


def test_the_other_hand_needs_mirror(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = write_hand(tmp_path / "hand.npz", "mediapipe21")
    out = tmp_path / "out.npz"
    assert run("map", hand, "--robot", "allegro_left", "--out", out) == 2
    assert "give --mirror" in capsys.readouterr().err
    assert run("map", hand, "--robot", "allegro_left", "--mirror", "--out", out) == 0
    assert out.is_file()


def test_a_recording_that_is_not_what_it_says_is_refused_everywhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = write_hand(tmp_path / "hand.npz", "mediapipe21", side="left")
    commands = (
        ("map", hand, "--robot", "allegro_left", "--out", tmp_path / "out.npz"),
        ("compare", hand, "--robot", "allegro_left"),
        ("view", hand, "--robot", "allegro_left", "--html", tmp_path / "out.html"),
        ("calibrate", hand, "--out", tmp_path / "me.yaml"),
        ("hands", "match", "allegro_left", "--recording", hand),
    )
    for command in commands:
        assert run(*command) == 2, command
        message = capsys.readouterr().err
        assert "and are those of a right hand, or of a mirrored world" in message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hand.npz"]
