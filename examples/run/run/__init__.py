"""A robot's computer: saved hands, the follower and the client, by the core of handmap-qp.

It needs numpy (1.26 or later), msgspec, pyzmq and handmap-core. What follows here follows in
handmap-qp too:

    from handmap_run import HumanSample, load

    follower = load("leap_right.hand")              # handmap hands save leap_right
    step = follower.map_sample(HumanSample(time, "right", landmarks))
    step.command.q                                  # in the order of step.command.joint_names

With the joints that its encoders measure, the hand holds what it meets, by torques that it says:

    step = follower.map_sample(sample, measured_q=motors.read())
    step.command.effort                             # [N m or N]; None without a grip

`handmap_run.client` is the client of the mapping service.
"""

__version__ = "0.2.0"

from handmap_core.errors import (
    HandError,
    HandmapError,
    InvalidInputError,
    InvalidOptionsError,
)
from handmap_core.human.sample import HumanSample
from handmap_core.stream.hand_grip import GripOptions
from handmap_core.stream.smoothing import Smoothing
from handmap_qp.stream.follower import Follower
from .saved import load, load_robot

__all__ = [
    "Follower",
    "GripOptions",
    "HandError",
    "HandmapError",
    "HumanSample",
    "InvalidInputError",
    "InvalidOptionsError",
    "Smoothing",
    "load",
    "load_robot",
]
