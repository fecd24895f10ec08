"""A mapping method of your own: `CustomMethod`, and `JointFunction` for a plain function.

    class HalfClosed(CustomMethod):
        def targets(self, sample):
            return self.place_joints(sample, 0.5 * (self.robot.rest + self.robot.upper_limits))

    HandMapper(human, robot, HalfClosed())

`targets` is all that must be written. The robot's palm follows the human's palm, and the QP keeps
the limits. A function from landmarks to joint angles is a method too:

    HandMapper(load_hand("human", points="landmarks"), robot, lambda landmarks: robot.rest)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.errors import (
    InvalidInputError,
    InvalidOptionsError,
    did_you_mean,
)
from handmap_core.mapping import palm
from handmap_core.mapping.alignment import Alignment
from handmap_core.mapping.targets import (
    HumanPose,
    RobotPosture,
    Targets,
    check_members,
)
from handmap_core.se3 import Array, inverse_pose, transform_points
from handmap_qp.hands import Hand
from handmap_qp.human import LANDMARK_NAMES
from handmap_qp.ik import IkOptions, JointPositions
from .hand_pair import points_in_palm, robot_fingers
from .method import FOLLOWING, BoundMethod, Method
from .palm import require_points

if TYPE_CHECKING:
    from handmap_qp.hands import ShapePairs

JointAnswer = ArrayLike | Mapping[str, float]
"""Joint positions [rad or m]: in the order of `Hand.joint_names`, shape (n,), or by name."""
LandmarkFunction = Callable[[Array], JointAnswer]
"""Takes landmarks in MediaPipe's order [m], shape (21, 3); returns joint positions."""

# Weight of a joint's error [1/rad]: 0.1 rad counts as much as 10 mm of a point.
_JOINT_WEIGHT = 10.0
_MOST_NAMES = 6  # in a message
_BOUND_MEMBERS = (
    "robot",
    "contacts",
    "needs_wrist",
    "reference_needs_wrist",
    "renews_reference",
    "start_palm",
    "start",
)
"""Members of a `BoundMethod`."""


class CustomMethod(ABC):
    """Base of a mapping method of your own: only `targets` must be written.

    One object is all stages of a method (`handmap_qp.mapping.method`). `bind` returns a copy that
    knows both hands, and `start` a copy that knows the reference. State of a subclass, such as a
    filter's, therefore starts again with each reference.

    Attributes:
        human: The hand that leads; set by `bind`.
        robot: The hand that follows; set by `bind`.
        rest: Joint positions that the QP's rest term pulls to [rad or m], shape (n,); set by
            `bind`, and `prepare` may change them.
        palm: Moves the robot's palm with the human's; set by `start`.
        alignment: From the human's world to the robot's; as of the other methods.
        weights: Weights and settings of the QP, unless the user gives others.
        human_points: Set of the human's reference points that `handmap compare` and `score` load,
            such as "landmarks"; the hand's own 20 joints and tips if None.
        keeps_apart: Whether the robot's links are kept apart, all that may collide.
        contacts: See `BoundMethod`; set by `bind`.
        needs_wrist: See `BoundMethod`.
        reference_needs_wrist: See `BoundMethod`.
        renews_reference: See `BoundMethod`.
    """

    human: Hand
    robot: Hand
    rest: Array
    palm: palm.PalmMap
    alignment: Alignment = "world"
    weights: IkOptions = FOLLOWING
    keeps_apart: bool = True
    human_points: str | None = None
    contacts: ShapePairs | None = None
    needs_wrist: str = "the pose of the palm"
    reference_needs_wrist: str = ""
    renews_reference: bool = False

    @abstractmethod
    def targets(self, sample: HumanPose) -> Targets:
        """Return the targets of one sample.

        `place_joints` makes them of joint positions, `place_points` of points in palm axes.

        Args:
            sample: The human hand: its reference points and its wrist, in the human's world [m].
        """

    def prepare(self) -> None:  # noqa: B027 - a subclass may do without
        """Compute what depends on the two hands alone, once; does nothing unless overridden.

        Raises:
            InvalidOptionsError: In a subclass that cannot be used with these hands.
        """

    # -- what a mapper calls

    def bind(self, human: Hand, robot: Hand) -> Self:
        """Return a copy for two hands; see `Method.bind`."""
        contacts = robot_fingers(robot).contacts if self.keeps_apart else None
        bound = self._copy(human=human, robot=robot, rest=robot.rest, contacts=contacts)
        bound.prepare()
        return bound

    def start_palm(self, sample: HumanPose) -> Array:
        """Return the human's palm in the robot's world; see `BoundMethod.start_palm`."""
        return self._palm_method.start_palm(sample)

    def start(self, sample: HumanPose, robot: RobotPosture) -> Self:
        """Return a copy that counts from a reference; see `BoundMethod.start`."""
        return self._copy(palm=palm.PalmMap(self._palm_method, sample, robot))

    # -- helpers for `targets`

    def in_palm(self, sample: HumanPose) -> Array:
        """Return the human's reference points in palm axes [m], shape (n_h, 3)."""
        human = palm.palm_of(sample, self.human)
        return transform_points(inverse_pose(human), sample.points)

    def place_points(
        self,
        sample: HumanPose,
        points: ArrayLike,
        diagnostics: Mapping[str, Array] | None = None,
    ) -> Targets:
        """Return targets of points in the robot's palm, which follows the human's.

        Args:
            sample: The sample, for the palm.
            points: Targets of the robot's reference points in its palm axes [m], shape (n_r, 3).
            diagnostics: Values to find in `MapStep.diagnostics`.
        """
        _, target, _ = self.palm.follow(sample)
        placed = self.palm.placed(target, np.asarray(points, dtype=float))
        return Targets(*placed, diagnostics or {})

    def place_joints(
        self,
        sample: HumanPose,
        q: JointAnswer,
        diagnostics: Mapping[str, Array] | None = None,
    ) -> Targets:
        """Return targets of joint positions, with a palm that follows the human's.

        A term of the QP pulls the joints there, and the reference points go where they then are.

        Args:
            sample: The sample, for the palm.
            q: Joint positions [rad or m], shape (n,), or by name; limits need not hold.
            diagnostics: Values to find in `MapStep.diagnostics`.

        Raises:
            InvalidInputError: If they are not those of the robot's joints.
        """
        robot = self.robot
        wanted = joint_positions(q, robot)
        _, target, _ = self.palm.follow(sample)
        placed = self.palm.placed(target, points_in_palm(robot, wanted))
        task = JointPositions(robot, slice(None), wanted, _JOINT_WEIGHT)
        return Targets(*placed, {"q": wanted.copy()} | dict(diagnostics or {}), (task,))

    @property
    def _palm_method(self) -> palm.PalmMethod[Hand]:
        return palm.PalmMethod(self.alignment, self.human, self.robot)

    def _copy(self, **known: Hand | Array | ShapePairs | palm.PalmMap | None) -> Self:
        """Return a copy with further attributes, also of a frozen dataclass."""
        made = copy(self)
        vars(made).update(known)
        return made


class JointFunction(CustomMethod):
    """A function from landmarks to joint angles, as a mapping method.

    The QP follows its joints within the robot's limits, and keeps links apart.

    Args:
        function: Takes the landmarks in MediaPipe's order in the human's world [m], shape (21, 3).
            Returns joint positions [rad or m]: in the order of `Hand.joint_names`, or by name.
    """

    human_points = "landmarks"

    def __init__(self, function: LandmarkFunction) -> None:
        self.function = function

    def prepare(self) -> None:
        """Find the landmarks among the human's points.

        Raises:
            InvalidOptionsError: If the human's reference points are not the landmarks.
        """
        known = [point.name for point in self.human.reference_points]
        if missing := [name for name in LANDMARK_NAMES if name not in known]:
            raise InvalidOptionsError(
                f"a function of landmarks needs all 21, and {', '.join(missing)} "
                "is not among the human's points",
                option="method",
                advice="load the human with points='landmarks'",
            )
        self._landmarks = require_points(self.human, LANDMARK_NAMES, "a function")

    def targets(self, sample: HumanPose) -> Targets:
        """Place the joints that the function returns."""
        landmarks = sample.points[self._landmarks]
        return self.place_joints(sample, self.function(landmarks))


def joint_positions(answer: JointAnswer, robot: Hand) -> Array:
    """Return joint positions in the order of a robot's joints [rad or m], shape (n,).

    Args:
        answer: Positions in that order, or by name. NaN is passed on.
        robot: The robot hand.

    Raises:
        InvalidInputError: If the names or their number are not the robot's, or one is no number.
    """
    names = robot.joint_names
    listed = shortened(names)
    if isinstance(answer, Mapping):
        unknown = [str(name) for name in answer if name not in names]
        missing = [name for name in names if name not in answer]
        if missing or unknown:
            got = f"unknown {shortened(unknown)}" if unknown else ""
            hint = did_you_mean(unknown[0], names) if unknown else ""
            raise InvalidInputError(
                argument="joints",
                expected=f"the {len(names)} joints of {robot.name}",
                got=got or f"none for {shortened(missing)}",
                advice=hint or f"they are {listed}",
            )
        answer = [answer[name] for name in names]
    try:
        q = np.array(answer, dtype=float)
    except (TypeError, ValueError):
        q = None
    if answer is None or q is None or q.shape != (len(names),):
        is_array = answer is not None and q is not None
        raise InvalidInputError(
            argument="joints",
            expected=f"{len(names)} joint positions as in {robot.name}.joint_names",
            got=f"an array of shape {q.shape}" if is_array else f"{answer!r:.60}",
            advice=f"they are {listed}",
        )
    return q


def shortened(names: Sequence[str]) -> str:
    """Return names as a list, with dots in the middle of a long one."""
    if len(names) > _MOST_NAMES:
        names = (*names[: _MOST_NAMES - 2], "...", names[-1])
    return ", ".join(names)


def bind_method(method: Method, human: Hand, robot: Hand) -> BoundMethod:
    """Bind a method to two hands, and check that what it returns is whole.

    Raises:
        InvalidOptionsError: If the choices contradict the hands, or members are missing.
    """
    bound = method.bind(human, robot)
    check_members(bound, _BOUND_MEMBERS, f"{type(method).__name__}.bind(human, robot)")
    return bound
