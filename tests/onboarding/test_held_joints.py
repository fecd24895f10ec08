"""Joints of an MJCF that no mimic rule describes are held, and `init` and `check` say why."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from made_loops import FINGERS, four_bars, pushed_fingers, tendons

from handmap_qp import load_hand
from handmap_qp.apps.onboarding.check import check_hand, check_held
from handmap_qp.apps.onboarding.init import DescribedHand, init_hands
from handmap_qp.errors import HandError
from handmap_qp.hands import LimitSpec, MimicSpec, held_joints, parse_urdf

pytestmark = pytest.mark.slow

# The distal joints end at 1.6 rad, and would begin at 2.5 rad.
CONTRADICTED = tendons(offset=2.5)
DISTAL = [f"{finger}_distal" for finger in FINGERS]


def _described(folder: Path, text: str) -> DescribedHand:
    file = folder / "held.xml"
    file.write_text(text, encoding="utf-8")
    (hand,) = init_hands(file, out=folder / "hand.yaml", overwrite=True).hands
    return hand


def test_init_says_what_a_contradicted_coupling_holds_and_the_next_step(
    tmp_path: Path,
) -> None:
    found = _described(tmp_path, CONTRADICTED)
    for joint in DISTAL:
        (note,) = (note for note in found.notes if note.startswith(f"{joint} is held"))
        assert "held at 1.6" in note
        assert "1 * " in note
        assert "+ 2.5" in note
        assert "outside of its limits [-0.3, 1.6]" in note
        assert "correct its range or the coupling in the MJCF file" in note
    # The file that is written says it too.
    assert "is held at 1.6" in found.file.read_text(encoding="utf-8")


def test_check_warns_of_what_a_contradicted_coupling_holds(tmp_path: Path) -> None:
    report = check_hand(_described(tmp_path, CONTRADICTED).file, has_motion=False)
    found = {one.key: one for one in report.findings if one.key.startswith("locked.")}
    assert {*found} == {f"locked.{joint}" for joint in DISTAL}
    for one in found.values():
        assert one.level == "warning"
        assert "outside of its limits" in one.text
        assert "`mimic` in place of `locked`" in one.change
    assert not report.is_usable


def test_the_next_step_ends_the_warning(tmp_path: Path) -> None:
    """Couple the joints under `mimic` with their true limits, in place of `locked`."""
    spec = _described(tmp_path, CONTRADICTED).hand.spec
    repaired = msgspec.structs.replace(
        spec,
        locked={},
        mimic={
            f"{name}_distal": MimicSpec(f"{name}_proximal", 1.0) for name in FINGERS
        },
        limits={**spec.limits, **dict.fromkeys(DISTAL, LimitSpec(-0.3, 1.6))},
    )
    hand = load_hand(repaired)
    assert [*check_held(hand)] == []
    assert not hand.notes
    followers = zip(hand.all_joint_names, hand.all_joint_roles, strict=True)
    assert {name for name, role in followers if role == "follower"} == {*DISTAL}


def test_a_coupling_within_its_limits_holds_nothing(tmp_path: Path) -> None:
    for text in (tendons(), four_bars()):
        found = _described(tmp_path, text)
        assert [*check_held(found.hand)] == []
        assert not any("is held" in note for note in found.notes)


@pytest.mark.parametrize("kind", ["loop", "motor"])
def test_what_a_urdf_cannot_say_is_no_contradiction(kind: str, tmp_path: Path) -> None:
    found = _described(tmp_path, CONTRADICTED)
    urdf = tmp_path / "held.urdf"
    text = urdf.read_text(encoding="utf-8").replace('"limits"', f'"{kind}"')
    urdf.write_text(text, encoding="utf-8")
    findings = [*check_held(load_hand(found.file))]
    assert [one.level for one in findings] == ["advice"] * len(DISTAL)
    assert all("couple it under `mimic`" in one.change for one in findings)


def test_init_says_that_no_motor_moves_a_joint(tmp_path: Path) -> None:
    """One motor of two bends and spreads a finger."""
    text = pushed_fingers().replace('<position joint="index_crank1"/>', "")
    notes = _described(tmp_path, text).notes
    (note,) = (note for note in notes if "no motor moves it" in note)
    assert note.startswith("index_")


def test_check_says_nothing_of_bars_that_are_held(tmp_path: Path) -> None:
    """Cranks and rods follow two joints at once, which no line describes."""
    found = _described(tmp_path, pushed_fingers())
    assert any("_crank0" in joint for joint in found.hand.spec.locked)
    assert [*check_held(found.hand)] == []


def test_a_refusal_says_why_joints_are_held(tmp_path: Path) -> None:
    """The only joints of the hand contradict what they follow."""
    text = CONTRADICTED.replace('range="0.0 1.2"', 'range="0.3 0.3000001"')
    with pytest.raises(HandError, match=r"is held at 1\.6") as caught:
        _described(tmp_path, text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("attributes", ["", 'kind="x"', 'why="y"', 'kind="limits"'])
def test_other_elements_of_that_name_are_no_error(attributes: str) -> None:
    robot = parse_urdf(
        f'<robot name="a"><joint name="j" type="fixed"><held {attributes}/></joint></robot>'
    )
    found = held_joints(robot)
    assert {*found} == ({"j"} if "limits" in attributes else set())
