"""`Smoother`: smooths the samples of a hand as much as they are noisy."""

from __future__ import annotations

from typing import TypedDict

from handmap_core.core import core
from handmap_core.mapping import HumanPose, core_pose
from handmap_core.options import NotNegative, Options, Positive
from handmap_core.se3 import Array


class Smoothing(Options, frozen=True):
    """How much samples are smoothed before they are mapped; see `Smoother`.

    Attributes:
        acceleration: Acceleration that a point at rest may have [m/s^2].
        speed_gain: Rise of the acceleration with the speed of a point [1/s].
    """

    acceleration: Positive = core.SMOOTHING[0]
    speed_gain: NotNegative = core.SMOOTHING[1]


SMOOTH_IK = {"speed_weight": 2.0, "acceleration_weight": 8.0}
"""Weights of `IkOptions` that smooth further: they damp what the QP adds to smooth targets."""


class _SmootherState(TypedDict):
    """What a copy of a `Smoother` continues from."""

    options: Smoothing | None
    saved: tuple[int, bool, Array]


class Smoother:
    """Smooths the samples of one hand as much as they are noisy; without options, not at all.

    An alpha-beta filter predicts every point by its velocity, and corrects it by a share of what is
    measured. Kalata's tracking index (IEEE Trans. AES 20 (1984) 174) gives the share: the
    acceleration that a point may have, times the square of the time, over the noise. Two low-pass
    filters of the same share follow, which take from the jerk; the velocity makes up for their lag.
    Without noise, all shares are 1, and samples pass as they are. The compiled core filters
    (`core/include/handmap/smoothing.hpp`).

    Args:
        options: How much; None for not at all.

    Attributes:
        options: As given.
        core: The smoother of the compiled core.
    """

    def __init__(self, options: Smoothing | None) -> None:
        self.options = options
        self.core = self._new_core()

    def _new_core(self) -> core.Smoother:
        if self.options is None:
            return core.Smoother(None, 0.0)
        return core.Smoother(self.options.acceleration, self.options.speed_gain)

    def __getstate__(self) -> _SmootherState:
        """Return what a copy continues from."""
        return {"options": self.options, "saved": self.core.save()}

    def __setstate__(self, state: _SmootherState) -> None:
        """Continue from the state of another one."""
        self.options = state["options"]
        self.core = self._new_core()
        self.core.restore(state["saved"])

    def smooth(self, pose: HumanPose, dt: float) -> HumanPose:
        """Smooth the next sample, dt [s] after the last call; one that repeats is the same one."""
        return HumanPose.of_core(self.core.smooth(core_pose(pose), dt))

    def wait(self, dt: float) -> None:
        """Let time pass without a sample [s]."""
        self.core.wait(dt)

    def restart(self) -> None:
        """Let the next sample pass as it is, and go on from there with the noise that is known."""
        self.core.restart()

    def forget(self) -> None:
        """Forget the sample that was smoothed last."""
        self.core.forget()
