"""`allegro` is the Allegro of a side that is known: in Python, on the command line, in sessions."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from handmap_qp import HandError, InvalidInputError, load_hand
from handmap_qp.apps.service.opening import HandCache
from handmap_qp.cli import main
from handmap_qp.errors import RefusedError, did_you_mean
from handmap_qp.hands import SIDES, Side, hand_files, hand_sides
from handmap_qp.hands.library import find_file
from handmap_qp.trackers import read_recording, write_recordings

FAMILIES = sorted(
    name.removesuffix("_right")
    for name in hand_files()
    if name.endswith("_right") and name.removesuffix("_right") not in ("romeo", "g1")
)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_has_both_sides(family: str) -> None:
    assert hand_sides(family) == {
        "left": f"{family}_left",
        "right": f"{family}_right",
    }


@pytest.mark.parametrize("side", SIDES)
def test_a_family_and_a_side_are_a_hand(side: Side) -> None:
    assert load_hand("allegro", side=side).name == f"allegro_{side}"
    assert load_hand("human", side=side).side == side
    # Among hands, the name of a robot with two hands is that of a family.
    assert load_hand("g1", side=side).name == f"g1_{side}"
    # A name that says its side keeps it.
    assert load_hand(f"allegro_{side}", side=side).side == side
    # A hand that exists once has no other side.
    assert load_hand("three_finger", side=side).name == "three_finger"


def test_a_side_that_contradicts_the_name_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="side: allegro_right is a right hand"):
        load_hand("allegro_right", side="left")


@pytest.mark.parametrize("side", ["both", "", 1])
def test_other_sides_are_refused(side: object) -> None:
    with pytest.raises(InvalidInputError, match="side: expected"):
        load_hand("allegro", side=side)  # ty: ignore[invalid-argument-type]


def test_without_a_side_both_names_are_offered() -> None:
    with pytest.raises(HandError) as caught:
        load_hand("allegro")
    assert str(caught.value) == (
        "no hand 'allegro': did you mean allegro_left or allegro_right?"
    )


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("allegro", "did you mean allegro_left or allegro_right?"),
        ("Shadow", "did you mean shadow_left or shadow_right?"),
        ("leap_r", "did you mean leap_right?"),
        ("allegro_rihgt", "did you mean allegro_right?"),
        ("alegro_right", "did you mean allegro_right?"),
        ("zzz", ""),
    ],
)
def test_near_names_begin_with_the_word(name: str, expected: str) -> None:
    assert did_you_mean(name, hand_files()) == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("alegro", "did you mean allegro_left or allegro_right?"),
        ("Shaddow", "did you mean shadow_left or shadow_right?"),
        ("alegro_right", "did you mean allegro_right?"),
        ("leap_r", "did you mean leap_right?"),
        ("ur5_alegro", "did you mean ur5_allegro?"),
        ("baret", "did you mean barrett?"),
    ],
)
def test_a_mistyped_family_offers_its_hands(name: str, expected: str) -> None:
    with pytest.raises(HandError) as caught:
        find_file(name)
    assert str(caught.value) == f"no hand {name!r}: {expected}"


def test_a_name_that_no_file_can_have_is_refused_as_a_name(
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = "x" * 300
    with pytest.raises(HandError, match="no hand 'xxx"):
        load_hand(name, side="right")
    assert main(["map", "demo::right", "--robot", name]) == 2
    assert capsys.readouterr().err.startswith("handmap: no hand 'xxx")


def test_a_folder_of_the_users_comes_before_a_family(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    description = hand_files()["three_finger"].read_text("utf-8")
    urdf = hand_files()["three_finger"].parent / "three_finger.urdf"
    Path("allegro").mkdir()
    text = description.replace("name: three_finger", "name: mine")
    Path("allegro/hand.yaml").write_text(
        text.replace("urdf: ", f"urdf: {urdf.parent}/")
    )
    assert load_hand("allegro", side="left").name == "mine"


@pytest.mark.parametrize(
    ("words", "robots"),
    [
        (["demo", "--side", "left"], ["allegro_left"]),
        (["demo", "--side", "right"], ["allegro_right"]),
        # Both hands are in the file: the right one, as of `human`.
        (["demo"], ["allegro_right"]),
        (["demo::left"], ["allegro_left"]),
        (["demo::left", "--mirror"], ["allegro_right"]),
        (["demo::left", "--mirror", "--side", "left"], ["allegro_right"]),
    ],
    ids=" ".join,
)
def test_map_takes_the_hand_of_the_recordings_side(
    words: list[str],
    robots: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = ["--out", str(tmp_path / "out.npz"), "--json"]
    assert main(["map", *words, "--robot", "allegro", *out]) == 0
    assert [json.loads(capsys.readouterr().out)["robot"]] == robots


def test_two_hands_of_a_family(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["map", "demo", "--robots", "allegro", "allegro", "--json"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["robot"] for row in rows] == ["allegro_left", "allegro_right"]


def test_a_robot_with_both_hands_is_no_family(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "out.npz"), "--json"]
    assert main(["map", "pinch", "--robot", "g1", *out]) == 0
    assert json.loads(capsys.readouterr().out)["robot"] == "g1"


def test_a_comparison_takes_the_hand_of_the_recordings_side(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "short.npz"
    recording = read_recording("demo", "left").part(slice(0, 120))
    write_recordings([recording], file)
    words = ["compare", str(file), "--robot", "allegro", "--json"]
    assert main([*words, "--methods", "paper"]) == 0
    assert json.loads(capsys.readouterr().out)["robot"] == "allegro_left"


def test_a_batch_takes_both_hands_of_a_family(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "both.npz"
    hands = [read_recording("demo", side).part(slice(0, 30)) for side in SIDES]
    write_recordings(hands, file)
    out = tmp_path / "out"
    words = ["batch", str(file), "--robot", "allegro", "--workers", "0", "--json"]
    assert main([*words, "--out", str(out)]) == 0
    text = "".join(line.read_text("utf-8") for line in out.glob("manifest*.jsonl"))
    assert {"allegro_left", "allegro_right"} <= {*re.findall(r"allegro_\w+", text)}


def test_a_session_takes_the_hand_of_its_side() -> None:
    cache = HandCache()
    for side in SIDES:
        assert cache.robot("allegro", None, None, side).name == f"allegro_{side}"
        assert cache.robot("allegro_left", None, None, side).name == "allegro_left"
    with pytest.raises(RefusedError, match="no hand 'allegr'"):
        cache.robot("allegr", None, None, "right")


def test_commands_without_a_side_offer_both_names(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["hands", "show", "allegro"]) == 2
    assert "did you mean allegro_left or allegro_right?" in capsys.readouterr().err
