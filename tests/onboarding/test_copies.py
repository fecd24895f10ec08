"""A finger with a placeholder for its range flexes as the finger does that it is a copy of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from handmap_qp.apps.onboarding.copies import Copy, find_copies
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.flexion import HandFlexion
from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.apps.onboarding.structure import find_structure
from handmap_qp.hands import PalmKinematics

EVEN = (-0.8, 0.8)
TRUE = (0.0, 0.7)


def _jaws(
    right: tuple[float, float] = EVEN,
    left: tuple[float, float] = TRUE,
    sense: float = 1.0,
    length: float = 0.04,
) -> str:
    """Return a URDF of two bent fingers, `left` and `right`, that close along x; z is ahead.

    Each is a driver that leans outwards, with a follower that leans inwards and flexes with it.

    Args:
        right: Range of the driver of the right one [rad].
        left: Range of the driver of the left one [rad].
        sense: -1 if the right one closes towards negative positions.
        length: Length of the right one's last part; that of the left one is 0.04 [m].
    """
    parts = '<link name="palm"/>'
    for name, side, own, turn, last in (
        ("left", 1.0, left, 1.0, 0.04),
        ("right", -1.0, right, sense, length),
    ):
        for part, above, place, lean, mimic, size in (
            ("driver", "palm", f"{0.03 * side} 0 0", 0.8, "", 0.06),
            ("jaw", f"{name}_driver", "0 0 .06", -0.7, f"{name}_driver_joint", last),
        ):
            rule = mimic and f'<mimic joint="{mimic}" multiplier="0.6"/>'
            parts += (
                f'<link name="{name}_{part}"><visual><origin xyz="0 0 {size / 2}"/><geometry>'
                f'<box size=".004 .01 {size}"/></geometry></visual></link>'
                f'<joint name="{name}_{part}_joint" type="revolute"><parent link="{above}"/>'
                f'<child link="{name}_{part}"/><origin xyz="{place}" rpy="0 {side * lean} 0"/>'
                f'<axis xyz="0 {-side * turn} 0"/>{rule}'
                f'<limit lower="{own[0]}" upper="{own[1]}" effort="1" velocity="2"/></joint>'
            )
    return f'<robot name="x">{parts}</robot>'


def _copies(text: str) -> dict[int, Copy]:
    robot = Robot(Path("x"), text)
    fingers = find_structure(robot).fingers
    groups = [finger.flexion for finger in fingers]
    return find_copies(PalmKinematics(robot), fingers, groups)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_finger_with_an_even_range_is_a_copy_of_the_other(sense: float) -> None:
    assert _copies(_jaws(sense=sense)) == {1: Copy(0, (0, 1), sense)}


@pytest.mark.parametrize(
    "text",
    [
        # Each says itself how it flexes.
        _jaws(right=TRUE),
        # Neither does.
        _jaws(left=EVEN),
        # They are not alike.
        _jaws(length=0.06),
    ],
)
def test_other_fingers_are_no_copies(text: str) -> None:
    assert _copies(text) == {}


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_copy_is_open_closed_and_at_rest_as_its_original(sense: float) -> None:
    robot = Robot(Path("x"), _jaws(sense=sense))
    flexion = HandFlexion(robot, find_structure(robot).fingers)
    for q in (flexion.q_open, flexion.q_closed):
        assert q[1] == pytest.approx(sense * q[0], abs=1e-9)
    # Their tips are mirror images.
    for tips in (flexion.tips_open, flexion.tips_closed):
        np.testing.assert_allclose(tips[1], tips[0] * [-1.0, 1.0, 1.0], atol=1e-9)
    assert flexion.tips_closed[0, 0] < flexion.tips_open[0, 0]
    rest = detect(Path("x"), _jaws(sense=sense)).spec.rest
    assert rest["right_driver_joint"] == pytest.approx(
        sense * rest["left_driver_joint"]
    )


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_jaws_of_which_one_is_a_copy_point_ahead(sense: float) -> None:
    palm = detect(Path("x"), _jaws(sense=sense)).spec.palm
    np.testing.assert_allclose(palm.distal, (0.0, 0.0, 1.0), atol=1e-6)
    assert abs(palm.dorsal[0]) == pytest.approx(1.0)
