"""The seam of motors: what a driver does."""

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from handmap_qp.errors import HandmapError, expect
from handmap_qp.hands import Names

T = TypeVar("T")

_POSSIBLE = 0.2
"""How far out of its range a joint may be, by play and an inexact zero [rad]."""


class DriverError(HandmapError):
    """Motors do not answer, or report a fault of their own."""


def insisting(ask: Callable[..., T], *given: object) -> T:
    """Return what motors answer, in three attempts: for the start, where one is not enough.

    Args:
        ask: Asks them.
        *given: Arguments of `ask`.

    Raises:
        DriverError: If none of them has an answer.
    """
    for _ in range(2):
        with suppress(DriverError):
            return ask(*given)
    return ask(*given)


def check_places(q: np.ndarray, names: Names, limits: np.ndarray) -> None:
    """Check that joints are where they can be, before motors get torque.

    Args:
        q: Where they are [rad], shape (n,).
        names: Their names.
        limits: Their least and largest angles [rad], shape (2, n).

    Raises:
        InvalidInputError: If one is not; the number, zero or ratio of its motor is wrong.
    """
    beyond = np.abs(q - np.clip(q, *limits))
    i = beyond.argmax()
    expect(
        beyond[i] < _POSSIBLE,
        names[i],
        f"{limits[:, i]} rad",
        got=f"{q[i]:.3g}",
        advice="compare id, zero and ratio in --motors with the hand",
    )


class Health(NamedTuple):
    """How motors are.

    Attributes:
        temperature: Of each motor [degrees Celsius], shape (n,); NaN if it does not tell.
        faults: What motors report themselves, such as `if_mcp: overload`.
        unpowered: Joints whose motor has no torque, or does not have the set-up that the driver
            gave it. A motor that had torque, and was not stopped, has lost it: it was reset.
    """

    temperature: np.ndarray
    faults: Names
    unpowered: Names = ()

    def check(self, joint_names: Names, hottest: float) -> None:
        """Reject motors that report a fault, or are hotter than a temperature [degrees Celsius].

        Raises:
            DriverError: If one does.
        """
        if self.faults:
            raise DriverError(", ".join(self.faults))
        for name, degrees in zip(joint_names, self.temperature, strict=True):
            # NaN is not more than anything.
            if degrees > hottest:
                raise DriverError(f"{name}: {degrees:g} degrees, more than {hottest:g}")


class Driver(Protocol):
    """The motors of a hand.

    Torques are shares of the largest. An error of the port may also be an `OSError`.

    Attributes:
        joint_names: The joints that have a motor, in the order of all arrays.
        range: Least and largest angles of the joints [rad], shape (2, n).
        rate: How often motors can be written and read [Hz].
        speed: Largest speed that they may be commanded [rad/s].
        effort: Limit of their torque unless the user gives another one.
    """

    joint_names: Names
    range: np.ndarray
    rate: float
    speed: float
    effort: float

    def connect(self) -> None:
        """Open the port, and prepare the motors, which have no torque yet.

        Raises:
            HandmapError: If that is not possible.
        """

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        """Return where the joints are [rad], their torques, shapes (n,), and their health.

        Raises:
            DriverError: If an answer is missing or damaged; the next one may be right.
        """

    def write(self, q: np.ndarray, effort: float) -> None:
        """Set goals [rad], shape (n,), and the limit of torque.

        Motors without torque get it, and before that the set-up that they do not have. They may
        need several calls for it. `read` tells what became of it. The caller stops motors that
        lost their torque before the next call: otherwise their goal may be far away.
        """

    def stop(self) -> None:
        """Take the torque away. Called again and again, because a message may be lost.

        A hand that cannot be without torque holds where it is, with the least it can.
        """
