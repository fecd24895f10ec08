"""Fingers with one joint each, as of prostheses and of the cheapest hands: straight at zero."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_hands import NAMES, BoxHand, pair_against_one, turns

from handmap_qp.apps.onboarding.detect import Detection, detect

PLAIN = tuple("abcde")


def _dorsal_and_distal(found: Detection, hand: BoxHand) -> np.ndarray:
    """Return both directions in the hand's own axes, shape (2, 3)."""
    palm = found.spec.palm
    return np.array([palm.dorsal, palm.distal]) @ hand.turn


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_such_a_hand_is_straight_at_zero_however_its_axes_lie(sense: float) -> None:
    for k, turn in enumerate(turns()):
        hand = BoxHand(
            names=PLAIN, joints=1, sense=sense, turn=turn, is_left=k % 2 == 1
        )
        found = detect(Path("x"), hand.urdf())
        expected = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
        np.testing.assert_allclose(_dorsal_and_distal(found, hand), expected, atol=1e-6)
        assert found.spec.side == ("left" if hand.is_left else "right")
        assert [joint for joint, *_ in found.chains.values()] == [
            f"{name}_0_joint" for name in PLAIN
        ]
        # Half open: towards the end of the range that is not zero.
        assert all(0.2 < sense * at < 1.0 for at in found.spec.rest.values())


@pytest.mark.parametrize("span", [(-0.1, 1.2), (0.0, 1.6), (-0.3, 1.2), (-0.5, 1.2)])
@pytest.mark.parametrize("place", [(0.02, 0.05, -0.01), (0.09, 0.05, 0.0)])
def test_a_joint_may_stretch_beyond_zero(
    span: tuple[float, float], place: tuple[float, float, float]
) -> None:
    hand = BoxHand(joints=1, span=span, thumb=place, turn=np.eye(3))
    found = detect(Path("x"), hand.urdf())
    expected = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    np.testing.assert_allclose(_dorsal_and_distal(found, hand), expected, atol=1e-6)
    assert found.spec.side == "right"


@pytest.mark.parametrize("is_open", [True, False])
def test_jaws_that_are_parallel_at_zero_close_all_the_same(is_open: bool) -> None:
    text = pair_against_one() if is_open else pair_against_one(gap=0.01, sense=-1.0)
    found = detect(Path("x"), text)
    assert found.chains["thumb"] == ("jc", "jc")
    # The back is away from the thumb, and the rest is between open and closed.
    assert found.spec.palm.dorsal[2] > 0.8
    assert found.spec.palm.distal[0] > 0.8
    assert all(0.0 < at < 0.5 for at in found.spec.rest.values())


def test_a_row_with_even_ranges_is_straight_at_zero() -> None:
    """Nothing says to which side they flex, but no gripper has five jaws in a row."""
    for names in (PLAIN, NAMES):
        hand = BoxHand(names=names, joints=1, span=(-0.6, 0.6), turn=np.eye(3))
        found = detect(Path("x"), hand.urdf())
        dorsal, distal = _dorsal_and_distal(found, hand)
        np.testing.assert_allclose(distal, [1.0, 0.0, 0.0], atol=1e-6)
        assert abs(dorsal[2]) > 0.99
        (clue,) = (clue for clue in found.clues if clue.what == "dorsal")
        assert clue.confidence < 0.6


@pytest.mark.parametrize("span", [(-0.5, 0.0), (-0.7, 0.3), (-0.25, 0.25)])
def test_a_pair_against_one_points_along_the_middle(span: tuple[float, float]) -> None:
    """They are open at an end of their ranges, where each side leans outwards."""
    found = detect(Path("x"), pair_against_one(span=span))
    assert found.chains["thumb"] == ("jc", "jc")
    np.testing.assert_allclose(found.spec.palm.distal, [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(found.spec.palm.dorsal, [0.0, 0.0, 1.0], atol=1e-6)


def test_the_kind_of_fingers_can_be_given() -> None:
    text = BoxHand(names=PLAIN, joints=1, turn=np.eye(3)).urdf()
    found, fingers, jaws = (
        detect(Path("x"), text, kind=kind) for kind in (None, "fingers", "jaws")
    )
    assert fingers.spec == found.spec
    assert jaws.spec.palm.distal != found.spec.palm.distal
    # It says nothing of fingers that curl.
    curled = BoxHand(turn=np.eye(3)).urdf()
    assert detect(Path("x"), curled, kind="jaws").spec == detect(Path("x"), curled).spec


def test_a_thumb_by_name_beside_one_finger_is_no_jaw() -> None:
    """A mitten: all fingers are one body."""
    for k, turn in enumerate(turns()):
        if k % 4 == 0:
            hand = BoxHand(names=("thumb", "fingers"), joints=1, turn=turn)
            found = detect(Path("x"), hand.urdf())
            expected = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
            np.testing.assert_allclose(
                _dorsal_and_distal(found, hand), expected, atol=1e-6
            )


def test_jaws_whose_slides_start_beyond_their_tips_lie_ahead() -> None:
    jaws = "".join(
        f'<link name="{name}"><visual><origin xyz="-.04 0 0"/><geometry>'
        f'<box size=".08 .01 .02"/></geometry></visual></link>'
        f'<joint name="{name}" type="prismatic"><parent link="base"/><child link="{name}"/>'
        f'<origin xyz=".17 {y} 0"/><axis xyz="0 {-np.sign(y)} 0"/>'
        '<limit lower="0" upper=".04" effort="1" velocity="1"/></joint>'
        for name, y in (("one", 0.05), ("other", -0.05))
    )
    found = detect(Path("x"), f'<robot name="x"><link name="base"/>{jaws}</robot>')
    assert found.spec.palm.distal[0] > 0.9


@pytest.mark.parametrize("lean", [-0.85, -1.0])
def test_jaws_that_lean_far_apart_point_along_the_middle(lean: float) -> None:
    """Tips that lean far apart move ahead as they close: that is not the way they meet."""
    found = detect(Path("x"), pair_against_one(span=(0.05, 1.2), lean=lean))
    np.testing.assert_allclose(found.spec.palm.distal, [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(found.spec.palm.dorsal, [0.0, 0.0, 1.0], atol=1e-6)
    (clue,) = (clue for clue in found.clues if clue.what == "distal")
    assert clue.confidence < 0.6


@pytest.mark.parametrize("lean", [0.55, 0.7])
def test_jaws_that_cross_at_zero_open_from_there(lean: float) -> None:
    """Tips that lean to each other at zero move ahead as they open: they still go apart."""
    text = pair_against_one(gap=0.05, span=(0.0, 1.5), sense=-1.0, lean=lean)
    found = detect(Path("x"), text)
    assert found.kind == "jaws"
    np.testing.assert_allclose(found.spec.palm.distal, [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(found.spec.palm.dorsal, [0.0, 0.0, 1.0], atol=1e-6)


@pytest.mark.parametrize("slower", [0.1, 0.5])
def test_a_jaw_that_overtakes_the_other_one_closes_on_it(slower: float) -> None:
    """One joint moves both the same way: only the difference of their motions closes them."""
    jaws = "".join(
        f'<link name="{name}"><visual><origin xyz=".05 0 {z}"/><geometry>'
        f'<box size=".1 .02 .01"/></geometry></visual></link>'
        f'<joint name="{name}" type="prismatic"><parent link="base"/><child link="{name}"/>'
        f'<axis xyz="0 0 -1"/><limit lower="0" upper=".05" effort="1" velocity="1"/>'
        f"{mimic}</joint>"
        for name, z, mimic in (
            ("fast", 0.04, ""),
            ("slow", -0.04, f'<mimic joint="fast" multiplier="{slower}"/>'),
        )
    )
    found = detect(Path("x"), f'<robot name="x"><link name="base"/>{jaws}</robot>')
    # The back of the other jaw is away from the thumb.
    thumb = next(point.link for point in found.spec.points if point.finger == "thumb")
    away = -1.0 if thumb == "fast" else 1.0
    assert found.spec.palm.dorsal[2] * away > 0.9
