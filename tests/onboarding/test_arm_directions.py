"""Where an arm points: along the joint of its wrist that turns the hand about its length."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_hands import BoxHand, slides_without_shapes, turns

from handmap_core.se3 import Array
from handmap_qp.apps.onboarding.arm_directions import arm_direction
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.robot import Robot

JAWS = ("a", "b")


def _arm(*joints: tuple[str, Array, Array], turn: Array | None = None) -> str:
    """Return links and joints from `world` to the palm `base`.

    Args:
        joints: Type, place on the link before [m] and axis of each, shape (3,).
        turn: Rotation of all frames, shape (3, 3).
    """
    turn = np.eye(3) if turn is None else turn
    parts = '<link name="world"/>'
    above = "world"
    for k, (kind, place, axis) in enumerate(joints):
        link = "base" if k == len(joints) - 1 else f"arm{k}"
        xyz, about = (
            " ".join(f"{value:g}" for value in turn @ vector + 0.0)
            for vector in (place, axis)
        )
        parts += (
            f'<link name="{link}"/><joint name="arm_joint{k}" type="{kind}">'
            f'<parent link="{above}"/><child link="{link}"/>'
            f'<origin xyz="{xyz}"/><axis xyz="{about}"/>'
            '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        )
        above = link
    return parts


X, Y, Z = np.eye(3)
PITCH = ("revolute", 0.2 * Z, Y)
ROLL = ("revolute", 0.1 * Z, Z)


def _direction(text: str) -> Array:
    return arm_direction(Robot(Path("x"), text), "base", JAWS)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_it_is_the_axis_of_a_roll_away_from_the_arm(sense: float) -> None:
    roll = ("revolute", 0.1 * Z, sense * Z)
    for joints in ([PITCH, roll], [roll, PITCH], [PITCH, roll, PITCH]):
        found = _direction(slides_without_shapes(arm=_arm(*joints)))
        np.testing.assert_allclose(found, Z, atol=1e-9)


@pytest.mark.parametrize(
    "joints",
    [
        [PITCH],
        # A slide turns nothing.
        [("prismatic", 0.1 * Z, Z)],
        # A roll too far from the hand is none of its wrist.
        [ROLL, PITCH, PITCH, PITCH],
        # An axis at right angles to the way to the fingers.
        [("revolute", 0.2 * Z, X)],
    ],
)
def test_there_is_none_without_a_roll_of_the_wrist(
    joints: list[tuple[str, Array, Array]],
) -> None:
    assert not _direction(slides_without_shapes(arm=_arm(*joints))).any()


def test_a_hand_without_an_arm_has_none() -> None:
    robot = Robot(Path("x"), slides_without_shapes())
    assert not arm_direction(robot, "base", JAWS).any()
    assert not arm_direction(robot, "no", JAWS).any()
    assert not arm_direction(robot, "base", ()).any()


def test_jaws_without_shapes_point_where_their_arm_does(tmp_path: Path) -> None:
    """In any axes of the file, from the whole file and from the palm on."""
    for turn in turns():
        arm = _arm(PITCH, ROLL, turn=turn)
        file = tmp_path / "jaws.urdf"
        file.write_text(slides_without_shapes(turn, arm), encoding="utf-8")
        for root in (None, "base"):
            palm = detect(file, root=root).spec.palm
            np.testing.assert_allclose(palm.distal, turn @ Z, atol=1e-9)
            assert abs(turn @ Y @ palm.dorsal) > 0.999


def test_fingers_on_a_bent_mount_keep_their_direction(tmp_path: Path) -> None:
    """The hand points along x, and the arm that carries it 30 degrees beside it."""
    ahead = np.array([np.cos(np.pi / 6), 0.5, 0.0])
    arm = _arm(("revolute", -0.3 * Y, Z), ("revolute", 0.1 * ahead, ahead))
    hand = BoxHand(turn=np.eye(3), palm="base").parts()
    file = tmp_path / "hand.urdf"
    arm = arm.replace('<link name="base"/>', "")
    text = f'<robot name="x">{arm}{hand}</robot>'
    file.write_text(text, encoding="utf-8")
    found = arm_direction(Robot(file), "base", ["index_0", "middle_0"])
    np.testing.assert_allclose(found, ahead, atol=1e-6)
    assert detect(file).spec.palm.distal == (1.0, 0.0, 0.0)
