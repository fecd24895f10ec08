"""What the view shows at one instant: `ViewSample`; and over time: `Variant`."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from handmap_core.se3 import Array, lengths
from handmap_qp.hands import Hand, Names
from handmap_qp.mapping import Choice


class HumanView(NamedTuple):
    """One instant of a human hand; None for what is not known.

    Attributes:
        points: Reference points in W [m], shape (n_h, 3).
        q: Joint angles [rad], shape (n_human,).
        wrist: Wrist pose in W, shape (4, 4).
        landmarks: Landmarks in W as they were tracked [m], shape (21, 3).
        motion_deformation: T_def, shape (4, 4).
        pivot: The pivot after T, in W [m], shape (3,); given with `motion_deformation`.
    """

    points: Array | None = None
    q: Array | None = None
    wrist: Array | None = None
    landmarks: Array | None = None
    motion_deformation: Array | None = None
    pivot: Array | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewSample:
    """One instant of a robot, and of the human hands and the object where there are any.

    Attributes:
        time: Time since the start [s].
        robot_q: Joint angles [rad], shape (n,).
        robot_wrist: Wrist pose in V, shape (4, 4).
        robot_points: Reference points in V [m], shape (n_r, 3).
        targets: Targets of the points in V [m], shape (n_r, 3); None if the source does not report
            them or the robot is released.
        wrist_error: How far the wrist is from its target, of several the largest [m, rad]; NaN as
            for `targets`.
        object_pose: Pose in V of the variant's object, shape (4, 4); None if there is none.
        is_limited: Whether a position or speed limit held each robot joint in this step, shape
            (n,); False if the source does not report it.
        status: How the step ended.
        held_by: Both links of the pair that keeps the robot from its targets; empty if none does.
        rule: The rule that the sample broke, such as `jump`; empty if it broke none.
        duration: Wall time of the mapping step [s]; NaN if there was none.
        is_seen: Whether the robot followed the sample; if not, the previous one is held.
        note: Line below the robot's name; if empty, why the robot does not follow.
        humans: The hands that the robot follows, in the order of its own.
    """

    time: float
    robot_q: Array
    robot_wrist: Array
    robot_points: Array
    targets: Array | None = None
    wrist_error: Array | tuple[float, float] = (np.nan, np.nan)
    object_pose: Array | None = None
    is_limited: Array | bool = False
    status: str = ""
    held_by: Sequence[str] = ()
    rule: str = ""
    duration: float = np.nan
    is_seen: bool = True
    note: str = ""
    humans: Sequence[HumanView] = ()

    @property
    def parts(self) -> tuple[Any, ...]:
        """The robot, then each of `humans`."""
        return (self, *self.humans)

    @property
    def point_error(self) -> Array:
        """Distances of the robot points from their targets [m], shape (n_r,); NaN without."""
        targets = np.nan if self.targets is None else self.targets
        return lengths(targets - self.robot_points)

    @cached_property
    def plotted(self) -> tuple[float, float, float, float]:
        """Time [s], mean and largest point error [mm], and duration of the step [µs]."""
        error = 1e3 * self.point_error
        return self.time, error.mean(), error.max(), 1e6 * self.duration


class Variant(NamedTuple):
    """A robot hand that the view shows, and what moves it.

    Attributes:
        label: Name of the method or preset, shown below the hand.
        robot: The robot hand, with the reference points that the method moves.
        choice: Preset and options; None for a motion that they do not explain.
        samples: Its samples; at least the first.
        solid: An object, a `trimesh.Trimesh`, placed by `ViewSample.object_pose`; None for none.
        axes: Rotation from V to the scene's axes, in which +y is up and the view is along +z,
            shape (3, 3); as the mapping aligns both hands if omitted.
        drawn: Links that are drawn; all if omitted.
    """

    label: str
    robot: Hand
    choice: Choice | None
    samples: Sequence[ViewSample]
    solid: Any = None
    axes: Array | None = None
    drawn: Names | None = None

    @property
    def plotted(self) -> Array:
        """What is plotted of the samples (`ViewSample.plotted`), shape (4, n)."""
        return np.array([sample.plotted for sample in self.samples]).T
