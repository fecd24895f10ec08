"""The preset and options of a session, from its client's requests."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any, TypeVar

import msgspec

from handmap_qp.errors import HandmapError, RefusedError
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.mapping.presets import Choice, default_preset, preset_choice
from handmap_qp.service.messages import Configure, Open, split_validation_error
from handmap_qp.service.refusals import refused

SOLVERS = ("daqp",)
"""Solvers that a client may choose. The time of others is not bounded, and all sessions would wait:
with a large weight, ProxQP took 97 s for one sample."""
MOST_ITERATIONS = 20
_T = TypeVar("_T")


def read_choice(
    request: Open, human: Hand, robot: Hand, contact_gap: float | None = None
) -> Choice:
    """Read preset and options from a request.

    Args:
        request: The request, with the changes of all `configure` since.
        human: The hand that leads.
        robot: The hand that follows.
        contact_gap: The measured contact gap [m], used unless the request gives one.

    Raises:
        RefusedError: With the field at fault.
    """
    name = request.preset or ("paper" if request.mapping else default_preset(human, robot))
    start = preset_choice(name, contact_gap)
    kinds = {"mapping": MappingOptions, "teleoperation": Teleoperation}
    own = "teleoperation" if start.is_teleoperation else "mapping"
    for field, kind in kinds.items():
        values = getattr(request, field)
        _check_names(field, values, kind)
        if field != own and values:
            raise RefusedError(
                "invalid",
                f"the preset {name} has no such option",
                field=f"{field}.{min(values):.64}",
            )
    options = read_options(own, asdict(start.options) | getattr(request, own), kinds[own])
    return start._replace(options=options, ik=_read_ik(asdict(start.ik) | request.ik))


_PROTECTING = ("max_acceleration", "avoids_self_collision")


def with_changes(request: Open, choice: Choice, changes: Configure) -> Open:
    """Return the request that opens a session with changed options.

    Args:
        request: The request, with all changes before.
        choice: The choice in force.
        changes: The changes. Without a preset, options that are not named stay as they are.
    """
    if changes.preset is not None:
        # A limit that protects the robot does not end with a preset.
        kept = {name: request.ik[name] for name in _PROTECTING if name in request.ik}
        return msgspec.structs.replace(
            request,
            preset=changes.preset,
            mapping=changes.mapping,
            teleoperation=changes.teleoperation,
            ik=kept | changes.ik,
        )
    return msgspec.structs.replace(
        request,
        preset=choice.preset,
        mapping=request.mapping | changes.mapping,
        teleoperation=request.teleoperation | changes.teleoperation,
        ik=request.ik | changes.ik,
    )


def read_options(field: str, values: dict[str, Any], kind: type[_T]) -> _T:
    """Read options from a client's request, strictly.

    Args:
        field: Field of the request that holds them.
        values: Names and values.
        kind: The dataclass of the options.

    Raises:
        RefusedError: With the option that is unknown, of another type, or out of range.
    """
    _check_names(field, values, kind)
    try:
        return msgspec.convert(values, kind, strict=True)
    except msgspec.ValidationError as error:
        # msgspec raises errors of the options' own checks again; the original is the cause.
        if isinstance(error.__cause__, HandmapError):
            raise refused(error.__cause__, field, options=field) from error
        message, path = split_validation_error(error)
        raise RefusedError(
            "invalid", message, field=f"{field}.{path}" if path else field
        ) from error
    except (TypeError, OverflowError) as error:
        raise RefusedError("invalid", str(error), field=field) from error


def _check_names(field: str, values: dict[str, Any], kind: type[Any]) -> None:
    known = [item.name for item in fields(kind)]
    for name in values:
        if name not in known:
            raise RefusedError(
                "invalid",
                f"no such option; there are {', '.join(known)}",
                field=f"{field}.{name:.64}",
            )


def _read_ik(values: dict[str, Any]) -> IkOptions:
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
