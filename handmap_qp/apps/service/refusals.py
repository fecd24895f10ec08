"""Errors of the library as refusals that name the field of the client's request."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from handmap_qp.client.messages import FORMER_OPTIONS, Open
from handmap_qp.errors import (
    HandError,
    HandmapError,
    InvalidInputError,
    InvalidOptionsError,
    RefusedError,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.presets import IK_NAMES, Choice, known_options

_LONGEST_MESSAGE = 400
_FIELDS = {"human_q": "q", "wrist_pose": "wrist"} | {
    name: name
    for name in ("wrist", "points", "landmarks", "values", "robot_q", "robot_wrist")
}
"""Fields of requests by the arguments of the library that take them."""
_CHOICES = {"method": "preset", "preset": "preset", "human_points": "human_points"}
"""Fields of requests by the choices of the library that they decide."""
_T = TypeVar("_T")


def refused(error: HandmapError, field: str = "") -> RefusedError:
    """Return an error of the library as a refusal.

    Args:
        error: The error; its attributes name the argument or option at fault.
        field: The field at fault, if the error does not name another one.
    """
    if isinstance(error, RefusedError):
        return error
    own, message = "", str(error)
    if isinstance(error, InvalidInputError):
        own = _field_of_argument(error.argument)
        message = message.removeprefix(f"{error.argument}: ") if own else message
    elif isinstance(error, InvalidOptionsError):
        own = _field_of_own_option(error.option)
        message = message.removeprefix(f"{error.option}: ") if own else message
    elif isinstance(error, HandError):
        # Clients must not learn the server's paths.
        message = f"{error.key}: {error.problem}" if error.key else error.problem
    return RefusedError(
        "invalid", " ".join(message.split())[:_LONGEST_MESSAGE], field=own or field
    )


def field_of_option(request: Open, option: str) -> str:
    """Return the field in which a request gives options of the method, by the name it used."""
    former = (name for name in FORMER_OPTIONS if getattr(request, name))
    return f"{next(former, 'options')}.{option:.64}"


def with_field_errors(field: str, make: Callable[[], _T]) -> _T:
    """Return what `make` returns, and raise its errors as refusals of a field.

    Raises:
        RefusedError: With the field that the error names, or else `field`.
    """
    try:
        return make()
    except HandmapError as error:
        raise refused(error, field) from error
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        message = f"cannot be used: {error}"[:_LONGEST_MESSAGE]
        raise RefusedError("invalid", message, field=field) from error


def with_option_errors(
    request: Open, robot: Hand, choice: Choice, make: Callable[[], _T]
) -> _T:
    """Return what `make` returns, and raise its errors as refusals of options.

    Args:
        request: The request, which may give options by former names.
        robot: The robot hand.
        choice: The options.
        make: Makes or configures a mapper.

    Raises:
        RefusedError: With the option at fault. If the error names none: `ik` if the QP alone cannot
            be set up; else `options`.
    """
    try:
        return with_field_errors("options", make)
    except RefusedError as error:
        with_field_errors("ik", lambda: PointIk(robot, choice.ik))
        place, _, option = error.field.partition(".")
        if place == "options" and option:
            error.field = field_of_option(request, option)
        raise


def _field_of_own_option(option: str) -> str:
    """Return the field of a request for an option of the library; empty if there is none."""
    places = known_options().get(option)
    if places is None:
        return _CHOICES.get(option, "")
    return f"{'ik' if option in IK_NAMES else 'options'}.{option}"


def _field_of_argument(argument: str) -> str:
    """Return the field of a request for an argument such as `human_q` or `points[3]`."""
    name, bracket, index = argument.partition("[")
    field = _FIELDS.get(name, "")
    return field + bracket + index if field else ""
