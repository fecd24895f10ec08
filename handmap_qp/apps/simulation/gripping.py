"""A pick by a robot whose measured joints go back into the mapping: `GripScene`."""

import copy
from collections.abc import Iterator

from handmap_qp.apps.offline.comparison import Take
from handmap_qp.apps.offline.trajectory import trajectory_of
from handmap_qp.hands import Hand, Vector
from handmap_qp.human import sample_columns
from handmap_qp.mapping import HandMapper, MapStep
from handmap_qp.stream import Follower, GripFollower, GripOptions
from .commands import PinchWindow
from .physics import Physics
from .pinch import PinchOutcome, PinchScene, PinchTrial
from .simulator import Simulator


class GripScene(PinchScene):
    """A robot that follows a recorded pinch, and holds what it meets by `GripFollower`.

    Args:
        take: The recording, prepared.
        hand: The robot hand.
        window: When the human pinches.
        physics: Actuators, gravity and time steps.
        sees: Whether the object's place is known too, until it is gripped.
        deviation: Standard deviation of that place along each axis, as it is stated [m].

    Attributes:
        deviation: As given.
        place_error: How far the stated place is from the object's middle [m], in world axes, in
            the last trial.

    Raises:
        InvalidInputError: If the hand's default preset cannot grip.
    """

    def __init__(
        self,
        take: Take,
        hand: Hand,
        window: PinchWindow,
        physics: Physics,
        sees: bool,
        deviation: float = 0.0,
    ) -> None:
        human = take.human.with_points("landmarks")
        follower = Follower(HandMapper(human, hand), smoothing=None)
        self._samples = sample_columns(take.recording)
        self._options = GripOptions(
            stiffness=physics.joint_stiffness,
            sliding_stiffness=physics.sliding_stiffness,
        )
        self._sees = sees
        self.deviation = deviation
        self.place_error: Vector = (0.0, 0.0, 0.0)
        self._opened = follower

        def steps() -> Iterator[MapStep]:
            for i in range(window.end + 1):
                if i == window.opened + 1:
                    # Where the hand is at the earliest start.
                    self._opened = copy.deepcopy(follower)
                yield follower.map_sample(self._samples.sample(i))

        time = take.recording.time[: window.end + 1]
        commands = trajectory_of(follower.mapper.robot, time, steps())
        super().__init__(commands, window, physics)

    def run(self, trial: PinchTrial) -> PinchOutcome:
        """Simulate one trial, whose known place is off by the trial's error.

        See `PinchScene.run`.
        """
        x, y, z = (self.deviation * error for error in trial.place_error)
        self.place_error = (x, y, z)
        return super().run(trial)

    def _play(self, simulator: Simulator, start: int) -> Iterator[float]:
        """Follow the recording to the end of the pinch, and yield the time of each sample [s]."""
        follower = copy.deepcopy(self._opened)
        for i in range(self.window.opened + 1, start + 1):
            follower.map_sample(self._samples.sample(i))
        grip = GripFollower(follower, self._options)
        time = self.commands.time
        for i in range(start + 1, self.window.end + 1):
            place = None
            if self._sees:
                place = simulator.object_pose[:3, 3] + self.place_error
            sample = self._samples.sample(i)
            step = grip.map_sample(sample, simulator.q, place, self.deviation)
            simulator.follow(step.ik.q, time[i] - time[i - 1])
            yield time[i]
