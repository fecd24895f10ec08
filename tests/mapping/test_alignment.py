"""Alignment: the human's world and the robot's, in every preset that moves the palm."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from marks import crossed

from handmap_core.mapping.alignment import rotation_of
from handmap_qp import HandMapper, InvalidOptionsError, load_hand
from handmap_qp.client.messages import SETUP
from handmap_qp.mapping.presets import (
    PRESETS,
    get_preset,
    kept_options,
    preset_choice,
)

HUMAN = load_hand("human", points="landmarks")
FORMULATIONS = ("compiled", "direct")
OF_A_PALM = [name for name in PRESETS if "alignment" in get_preset(name).method.values]
TURN = pin.exp3(np.array([0.7, -1.1, 0.4]))
robot_of = cache(load_hand)


def motion(count: int = 12) -> list[tuple[np.ndarray, np.ndarray]]:
    """A person who closes the hand, turns it and moves it in all directions."""
    found = []
    for i in range(count):
        wrist = np.eye(4)
        wrist[:3, :3] = pin.exp3(0.02 * i * np.array([0.3, 0.5, -0.2]))
        wrist[:3, 3] = 0.002 * i, -0.003 * i, 0.001 * i
        found.append((HUMAN.rest + 0.02 * i, wrist))
    return found


def turned(wrist: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return a pose as it is seen in a world that is turned."""
    world = np.eye(4)
    world[:3, :3] = turn
    return world @ wrist


def mapped(
    preset: str, robot: str, alignment: Any, turn: np.ndarray, formulation: str
) -> np.ndarray:
    """Return joints and wrists of a motion in a turned world, shape (T, n + 16)."""
    chosen = get_preset(preset)
    mapper = HandMapper(
        HUMAN,
        robot_of(robot),
        chosen.method.replaced(alignment=alignment),
        ik=chosen.ik.replaced(formulation=formulation),
    )
    steps = [mapper.map_step(q, turned(wrist, turn)) for q, wrist in motion()]
    commands = [step.command for step in steps]
    return np.array([np.append(one.q, one.wrist) for one in commands])


def test_every_preset_has_it() -> None:
    assert set(PRESETS) == set(OF_A_PALM)


@pytest.mark.parametrize(
    ("preset", "robot", "formulation"),
    crossed(OF_A_PALM, ["allegro_right", "ur5_allegro"], FORMULATIONS, every=3),
)
def test_a_turned_world_is_turned_back(
    preset: str, robot: str, formulation: str
) -> None:
    rows = tuple(map(tuple, TURN.T.tolist()))
    plain = mapped(preset, robot, "world", np.eye(3), formulation)
    aligned = mapped(preset, robot, rows, TURN, formulation)
    np.testing.assert_allclose(aligned, plain, atol=1e-6)
    other = mapped(preset, robot, "world", TURN, formulation)
    assert np.abs(other - plain).max() > 1e-3


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("preset", OF_A_PALM)
def test_with_palm_it_does_not_matter_where_the_person_stands(
    preset: str, formulation: str
) -> None:
    here, elsewhere = (
        mapped(preset, "ur5_allegro", "palm", turn, formulation)
        for turn in (np.eye(3), TURN)
    )
    np.testing.assert_allclose(elsewhere, here, atol=1e-6)


@pytest.mark.parametrize("preset", sorted({*OF_A_PALM} - {"fixed_wrist"}))
def test_up_and_forward_of_a_headset_are_those_of_the_robot(preset: str) -> None:
    directions = {(0, 1, 0): (0, 0, 1), (0, 0, -1): (1, 0, 0), (1, 0, 0): (0, -1, 0)}
    arm = load_hand("ur5_allegro")
    method = get_preset(preset).method.replaced(alignment="y-up")
    for human, robot in directions.items():
        mapper = HandMapper(HUMAN, arm, method, ik=get_preset(preset).ik)
        wrist = np.eye(4)
        mapper.map_step(HUMAN.rest, wrist)
        # Clutching keeps the alignment.
        for _ in range(2):
            before = mapper.map_step(HUMAN.rest, wrist).wrist_target
            wrist[:3, 3] += 0.02 * np.array(human)
            after = mapper.map_step(HUMAN.rest, wrist).wrist_target
            way = after[:3, 3] - before[:3, 3]
            np.testing.assert_allclose(way / np.linalg.norm(way), robot, atol=1e-6)
            mapper.clutch()


def test_another_preset_keeps_it() -> None:
    rows = tuple(map(tuple, TURN.tolist()))
    for alignment in ("y-up", rows):
        choice = preset_choice("teleoperation").with_changes({"alignment": alignment})
        other = choice.with_changes({"preset": "object"})
        assert other.method.values["alignment"] == alignment
        named = choice.with_changes({"preset": "object", "alignment": "palm"})
        assert named.method.values["alignment"] == "palm"
    for name in PRESETS:
        # The client, which stands alone, says the same again where it opens a lost session.
        values = get_preset(name).method.values
        assert [*kept_options(values, name)] == [one for one in SETUP if one in values]
    plain = preset_choice("teleoperation").with_changes({"preset": "fixed_wrist"})
    assert plain == preset_choice("fixed_wrist")


def test_its_names_are_rotations() -> None:
    for name in ("world", "y-up"):
        rotation = rotation_of(name)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("preset", OF_A_PALM)
def test_what_is_no_rotation_is_refused_by_name(preset: str) -> None:
    method = get_preset(preset).method
    for wrong in (np.diag([1.0, 1.0, -1.0]), 2.0 * np.eye(3)):
        with pytest.raises(InvalidOptionsError) as raised:
            method.replaced(alignment=tuple(map(tuple, wrong.tolist())))
        assert raised.value.option == "alignment"
