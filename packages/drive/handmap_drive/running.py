"""What commands that move motors share: they find a driver, and stop it at the end."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGTSTP, signal
from threading import Event
from typing import Annotated

from handmap_qp.apps.arguments import hinted
from handmap_qp.errors import did_you_mean, expect
from handmap_qp.hands import Names
from . import DRIVERS
from .driver import Driver, DriverError

MotorsFile = Annotated[Path | None, hinted("MOTORS.yaml", "(default: the driver's)")]
Effort = Annotated[float | None, hinted("SHARE", "(default: the driver's)")]
_ENDING = SIGINT, SIGTERM, SIGHUP, SIGQUIT, SIGTSTP
"""Signals that end a drive. Ctrl-Z, too: it would leave motors alone with their last goal."""


def find_driver(name: str) -> Callable[[str, Names, Path | None], Driver]:
    """Return the maker of a driver.

    Raises:
        InvalidInputError: If there is none of this name.
    """
    expect(
        name in DRIVERS,
        "--driver",
        f"one of {', '.join(DRIVERS)}",
        value=name,
        advice=did_you_mean(name, DRIVERS),
    )
    return DRIVERS[name]


def effort_of(driver: Driver, given: float | None) -> float:
    """Return the limit of torque that is given, or the driver's own, a share of the largest.

    Raises:
        InvalidInputError: If it is no share.
    """
    effort = driver.effort if given is None else given
    expect(0.0 < effort <= 1.0, "--effort", "a share, 0 to 1", value=effort)
    return effort


@contextmanager
def stopping(driver: Driver) -> Iterator[Event]:
    """Yield what Ctrl-C sets, or the end of the terminal; motors have no torque in the end."""
    over = Event()
    # Not in the middle of a message, as an exception would end it.
    for number in _ENDING:
        signal(number, lambda *_: over.set())
    try:
        yield over
    finally:
        # A message may be lost, or the port be gone.
        for _ in range(3):
            with suppress(OSError, DriverError):
                driver.stop()
