"""Presets by name: in `HandMapper`, `RobotMapper` and `configure`, by one rule."""

from __future__ import annotations

from typing import Any

import pytest

from handmap_qp import PRESETS, HandMapper, InvalidOptionsError, load_hand
from handmap_qp.hands import load_robot
from handmap_qp.mapping import RobotMapper

HUMAN, ROBOT = load_hand("human", points="landmarks"), load_hand("three_finger")
PAIR = load_robot("alex")
NAMES = [name for name, preset in PRESETS.items() if name != "fixed_wrist"]


@pytest.mark.parametrize("name", NAMES)
def test_a_preset_is_its_method_and_its_weights(name: str) -> None:
    named = HandMapper(HUMAN, ROBOT, preset=name)
    assert named.method == PRESETS[name].method
    assert named.ik == PRESETS[name].ik
    # The former way to name one.
    former = HandMapper(HUMAN, ROBOT, name)
    assert (former.method, former.ik) == (named.method, named.ik)


def test_options_beside_a_preset_change_its_method() -> None:
    mapper = HandMapper(HUMAN, ROBOT, preset="object", ridge=0.5)
    assert mapper.method == PRESETS["object"].method.replaced(ridge=0.5)
    assert mapper.ik == PRESETS["object"].ik
    with pytest.raises(InvalidOptionsError, match="rigde"):
        HandMapper(HUMAN, ROBOT, preset="object", rigde=0.5)


def test_a_robot_takes_a_preset_for_both_hands() -> None:
    mapper = RobotMapper(PAIR, preset="teleoperation")
    for source in mapper.sources.values():
        assert source.method == PRESETS["teleoperation"].method


def test_a_mapper_changes_to_a_preset() -> None:
    mapper = HandMapper(HUMAN, ROBOT, preset="paper")
    mapper.configure(preset="object")
    assert mapper.method == PRESETS["object"].method
    assert mapper.ik == PRESETS["object"].ik


def made(**words: Any) -> None:
    HandMapper(HUMAN, ROBOT, **words)


def made_for_two(**words: Any) -> None:
    RobotMapper(PAIR, **words)


def changed(**words: Any) -> None:
    HandMapper(HUMAN, ROBOT).configure(**words)


@pytest.mark.parametrize("call", [made, made_for_two, changed])
@pytest.mark.parametrize("key", ["preset", "method"])
def test_unknown_presets_are_refused_with_the_nearest(call: Any, key: str) -> None:
    with pytest.raises(InvalidOptionsError) as caught:
        call(**{key: "teleop"})
    assert caught.value.option == "preset"
    assert "did you mean teleoperation?" in str(caught.value)


@pytest.mark.parametrize("call", [made, made_for_two, changed])
@pytest.mark.parametrize("method", ["object", PRESETS["object"].method])
def test_a_method_beside_a_preset_is_refused(call: Any, method: Any) -> None:
    with pytest.raises(InvalidOptionsError, match="preset: a method is given, too"):
        call(method=method, preset="object")


def test_a_refused_change_leaves_the_mapper_as_it_was() -> None:
    mapper = HandMapper(HUMAN, ROBOT, preset="paper")
    before = mapper.method, mapper.ik
    with pytest.raises(InvalidOptionsError):
        mapper.configure(preset="objekt")
    assert (mapper.method, mapper.ik) == before


@pytest.mark.parametrize("name", [1, b"object", ["object"], ""])
def test_other_types_are_refused(name: Any) -> None:
    with pytest.raises(InvalidOptionsError, match="preset: expected one of"):
        HandMapper(HUMAN, ROBOT, preset=name)
