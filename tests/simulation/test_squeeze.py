"""Links that are commanded to overlap press on each other, and never harder than asked for."""

from __future__ import annotations

from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
from marks import crossed
from oracles.shape_distances import MeasuredPairs

from handmap_qp import (
    HandMapper,
    Teleoperation,
    load_hand,
    read_recording,
)
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.hands import (
    CONTACT_GAP,
    Hand,
    ShapePairs,
    pair_ends,
    read_collision_shapes,
)
from handmap_qp.mapping.objects import Box
from handmap_qp.mapping.presets import get_preset
from handmap_qp.se3 import Array, affine, unit

HUMAN = load_hand("human", points="landmarks")
# Far from the hand, and light.
ASIDE = affine(np.eye(3), [3.0, 3.0, 3.0])
# Levers change a little from the commanded posture to the real one.
TOLERANCE = 1.05
# Of the commanded postures, one before thumb and index finger pinch, and one in which they do.
_OPEN, _PINCH = 19, 23


@cache
def mapper_of(name: str, squeeze: float) -> HandMapper:
    method = Teleoperation(squeeze=squeeze, contact_gap=CONTACT_GAP)
    ik = get_preset("teleoperation").ik
    return HandMapper(HUMAN, load_hand(name, mount="fixed"), method, ik=ik)


def pressing_pairs(hand: Hand, contacts: ShapePairs) -> Any:
    """Return what lets the pairs of a hand's shapes collide with each other in MuJoCo."""
    shapes = read_collision_shapes(hand).geometryObjects

    def furnish(spec: Any) -> None:
        left = {body.name: [*body.geoms] for body in spec.bodies}
        geoms = [
            left[hand.model.names[shape.parentJoint].replace("universe", "world")].pop(
                0
            )
            for shape in shapes
        ]
        for k, geom in enumerate(geoms):
            geom.name = f"shape{k}"
        for first, second in pair_ends(contacts.geometry):
            # Without friction, which would also carry what presses.
            spec.add_pair(
                geomname1=f"shape{first}", geomname2=f"shape{second}", condim=1
            )

    return furnish


def forces_between_links(simulator: Simulator) -> dict[tuple[int, int], float]:
    """Return the normal forces between the shapes of the hand [N]."""
    force = np.zeros(6)
    found: dict[tuple[int, int], float] = {}
    for row, contact in enumerate(simulator.data.contact):
        if contact.efc_address >= 0:
            mujoco.mj_contactForce(simulator.model, simulator.data, row, force)
            pair = contact.geom[0], contact.geom[1]
            found[pair] = found.get(pair, 0.0) + force[0]
    return found


def press(mapper: HandMapper, postures: list[Array]) -> list[float]:
    """Return the largest force between two shapes in each commanded posture at rest [N]."""
    hand = mapper.robot
    contacts = mapper.bound.contacts
    assert contacts is not None
    simulator = Simulator(
        hand,
        Box((0.01, 0.01, 0.01)),
        Physics(gravity=(0.0, 0.0, 0.0)),
        furnish=pressing_pairs(hand, contacts),
    )
    simulator.reset(hand.configuration_vector(hand.rest), ASIDE)
    largest = []
    for q in postures:
        goal = hand.configuration_vector(q)
        simulator.follow(goal, 0.3)
        simulator.follow(goal, 0.7)
        largest.append(max(forces_between_links(simulator).values(), default=0.0))
    return largest


@cache
def commanded(name: str, squeeze: float) -> list[Array]:
    """Return postures of a recorded hand that closes, pinches and makes a fist."""
    mapper = mapper_of(name, squeeze)
    found = [
        mapper.map_landmarks(landmarks, dt=0.033).command.q
        for landmarks in read_recording("demo", "right").landmarks[:180]
    ]
    return found[6::6]


@pytest.mark.parametrize(
    ("name", "squeeze"),
    crossed(["allegro_right", "leap_right", "shadow_right"], [0.3, 3.0], every=2),
)
def test_links_press_but_no_harder_than_asked_for(name: str, squeeze: float) -> None:
    forces = press(mapper_of(name, squeeze), commanded(name, squeeze))
    assert 0.0 < max(forces) <= TOLERANCE * squeeze


def test_links_do_not_press_without_squeeze() -> None:
    name = "allegro_right"
    forces = press(mapper_of(name, 0.0), commanded(name, 0.0))
    assert max(forces) == 0.0


def press_on_plate(name: str, squeeze: float) -> float:
    """Return the force of a link on a plate of 6 mm between thumb and index finger [N]."""
    mapper = mapper_of(name, squeeze)
    hand = mapper.robot
    limit = MeasuredPairs.of(mapper.point_ik)
    postures = commanded(name, squeeze)
    opened, closed = (hand.configuration_vector(postures[i]) for i in (_OPEN, _PINCH))
    # It stands across the line on which the links press.
    near = limit.within(closed)
    distance, *rest = near.found[near.found[:, 0].argmin()]
    normal, point = np.split(np.array(rest), 2)
    along = unit(np.cross(normal, [1.0, 0.0, 0.3]))
    axes = np.array([along, np.cross(normal, along), normal]).T
    plate = affine(axes, point + 0.5 * distance * normal)
    physics = Physics(gravity=(0.0, 0.0, 0.0), mass=0.02)
    simulator = Simulator(hand, Box((0.016, 0.016, 0.006)), physics)
    simulator.reset(opened, plate)
    simulator.follow(closed, 1.0)
    simulator.follow(closed, 1.0)
    forces = simulator.pressing().values()
    assert len(forces) == 2
    return max(forces)


@pytest.mark.parametrize("name", ["leap_right", "shadow_right"])
def test_an_object_is_pressed_harder_but_by_no_more_than_asked_for(name: str) -> None:
    squeeze = 3.0
    without = press_on_plate(name, 0.0)
    pressed = press_on_plate(name, squeeze)
    assert 1.3 * without < pressed <= without + squeeze
