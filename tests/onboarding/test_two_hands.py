"""Two hands of a robot: their sides by names or places, on a rigid base, and beside other limbs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from box_hands import NAMES, BoxHand

from handmap_qp import HandError, init_hands
from handmap_qp.apps.onboarding.detect import detect, detect_hands
from handmap_qp.apps.onboarding.two_hands import side_by_difference
from handmap_qp.hands import load_robot

PLAIN = tuple("abcde")


def _joint(name: str, parent: str, child: str, place: str, kind: str) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{place}"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )


def _two(
    prefixes: tuple[str, str] = ("left_", "right_"),
    places: tuple[str, str] = ("0 .3 0", "0 -.3 0"),
    *,
    names: tuple[str, ...] = NAMES,
    is_mirrored: bool = True,
    kind: str = "revolute",
) -> str:
    """Return two hands on a base; the second one is a right hand, and the first one its mirror."""
    text = '<link name="base"/>'
    for k, (prefix, place) in enumerate(zip(prefixes, places, strict=True)):
        hand = BoxHand(
            names=tuple(f"{prefix}{name}" for name in names),
            palm=f"{prefix}base_link",
            turn=np.eye(3),
            is_left=is_mirrored and k == 0,
        )
        text += hand.parts() + _joint(f"{prefix}arm", "base", hand.palm, place, kind)
    return f'<robot name="x">{text}</robot>'


def _found(folder: Path, text: str) -> dict[str, tuple[str, str]]:
    """Return the palm and the certainty of the side, by side."""
    file = folder / "two.urdf"
    file.write_text(text, encoding="utf-8")
    return {
        one.spec.side: (
            one.spec.palm.link,
            next(clue.certainty for clue in one.clues if clue.what == "side"),
        )
        for one in detect_hands(file)
    }


@pytest.mark.parametrize(("one", "other", "side"), [
    (["gripper_l_base"], ["gripper_r_base"], "left"),
    (["rhand", "rthumb"], ["lhand", "lthumb"], "right"),
    (["LeftThumb_1"], ["RightThumb_1"], "left"),
    (["handr_finger"], ["handl_finger"], "right"),
    # Jaws of both, and a maker's name.
    (["arm_l_rh_p12_r1", "arm_l_rh_p12_l1"], ["arm_r_rh_p12_r1", "arm_r_rh_p12_l1"], "left"),
    (["one_palm"], ["two_palm"], None),
    (["l_jaw", "r_jaw"], ["l_jaw_2", "r_jaw_2"], None),
])  # fmt: skip
def test_the_token_in_which_names_differ_is_the_side(
    one: list[str], other: list[str], side: str | None
) -> None:
    opposite = {"left": "right", "right": "left", None: None}
    assert side_by_difference(one, other) == side
    assert side_by_difference(other, one) == opposite[side]


@pytest.mark.parametrize("is_mirrored", [True, False])
def test_names_tell_two_hands_apart_though_they_are_alike(
    tmp_path: Path, is_mirrored: bool
) -> None:
    text = _two(("gripper_l_", "gripper_r_"), is_mirrored=is_mirrored)
    found = _found(tmp_path, text)
    assert {side: palm for side, (palm, _) in found.items()} == {
        "left": "gripper_l_base_link",
        "right": "gripper_r_base_link",
    }
    # Two right hands are no left and right one for certain.
    assert found["left"][1].startswith("certain" if is_mirrored else "a guess")
    assert found["right"][1] == "certain"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_places_tell_two_hands_apart_whose_names_do_not(
    tmp_path: Path, sign: float
) -> None:
    places = f"0 {0.3 * sign} 0", f"0 {-0.3 * sign} 0"
    text = _two(("one_", "two_"), places, names=PLAIN, is_mirrored=False)
    left = "one_" if sign > 0.0 else "two_"
    assert _found(tmp_path, text)["left"][0] == f"{left}base_link"


def test_two_alike_hands_that_nothing_tells_apart_are_named(tmp_path: Path) -> None:
    places = "0.3 0 0", "-0.3 0 0"
    text = _two(("one_", "two_"), places, names=PLAIN, is_mirrored=False)
    problem = r"one_base_link and two_base_link both look like right hands; .*--side"
    with pytest.raises(HandError, match=problem):
        _found(tmp_path, text)


def test_two_hands_on_one_rigid_base_are_a_robot(tmp_path: Path) -> None:
    file = tmp_path / "two.urdf"
    file.write_text(_two(kind="fixed"), encoding="utf-8")
    result = init_hands(file, out=tmp_path / "hand.yaml")
    assert [each.hand.side for each in result.hands] == ["left", "right"]
    for each in result.hands:
        assert not each.hand.is_floating
        assert each.hand.spec.palm.link == f"{each.hand.side}_base_link"
        assert len(each.hand.joint_names) == 10
        assert any("its wrist does not move" in note for note in each.notes)
    assert len(load_robot(result.file).joint_names) == 20
    # One of them alone is chosen as before.
    with pytest.raises(HandError, match="two hands on one base"):
        detect(file)


def _with(text: str, *parts: str) -> str:
    return text.replace("</robot>", "".join(parts) + "</robot>")


def _chain(names: list[str], place: str, kind: str = "revolute") -> str:
    """Return links with a box each, one on the other, from the base."""
    text, parent = "", "base"
    for name in names:
        text += (
            f'<link name="{name}"><visual><origin xyz=".03 0 0"/><geometry>'
            '<box size=".06 .02 .02"/></geometry></visual></link>'
        )
        text += _joint(f"{name}_joint", parent, name, place, kind)
        parent, place = name, "0.05 0 0"
    return text


@pytest.mark.parametrize(("parts", "kind"), [
    ([["front_caster", "front_wheel"], ["back_caster", "back_wheel"]], "revolute"),
    # Wheels on swivels, by joints that turn without end.
    ([["a1", "a2"], ["b1", "b2"], ["c1", "c2"]], "continuous"),
    ([["l_foot", "l_toe"], ["r_foot", "r_toe"]], "revolute"),
    ([["left_shoulder", "x1"], ["right_shoulder", "x2"]], "revolute"),
])  # fmt: skip
def test_casters_feet_and_arms_are_no_fingers(
    tmp_path: Path, parts: list[list[str]], kind: str
) -> None:
    """They branch from the base beside both arms, or from another link."""
    more = [_chain(names, f"0 {0.1 * k} -.1", kind) for k, names in enumerate(parts)]
    stand = '<link name="stand"/>' + _joint("lift", "stand", "base", "0 0 0", "fixed")
    for text in (_two(), _two(kind="fixed")):
        assert _found(tmp_path, _with(text, *more, stand)) == _found(tmp_path, text)
    alone = f'<robot name="x"><link name="base"/>{"".join(more)}</robot>'
    with pytest.raises(HandError, match="none of which branches into fingers"):
        _found(tmp_path, alone)


def test_the_screw_of_a_hand_is_no_finger(tmp_path: Path) -> None:
    text = BoxHand(turn=np.eye(3)).urdf()
    screw = re.sub("base", "palm", _chain(["lead_screw"], "0.02 0 0.03"))
    found = detect(tmp_path / "x", _with(text, screw))
    assert {*found.chains} == {*NAMES}
    assert "lead_screw_joint" in found.spec.locked


def test_what_is_named_as_a_hand_is_the_palm(tmp_path: Path) -> None:
    """Another body that branches alike, and is named as nothing, is none."""
    hand = BoxHand(names=PLAIN, palm="hand_base", turn=np.eye(3))
    other = BoxHand(
        names=tuple(f"s{name}" for name in PLAIN), palm="m7", turn=np.eye(3)
    )
    parts = hand.parts() + other.parts()
    for palm, place in ((hand.palm, "0 .3 0"), (other.palm, "0 -.3 0")):
        parts += _joint(f"to_{palm}", "base", palm, place, "revolute")
    file = tmp_path / "x.urdf"
    file.write_text(f'<robot name="x"><link name="base"/>{parts}</robot>')
    (found,) = detect_hands(file)
    assert found.spec.palm.link == "hand_base"
