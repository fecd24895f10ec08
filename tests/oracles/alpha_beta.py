"""The smoothing by numpy, as an oracle of the compiled core.

An alpha-beta filter with Kalata's tracking index (IEEE Trans. AES 20 (1984) 174).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from oracles.hand_place import Place

from handmap_core.stream.smoothing import Smoothing
from handmap_qp.mapping.method import HumanPose
from handmap_qp.se3 import Array, lengths

_LONGEST_GAP = 0.5  # a gap in time longer than this starts the filter again [s]
_HAND = 0.1  # lever that turns the wrist's angles into lengths [m]
_MEMORY = 0.25  # time in which the speed of a point is forgotten: where it turns, it is slow [s]
_LEAST_NOISE = 1e-9  # noise below this counts as this [m]
_MOST_NOISE = 0.004  # noise above this is not worth the lag that it would cost [m]
_FARTHEST = 3.0  # largest correction that is left out, over the noise
_LEAST_INDEX = (
    1e-9  # a tracking index below this counts as this: samples count, however little
)
_NORMAL = 1.538  # median length of vectors of three standard normal numbers
_SHARE = 0.1  # of a sample in the running estimate of noise
_MOST, _LEAST = 3.0, 3e-4


class SmoothState(NamedTuple):
    """State of the filter after a sample.

    Attributes:
        noise: Running estimate of the noise of the points [m]; 0 before there is one.
        waited: Time since the sample came [s].
        seen: The sample; None to start again.
        dt: Time between it and the one before [s]; 0 for a first one.
        moving: Velocity of its points, shape (n, 3) [m/s]; None for a first one.
        speeds: Smoothed velocities, as of `Place.to`, shape (n + 2, 3) [m/s, rad/s].
        recent: Largest recent speeds, of the turn at a lever, shape (n + 2,) [m/s]; 0 likewise.
        stages: Where the three filters are; the last one is the smoothed sample.
    """

    noise: float = 0.0
    waited: float = 0.0
    seen: Any = None
    dt: float = 0.0
    moving: Any = None
    speeds: Any = None
    recent: Any = 0.0
    stages: tuple[Place, ...] = ()


class ReferenceSmoother:
    """Does what `Smoother` does."""

    def __init__(self, options: Smoothing | None) -> None:
        self.options = options
        self._state = self._former = SmoothState()

    def smooth(self, pose: HumanPose, dt: float) -> HumanPose:
        """Smooth the next sample, dt [s] after the last call; one that repeats is the same one."""
        if self.options is None:
            return pose
        before = self._former = self._state
        seen, former = Place.of(pose), before.seen
        dt += before.waited
        is_first = former is None or former.has_wrist != seen.has_wrist
        if is_first or dt > _LONGEST_GAP:
            still = np.zeros((len(seen.points) + 1, 3))
            self._state = SmoothState(
                before.noise, seen=seen, speeds=still, stages=(seen,) * 3
            )
        elif all(map(np.array_equal, seen, former)):
            self._state = before._replace(waited=dt)
        else:
            self._state = _smoothed(self.options, before, seen, dt)
        return self._state.stages[-1].pose()

    def wait(self, dt: float) -> None:
        """Let time pass without a sample [s]."""
        self._state = self._state._replace(waited=self._state.waited + dt)

    def restart(self) -> None:
        """Let the next sample pass as it is, and go on from there with the noise that is known."""
        self._state = SmoothState(self._state.noise)

    def forget(self) -> None:
        """Forget the sample that was smoothed last."""
        self._state = self._former


def _smoothed(
    options: Smoothing, before: SmoothState, seen: Place, dt: float
) -> SmoothState:
    """Smooth a sample that came dt [s] after the one before."""
    moving = (seen.points - before.seen.points)[:-1] / dt
    noise = before.noise
    if before.dt > 0.0:
        rate = change_rate(dt, before.dt)
        noise = learnt_noise(noise, noise_of(lengths(moving - before.moving), rate))
    noise = max(noise, _LEAST_NOISE)
    speeds = before.speeds
    levers = np.ones(len(speeds))
    levers[-1] = _HAND
    at = before.stages[0].moved(dt * speeds)
    way = at.to(seen)
    kept = math.exp(-dt / _MEMORY)
    recent = np.maximum(levers * lengths(speeds), kept * before.recent)
    # Kalata: alpha is 1 - r^2 and beta is 2 (1 - r)^2.
    acceleration = options.acceleration + options.speed_gain * recent
    index = acceleration * dt * dt / min(noise, _MOST_NOISE)
    index = np.maximum(index, _LEAST_INDEX)
    r = 4.0 / (4.0 + index + np.sqrt(8.0 * index + index * index))
    farthest = _FARTHEST * noise / np.maximum(levers * lengths(way), noise)
    left = np.minimum(r * r, farthest)[:, None]
    alpha = 1.0 - left
    speeds = speeds + 2.0 * (1.0 - np.sqrt(left)) ** 2 / dt * way
    stages = [at.moved(alpha * way)]
    at = stages[0].moved(2.0 * left / alpha * dt * speeds)
    for stage in before.stages[1:]:
        at = stage.moved(alpha * stage.to(at))
        stages.append(at)
    return SmoothState(noise, 0.0, seen, dt, moving, speeds, recent, tuple(stages))


def change_rate(dt: float, former: float) -> float:
    """Return the change of velocity over the noise that makes it, from the last steps [1/s]."""
    return math.hypot(1.0 / dt, 1.0 / former, 1.0 / dt + 1.0 / former)


def noise_of(changes: Array, rate: float) -> float:
    """Return the noise of points [m], of sizes (n,) of the changes of their velocities [m/s]."""
    return median(changes) / (_NORMAL * rate)


def learnt_noise(noise: float, seen: float) -> float:
    """Return the running estimate of noise after a sample, from that before [m]."""
    return noise + _SHARE * (min(seen, _MOST * max(noise, _LEAST)) - noise)


def median(values: Array) -> float:
    """Return the (upper) median, without the overhead of `np.median` on small arrays."""
    return float(np.sort(values)[len(values) // 2])
