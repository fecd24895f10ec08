"""`TargetSource`: the human's side of one hand, whose method is named or given.

`handmap_core.mapping.target_source` turns samples into targets by a method that is bound already.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from handmap_core.mapping import target_source
from handmap_core.mapping.reference import Reference
from handmap_core.se3 import QuatOrder
from handmap_qp.hands import Hand, Values
from handmap_qp.ik import IkOptions, Task
from .custom_method import LandmarkFunction, bind_method
from .method import BoundMethod, Method, Preset, default_preset
from .named_method import named_method


class Binding(NamedTuple):
    """A method that is bound to the two hands of a source.

    Attributes:
        method: The method.
        weights: Weights and settings of the QP that go with it.
        bound: The method for the two hands.
        counted_from: The reference, bound to the method; None if the next sample becomes it.
    """

    method: Method
    weights: IkOptions
    bound: BoundMethod
    counted_from: Reference | None = None


class TargetSource(target_source.TargetSource[Hand, BoundMethod]):
    """Turns the samples of a human hand into targets of a robot hand.

    Args:
        human: The hand that leads, with a floating wrist.
        robot: The hand that follows.
        method: As of `HandMapper`.
        preset: Likewise.
        tasks: Likewise.
        quat_order: Likewise.
        joint_tolerance: Likewise [rad].
        options: Options of the method, by name.

    Attributes:
        method: The mapping method.
        weights: Weights and settings of the QP that go with the method.

    Raises:
        InvalidOptionsError: If choices contradict each other or the hands.
        InvalidInputError: If `robot` has several hands, or `joint_tolerance` cannot be used.
    """

    method: Method
    weights: IkOptions

    def __init__(
        self,
        human: Hand,
        robot: Hand,
        method: Method | LandmarkFunction | str | None = None,
        *,
        preset: Preset | str | None = None,
        tasks: Sequence[Task] = (),
        quat_order: QuatOrder | None = None,
        joint_tolerance: float = 0.25,
        options: Values,
    ) -> None:
        def bind() -> BoundMethod:
            is_free = method is None and preset is None and not options
            chosen = default_preset(human, robot) if is_free else preset
            self.method, self.weights = named_method(method, chosen, options)
            return bind_method(self.method, human, robot)

        self._given_robot = robot
        super().__init__(
            human,
            robot,
            bind,
            tasks=tasks,
            quat_order=quat_order,
            joint_tolerance=joint_tolerance,
        )

    @property
    def robot(self) -> Hand:
        """The hand that follows, with the reference points that the method moves."""
        return self.bound.robot

    # -- another method

    def binding(
        self,
        method: Method | LandmarkFunction | str | None,
        preset: Preset | str | None = None,
    ) -> Binding:
        """Return another method, bound to the two hands, with the same reference.

        A reference that was taken without a wrist pose is given up where the method needs one.

        Args:
            method: As of `HandMapper`; None if `preset` is given.
            preset: Likewise.

        Raises:
            InvalidOptionsError: If choices contradict each other or the hands.
            DegeneratePointsError: If the reference points do not determine the motion.
        """
        chosen, weights = named_method(method, preset, {})
        bound = bind_method(chosen, self.human, self._given_robot)
        reference = self.counted_from and self.counted_from.bound_again(bound)
        return Binding(chosen, weights, bound, reference)

    def bind(self, binding: Binding) -> None:
        """Map by another method."""
        self.method = binding.method
        self.weights = binding.weights
        self.bound = binding.bound
        self.counted_from = binding.counted_from
