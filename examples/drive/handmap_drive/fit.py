"""What a hand makes of its commands, by least squares on what happened."""

import numpy as np

from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.hands import Hand
from .motion import Log

SLOWEST = 0.04
"""A joint moves above this speed [rad/s]."""
FULL = 0.9
"""Share of the limit of torque from which on a motor gives way."""
TORQUE = 0.01
"""Torques below this are none, as shares of the largest."""
MEETS = 0.02
"""Torque beyond friction that says that something is in the way."""
_LONGEST = 0.25
"""Longest delay that is looked for [s]."""
_ITERATIONS = 5
_STEP = 1e-4
"""Change of a joint from which gaps' slopes are found [rad]."""
_ERROR, _GAP = 0.03, 0.0003
"""Errors of encoders [rad] and of gaps [m] that are expected."""


def fit_joint(log: Log, i: int, limit: float) -> tuple[float, ...]:
    """Find the parameters of a joint by least squares.

    Where the torque e pulls the joint, still or not, `q = gain u(t - delay) + zero - sign(e)
    backlash / 2 - stretch e`. The delay is the one that leaves the least.

    Args:
        log: What happened.
        i: The joint.
        limit: The limit of torque.

    Returns:
        Gain, zero, delay, backlash, stretch and friction.
    """
    time, told = log.time, log.told[:, i]
    size = np.abs(log.torque[:, i])
    counts = (size > TORQUE) & (size < FULL * limit)
    pulls = np.sign(log.torque[:, i]) * counts
    is_pulled = np.abs(_smooth(pulls)) > 0.99
    q, torque = _smooth(log.q[:, i]), _smooth(log.torque[:, i])
    speed = np.abs(np.gradient(q, time))
    moves = is_pulled & (speed > SLOWEST)
    friction = np.median(np.abs(torque[moves]))
    # Noise of the many samples in motion would hide how torques change at rest.
    torque = np.where(moves, pulls * friction, torque)

    def solve(delay: float) -> tuple[float, np.ndarray]:
        late = _smooth(np.interp(time - delay, time, told))
        columns = np.array([late, np.ones_like(q), -0.5 * pulls, -torque])
        rows, wanted = columns.T[is_pulled], q[is_pulled]
        found, *_ = np.linalg.lstsq(rows, wanted)
        return np.sum((rows @ found - wanted) ** 2), found

    def best(delays: np.ndarray) -> float:
        return min(delays.tolist(), key=lambda delay: solve(delay)[0])

    delay = best(np.arange(0.0, _LONGEST, 0.01))
    delay = best(np.clip(delay + np.arange(-0.01, 0.01, 0.001), 0.0, None))
    gain, zero, *lag = solve(delay)[1]
    backlash, stretch = np.maximum(lag, 0.0)
    return gain, zero, delay, backlash, stretch, friction


def _smooth(values: np.ndarray) -> np.ndarray:
    """Return means over five turns."""
    return np.convolve(np.pad(values, 2, "edge"), np.full(5, 0.2), "valid")


def fit_encoders(
    hand: Hand, met: list[tuple[str, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Find the smallest errors of encoders with which tips meet where they met (Gauss-Newton).

    Args:
        hand: The hand.
        met: Fingers that met the thumb, and all joints there as encoders tell them [rad].

    Returns:
        What encoders miss [rad], shape (n,), and the gaps that they tell without it [m], (k,).
    """
    meter, n = GapMeter(hand), len(hand.joint_names)
    steps = np.vstack([np.zeros(n), _STEP * np.eye(n)])

    def gaps(error: np.ndarray) -> np.ndarray:
        rows = [meter.pinches(q + error + steps)[finger] for finger, q in met]
        return np.reshape(rows, (-1, n + 1))

    error = np.zeros(n)
    for _ in range(_ITERATIONS):
        values = gaps(error)
        gap = values[:, 0]
        slopes = (values[:, 1:] - values[:, :1]) / _STEP
        rows = np.vstack([slopes / _GAP, np.eye(n) / _ERROR])
        misses = np.concatenate([gap / _GAP, error / _ERROR])
        error = error - np.linalg.lstsq(rows, misses)[0]
    return error, gaps(np.zeros(n))[:, 0]
