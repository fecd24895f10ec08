"""Errors of the library as refusals that name the field of the client's request."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import TypeVar

import numpy as np

from handmap_qp.errors import (
    HandError,
    HandmapError,
    InvalidInputError,
    InvalidOptionsError,
    RefusedError,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.mapping.presets import Choice

_LONGEST_MESSAGE = 400
_FIELDS = {
    "human_q": "q",
    "wrist_pose": "wrist",
    "wrist": "wrist",
    "points": "points",
    "landmarks": "landmarks",
    "values": "values",
    "robot_q": "robot_q",
    "robot_wrist": "robot_wrist",
}
"""Fields of requests by the arguments of the library that take them."""
_IK_OPTIONS = {item.name for item in fields(IkOptions)}
_METHOD_OPTIONS = {item.name for kind in (MappingOptions, Teleoperation) for item in fields(kind)}
_CHOICES = {"method": "preset", "preset": "preset", "human_points": "human_points"}
"""Fields of requests by the choices of the library that they decide."""
_T = TypeVar("_T")


def refused(error: HandmapError, field: str = "", options: str = "mapping") -> RefusedError:
    """Return an error of the library as a refusal.

    Args:
        error: The error; its attributes name the argument or option at fault.
        field: The field at fault, if the error does not name another one.
        options: Field of the method's options: `mapping` or `teleoperation`.
    """
    if isinstance(error, RefusedError):
        return error
    own, message = "", str(error)
    if isinstance(error, InvalidInputError):
        own = _field_of_argument(error.argument)
        message = message.removeprefix(f"{error.argument}: ") if own else message
    elif isinstance(error, InvalidOptionsError):
        own = _field_of_option(error.option, options)
        message = message.removeprefix(f"{error.option}: ") if own else message
    elif isinstance(error, HandError):
        # Clients must not learn the server's paths.
        message = f"{error.key}: {error.problem}" if error.key else error.problem
    return RefusedError("invalid", " ".join(message.split())[:_LONGEST_MESSAGE], field=own or field)


def with_field_errors(field: str, make: Callable[[], _T], options: str = "mapping") -> _T:
    """Return what `make` returns, and raise its errors as refusals of a field.

    `options` is as of `refused`.

    Raises:
        RefusedError: With the field that the error names, or else `field`.
    """
    try:
        return make()
    except HandmapError as error:
        raise refused(error, field, options) from error
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        message = f"cannot be used: {error}"[:_LONGEST_MESSAGE]
        raise RefusedError("invalid", message, field=field) from error


def with_option_errors(robot: Hand, choice: Choice, make: Callable[[], _T]) -> _T:
    """Return what `make` returns, and raise its errors as refusals of options.

    Args:
        robot: The robot hand.
        choice: The options.
        make: Makes or configures a mapper.

    Raises:
        RefusedError: With the option at fault. If the error names none: `ik` if the QP alone cannot
            be set up; else the field of the method's options.
    """
    options = "teleoperation" if choice.is_teleoperation else "mapping"
    try:
        return with_field_errors(options, make, options)
    except RefusedError:
        with_field_errors("ik", lambda: PointIk(robot, choice.ik))
        raise


def _field_of_option(option: str, options: str) -> str:
    """Return the field of a request for an option of the library; empty if there is none."""
    if option in _IK_OPTIONS:
        return f"ik.{option}"
    return f"{options}.{option}" if option in _METHOD_OPTIONS else _CHOICES.get(option, "")


def _field_of_argument(argument: str) -> str:
    """Return the field of a request for an argument such as `human_q` or `points[3]`."""
    name, bracket, index = argument.partition("[")
    field = _FIELDS.get(name, "")
    return field + bracket + index if field else ""
