"""What the view shows at one instant: `ViewSample`; and over time: `Variant`."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from handmap_qp.hands import Hand
from handmap_qp.mapping import Choice
from handmap_qp.se3 import Array, lengths


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewSample:
    """One instant of a robot hand, and of the human hand and the object where there are any.

    Attributes:
        time: Time since the start [s].
        robot_q: Robot joint angles [rad], shape (n,).
        robot_wrist: Robot wrist pose in V, shape (4, 4); of several hands, the base's.
        robot_points: Robot reference points in V [m], shape (n_r, 3).
        targets: Targets of the robot reference points in V [m], shape (n_r, 3); None if the source
            does not report them or the robot is released.
        wrist_target: Target of the robot wrist in V, shape (4, 4); None as for `targets`.
        human_q: Human joint angles [rad], shape (n_human,); None if only the points are known.
        human_wrist: Human wrist pose in W, shape (4, 4); None without a human hand.
        human_points: Human reference points in W [m], shape (n_h, 3); None without a human hand.
        landmarks: Landmarks in W as they were tracked [m], shape (21, 3); None if there are none.
        motion_deformation: T_def, shape (4, 4); None if the source does not report it.
        pivot: The human's pivot after T, in W [m], shape (3,); given with `motion_deformation`.
        object_pose: Pose in V of the variant's object, shape (4, 4); None if there is none.
        is_limited: Whether a position or speed limit held each robot joint in this step, shape
            (n,); False if the source does not report it.
        status: How the step ended.
        held_by: Both links of the pair that keeps the robot from its targets; empty if none does.
        rule: The rule that the sample broke, such as `jump`; empty if it broke none.
        duration: Wall time of the mapping step [s]; NaN if there was none.
        is_seen: Whether the robot followed the sample; if not, the previous one is held.
        note: Line below the robot's name; if empty, why the robot does not follow.
        hands: Of a robot with several hands, what each does and follows, in the robot's order.
    """

    time: float
    robot_q: Array
    robot_wrist: Array
    robot_points: Array
    targets: Array | None = None
    wrist_target: Array | None = None
    human_q: Array | None = None
    human_wrist: Array | None = None
    human_points: Array | None = None
    landmarks: Array | None = None
    motion_deformation: Array | None = None
    pivot: Array | None = None
    object_pose: Array | None = None
    is_limited: Array | bool = False
    status: str = ""
    held_by: Sequence[str] = ()
    rule: str = ""
    duration: float = np.nan
    is_seen: bool = True
    note: str = ""
    hands: Sequence["ViewSample"] = ()

    @property
    def parts(self) -> tuple["ViewSample", ...]:
        """The whole, then each of `hands`; the last ones are of one hand each."""
        return (self, *self.hands)

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
    """

    label: str
    robot: Hand
    choice: Choice | None
    samples: Sequence[ViewSample]
    solid: Any = None
    axes: Array | None = None

    @property
    def plotted(self) -> Array:
        """What is plotted of the samples (`ViewSample.plotted`), shape (4, n)."""
        return np.array([sample.plotted for sample in self.samples]).T
