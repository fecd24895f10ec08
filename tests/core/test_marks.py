"""The suite samples matrices so that every value is met, and leaves nothing out of `--full`."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest
from marks import crossed, rotated

HANDS = [f"hand {number}" for number in range(7)]
PRESETS = ["paper", "object", "teleoperation", "contact"]
WAYS = ["compiled", "direct"]


def values_of(parameter: Any) -> tuple[Any, ...]:
    return tuple(getattr(parameter, "values", (parameter,)))


def is_in_suite(parameter: Any) -> bool:
    return all(mark.name != "full" for mark in getattr(parameter, "marks", ()))


@pytest.mark.parametrize("start", range(4))
@pytest.mark.parametrize("every", [1, 2, 3, 4])
def test_a_crossing_meets_every_value_of_each_axis(every: int, start: int) -> None:
    parameters = crossed(HANDS, PRESETS, every=every, start=start)
    assert [values_of(each) for each in parameters] == [*product(HANDS, PRESETS)]
    chosen = [values_of(each) for each in parameters if is_in_suite(each)]
    assert len(chosen) <= len(parameters) // every + 1
    assert {hand for hand, _ in chosen} == {*HANDS}
    assert {preset for _, preset in chosen} == {*PRESETS}


def test_a_crossing_takes_more_than_two_axes() -> None:
    parameters = crossed(HANDS, PRESETS, WAYS, every=3)
    chosen = [values_of(each) for each in parameters if is_in_suite(each)]
    assert len(parameters) == len(HANDS) * len(PRESETS) * len(WAYS)
    for axis, values in enumerate((HANDS, PRESETS, WAYS)):
        assert {each[axis] for each in chosen} == {*values}


@pytest.mark.parametrize("every", [1, 2, 3])
def test_rotations_that_start_elsewhere_share_the_values(every: int) -> None:
    suites = [
        [
            value
            for parameter in rotated(HANDS, every, start)
            for value in values_of(parameter)
            if is_in_suite(parameter)
        ]
        for start in range(every)
    ]
    assert sorted(hand for suite in suites for hand in suite) == sorted(HANDS)


@pytest.mark.full
def test_what_the_suite_leaves_out_runs_where_it_is_asked_for(
    request: pytest.FixtureRequest,
) -> None:
    config = request.config
    is_named = any(request.path.name in argument for argument in config.args)
    assert config.option.full or is_named
