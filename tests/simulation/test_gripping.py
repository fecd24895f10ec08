"""A grip in MuJoCo: pads press with the force that is told, and hold what they press."""

from __future__ import annotations

import numpy as np
import pytest
from marks import rotated
from picks import made_pick

from handmap_qp import load_hand
from handmap_qp.apps.offline.comparison import prepare_take
from handmap_qp.apps.simulation.commands import find_pinch
from handmap_qp.apps.simulation.gripping import GripScene
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.pinch import PinchTrial

# A whole simulation.
pytestmark = pytest.mark.slow


def scene_of(name: str, deviation: float | None = None) -> GripScene:
    hand = load_hand(name)
    recording = made_pick()
    physics = Physics(gravity=(0.0, -9.81, 0.0))
    take = prepare_take(recording, hand.side)
    window = find_pinch(recording)
    sees = deviation is not None
    return GripScene(take, hand, window, physics, sees, deviation or 0.0)


@pytest.mark.parametrize(
    "name", rotated(["allegro_right", "shadow_right", "panda_gripper"], 2)
)
def test_both_pads_press_with_the_force_that_is_told(name: str) -> None:
    """Fingers and jaws alike, with the actuators that they have if nobody says anything."""
    scene = scene_of(name)
    outcome = scene.run(PinchTrial())
    assert outcome.is_held
    # In the equilibrium of the carry: 5 N from either side.
    forces = outcome.episode.at.normal_force[-10:]
    assert np.ptp(forces) < 1.0
    assert forces.mean() == pytest.approx(10.0, rel=0.2)
    # It stays where it was gripped: the touch is found before the pads have dragged it far.
    assert outcome.slip < 0.005


def test_a_place_that_is_wrong_by_what_it_says_loses_nothing() -> None:
    deviation = 0.005
    scene = scene_of("allegro_right", deviation)
    assert scene.run(PinchTrial(place_error=(1.0, -1.0, 1.0))).is_held
    assert scene.place_error == (deviation, -deviation, deviation)
