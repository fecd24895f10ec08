"""Smoothing of human samples before they are mapped: the one-euro filter, aware of time.

A low-pass filter whose cutoff rises with speed (Casiez, Roussel and Vogel, CHI 2012): a still hand
is smoothed much, a quick one hardly lags. Samples are filtered rather than commands, so that the
QP's speed limits hold for the commands.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.mapping.method import HumanPose
from handmap_qp.options import Options, number
from handmap_qp.se3 import affine, lengths

# A gap in time longer than this starts the filter again [s].
_LONGEST_GAP = 0.5
# Lever that turns the wrist's angular speed into a speed of points [m].
_HAND = 0.1


class Smoothing(Options, frozen=True):
    """Settings of the filter."""

    min_cutoff: Annotated[
        float, number("Cutoff frequency of a point at rest [Hz].", above=True)
    ] = 2.0
    speed_gain: Annotated[
        float, number("Rise of the cutoff with the speed of a point [Hz per m/s].")
    ] = 90.0
    speed_cutoff: Annotated[
        float, number("Cutoff frequency of the speed estimate [Hz].", above=True)
    ] = 5.0


SMOOTH_IK = {"speed_weight": 2.0, "acceleration_weight": 8.0}
"""Weights of `IkOptions` that go with smoothing: they damp what the QP adds to smooth targets."""


class SmoothState(NamedTuple):
    """State of the filter after a sample.

    Attributes:
        points: Smoothed points in wrist axes, or in the world without a wrist [m], shape (n, 3).
        speeds: Smoothed velocity of each point [m/s], shape (n, 3).
        wrist: Smoothed wrist pose, shape (4, 4); None without a wrist.
        twist: Smoothed velocity of the wrist, linear and angular, in its axes, shape (6,).
    """

    points: np.ndarray
    speeds: np.ndarray
    wrist: np.ndarray | None
    twist: np.ndarray


def smooth_sample(
    options: Smoothing, before: SmoothState | None, sample: HumanPose, dt: float
) -> tuple[HumanPose, SmoothState]:
    """Smooth one sample: the points in wrist axes, and the wrist pose.

    Args:
        options: Settings.
        before: State after the sample before; None for the first sample.
        sample: The human hand.
        dt: Time since the sample before [s].

    Returns:
        The smoothed sample, and the state for the next one.
    """
    points = sample.in_wrist
    is_first = (
        before is None
        or dt > _LONGEST_GAP
        or (before.wrist is None) != (sample.wrist is None)
    )
    if is_first or before is None:
        state = SmoothState(points, np.zeros_like(points), sample.wrist, np.zeros(6))
        return sample, state
    speeds = _blend(
        before.speeds, (points - before.points) / dt, options.speed_cutoff, dt
    )
    cutoff = options.min_cutoff + options.speed_gain * lengths(speeds)[:, None]
    smooth = _blend(before.points, points, cutoff, dt)
    wrist, twist = None, before.twist
    if sample.wrist is not None and before.wrist is not None:
        wrist, twist = _smooth_wrist(options, before.wrist, twist, sample.wrist, dt)
    return HumanPose.placed(smooth, wrist), SmoothState(smooth, speeds, wrist, twist)


def _smooth_wrist(
    options: Smoothing,
    before: np.ndarray,
    twist: np.ndarray,
    now: np.ndarray,
    dt: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smoothed wrist pose and its smoothed velocity."""
    turn = pin.log3(before[:3, :3].T @ now[:3, :3])
    shift = now[:3, 3] - before[:3, 3]
    twist = _blend(twist, np.concatenate([shift, turn]) / dt, options.speed_cutoff, dt)
    linear = options.min_cutoff + options.speed_gain * math.sqrt(
        twist[:3].dot(twist[:3])
    )
    angular = options.min_cutoff + options.speed_gain * _HAND * math.sqrt(
        twist[3:].dot(twist[3:])
    )
    rotation = before[:3, :3] @ pin.exp3(_share(angular, dt) * turn)
    return affine(rotation, before[:3, 3] + _share(linear, dt) * shift), twist


def _blend(
    before: np.ndarray, now: np.ndarray, cutoff: float | np.ndarray, dt: float
) -> np.ndarray:
    return before + _share(cutoff, dt) * (now - before)


def _share(cutoff: float | np.ndarray, dt: float) -> float | np.ndarray:
    """Return the share of the new value in a first-order low-pass filter."""
    turn = 2.0 * math.pi * dt * cutoff
    return turn / (1.0 + turn)
