"""`init_hands` and `check_hand` give programs what the commands print."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_hands import two_hands_mjcf

from handmap_qp import (
    HandError,
    InvalidInputError,
    check_hand,
    check_robot,
    init_hands,
    load_hand,
)
from handmap_qp.hands import load_robot
from handmap_qp.hands.sources import urdf_directory

# Whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

THREE_FINGER = urdf_directory() / "three_finger" / "hand.urdf"


def test_a_hand_is_described_with_the_evidence_for_it(tmp_path: Path) -> None:
    result = init_hands(THREE_FINGER, out=tmp_path / "mine.yaml", name="mine", speed=2)
    assert (result.name, result.file) == ("mine", tmp_path / "mine.yaml")
    assert not result.is_robot
    assert result.converted is None
    (described,) = result.hands
    assert described.file == result.file
    assert (described.hand.velocity_limits == 2.0).all()
    loaded = load_hand(result.file)
    assert loaded.spec == described.hand.spec
    clues = {clue.what: clue for clue in described.clues}
    assert {"palm", "thumb", "side", "rest"} <= clues.keys()
    assert clues["palm"].certainty in ("certain", "likely", "a guess: check it")
    report = check_hand(result.file, has_motion=False)
    assert report.is_usable
    assert report.worst == report.findings[0].level
    assert report.hand is not None
    assert report.error is None


def test_both_hands_of_a_robot_are_described(tmp_path: Path) -> None:
    model = tmp_path / "two.xml"
    model.write_text(two_hands_mjcf(), encoding="utf-8")
    result = init_hands(model, out=tmp_path / "made" / "robot.yaml", name="pair")
    assert result.is_robot
    assert result.converted == tmp_path / "made" / "two.urdf"
    assert [each.hand.name for each in result.hands] == ["pair_left", "pair_right"]
    assert [each.file.name for each in result.hands] == ["left.yaml", "right.yaml"]
    assert load_robot(result.file).name == "pair"
    assert check_robot(result.file, has_motion=False).name == "pair"


def test_a_file_that_exists_is_kept_unless_it_may_be_replaced(tmp_path: Path) -> None:
    out = tmp_path / "hand.yaml"
    out.write_text("name: another", encoding="utf-8")
    with pytest.raises(InvalidInputError) as caught:
        init_hands(THREE_FINGER, out=out)
    assert caught.value.argument == "out"
    assert out.read_text(encoding="utf-8") == "name: another"
    assert init_hands(THREE_FINGER, out=out, overwrite=True).hands[0].hand.joint_names


def test_wrong_arguments_write_nothing(tmp_path: Path) -> None:
    for speed in (0.0, float("nan")):
        with pytest.raises(InvalidInputError) as caught:
            init_hands(THREE_FINGER, out=tmp_path / "hand.yaml", speed=speed)
        assert caught.value.argument == "speed"
    with pytest.raises(HandError):
        init_hands(tmp_path / "absent.urdf", out=tmp_path / "hand.yaml")
    assert not [*tmp_path.iterdir()]


def test_a_description_that_cannot_be_used_is_a_report(tmp_path: Path) -> None:
    file = tmp_path / "hand.yaml"
    file.write_text("name: x", encoding="utf-8")
    report = check_hand(file)
    assert (report.worst, report.hand, report.is_usable) == ("error", None, False)
    assert isinstance(report.error, HandError)
    with pytest.raises(HandError):
        check_robot(tmp_path / "robot.yaml")
