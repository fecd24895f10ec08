"""Where a fingertip is without shapes and end frames: on from the last joint, as links go on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.apps.onboarding.structure import find_structure

STEP = 0.02


def _fist(bend: float, reach: float, drawn: str = "") -> str:
    """Return a URDF of a hand without shapes that is a fist at zero, and opens along x.

    Args:
        bend: How far each joint is bent at zero [rad].
        reach: How far one motor opens each of them [rad].
        drawn: Turn of the last links' axes about themselves, `rpy` in place of none.
    """
    parts = '<link name="palm"/><link name="motor"/>'
    parts += (
        '<joint name="motor_joint" type="revolute"><parent link="palm"/><child link="motor"/>'
        '<axis xyz="1 0 0"/><limit lower="0" upper="1" effort="1" velocity="2"/></joint>'
    )
    for name, y, z, count in (
        ("a", 0.02, -0.03, 3),
        ("b", 0.02, 0.0, 3),
        ("c", 0.0, 0.0, 3),
        ("d", -0.02, 0.0, 3),
    ):
        above, place = "palm", f"0.05 {y} {z}"
        for k in range(count):
            turn = drawn if drawn and k == count - 1 else f"0 {bend} 0"
            parts += (
                f'<link name="{name}{k}"><visual><geometry><mesh filename="lost.stl"/>'
                f'</geometry></visual></link><joint name="{name}{k}_joint" type="revolute">'
                f'<parent link="{above}"/><child link="{name}{k}"/>'
                f'<origin xyz="{place}" rpy="{turn}"/><axis xyz="0 -1 0"/>'
                f'<mimic joint="motor_joint" multiplier="{reach}"/>'
                f'<limit lower="0" upper="{reach}" effort="1" velocity="2"/></joint>'
            )
            above, place = f"{name}{k}", f"{STEP} 0 0"
    return f'<robot name="fist">{parts}</robot>'


def _tips(text: str) -> list[np.ndarray]:
    fingers = find_structure(Robot(Path("x"), text)).fingers
    assert len(fingers) == 4
    return [finger.xyz for finger in fingers]


@pytest.mark.parametrize("reach", [1.0, 0.85])
def test_the_tip_of_a_fist_is_along_the_links(reach: float) -> None:
    """Links that are drawn alike go on along the same axis; a motor may not open them fully."""
    for tip in _tips(_fist(1.0, reach)):
        np.testing.assert_allclose(tip, (0.8 * STEP, 0.0, 0.0), atol=1e-9)


def test_a_fist_without_shapes_points_where_it_opens() -> None:
    spec = detect(Path("x"), _fist(1.0, 1.0)).spec
    np.testing.assert_allclose(spec.palm.distal, (1.0, 0.0, 0.0), atol=1e-6)
    # It closes towards -z, and rests there and not at the open end.
    np.testing.assert_allclose(spec.palm.dorsal, (0.0, 0.0, 1.0), atol=1e-6)
    assert spec.rest["motor_joint"] < 0.9


def test_the_tip_of_an_open_hand_is_straight_on() -> None:
    for tip in _tips(_fist(0.0, -1.0)):
        np.testing.assert_allclose(tip, (0.8 * STEP, 0.0, 0.0), atol=1e-9)


def test_the_tip_of_links_with_other_axes_is_straight_on() -> None:
    """A frame that is turned about another axis than the joint's is never that of the link before.

    The finger goes on along its line at rest.
    """
    for tip in _tips(_fist(0.0, -1.0, drawn="1.5707963 0 0.9")):
        np.testing.assert_allclose(np.linalg.norm(tip), 0.8 * STEP)
        # The line of the link before, in the last link's frame.
        assert not np.allclose(tip, (0.8 * STEP, 0.0, 0.0), atol=1e-3)
