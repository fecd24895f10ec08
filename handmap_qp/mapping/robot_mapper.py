"""`RobotMapper`: both hands of a person move one robot, by one QP and one command.

    mapper = RobotMapper(load_robot("g1"))
    step = mapper.map_landmarks({"left": left, "right": right})
    robot.move_joints(step.command.joint_names, step.command.q)

`handmap_core.mapping.robot_mapper` maps samples. Here all hands are bound to a method, and the QP
is made for them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from handmap_core.errors import expect
from handmap_core.mapping import robot_mapper
from handmap_core.mapping.exclusive import exclusively
from handmap_core.mapping.robot_mapper import expect_sides
from handmap_core.se3 import Array, QuatOrder
from handmap_qp.hands import Hand, Side, common_pairs, joined, load_hand
from handmap_qp.human import human_name
from handmap_qp.ik import IkOptions, Motion, PointIk
from .custom_method import LandmarkFunction
from .method import BoundMethod, Method, Preset
from .target_source import TargetSource


class RobotMapper(robot_mapper.RobotMapper[TargetSource, PointIk]):
    """Turns the motion of a person's hands into the motion of a robot.

    The first sample of each hand is its reference; the robot is at rest there. A copy continues
    from the same state on its own.

    Args:
        robot: The robot, as of `load_robot`.
        humans: The hands that lead, by side; hands of the package's person if omitted.
        method: As of `HandMapper`, for all hands.
        preset: Likewise.
        ik: Weights and settings of the QP; those of the preset if omitted.
        dt: Usual time between samples [s], where a step gives none of its own.
        quat_order: As of `HandMapper`.
        joint_tolerance: Likewise [rad].
        turns_in: Time after a reference until the robot's palms have the directions of the person's
            [s]; infinite to keep how they differ at the reference.
        **options: Options of the method, as of `HandMapper`. Name tasks in `IkOptions`.

    Raises:
        InvalidOptionsError: As of `HandMapper`.
        InvalidInputError: Likewise, or if a hand of the robot has no partner in `humans`.
    """

    def __init__(
        self,
        robot: Hand,
        humans: Mapping[Side, Hand] | None = None,
        method: Method | LandmarkFunction | str | None = None,
        *,
        preset: Preset | str | None = None,
        ik: IkOptions | None = None,
        dt: float = 1.0 / 60.0,
        quat_order: QuatOrder | None = None,
        joint_tolerance: float = 0.25,
        turns_in: float = 2.0,
        **options: Any,
    ) -> None:
        expect("tasks" not in options, "tasks", "none: name them in `ik`")
        if humans is None:
            humans = {
                side: load_hand(human_name(side), points="landmarks")
                for side in robot.by_side
            }
        expect_sides(robot.by_side, humans, "humans")
        sources = {
            side: TargetSource(
                humans[side],
                hand,
                method,
                preset=preset,
                quat_order=quat_order,
                joint_tolerance=joint_tolerance,
                options=options,
            )
            for side, hand in robot.by_side.items()
        }
        self._name = robot.name
        first = sources[robot.side]
        bound = [source.bound for source in sources.values()]
        solver, pinching = _solver_of(robot.name, bound, ik or first.weights)
        super().__init__(sources, solver, dt, pinching=pinching, turns_in=turns_in)

    @property
    def human(self) -> Hand:
        """The first hand that leads; joints and points of the others have the same names."""
        return self.hands[self.robot.side].source.human

    @property
    def robot(self) -> Hand:
        """The robot as one hand, with the reference points of all that the methods move."""
        return self.point_ik.hand

    @exclusively
    def configure(
        self,
        method: Method | LandmarkFunction | str | None = None,
        *,
        ik: IkOptions | None = None,
    ) -> None:
        """Change options between samples, as `HandMapper.configure` of all hands.

        Raises:
            InvalidOptionsError: As there; the mapper is then as it was before.
        """
        bindings = {}
        if method is not None:
            for side, source in self.sources.items():
                bindings[side] = source.binding(method)
        if isinstance(method, str):
            ik = ik or bindings[self.robot.side].weights
        bound = [
            bindings[side].bound if side in bindings else source.bound
            for side, source in self.sources.items()
        ]
        motion = self.moving_robot.motion
        solver, pinching = _solver_of(self._name, bound, ik or self.ik, motion)
        # Nothing fails from here on.
        self.moving_robot.replace_solver(solver)
        self.pinching = pinching
        self.core = None
        for side, hand in self.hands.items():
            hand.core = None
            if side in bindings:
                hand.source.bind(bindings[side])
                # Its last request was of the former method.
                hand.stay()


def _solver_of(
    name: str, bound: Sequence[BoundMethod], ik: IkOptions, motion: Motion | None = None
) -> tuple[PointIk, list[Array]]:
    """Return the QP that moves the robot hands of methods as one.

    Args:
        name: Name of the robot.
        bound: The method of each hand.
        ik: Weights and settings of the QP.
        motion: How the robot moves; at rest if omitted.

    Returns:
        The QP, and which r pairs of shapes of each hand pinch, as `RobotMapper.pinching`.
    """
    whole = joined(name, *(each.robot for each in bound))
    contacts = tuple(each.contacts for each in bound if each.contacts)
    pairs, pinching = common_pairs(contacts) if contacts else (None, [])
    return PointIk(whole, ik, motion, contacts=pairs), pinching
