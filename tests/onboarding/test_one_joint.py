"""Fingers with one joint each, as of prostheses and of the cheapest hands: straight at zero."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_hands import BoxHand, turns

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


@pytest.mark.parametrize("span", [(-0.1, 1.2), (0.0, 1.6)])
@pytest.mark.parametrize("place", [(0.02, 0.05, -0.01), (0.09, 0.05, 0.0)])
def test_a_joint_may_stretch_a_little_beyond_zero(
    span: tuple[float, float], place: tuple[float, float, float]
) -> None:
    hand = BoxHand(joints=1, span=span, thumb=place, turn=np.eye(3))
    found = detect(Path("x"), hand.urdf())
    expected = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    np.testing.assert_allclose(_dorsal_and_distal(found, hand), expected, atol=1e-6)
    assert found.spec.side == "right"


def _gripper(is_open: bool) -> str:
    """Return two jaws beside each other against a third one, with boxes along x.

    They turn to each other from zero, or away from each other.
    """
    parts = '<link name="base"/>'
    for name, y, z in (("a", 0.02, 0.03), ("b", -0.02, 0.03), ("c", 0.0, -0.03)):
        inwards = np.sign(z) * (1.0 if is_open else -1.0)
        parts += (
            f'<link name="{name}"><visual><origin xyz=".04 0 0"/><geometry>'
            f'<box size=".08 .02 .01"/></geometry></visual></link>'
            f'<joint name="j{name}" type="revolute"><parent link="base"/><child link="{name}"/>'
            f'<origin xyz=".05 {y} {z if is_open else z / 3}"/><axis xyz="0 {inwards} 0"/>'
            '<limit lower="0" upper=".5" effort="1" velocity="2"/></joint>'
        )
    return f'<robot name="x">{parts}</robot>'


@pytest.mark.parametrize("is_open", [True, False])
def test_jaws_that_are_parallel_at_zero_close_all_the_same(is_open: bool) -> None:
    found = detect(Path("x"), _gripper(is_open))
    assert found.chains["thumb"] == ("jc", "jc")
    # The back is away from the thumb, and the rest is between open and closed.
    assert found.spec.palm.dorsal[2] > 0.8
    assert found.spec.palm.distal[0] > 0.8
    assert all(0.0 < at < 0.5 for at in found.spec.rest.values())


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
