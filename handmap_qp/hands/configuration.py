"""A hand in one posture: the workspace of everything that runs sample by sample.

It offers what `mink.build_ik` reads from a configuration, too (`model.nv`, `nv`, `q`).
"""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from handmap_core.errors import InvalidInputError
from handmap_core.hands import AttachedPoints
from handmap_core.se3 import Array, frozen

if TYPE_CHECKING:
    from handmap_core import _core
    from .hand import Hand


class PinocchioConfiguration:
    """One posture of a model, with its reference points; at first Pinocchio's neutral one.

    `place` and `displace` put it somewhere else.

    Args:
        hand: The hand, or the hands of a robot as one.

    Attributes:
        model: The hand's model.
        spread: `Hand.spread`.
        data: Its Pinocchio data. `data.J` has the spatial velocity at the world's origin per
            velocity of the model, linear rows first, shape (6, model.nv): do not write to it.
        q: Configuration last placed, shape (nq,), read-only; a new array with every placement.
        parts: Where the points of each hand are among all.
    """

    def __init__(self, hand: Hand) -> None:
        self._hand = hand
        self.model = hand.model
        self.spread = hand.spread
        self._wrists = [each.wrist_frame for each in hand.hands]
        self._points = AttachedPoints.reference_points(hand)
        self.data = self.model.createData()
        ends = [*accumulate(len(each.reference_points) for each in hand.hands)]
        self.parts = [*map(slice, [0, *ends], ends)]
        self.place(pin.neutral(self.model))

    def __reduce__(self) -> tuple[Any, ...]:
        """Build a copy with data of its own."""
        return type(self), (self._hand,), self.q

    @property
    def tree(self) -> _core.Tree:
        """The hand's kinematics, as the core has them."""
        return self._hand.tree

    @property
    def wrist(self) -> pin.SE3:
        """Wrist frame of the hand, or of the first one of a robot."""
        return self.wrists[0]

    @property
    def nv(self) -> int:
        """Number of active velocity coordinates, k: the wrist's and those of joints that lead."""
        return self.spread.shape[1]

    def place(self, q: Array) -> None:
        """Put the model at a configuration.

        Args:
            q: Pinocchio configuration, shape (nq,); its values are not checked.

        Raises:
            InvalidInputError: On a wrong shape or type.
        """
        try:
            pin.computeJointJacobians(self.model, self.data, q)
        except (TypeError, ValueError) as error:
            raise InvalidInputError(
                argument="q",
                expected=f"a Pinocchio configuration of shape ({self.model.nq},)",
                value=q,
            ) from error
        self.q = frozen(np.array(q))

    __setstate__ = place

    @property
    def points(self) -> Array:
        """Reference points in the world [m], shape (m, 3)."""
        return frozen(self._points.positions(self))

    @property
    def wrists(self) -> list[pin.SE3]:
        """Wrist frame of each hand."""
        return [*map(self._placed, self._wrists)]

    def _placed(self, frame: pin.Frame) -> pin.SE3:
        return self.data.oMi[frame.parentJoint] * frame.placement

    def frame_pose(self, frame: pin.Frame) -> Array:
        """Return the pose of any frame on the joints in the world, shape (4, 4); a new array."""
        return self._placed(frame).homogeneous

    def displace(self, start: Array, displacement: Array) -> None:
        """Go from a configuration by a displacement; Jacobians become valid.

        Args:
            start: Pinocchio configuration, shape (nq,).
            displacement: Displacement in the active coordinates [rad or m], shape (k,).
        """
        self.place(pin.integrate(self.model, start, self.spread.dot(displacement)))

    def point_jacobian(self) -> Array:
        """Jacobian of the points in the active coordinates, in world axes [m per unit].

        Returns:
            Jacobian, rows x, y, z of each point in turn, shape (3 m, k); a new array.
        """
        return self._points.jacobians(self).reshape(-1, self.nv)

    def wrist_jacobian(self, error_jacobian: Array, part: int = 0) -> Array:
        """Body Jacobian of a wrist in the active coordinates.

        Args:
            error_jacobian: Factor on its left, shape (6, 6).
            part: Index of the hand.

        Returns:
            `error_jacobian @ J_wrist`, shape (6, k); a new array.
        """
        wrist = self._wrists[part]
        place = wrist.parentJoint, wrist.placement
        rows = pin.getFrameJacobian(self.model, self.data, *place, pin.LOCAL)
        return self.contracted(error_jacobian @ rows)

    def contracted(self, jacobian: Array) -> Array:
        """Take a Jacobian over the model's tangent space to the active coordinates.

        Args:
            jacobian: Shape (..., model.nv).

        Returns:
            Jacobian, shape (..., k).
        """
        return jacobian.dot(self.spread)
