"""A mapper is engaged and disengaged, by these words and by the former ones."""

from __future__ import annotations

import numpy as np
import pytest

from handmap_qp import HandMapper, load_hand


@pytest.mark.parametrize(
    ("disengage", "engage"), [("disengage", "engage"), ("release", "clutch")]
)
def test_a_disengaged_robot_holds_and_an_engaged_one_goes_on_from_there(
    disengage: str, engage: str
) -> None:
    human, robot = load_hand("human"), load_hand("three_finger")
    mapper = HandMapper(human, robot, "paper", dt=1 / 60)
    act = {
        "engage": mapper.engage,
        "disengage": mapper.disengage,
        "clutch": mapper.clutch,
        "release": mapper.release,
    }
    bent = human.rest + 0.3 * (human.upper_limits - human.rest)
    for q in (human.rest, bent):
        before = mapper.map_step(q, np.eye(4)).command.q
    act[disengage]()
    held = mapper.map_step(human.rest, np.eye(4))
    assert held.status == "released"
    np.testing.assert_array_equal(held.command.q, before)
    act[engage]()
    # The present posture of the human is the reference: the robot stays where it is.
    step = mapper.map_step(human.rest, np.eye(4))
    assert step.status != "released"
    np.testing.assert_allclose(step.command.q, before, atol=0.02)
