"""`handmap hands match`: the matched posture is solved, printed and drawn."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from handmap_qp import InvalidInputError, cli, load_hand
from handmap_qp.apps.onboarding.match import Match, match_hand
from handmap_qp.hands.sources import urdf_directory

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

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
    given = yaml.safe_load(match.text)["neutral_match"]
    assert list(given) == list(robot.spec.joints)
    indices = [robot.joint_names.index(joint) for joint in robot.spec.joints]
    np.testing.assert_array_equal(list(given.values()), match.q[indices])


def test_a_pasted_posture_is_read_again(own: Path) -> None:
    match = match_hand(load_hand(own))
    own.write_text(own.read_text() + match.text)
    matched = load_hand(own).neutral_match
    assert matched is not None
    np.testing.assert_array_equal(matched, match.q)


def test_a_given_posture_is_shown_beside_the_solved_one(own: Path) -> None:
    solved = match_hand(load_hand(own))
    at_rest = Match(HUMAN, solved.robot, solved.robot.rest)
    own.write_text(own.read_text() + at_rest.text)
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
def test_the_command_prints_and_draws(
    own: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = own.with_name("match.png")
    command = ["hands", "match", str(own), "--json"]
    assert cli.main([*command, "--picture", str(picture)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["written"] == [str(picture)]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert cli.main(command[:-1]) == 0
    assert (
        "paste into hand.yaml:\nneutral_match:\n  f1_proximal: "
        in capsys.readouterr().out
    )
