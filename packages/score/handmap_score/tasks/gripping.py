"""A mapping whose robot holds what its thumb and finger meet: `Gripping`.

The simulated robot's joints are measured as by encoders, and go back into the mapping
(`GripFollower`). The object's place may be known too, with an error.
"""

import numpy as np

from handmap_qp.apps.simulation.commands import GripName
from handmap_qp.errors import expect
from handmap_qp.hands import Hand
from handmap_qp.human import HumanSample
from handmap_qp.mapping import HandMapper
from handmap_qp.se3 import Array, inverse_pose, transform_points
from handmap_qp.stream import Follower, GripFollower
from .operator import HumanHand, Joints
from .task import Scene

_PLACES = 1
"""Stream of random numbers for errors of places, so that they do not depend on other draws."""


class Gripping:
    """A preset with `GripFollower`; a `SensingMapping`.

    The known place of the object is the true middle between the faces where it is to be pinched,
    plus an error that does not change during an attempt. It is relative to the robot's wrist, as of
    an arm whose joints are measured.

    Args:
        human: The person's hand.
        robot: The robot hand.
        grip: The preset, and how well the object's place is known.

    Attributes:
        place_error: Error of the object's place in the world, in this attempt [m], shape (3,).
        object_centre: The object's place that the mapper gets, in the mapper's world [m], shape
            (3,); None before the second sample, or if no place is known.
        effort: Torques of the grip in the last command [N m or N], shape (n,); None without a grip.

    Raises:
        InvalidInputError: If the robot hand cannot grip.
    """

    def __init__(self, human: Hand, robot: Hand, grip: GripName) -> None:
        self._human = human
        self._robot = robot
        self._name = grip
        self.place_error = np.zeros(3)
        self.reset()

    def reset(self) -> None:
        """Make a new mapper, which grips nothing."""
        mapper = HandMapper(self._human, self._robot, self._name.preset)
        # Unsmoothed, as the preset without a grip. Motors have the default stiffness of a grip.
        self._follower = GripFollower(Follower(mapper, smoothing=None))
        self._time = 0.0
        self._wrist: Array | None = None
        self._q: Array | None = None
        self.object_centre: Array | None = None
        self.effort: Array | None = None

    def draw_errors(self, seed: int) -> None:
        """Draw the error of the object's place in this attempt."""
        deviation = self._name.deviation or 0.0
        random = np.random.default_rng((seed, _PLACES))
        self.place_error = deviation * random.normal(size=3)

    def sense(self, scene: Scene) -> None:
        """Take the robot's measured joints, and the object's place if it is known.

        Raises:
            InvalidInputError: If the task does not measure joints.
        """
        wanted = "a task that measures the robot's joints, for a mapping with a grip"
        expect(scene.joints, "--tasks", wanted, got="one that does not")
        names = self._follower.follower.mapper.robot.joint_names
        self._q = np.array([scene.joints[name] for name in names])
        if self._name.sees and self._wrist is not None:
            place = scene.points["faces"].mean(axis=0) + self.place_error
            # In the task the operator moves the wrist, so the mapper's wrist is elsewhere.
            to_mapper = self._wrist @ inverse_pose(scene.poses["wrist"])
            self.object_centre = transform_points(to_mapper, place)

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Map the landmarks, and hold what the robot has met."""
        sample = HumanSample(self._time, self._human.side, hand.landmarks)
        step = self._follower.map_sample(
            sample, self._q, self.object_centre, self._name.deviation or 0.0, dt=dt
        )
        self._time += dt
        self._wrist = step.ik.wrists[0]
        self.effort = step.command.effort
        names = self._follower.follower.mapper.robot.joint_names
        return dict(zip(names, step.command.q.tolist(), strict=True))
