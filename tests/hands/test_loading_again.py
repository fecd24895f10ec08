"""A hand that is loaded by name again is the same, its caller's own, and follows its files."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from handmap_qp import Hand, HandError, load_hand
from handmap_qp.hands import library, load_robot, read_hand_spec
from handmap_qp.hands.library import missing_hands
from handmap_qp.hands.sources import urdf_directory
from handmap_qp.hands.urdf import parse_urdf

NAME = "three_finger"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which a hand of the package has its name, and may be changed."""
    shutil.copytree(urdf_directory() / NAME, tmp_path / NAME)
    monkeypatch.setattr(library, "urdf_directory", lambda: tmp_path)
    return tmp_path / NAME


def edited(file: Path, change: Callable[[str], str]) -> None:
    before = file.read_text(encoding="utf-8")
    after = change(before)
    assert after != before
    file.write_text(after, encoding="utf-8")


def test_it_is_the_same_hand() -> None:
    first, again = load_hand(NAME), load_hand(NAME)
    assert again is not first
    assert again.spec == first.spec
    assert again.urdf_text == first.urdf_text
    np.testing.assert_array_equal(again.points(again.rest), first.points(first.rest))
    assert load_hand(NAME, mount="fixed").mount == "fixed"
    assert load_hand(NAME).mount == first.mount


def test_what_its_user_changes_changes_no_other() -> None:
    first = load_hand(NAME)
    limits, speeds = first.upper_limits.copy(), dict(first.spec.limits)
    first.model.upperPositionLimit[:] = 0.0
    first.model.names[1] = "changed"
    first.spec.rest.clear()
    first.spec.limits.clear()
    again = load_hand(NAME)
    assert (again.model.upperPositionLimit[again.q_indices] == limits).all()
    assert again.model.names[1] != "changed"
    assert again.spec.rest.keys() == {*again.joint_names}
    assert again.spec.limits == speeds


def test_a_document_and_a_robot_are_their_readers_own() -> None:
    file = urdf_directory() / NAME / "hand.yaml"
    spec = read_hand_spec(file)
    spec.sets.clear()
    assert read_hand_spec(file).sets
    text = load_hand(NAME).urdf_text
    parse_urdf(text).clear()
    assert len(parse_urdf(text))


def urdf_of(hand: Hand) -> Path:
    """Return the file of a hand's URDF."""
    return Path(hand.spec.directory or "", hand.spec.urdf)


def test_a_changed_description_is_read_again(folder: Path) -> None:
    assert load_hand(NAME).side == "right"
    edited(folder / "hand.yaml", lambda text: text.replace("side: right", "side: left"))
    assert load_hand(NAME).side == "left"


def test_a_changed_robot_is_read_again(folder: Path) -> None:
    before = load_hand(NAME)
    joint = before.joint_names[0]
    edited(
        urdf_of(before),
        lambda text: text.replace(f'name="{joint}"', 'name="renamed"'),
    )
    with pytest.raises(HandError, match="renamed"):
        load_hand(NAME)


def test_a_lost_robot_is_an_error_and_missing(folder: Path) -> None:
    hand = load_hand(NAME)
    assert not missing_hands()
    urdf_of(hand).unlink()
    with pytest.raises(HandError, match="cannot be read"):
        load_hand(NAME)
    assert missing_hands() == {NAME: "its URDF is missing"}


def test_a_hand_that_is_described_anew_is_no_more_missing(folder: Path) -> None:
    urdf = load_hand(NAME).spec.urdf
    lost = urdf.replace(".urdf", "_lost.urdf")
    edited(folder / "hand.yaml", lambda text: text.replace(urdf, lost))
    assert [*missing_hands()] == [NAME]
    edited(folder / "hand.yaml", lambda text: text.replace(lost, urdf))
    assert not missing_hands()


def test_its_notes_are_said_each_time(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("handmap_qp.hands.hand.tighten_model", lambda *_: ("is odd",))
    for _ in range(2):
        with pytest.warns(UserWarning, match=f"{NAME}: is odd"):
            load_hand(NAME)


def test_a_robot_is_the_same_and_its_users_own() -> None:
    first = load_robot("g1")
    text, speeds = first.urdf_text, first.velocity_limits.copy()
    for hand in first.hands:
        hand.model.velocityLimit[:] = 0.0
        hand.spec.rest.clear()
    again = load_robot("g1")
    assert again is not first
    assert again.urdf_text == text
    assert [hand.side for hand in again.hands] == [hand.side for hand in first.hands]
    for hand in (again, *again.hands):
        assert (hand.model.velocityLimit[hand.v_indices] == speeds).all()
        assert hand.spec.rest.keys() == {*hand.joint_names}
    assert again.has_floating_base == first.has_floating_base


@pytest.fixture
def pair(folder: Path) -> Path:
    """The description of a robot that has a name, with the hand that may be changed."""
    file = folder.parent / "pair" / "robot.yaml"
    file.parent.mkdir()
    text = f"name: pair\nhands:\n  right: {{hand: {NAME}}}\n"
    file.write_text(text, encoding="utf-8")
    assert load_robot("pair").name == load_robot("pair").name == "pair"
    return file


def test_a_changed_robot_with_hands_is_read_again(pair: Path) -> None:
    edited(pair, lambda text: text.replace("name: pair", "name: other"))
    assert load_robot("pair").name == "other"


def test_a_robot_whose_hand_changes_is_read_again(pair: Path, folder: Path) -> None:
    edited(folder / "hand.yaml", lambda text: text.replace("side: right", "side: left"))
    with pytest.raises(HandError, match="is a left hand"):
        load_robot("pair")


def test_a_robot_whose_urdf_changes_is_read_again(pair: Path, folder: Path) -> None:
    joint = load_robot("pair").joint_names[0]
    edited(
        folder / "hand.urdf",
        lambda text: text.replace(f'name="{joint}"', 'name="renamed"'),
    )
    with pytest.raises(HandError, match="renamed"):
        load_robot("pair")


def test_a_hand_is_read_again_when_the_file_that_it_extends_changes(
    folder: Path,
) -> None:
    (folder.parent / "mine").mkdir()
    (folder.parent / "mine" / "hand.yaml").write_text(
        f"extends: ../{NAME}/hand.yaml\nname: mine\n", encoding="utf-8"
    )
    assert load_hand("mine").side == "right"
    edited(folder / "hand.yaml", lambda text: text.replace("side: right", "side: left"))
    assert load_hand("mine").side == "left"
