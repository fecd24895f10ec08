"""The seam between the angles of joints and the angles that motors are commanded."""

from typing import Protocol

import numpy as np

from handmap_qp.se3 import Array
from .driver import Driver


class JointMap(Protocol):
    """Maps angles of joints to goals of their motors, and back.

    Attributes:
        range: Least and largest angles of the joints [rad], shape (2, n).
    """

    range: Array

    def restart(self, q: Array) -> None:
        """Forget what was commanded; joints are at angles q [rad], shape (n,)."""

    def command(self, q: Array) -> Array:
        """Return the motors' goals in a turn that bring joints to q [rad], shapes (n,)."""

    def reached(self, goal: Array) -> Array:
        """Return the angles to which joints come by the motors' goals [rad], shapes (n,)."""

    def angles(self, q: Array) -> Array:
        """Return the angles of joints by those that motors tell [rad], shapes (n,)."""

    def torques(self, share: Array) -> Array:
        """Return the torques of joints by shares of the largest, NaN if not known [N m], (n,)."""


class Direct:
    """Joints that do what their motors are commanded; attributes as in `JointMap`.

    Args:
        driver: The motors.
    """

    def __init__(self, driver: Driver) -> None:
        self.range = driver.range

    def restart(self, q: Array) -> None:
        """See `JointMap`."""

    def command(self, q: Array) -> Array:
        """See `JointMap`."""
        return q

    def reached(self, goal: Array) -> Array:
        """See `JointMap`."""
        return goal

    def angles(self, q: Array) -> Array:
        """See `JointMap`."""
        return q

    def torques(self, share: Array) -> Array:
        """See `JointMap`."""
        return np.full_like(share, np.nan, dtype=float)
