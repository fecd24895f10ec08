"""The preset and options of a session, from its client's requests."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import msgspec

from handmap_qp.errors import InvalidOptionsError, RefusedError
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.presets import Choice, preset_choice, preset_with
from handmap_qp.options import Options
from handmap_qp.service.messages import Configure, Open, field_of_option, misplaced_option
from handmap_qp.service.refusals import with_field_errors

T = TypeVar("T", bound=Options)
SOLVERS = ("daqp",)
"""Solvers that a client may choose. The time of others is not bounded, and all sessions would wait:
with a large weight, ProxQP took 97 s for one sample."""
MOST_ITERATIONS = 20


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
    name = request.preset or preset_with(request.options, human, robot)
    start = with_field_errors("preset", lambda: preset_choice(name, contact_gap))
    if field := misplaced_option(request, name):
        raise RefusedError("invalid", f"the preset {name} has no such option", field=field)
    method = _changed(partial(field_of_option, request), start.method, request.options)
    ik = _changed("ik.{:.64}".format, start.ik, request.ik)
    if ik.solver not in SOLVERS:
        expected = f"expected one of {', '.join(SOLVERS)}; got {ik.solver!r:.40}"
        raise RefusedError("invalid", expected, field="ik.solver")
    if ik.max_iterations > MOST_ITERATIONS:
        expected = f"expected at most {MOST_ITERATIONS}, got {ik.max_iterations}"
        raise RefusedError("invalid", expected, field="ik.max_iterations")
    return Choice(name, method, ik)


def _changed(field_of: Callable[[str], str], start: T, values: dict[str, Any]) -> T:
    """Return options with the values of a request, which gives each in the field of its name."""
    try:
        return start.replaced(**values)
    except InvalidOptionsError as error:
        message = ": ".join(filter(None, (error.what, error.advice)))
        raise RefusedError("invalid", message, field=field_of(error.option)) from error


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
            options=changes.options,
            mapping=changes.mapping,
            teleoperation=changes.teleoperation,
            ik=kept | changes.ik,
        )
    return msgspec.structs.replace(
        request,
        preset=choice.preset,
        options=request.options | changes.options,
        mapping=request.mapping | changes.mapping,
        teleoperation=request.teleoperation | changes.teleoperation,
        ik=request.ik | changes.ik,
    )
