"""What a simulated finger feels is what MuJoCo's constraint forces say of its contacts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from handmap_qp import load_hand
from handmap_qp.apps.simulation.haptics import finger_forces
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.hands import finger_by_joint
from handmap_qp.mapping.objects import Box
from handmap_qp.se3 import affine


def normal_forces(simulator: Simulator) -> dict[str, float]:
    """Return the forces by finger from the rows of the solver, by the names of MuJoCo's bodies.

    Of a pyramidal cone the normal force is the sum of its edges, of an elliptic one the first row.
    """
    model, data = simulator.model, simulator.data
    is_pyramid = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    held = model.body("/object").id
    forces: dict[str, float] = {}
    for contact in data.contact:
        bodies = [int(model.geom_bodyid[i]) for i in contact.geom]
        if held not in bodies or contact.efc_address < 0:
            continue
        rows = 2 * (contact.dim - 1) if is_pyramid and contact.dim > 1 else 1
        force = data.efc_force[contact.efc_address :][:rows].sum()
        (body,) = (body for body in bodies if body != held)
        name = model.body(body).name
        finger = finger_by_joint(simulator.hand).get(name)
        if finger:
            forces[finger] = forces.get(finger, 0.0) + float(force)
    return forces


def test_forces_of_fingers_are_those_of_the_solver() -> None:
    hand = load_hand("three_finger")
    pinch = Simulator(hand, Box((0.05, 0.05, 0.05)), Physics(mass=0.05))
    goal = hand.configuration_vector(hand.rest, np.eye(4) if hand.is_floating else None)
    pinch.reset(goal, affine(np.eye(3), np.array([0.0, 0.0, 100.0])))
    assert set(finger_forces(pinch).values()) == {0.0}
    # The object overlaps a link of the thumb, which presses back.
    pinch.reset(goal, pinch.body_pose("f1_proximal"))
    felt = {finger: force for finger, force in finger_forces(pinch).items() if force}
    assert felt["thumb"] > 0.1
    expected = {f: force for f, force in normal_forces(pinch).items() if force}
    assert felt == pytest.approx(expected)
    assert sum(felt.values()) <= float(pinch.instant().normal_force) + 1e-9


@pytest.mark.parametrize(
    ("robot", "count"), [("three_finger", 3), ("leap_right", 4), ("allegro_right", 4)]
)
def test_joints_belong_to_one_finger(robot: str, count: int) -> None:
    hand = load_hand(robot)
    fingers = finger_by_joint(hand)
    assert len({*fingers.values()}) == count
    moves = hand.moves_points
    names = np.array([point.finger for point in hand.reference_points])
    for i, joint in enumerate(hand.joint_names):
        if joint in fingers:
            assert {*names[moves[:, i]]} == {fingers[joint]}
