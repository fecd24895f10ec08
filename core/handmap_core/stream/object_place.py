"""`ObjectPlace`: where an object is, with the uncertainty of that, which touches make smaller."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array

PLACE_DEVIATION = 0.005
"""Standard deviation along each axis of a place for which none is stated [m]: a depth camera's."""
_TOUCH_DEVIATION = 0.002
"""Standard deviation of a place that a touch measures, along its normal [m]."""
_PLAUSIBLE = 3.0
"""A touch farther from the place than so many deviations is none of both sides of the object."""
_TRUSTED = 0.004
"""Standard deviation at which a place counts half as much as an exact one [m]."""
_SEVERAL = 3.0
"""A place farther from the one before than so many deviations is of another object."""
_ANOTHER = 0.02
"""A place no farther from the one before than this is of the same object [m]."""


class ObjectPlace(NamedTuple):
    """Where an object is.

    The places that a user states have one common error, such as that of a camera's calibration. It
    is normal, with mean 0 and the stated standard deviation along each axis, until a touch has
    measured it along one direction (Kalman, J. Basic Eng. 82 (1960) 35, for one number).

    Attributes:
        stated: The place as the user states it now [m], shape (3,).
        deviation: Its stated standard deviation along each axis [m].
        correction: What has to be added to it, by all touches [m], shape (3,).
        covariance: Covariance of the corrected place [m^2], shape (3, 3).
    """

    stated: Array
    deviation: float
    correction: Array
    covariance: Array

    @classmethod
    def first(cls, stated: Array, deviation: float) -> ObjectPlace:
        """Return a place that nothing has touched."""
        return cls(stated, deviation, np.zeros(3), deviation**2 * np.eye(3))

    def at(self, stated: Array, deviation: float) -> ObjectPlace:
        """Return the place after the next statement; touches of the same object still count."""
        moved = float(np.linalg.norm(stated - self.stated))
        is_another = moved > max(_SEVERAL * self.deviation, _ANOTHER)
        if is_another or deviation != self.deviation:
            return ObjectPlace.first(stated, deviation)
        return self._replace(stated=stated)

    @property
    def centre(self) -> Array:
        """The corrected place [m], shape (3,)."""
        return self.stated + self.correction

    @property
    def shares(self) -> Array:
        """How much errors from the place count against those from an exact one, shape (3, 3).

        `(1 + P / s^2)^(-1)` with the covariance P and s = 4 mm: the share of a measurement in the
        mean of two normal errors, of which the other one, the person's closing, has the standard
        deviation s.
        """
        variances, axes = np.linalg.eigh(self.covariance)
        shares = 1.0 / (1.0 + variances.clip(0.0) / _TRUSTED**2)
        return (axes * shares) @ axes.T

    def shares_beside(self, line: Array, across: float) -> Array:
        """Return `shares` of which those across a line count less, shape (3, 3).

        Args:
            line: Direction of the line, of length 1, shape (3,).
            across: Share of an error across the line that counts, from 0 to 1.
        """
        along = np.outer(line, line)
        counted = along + across * (np.eye(3) - along)
        return counted @ self.shares @ counted

    def deviation_along(self, direction: Array) -> float:
        """Return the standard deviation along a direction of length 1, shape (3,) [m]."""
        return float(np.sqrt(direction @ self.covariance @ direction))

    def is_midway(self, point: Array, normal: Array) -> bool:
        """Return whether two pads that press on the object could have this point between them.

        Pads that press on opposite faces are equally far from its middle along their line. So a
        measured middle that the place and the touch do not explain is of pads that touch something
        else, or of a finger that is stopped by another part than its pad.

        Args:
            point: Midway between the pads [m], shape (3,).
            normal: Direction of the line between the pads, of length 1, shape (3,).
        """
        missed = normal @ (point - self.centre)
        variance = normal @ self.covariance @ normal + _TOUCH_DEVIATION**2
        return bool(missed**2 <= _PLAUSIBLE**2 * variance)

    def touched(self, point: Array, normal: Array) -> ObjectPlace:
        """Return the place after a touch, which measures it along its normal.

        Args:
            point: A point of the plane through the middle of the object, normal to the touch [m],
                shape (3,): midway between two pads that press on it.
            normal: Direction of the touch, of length 1, shape (3,).
        """
        towards = self.covariance @ normal
        gain = towards / (normal @ towards + _TOUCH_DEVIATION**2)
        missed = normal @ (point - self.centre)
        return self._replace(
            correction=self.correction + gain * missed,
            covariance=self.covariance - np.outer(gain, towards),
        )
