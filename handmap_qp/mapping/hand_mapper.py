"""`HandMapper`: the paper's loop (Fig. 3), by a method that is named or given.

`handmap_core.mapping.hand_mapper` maps samples. Here both hands are bound to a method, and the QP
is made for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from handmap_core.mapping import hand_mapper
from handmap_core.mapping.exclusive import exclusively
from handmap_core.se3 import QuatOrder
from handmap_qp.hands import Hand
from handmap_qp.ik import IkOptions, Motion, PointIk, Task
from .custom_method import LandmarkFunction
from .method import BoundMethod, Method, Preset
from .target_source import TargetSource


class HandMapper(hand_mapper.HandMapper[TargetSource, PointIk]):
    """Turns the motion of a human hand into the motion of a robot hand.

    The first sample is the reference unless `reset` has given one. There the robot is at rest with
    its palm on the human's palm, as `alignment` takes it to the robot's world. The
    human's motion is imposed from there.

    A copy (`copy.deepcopy`, `copy.copy` or pickle) continues from the same state on its own.

    Args:
        human: The hand that leads, with a floating wrist; its reference points are the method's
            input.
        robot: The hand that follows.
        method: How a sample becomes targets: a `Method` such as a `CustomMethod` of your own, a
            function from landmarks to joint angles (`JointFunction`), or the name of a preset. If
            it and `preset` are omitted, `teleoperation` where the robot's fingers have partners on
            the human hand, else `object`.
        preset: A preset or its name (`PRESETS`), in place of `method`: its method and its weights.
        ik: Weights and settings of the QP; those of the preset if omitted.
        tasks: Further terms of the QP's cost, in every sample.
        dt: Usual time between samples [s], where a step gives none of its own.
        quat_order: Order of the quaternion in wrist poses given as seven numbers.
        joint_tolerance: How far a human joint may be outside its limits before the sample is
            rejected [rad].
        **options: Options of the method that is named, as in
            `HandMapper(human, robot, "object", ridge=0.01)`; if none is, those of the paper's
            method.

    Attributes:
        source: The human's side: the readers, the method for the two hands, and the reference.
        moving_robot: The robot's side.
        core: What maps the next sample in the compiled core; None where Python has to look at it.

    Raises:
        InvalidOptionsError: If choices contradict each other or the hands.
        InvalidInputError: If `dt` or `joint_tolerance` cannot be used.

    One thread at a time works on a mapper: while it maps, other threads that enter get a
    `MapperBusyError`, and nothing changes.
    """

    def __init__(
        self,
        human: Hand,
        robot: Hand,
        method: Method | LandmarkFunction | str | None = None,
        *,
        preset: Preset | str | None = None,
        ik: IkOptions | None = None,
        tasks: Sequence[Task] = (),
        dt: float = 1.0 / 60.0,
        quat_order: QuatOrder | None = None,
        joint_tolerance: float = 0.25,
        **options: Any,
    ) -> None:
        source = TargetSource(
            human,
            robot,
            method,
            preset=preset,
            tasks=tasks,
            quat_order=quat_order,
            joint_tolerance=joint_tolerance,
            options=options,
        )
        super().__init__(source, _solver_of(source.bound, ik or source.weights), dt)

    @property
    def human(self) -> Hand:
        """The hand that leads."""
        return self.source.human

    @property
    def robot(self) -> Hand:
        """The hand that follows, with the reference points that the method moves."""
        return self.source.robot

    @property
    def method(self) -> Method:
        """The mapping method, which turns a sample into targets; `configure` changes it."""
        return self.source.method

    @property
    def bound(self) -> BoundMethod:
        """What the method is for these two hands."""
        return self.source.bound

    @exclusively
    def configure(
        self,
        method: Method | LandmarkFunction | str | None = None,
        *,
        preset: Preset | str | None = None,
        ik: IkOptions | None = None,
        tasks: Sequence[Task] | None = None,
    ) -> None:
        """Change options between samples: reference and posture of the robot stay.

        A reference that was taken without a wrist pose is given up where the new method needs one;
        the next sample then takes its place.

        Args:
            method: How a sample becomes targets, as of `HandMapper`; as it is if it and `preset`
                are omitted.
            preset: Name of a preset, as of `HandMapper`.
            ik: Weights and settings of the QP; as they are if omitted, or those of a preset that is
                named.
            tasks: Further terms of the QP's cost; as they are if omitted.

        Raises:
            InvalidOptionsError: If choices contradict each other or the hands; the mapper is then
                as it was before.
            DegeneratePointsError: If with them the reference points do not determine the motion;
                likewise.
        """
        source = self.source
        robot = self.moving_robot
        binding = None
        if method is not None or preset is not None:
            binding = source.binding(method, preset)
            if preset is not None or isinstance(method, str):
                ik = ik or binding.weights
        solver = None
        if binding or ik:
            bound = binding.bound if binding else source.bound
            solver = _solver_of(bound, ik or self.ik, robot.motion)
        # Nothing fails from here on.
        if binding:
            source.bind(binding)
        if solver:
            robot.replace_solver(solver)
        if tasks is not None:
            self.set_tasks(tasks)
        self.core = None


def _solver_of(
    bound: BoundMethod, ik: IkOptions, motion: Motion | None = None
) -> PointIk:
    """Return the QP that moves the robot hand of a method."""
    return PointIk(bound.robot, ik, motion, contacts=bound.contacts)
