"""How the hands of a robot are led together; `core/src/robot.hpp` has the formulas."""

from __future__ import annotations

from .encoding import Indices, Model, Pose


class RobotHandModel(Model, frozen=True, kw_only=True):
    """A hand of a robot.

    Attributes:
        palm_joint: Joint that carries its palm; -1 for the world.
        palm: The palm's frame on it, shape (4, 4).
        pinching: Pairs of links of a thumb and a finger, among those of the robot, shape (k,).
        among_own: The same pairs among those of the hand, shape (k,).
    """

    palm_joint: int
    palm: Pose
    pinching: Indices
    among_own: Indices


class RobotModel(Model, frozen=True, kw_only=True):
    """The hands of a robot, and how their palms are led; see `RobotMapper`.

    Attributes:
        hands: The hands.
        turns_in: Time after a reference until palms have the person's directions [s].
        near: Distance of the person's palms at which the robot's begin to go by it [m].
        together: Distance at which they wholly do [m].
        together_share: Weight of that over the weight of a wrist's position.
        margin: Margin of pairs of links for which no hand has another one [m].
    """

    hands: tuple[RobotHandModel, ...]
    turns_in: float
    near: float
    together: float
    together_share: float
    margin: float
