"""The workspace of one posture: what each placement leaves valid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from strategies import generators

from handmap_qp import InvalidInputError, load_hand
from handmap_qp.hands import PinocchioConfiguration

HANDS = {name: load_hand(name) for name in ("three_finger", "human", "ur5_allegro")}
every_hand = pytest.mark.parametrize("name", HANDS)
JACOBIANS: dict[str, Callable[[PinocchioConfiguration], np.ndarray]] = {
    "joints": lambda workspace: workspace.data.J,
    "points": lambda workspace: workspace.point_jacobian(),
    "wrist": lambda workspace: workspace.wrist_jacobian(np.eye(6)),
}
every_jacobian = pytest.mark.parametrize("jacobian", JACOBIANS.values(), ids=JACOBIANS)


@every_jacobian
def test_jacobians_follow_every_placement(
    jacobian: Callable[[PinocchioConfiguration], np.ndarray],
) -> None:
    # On an arm, so that the wrist's Jacobian depends on the posture too.
    hand = HANDS["ur5_allegro"]
    workspace = hand.configuration()
    first = hand.configuration_vector(hand.rest)
    second = hand.configuration_vector(hand.rest + 0.3)
    workspace.place(first)
    before = jacobian(workspace).copy()
    workspace.displace(second, np.zeros(workspace.nv))
    assert np.abs(jacobian(workspace) - before).max() > 1e-3
    workspace.place(first)
    np.testing.assert_allclose(jacobian(workspace), before, atol=1e-14)


@every_hand
@given(generator=generators)
def test_the_wrist_jacobian_is_the_derivative_of_the_wrist(
    name: str, generator: np.random.Generator
) -> None:
    hand = HANDS[name]
    workspace = hand.configuration()
    q = hand.configuration_vector(
        generator.uniform(hand.lower_limits, hand.upper_limits)
    )
    workspace.place(q)
    jacobian, start = workspace.wrist_jacobian(np.eye(6)), pin.SE3(workspace.wrist)
    step = 1e-6 * generator.normal(size=workspace.nv)
    workspace.displace(q, step)
    twist = pin.log6(start.actInv(workspace.wrist)).vector
    np.testing.assert_allclose(twist, jacobian @ step, atol=1e-10)


def test_a_new_workspace_is_placed() -> None:
    hand = HANDS["three_finger"]
    workspace = hand.configuration()
    elsewhere = hand.configuration()
    elsewhere.place(workspace.q)
    np.testing.assert_array_equal(workspace.points, elsewhere.points)


@pytest.mark.parametrize("q", [np.zeros(3), "rest", None, 1.0], ids=str)
def test_a_configuration_of_another_shape_changes_nothing(q: np.ndarray) -> None:
    hand = HANDS["three_finger"]
    workspace = hand.configuration()
    workspace.place(hand.configuration_vector(hand.rest))
    points, jacobian = workspace.points.copy(), workspace.point_jacobian()
    with pytest.raises(InvalidInputError) as caught:
        workspace.place(q)
    assert caught.value.argument == "q"
    np.testing.assert_array_equal(workspace.points, points)
    np.testing.assert_array_equal(workspace.point_jacobian(), jacobian)
