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
        wrist: Smoothed wrist pose, shape (4, 4); None without a wrist.
        speeds: Smoothed velocity of each point, shape (n, 3) [m/s]; of a wrist also its linear and
            angular ones, shape (n + 2, 3).
    """

    points: np.ndarray
    wrist: np.ndarray | None
    speeds: np.ndarray


def smooth_sample(
    options: Smoothing,
    before: SmoothState | None,
    sample: HumanPose,
    dt: float,
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
    wrist = sample.wrist
    count = len(points)
    if before is None or dt > _LONGEST_GAP or (before.wrist is None) != (wrist is None):
        still = np.zeros((count if wrist is None else count + 2, 3))
        return sample, SmoothState(points, wrist, still)
    moves = [*(points - before.points)]
    levers = np.ones(len(before.speeds))
    if before.wrist is not None and wrist is not None:
        turn = pin.log3(before.wrist[:3, :3].T @ wrist[:3, :3])
        moves += [wrist[:3, 3] - before.wrist[:3, 3], turn]
        levers[-1] = _HAND
    steps = np.array(moves)
    share = _share(options.speed_cutoff, dt)
    speeds = before.speeds + share * (steps / dt - before.speeds)
    cutoffs = options.min_cutoff + options.speed_gain * levers * lengths(speeds)
    steps *= _share(cutoffs[:, None], dt)
    if before.wrist is not None:
        rotation = before.wrist[:3, :3] @ pin.exp3(steps[-1])
        wrist = affine(rotation, before.wrist[:3, 3] + steps[-2])
    smooth = before.points + steps[:count]
    return HumanPose.placed(smooth, wrist), SmoothState(smooth, wrist, speeds)


def _share(cutoff: float | np.ndarray, dt: float) -> float | np.ndarray:
    """Return the share of the new value in a first-order low-pass filter."""
    turn = 2.0 * math.pi * dt * cutoff
    return turn / (1.0 + turn)
