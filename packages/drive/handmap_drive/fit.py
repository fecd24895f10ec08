"""What a hand makes of its commands, by least squares on what happened."""

from functools import partial

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import approx_fprime

from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.hands import Hand
from handmap_qp.se3 import Array
from .motion import Log
from .tuning import BOUNDS, TORQUE

_SLOWEST = 0.04
"""A joint moves above this speed [rad/s]."""
FULL = 0.9
"""Share of the limit of torque from which on a motor gives way."""
_smooth = partial(uniform_filter1d, size=5, mode="nearest")
"""Returns means over five turns."""
_WEIGHT = 0.0005
"""Torque of weights that is hardly felt [N m]."""
_ITERATIONS = 5
_STEP = 1e-4
"""Change of a joint from which gaps' slopes are found [rad]."""
_ERROR = 0.03
"""Errors of encoders that are expected [rad]."""
_GAP = 0.0003
"""Errors of gaps that are expected [m]."""


def fit_joint(log: Log, i: int, limit: float, weights: Array) -> tuple[float, ...]:
    """Find the parameters of a joint by least squares.

    Where the torque e pulls the joint, still or not, `q = gain u(t - delay) + zero - sign(e)
    backlash / 2 - stretch e`. The delay is the one that leaves the least.

    Args:
        log: What happened.
        i: The joint.
        limit: The limit of torque.
        weights: Torques that hold the joint's links [N m], shape (T,).

    Returns:
        Gain, zero, delay, backlash, stretch, friction, and weight.
    """
    time = log.time
    commanded = log.commanded[:, i]
    raw = log.torque[:, i]
    is_able = np.abs(raw) < FULL * limit
    pulls = np.sign(raw) * (is_able & (np.abs(raw) > TORQUE))
    is_pulled = _is_steady(pulls)
    q = _smooth(log.q[:, i])
    speed = np.gradient(q, time)
    side = np.sign(speed)
    moves = _is_steady(side * (is_able & (np.abs(speed) > _SLOWEST)))
    # In motion, torque is that of weights and friction. Links that weigh next to nothing tell
    # nothing about the motor.
    loads = np.array([weights, side]).T
    slight = [_WEIGHT * np.sqrt(moves.sum()), 0.0]
    felt = np.append(raw[moves], 0.0)
    held, *_ = np.linalg.lstsq(np.vstack([loads[moves], slight]), felt)
    weight, friction = np.maximum(held, 0.0)
    # Noise of the many samples in motion would hide how torques change at rest.
    torque = np.where(moves, loads @ (weight, friction), _smooth(raw))
    ones = np.ones_like(q)
    wanted = q[is_pulled]

    def solve(delay: float) -> tuple[float, ...]:
        late = _smooth(np.interp(time - delay, time, commanded))
        columns = np.array([late, ones, -0.5 * pulls, -torque])
        rows = columns.T[is_pulled]
        found, *_ = np.linalg.lstsq(rows, wanted)
        left = rows @ found - wanted
        return left @ left, delay, *found

    _, longest = BOUNDS["delay"]
    _, rough, *_ = min(map(solve, np.arange(0.0, longest, 0.01)))
    near = rough + np.arange(-0.01, 0.01, 0.001)
    _, delay, gain, zero, *lag = min(map(solve, np.maximum(near, 0.0)))
    backlash, stretch = np.maximum(lag, 0.0)
    return gain, zero, delay, backlash, stretch, friction, weight


def _is_steady(signs: Array) -> Array:
    """Return where signs are the same over some turns, and not 0."""
    return np.abs(_smooth(signs)) > 0.99


def fit_encoders(hand: Hand, met: list[tuple[str, Array]]) -> tuple[Array, Array]:
    """Find the smallest errors of encoders with which tips meet where they met (Gauss-Newton).

    Args:
        hand: The hand.
        met: Fingers that met the thumb, and all joints there as encoders tell them [rad].

    Returns:
        What encoders miss [rad], shape (n,), and the gaps that they tell without it [m], (k,).
    """
    meter = GapMeter(hand)
    nothing = np.zeros(len(hand.joint_names))

    def gaps(error: Array) -> Array:
        rows = [meter.pinches(q[None] + error)[finger] for finger, q in met]
        return np.ravel(rows)

    def misses(error: Array) -> Array:
        return np.append(gaps(error) / _GAP, error / _ERROR)

    error = nothing
    for _ in range(_ITERATIONS):
        slopes = approx_fprime(error, misses, _STEP)
        change, *_ = np.linalg.lstsq(slopes, misses(error))
        error = error - change
    return error, gaps(nothing)
