"""Checks of the arguments of functions about grasps."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from handmap_qp.errors import InvalidInputError
from handmap_qp.se3 import as_floats


def finite_array(
    value: npt.ArrayLike, shape: tuple[int | str, ...], name: str
) -> np.ndarray:
    """Return a write-protected copy of finite numbers of the right shape.

    Args:
        value: The numbers.
        shape: The shape they must have; a text such as `"n"` stands for any size.
        name: Name of the argument in errors.

    Returns:
        The copy.

    Raises:
        InvalidInputError: On another shape, or if a value is not a finite number.
    """
    array = as_floats(value, name, shape=shape, is_finite=True).copy()
    array.setflags(write=False)
    return array


def positive_number(value: Any, name: str, *, or_zero: bool = False) -> float:
    """Return a finite number > 0, or >= 0.

    Raises:
        InvalidInputError: If it is not one.
    """
    is_number = isinstance(value, int | float | np.integer | np.floating)
    # NaN fails every comparison.
    is_allowed = is_number and (0.0 < value < np.inf or (or_zero and value == 0.0))
    if not is_allowed or isinstance(value, bool):
        expected = "a number >= 0" if or_zero else "a number > 0"
        raise InvalidInputError(argument=name, expected=expected, value=value)
    return float(value)


def whole_number(value: Any, name: str, *, least: int) -> int:
    """Return an integer that is not below `least`.

    Raises:
        InvalidInputError: If it is not one.
    """
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_whole or value < least:
        raise InvalidInputError(
            argument=name, expected=f"an integer >= {least}", value=value
        )
    return int(value)


def one_of(value: Any, allowed: tuple[str, ...], name: str) -> str:
    """Return one of the allowed texts.

    Raises:
        InvalidInputError: If it is none of them.
    """
    if not isinstance(value, str) or value not in allowed:
        raise InvalidInputError(
            argument=name, expected=f"one of {', '.join(allowed)}", value=value
        )
    return value
