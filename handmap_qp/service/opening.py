"""From an `open` request to the hands and the mapper of a session.

Runs in a thread, because it takes some 10 ms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import msgspec
import numpy as np

from handmap_qp.errors import HandmapError, InvalidInputError, RefusedError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import load_hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.service.hand_cache import HandCache
from handmap_qp.service.messages import Open, split_validation_error
from handmap_qp.service.refusals import (
    refused,
    with_field_errors,
    with_option_errors,
)
from handmap_qp.trackers.landmarks import LandmarkFitter, human_name

SOLVERS = ("daqp",)
"""Solvers that a client may choose. The time of others is not bounded, and all sessions would wait:
with a large weight, ProxQP took 97 s for one sample."""
MOST_ITERATIONS = 20
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, eq=False)
class Hands:
    """The hands of a session and what maps between them.

    Attributes:
        mapper: Maps the human hand to the robot hand.
        fitter: Fits the human hand to landmarks; None if samples are joint angles or points.
        lengths: The measured human hand; None for the model's own.
        needs_measuring: Whether the first landmarks measure the human hand. Until then it is the
            model's own.
    """

    mapper: HandMapper
    fitter: LandmarkFitter | None
    lengths: HumanLengths | None
    needs_measuring: bool = False


def prepare_hands(request: Open, cache: HandCache, lengths: HumanLengths | None = None) -> Hands:
    """Make the mapper of a session.

    Args:
        request: The client's request.
        cache: The hands that clients may open.
        lengths: The human hand as measured from landmarks; the request decides if omitted.

    Returns:
        The mapper, and the fitter if samples are landmarks.

    Raises:
        RefusedError: With the field at fault.
    """
    if request.hand_length is not None and request.lengths is not None:
        raise RefusedError("invalid", "give hand_length or lengths, not both", field="lengths")
    mapping = read_options("mapping", request.mapping, MappingOptions)
    ik = read_ik(request.ik)
    robot = cache.robot(request.robot, request.robot_points, request.mount)
    if lengths is None:
        lengths = with_field_errors("lengths", lambda: _human_lengths(request))
    fitter = None
    if request.input == "landmarks":
        fitter = with_field_errors("lengths", lambda: LandmarkFitter(request.side, lengths))
    human = with_field_errors("human_points", lambda: _human(request, cache, lengths, fitter))
    mapper = with_option_errors(robot, ik, lambda: HandMapper(human, robot, mapping, ik=ik))
    return Hands(mapper, fitter, lengths, needs_measuring=fitter is not None and lengths is None)


def read_options(field: str, values: dict[str, Any], kind: type[_T]) -> _T:
    """Read options from a client's request, strictly.

    Args:
        field: Field of the request that holds them.
        values: Names and values.
        kind: The dataclass of the options.

    Raises:
        RefusedError: With the option that is unknown, of another type, or out of range.
    """
    known = [item.name for item in fields(kind)]  # type: ignore[arg-type]
    for name in values:
        if name not in known:
            raise RefusedError(
                "invalid",
                f"no such option; there are {', '.join(known)}",
                field=f"{field}.{name:.64}",
            )
    try:
        return msgspec.convert(values, kind, strict=True)
    except msgspec.ValidationError as error:
        # msgspec raises errors of the options' own checks again; the original is the cause.
        if isinstance(error.__cause__, HandmapError):
            raise refused(error.__cause__, field) from error
        message, path = split_validation_error(error)
        raise RefusedError(
            "invalid", message, field=f"{field}.{path}" if path else field
        ) from error
    except (TypeError, OverflowError) as error:
        raise RefusedError("invalid", str(error), field=field) from error


def read_ik(values: dict[str, Any]) -> IkOptions:
    """Read the options of the QP, within what a server can solve in time.

    Raises:
        RefusedError: With the option at fault.
    """
    ik = read_options("ik", values, IkOptions)
    if ik.solver not in SOLVERS:
        raise RefusedError(
            "invalid",
            f"expected one of {', '.join(SOLVERS)}; got {ik.solver!r:.40}",
            field="ik.solver",
        )
    if ik.max_iterations > MOST_ITERATIONS:
        raise RefusedError(
            "invalid",
            f"expected at most {MOST_ITERATIONS}, got {ik.max_iterations}",
            field="ik.max_iterations",
        )
    return ik


def _human(
    request: Open, cache: HandCache, lengths: HumanLengths | None, fitter: LandmarkFitter | None
) -> Hand:
    """Return the human hand with the reference points of the request."""
    if fitter is not None:
        return fitter.human.with_points(request.human_points)
    if lengths is None:
        return cache.human(request.side, request.human_points)
    return load_hand(human_name(request.side), points=request.human_points, lengths=lengths)


def _human_lengths(request: Open) -> HumanLengths | None:
    """Return the measured hand if the request has one."""
    lengths = request.lengths
    if lengths is None:
        return (
            None
            if request.hand_length is None
            else HumanLengths.from_hand_length(request.hand_length)
        )
    if not all(0.0 < math.hypot(*row) < 1.0 for row in (*lengths.bases, *lengths.segments)):
        raise InvalidInputError(argument="lengths", expected="lengths between 0 and 1 m")
    return HumanLengths(np.array(lengths.bases), np.array(lengths.segments))
