"""A robot's computer: saved hands follow a tracker, and hold what they meet.

    from handmap_core.run import HumanSample, load

    follower = load("leap_right.hand")              # handmap hands save leap_right
    step = follower.map_sample(HumanSample(time, "right", landmarks))
    step.command.q                                  # in the order of step.command.joint_names

With the joints that its encoders measure, the hand holds what it meets, by the torques of the grip:

    step = follower.map_sample(sample, measured_q=motors.read())
    step.command.effort                             # [N m or N]; None without a grip

It needs numpy (1.26 or later) and msgspec alone. What follows here follows in `handmap_qp`, too.
`handmap_core.client` is the client of the mapping service.
"""

from handmap_core.errors import (
    HandError,
    HandmapError,
    InvalidInputError,
    InvalidOptionsError,
)
from handmap_core.human import HumanSample
from handmap_core.stream.hand_grip import GripOptions
from handmap_core.stream.smoothing import Smoothing
from .gripping import GrippingFollower
from .load import load, load_robot
from .robot_gripping import GrippingRobotFollower

__all__ = [
    "GripOptions",
    "GrippingFollower",
    "GrippingRobotFollower",
    "HandError",
    "HandmapError",
    "HumanSample",
    "InvalidInputError",
    "InvalidOptionsError",
    "Smoothing",
    "load",
    "load_robot",
]
