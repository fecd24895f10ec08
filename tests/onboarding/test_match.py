"""`handmap hands match`: the matched posture is solved, printed, drawn and written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from marks import slow

from handmap_qp import InvalidInputError, cli, load_hand
from handmap_qp.apps.onboarding.match import Match, match_hand, own_file, write_matched
from handmap_qp.hands.sources import urdf_directory
from handmap_qp.hands.spec import read_hand_spec

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

ROMEO = urdf_directory() / "romeo_right" / "hand.yaml"
THREE = urdf_directory() / "three_finger" / "hand.yaml"
HUMAN = load_hand("human", points="landmarks")


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A hand.yaml of the user's own, with comments."""
    file = tmp_path / "hand.yaml"
    file.write_text(
        f"# Mine.\nextends: {THREE}  # a hand of the package\nname: mine\n# The end.\n"
    )
    return file


@pytest.mark.parametrize(
    "name", ["romeo_right", "three_finger", "allegro_left", "ur5_allegro"]
)
def test_positions_are_inside_the_limits_and_near_the_solution(name: str) -> None:
    robot = load_hand(name)
    match = match_hand(robot)
    assert (match.q >= robot.lower_limits).all()
    assert (match.q <= robot.upper_limits).all()
    assert [row["joint"] for row in match.rows] == list(robot.spec.joints)
    given = yaml.safe_load(match.text)["matched"]
    assert list(given) == list(robot.spec.joints)
    indices = [robot.joint_names.index(joint) for joint in robot.spec.joints]
    np.testing.assert_array_equal(list(given.values()), match.q[indices])


def test_a_written_posture_is_read_again_and_comments_stay(own: Path) -> None:
    before = own.read_text()
    match = match_hand(load_hand(own))
    write_matched(match, own)
    assert own.read_text().startswith(before)
    matched = load_hand(own).matched
    assert matched is not None
    np.testing.assert_array_equal(matched, match.q)
    assert sorted(own.parent.iterdir()) == [own]


@pytest.mark.parametrize(
    "old",
    [
        "matched:\n  f1: 0.1  # one\n  # two\n  f2: 0.2  # three\n",
        "matched: {f1: 0.1, f2: 0.2}  # one\n",
        "matched: {f1: 0.1,\n  f2: 0.2}\n",
        "'matched': null\n",
        "matched:\n",
    ],
)
@pytest.mark.parametrize("newline", ["\n", slow("\r\n")])
def test_an_existing_posture_is_replaced_in_its_place(
    own: Path, old: str, newline: str
) -> None:
    text = own.read_text()
    around = (text, "\n# About the side.\nside: left  # really\n")
    match = match_hand(load_hand(own))
    own.write_bytes((around[0] + old + around[1]).replace("\n", newline).encode())
    for _ in range(2):
        write_matched(match, own)
        raw = own.read_bytes().decode()
        assert raw == (around[0] + match.text + around[1]).replace("\n", newline)
    assert read_hand_spec(own).matched == {
        row["joint"]: row["matched"] for row in match.rows
    }


def test_a_file_without_a_last_newline_or_of_flow_style_is_safe(own: Path) -> None:
    match = match_hand(load_hand(own))
    own.write_text(f"extends: {THREE}")
    write_matched(match, own)
    assert read_hand_spec(own).matched is not None
    flow = f"{{extends: {THREE}}}\n"
    own.write_text(flow)
    with pytest.raises(InvalidInputError) as caught:
        write_matched(match, own)
    assert caught.value.argument == "--write"
    assert own.read_text() == flow
    assert sorted(own.parent.iterdir()) == [own]


@pytest.mark.slow
def test_a_posture_of_another_hand_is_not_written(own: Path) -> None:
    before = own.read_text()
    with pytest.raises(InvalidInputError, match="is not one of `joints`"):
        write_matched(match_hand(load_hand("romeo_right")), own)
    assert own.read_text() == before


@pytest.mark.parametrize(
    "hand", ["romeo_right", str(ROMEO), str(ROMEO.parent), "nowhere.yaml"]
)
def test_files_of_the_package_are_never_written(hand: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        own_file(hand)
    assert caught.value.argument == "--write"


def test_a_name_of_the_package_is_not_taken_for_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "romeo_right").mkdir()
    (tmp_path / "romeo_right" / "hand.yaml").write_text(f"extends: {ROMEO}\n")
    with pytest.raises(InvalidInputError):
        own_file("romeo_right")
    assert own_file("./romeo_right") == Path("romeo_right/hand.yaml")


def test_a_given_posture_is_shown_beside_the_solved_one(own: Path) -> None:
    solved = match_hand(load_hand(own))
    write_matched(Match(HUMAN, solved.robot, solved.robot.rest), own)
    again = match_hand(load_hand(own))
    np.testing.assert_array_equal(again.q, solved.q)
    assert [row["in hand.yaml"] for row in again.rows] == solved.robot.rest.tolist()


def test_the_persons_hand_is_taken_into_account() -> None:
    robot = load_hand("three_finger")
    with pytest.raises(InvalidInputError):
        match_hand(robot, human_length=-1.0)
    # Thumb and fingers of a real person are longer in proportion than the standard hand's.
    assert (
        np.abs(match_hand(robot, human_length=0.19).q - match_hand(robot).q).max()
        > 0.01
    )


@pytest.mark.slow
def test_the_command_prints_draws_and_writes(
    own: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = own.with_name("match.png")
    command = ["hands", "match", str(own), "--json"]
    assert cli.main([*command, "--write", "--picture", str(picture)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["written"] == [str(picture), str(own)]
    assert picture.read_bytes().startswith(b"\x89PNG")
    matched = read_hand_spec(own).matched
    assert matched == {row["joint"]: row["matched"] for row in document["joints"]}
    assert cli.main(command[:-1]) == 0
    assert "paste into hand.yaml:\nmatched:\n  f1_proximal: " in capsys.readouterr().out
