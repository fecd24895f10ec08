"""Palm axes, side and fingers that are found, on hands with known truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from made_hands import ODDITIES, MadeHand, make_hand, make_odd_hand
from shared_hands import shared_hands_folder
from strategies import generators

from handmap_qp import HandError, load_hand
from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.hands import OTHER_SIDE, Side

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

SHARED = shared_hands_folder()
LEAP_PIP = {"index": "dip", "middle": "dip_2", "ring": "dip_3"}


def found_in(
    made: MadeHand, side: Side | None = None, file: Path = Path("x.urdf")
) -> Detection:
    return detect(file, made.urdf, side=side)


def degrees(one: tuple[float, ...], other: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(np.array(one) @ other, -1.0, 1.0))))


def certain(found: Detection) -> set[str]:
    return {clue.what for clue in found.clues if clue.certainty == "certain"}


def tips(found: Detection) -> dict[str | None, str]:
    return {p.finger: p.link for p in found.spec.points if p.name.endswith("_tip")}


@settings(max_examples=12)
@given(generator=generators)
def test_axes_side_and_fingers_of_hands_made_at_random(
    generator: np.random.Generator,
) -> None:
    made = make_hand(generator)
    found = found_in(made)
    palm = found.spec.palm
    # Directions within 16 degrees of the link's own axes may be taken for these.
    assert degrees(palm.dorsal, made.dorsal) < 17.0
    assert degrees(palm.distal, made.distal) < 17.0
    assert found.spec.side == made.side
    assert tips(found) == made.tips
    if made.is_one_sided:
        assert {"distal", "thumb"} <= certain(found)
        # Two knuckles show no plane.
        assert len(made.tips) < 4 or "dorsal" in certain(found)
    else:
        # Symmetric ranges leave one kind of evidence for the palm's side.
        assert made.has_names or "side" not in certain(found)


def test_axes_of_odd_hands_are_right_and_nothing_wrong_is_certain() -> None:
    for kind in ODDITIES:
        made = make_odd_hand(np.random.default_rng(1), kind)
        found = found_in(made)
        assert degrees(found.spec.palm.dorsal, made.dorsal) < 20.0, kind
        assert degrees(found.spec.palm.distal, made.distal) < 20.0, kind
        assert found.spec.side == made.side or "side" not in certain(found), kind
        is_named = all(
            made.tips.get(str(one)) == tip for one, tip in tips(found).items()
        )
        assert is_named or "fingers" not in certain(found), kind
        assert (
            "thumb" not in certain(found) or tips(found)["thumb"] == made.tips["thumb"]
        ), kind


@pytest.mark.parametrize("seed", [5, 6])
def test_followers_beyond_a_spread_joint_show_the_flexion(seed: int) -> None:
    """The leader is before the spread joint, and its followers beyond: the leader flexes."""
    kind = "coupled"
    made = make_odd_hand(
        np.random.default_rng([0, seed, list(ODDITIES).index(kind)]), kind
    )
    found = found_in(made)
    assert found.spec.side == made.side
    assert degrees(found.spec.palm.dorsal, made.dorsal) < 5.0


def symmetric(has_names: bool) -> MadeHand:
    generator = np.random.default_rng(3)
    while True:
        made = make_hand(generator)
        if not made.is_one_sided and made.has_names == has_names:
            return made


def test_a_given_side_turns_the_palm_over_and_renames_no_finger(tmp_path: Path) -> None:
    made, file = symmetric(has_names=False), tmp_path / "hand.urdf"
    file.write_text(made.urdf)
    other = OTHER_SIDE[made.side]
    right, wrong = found_in(made, made.side, file), found_in(made, other, file)
    assert (wrong.spec.side, tips(wrong)) == (other, tips(right))
    np.testing.assert_allclose(
        wrong.spec.palm.dorsal, -np.array(right.spec.palm.dorsal)
    )
    # The fingers rest on the palm's side, whichever that is.
    for found in (right, wrong):
        hand = load_hand(found.spec)
        moved = hand.points(hand.rest) - hand.points(np.zeros(len(hand.rest)))
        assert moved[1] @ np.array(found.spec.palm.dorsal) < -0.01


def test_a_side_that_contradicts_clear_flexion_is_a_guess() -> None:
    generator = np.random.default_rng(5)
    made = make_hand(generator)
    while not made.is_one_sided or made.has_names:
        made = make_hand(generator)
    found = found_in(made, OTHER_SIDE[made.side])
    assert {"side", "dorsal", "rest"}.isdisjoint(certain(found))
    how = next(clue.how for clue in found.clues if clue.what == "side")
    assert f"suggest {made.side}" in how


def test_what_is_derived_is_not_surer() -> None:
    generator = np.random.default_rng(11)
    for _ in range(6):
        sure = {
            clue.what: clue.confidence for clue in found_in(make_hand(generator)).clues
        }
        assert sure["rest"] <= sure["dorsal"]
        assert sure["palm origin"] <= sure["distal"]
        assert sure["index_tip"] <= max(sure["fingers"], 0.3)


@pytest.mark.skipif(
    SHARED is None, reason="LEAP and SVH are not here: set HANDMAP_HANDS"
)
@pytest.mark.parametrize("side", ["right", "left"])
def test_leap_is_as_its_drawing_says(side: str) -> None:
    assert SHARED is not None
    found = detect(SHARED / "leap_hand" / f"leap_hand_{side}.urdf")
    assert (found.spec.palm.distal, found.spec.palm.dorsal) == ((1, 0, 0), (0, 0, 1))
    assert found.spec.side == side
    points = {point.name: point for point in found.spec.points}
    for finger, link in LEAP_PIP.items():
        # The joint's axis passes 15 mm beside the link's origin, in the finger's plane.
        assert points[f"{finger}_pip"].link == link
        assert points[f"{finger}_pip"].xyz[2] == pytest.approx(0.015, abs=0.001)
    assert points["thumb_ip"].link.startswith("thumb_fingertip")
    # Abduction joints rest at zero; a thumb's base joint that moves the tip as flexion does bends.
    assert all(abs(found.spec.rest[joint]) < 1e-9 for joint in ("0", "4", "8"))
    assert found.spec.rest["13"] < -0.1


@pytest.mark.skipif(
    SHARED is None, reason="LEAP and SVH are not here: set HANDMAP_HANDS"
)
def test_svh_is_as_its_drawing_says() -> None:
    assert SHARED is not None
    found = detect(SHARED / "schunk_hand" / "schunk_svh_hand_right.urdf")
    assert (found.spec.palm.distal, found.spec.palm.dorsal) == ((0, 0, 1), (0, -1, 0))
    links = {point.name: point.link for point in found.spec.points}
    # The first ring and little joints spread; c is the thumb's last link.
    assert (links["ring_pip"], links["little_pip"]) == ("right_hand_n", "right_hand_m")
    assert links["thumb_ip"] == "right_hand_c"
    hand = load_hand(found.spec)
    names = [point.name for point in hand.reference_points]
    last = hand.link_poses(["right_hand_t"], hand.rest)[0, :3, 3]
    tip = hand.points(hand.rest)[names.index("index_tip")]
    assert np.linalg.norm(tip - last) == pytest.approx(0.0225, abs=0.001)


def two_hands(apart: float) -> str:
    generator = np.random.default_rng(1)
    parts, links = [], []
    for k in range(2):
        made = make_hand(generator)
        text = made.urdf[made.urdf.index(">") + 1 : made.urdf.rindex("</robot>")]
        parts.append(
            text.replace('name="', f'name="h{k}').replace('link="', f'link="h{k}')
        )
        links.append(f"h{k}{made.palm}")
        parts.append(
            f'<joint name="on{k}" type="fixed"><parent link="base"/><child link="{links[k]}"/>'
            f'<origin xyz="{k * apart} 0 0"/></joint>'
        )
    return f'<robot name="two"><link name="base"/>{"".join(parts)}</robot>'


def test_two_hands_on_one_base_are_refused() -> None:
    text = two_hands(0.6)
    with pytest.raises(
        HandError, match=r"two hands on one base: .*; choose one with --root"
    ) as e:
        detect(Path("two.urdf"), text)
    for link in e.value.value:
        assert detect(Path("two.urdf"), text, root=link).spec.palm.link == link


def test_wrist_joints_that_are_left_out_are_named_with_the_option() -> None:
    made = make_hand(np.random.default_rng(2))
    above = (
        '<link name="forearm"/><joint name="WRJ1" type="revolute"><parent link="forearm"/>'
        f'<child link="{made.palm}"/><origin xyz="0 0 0.03"/><axis xyz="1 0 0"/>'
        '<limit lower="-0.5" upper="0.5" effort="1" velocity="2"/></joint>'
    )
    text = made.urdf.replace("</robot>", above + "</robot>")
    found = detect(Path("x.urdf"), text)
    assert "WRJ1" not in found.spec.joints
    assert any("WRJ1" in note and "--base forearm" in note for note in found.notes)
    kept = detect(Path("x.urdf"), text, base="forearm")
    assert "WRJ1" in kept.spec.joints
    assert not any("--base" in note for note in kept.notes)


def test_notes_about_many_joints_are_one() -> None:
    made = make_hand(np.random.default_rng(4))
    found = detect(Path("x.urdf"), made.urdf.replace(' velocity="5"', ""))
    speeds = [note for note in found.notes if "speed limit" in note]
    assert len(speeds) == 1
    assert "each has no speed limit" in speeds[0]


def test_a_name_has_its_side_once() -> None:
    made = make_hand(np.random.default_rng(6))
    robot = made.urdf.replace(
        made.urdf.partition('"')[2].partition('"')[0], "shadow_right", 1
    )
    above = (
        '<link name="arm"/><joint name="A1" type="revolute"><parent link="arm"/>'
        f'<child link="{made.palm}"/><axis xyz="1 0 0"/>'
        '<limit lower="-0.5" upper="0.5" effort="1" velocity="2"/></joint>'
    )
    text = robot.replace("</robot>", above + "</robot>")
    assert detect(Path("x.urdf"), text, side="right").spec.name == "shadow_right"


def test_a_visual_fingertip_has_the_pad_that_collision_shapes_would_show() -> None:
    made = make_hand(np.random.default_rng(2))
    ball = "<geometry><sphere radius='0.008'/></geometry>"
    pads = {}
    for kind in ("visual", "collision"):
        text = made.urdf
        for tip in made.tips.values():
            shape = f'<link name="{tip}"><{kind}>{ball}</{kind}></link>'
            text = text.replace(f'<link name="{tip}"/>', shape)
        points = detect(Path("x.urdf"), text).spec.points
        pads[kind] = [point.pad for point in points if point.name.endswith("_tip")]
    assert pads["collision"] == [None] * len(made.tips)
    for pad in pads["visual"]:
        assert pad is not None
        assert pad.radius == pytest.approx(0.008, abs=3e-4)
        np.testing.assert_allclose(pad.xyz, 0.0, atol=3e-4)
