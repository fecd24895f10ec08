"""Marks of parameters: what the quick tests leave out, and what the suite leaves out.

The suite samples large matrices, such as every hand by every preset, by a fixed rotation. Its other
cases bear the mark `full`. `pytest --full` runs them, and so does `pytest` if their file is named.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any

import pytest


def slow(value: Any) -> Any:
    """Return a parameter whose test is left out by `-m 'not slow'`."""
    return pytest.param(value, marks=pytest.mark.slow)


def full(value: Any) -> Any:
    """Return a parameter whose test runs with `--full` only."""
    return pytest.param(value, marks=pytest.mark.full)


def rotated(values: Iterable[Any], every: int, start: int = 0) -> list[Any]:
    """Return parameters of which the suite runs one of `every`, beginning with number `start`.

    Args:
        values: Values of one parameter.
        every: The suite runs one of so many.
        start: Number of the first value that the suite runs. If other tests start elsewhere, the
            suite meets the values that this one leaves out.

    Returns:
        All values. Those that the suite leaves out are marked.
    """
    return [
        value if number % every == start % every else full(value)
        for number, value in enumerate(values)
    ]


def crossed(*axes: Sequence[Any], every: int, start: int = 0) -> list[Any]:
    """Return the combinations of values of several parameters, most of them marked `full`.

    The suite runs the combinations whose numbers along the axes add up to `start`, modulo `every`.
    So it meets each value of an axis if the other axes together have enough values.

    Args:
        *axes: Values of each parameter.
        every: The suite runs one of so many combinations.
        start: Sum of the numbers of a combination that the suite runs.

    Returns:
        All combinations, in the order of `itertools.product`.
    """
    numbered = product(*(list(enumerate(axis)) for axis in axes))
    return [
        pytest.param(
            *(value for _, value in pairs),
            marks=()
            if sum(number for number, _ in pairs) % every == start % every
            else pytest.mark.full,
        )
        for pairs in numbered
    ]
