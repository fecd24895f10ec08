"""`GripFollower`, `RobotGripFollower`: followers that hold what a thumb and a finger have met.

`handmap_core.stream.grip` holds it; here fingers and pads are found on the robot's hands.
"""

from __future__ import annotations

from handmap_core.stream import grip as core_grip
from handmap_core.stream.hand_grip import GripOptions
from handmap_qp.mapping import HandMapper, RobotMapper
from .follower import Follower
from .grasp import grasp_fingers
from .robot_follower import RobotFollower


class GripFollower(core_grip.GripFollower[HandMapper]):
    """Lets a follower hold what thumb and finger grip, by the measured joints of the robot.

    It is for one hand, of fingers or jaws, and the method `Teleoperation`. Without an object, it
    follows as before.

    Args:
        follower: Follows the samples.
        grip: How what is gripped is held.

    Raises:
        InvalidInputError: If `grip` is something else, it is for another preset, or the robot has
            no thumb with a finger or jaws.
    """

    def __init__(self, follower: Follower, grip: GripOptions | None = None) -> None:
        fingers = grasp_fingers(follower.mapper.source.robot)
        super().__init__(follower, fingers, grip)


class RobotGripFollower(core_grip.RobotGripFollower[RobotMapper]):
    """Lets a follower of both hands hold what each of them grips; see `GripFollower`.

    Args:
        follower: Follows the samples.
        grip: How what is gripped is held, by all hands.

    Raises:
        InvalidInputError: If `grip` is something else, or no hand can grip.
    """

    def __init__(
        self, follower: RobotFollower, grip: GripOptions | None = None
    ) -> None:
        sources = follower.mapper.sources.items()
        fingers = {side: grasp_fingers(source.robot) for side, source in sources}
        super().__init__(follower, fingers, grip)


def gripping(
    follower: Follower | RobotFollower, grip: GripOptions | None = None
) -> GripFollower | RobotGripFollower:
    """Return a follower that holds what the hands of another one grip.

    Raises:
        InvalidInputError: As of `GripFollower` and `RobotGripFollower`.
    """
    if isinstance(follower, Follower):
        return GripFollower(follower, grip)
    return RobotGripFollower(follower, grip)
