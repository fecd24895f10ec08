"""What the view shows at one instant, and a recording as a sequence of such samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.presets import Choice, possible_presets, preset_choice
from handmap_qp.mapping.smoothing import Smoothing
from handmap_qp.mapping.stages import motion_stages
from handmap_qp.mapping.step import MapStep
from handmap_qp.trackers.recording import HumanMotion, Recording, recording_samples


@dataclass(frozen=True, slots=True, eq=False)
class ViewSample:
    """One instant of both hands.

    Attributes:
        time: Time since the start [s].
        human_q: Human joint angles [rad], shape (n_human,); None if only the points are known.
        human_wrist: Human wrist pose in W, shape (4, 4).
        human_points: Human reference points in W [m], shape (n_h, 3).
        robot_q: Robot joint angles [rad], shape (n,).
        robot_wrist: Robot wrist pose in V, shape (4, 4).
        robot_points: Robot reference points in V [m], shape (n_r, 3).
        targets: Targets of the robot reference points in V [m], shape (n_r, 3); None if the source
            does not report them or the robot is released.
        deformation: Linear part of T_def, shape (3, 3); None if the source does not report it.
        pivot: The human's pivot after T, in W [m], shape (3,); given with `deformation`.
        is_limited: Whether a position or speed limit held each robot joint in this step, shape
            (n,).
        status: How the step ended, and the rule that the sample broke, as in `held: jump`.
        duration: Wall time of the mapping step [s].
        is_seen: Whether the robot followed the sample; if not, the previous one is held.
    """

    time: float
    human_q: np.ndarray | None
    human_wrist: np.ndarray
    human_points: np.ndarray
    robot_q: np.ndarray
    robot_wrist: np.ndarray
    robot_points: np.ndarray
    targets: np.ndarray | None
    deformation: np.ndarray | None
    pivot: np.ndarray | None
    is_limited: np.ndarray
    status: str
    duration: float
    is_seen: bool = True

    @property
    def point_error(self) -> np.ndarray:
        """Distances of the robot points from their targets [m], shape (n_r,); empty if none."""
        if self.targets is None:
            return np.empty(0)
        return np.linalg.norm(self.targets - self.robot_points, axis=1)


class Replay:
    """A recording, mapped as a whole and again whenever options change.

    Landmarks are mapped as they were measured. Joint angles are fitted for drawing only.

    Args:
        recording: The recording.
        motion: Joint angles and wrist poses fitted to it (`fit_recording`).
        human: The human hand, scaled to the person, with the reference points to use.
        robot: The robot hand.
        choice: Preset and options.
        smoothing: How samples are smoothed; not at all if omitted.
        contact_gap: The measured contact gap [m], for other presets than the one chosen.

    Attributes:
        human: The human hand.
        time: Time since the first instant [s], shape (T,).
        choice: Preset and options of the current `samples`.
        switches: Sample indices at which the user released (True) or clutched (False).
        samples: One per instant.

    Raises:
        InvalidInputError: If no sample of the motion is valid.
        HandmapError: If the options do not fit the hands.
    """

    def __init__(
        self,
        recording: Recording,
        motion: HumanMotion,
        human: Hand,
        robot: Hand,
        choice: Choice,
        *,
        smoothing: Smoothing | None = None,
        contact_gap: float | None = None,
    ) -> None:
        if not motion.valid.any():
            raise InvalidInputError(
                argument="motion", problem="no sample is valid, there is nothing to show"
            )
        self.human = human
        self.time = motion.time - motion.time[0]
        self.switches: dict[int, bool] = {}
        self._recording, self._motion, self._given_robot = recording, motion, robot
        self._smoothing, self._contact_gap = smoothing, contact_gap
        self.remap(choice)

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self._recording.name

    @property
    def robot(self) -> Hand:
        """The robot hand, with the reference points that the method moves."""
        return self._robot

    @property
    def presets(self) -> tuple[str, ...]:
        """The presets that these hands can be mapped with."""
        return possible_presets(self.human, self._given_robot)

    def preset(self, name: str) -> Choice:
        """Return a preset with its own options and the measured contact gap."""
        return preset_choice(name, self._contact_gap)

    def remap(self, choice: Choice) -> None:
        """Map the whole recording with another preset or other options.

        Args:
            choice: Preset and options.

        Raises:
            HandmapError: If the options cannot be used; the replay is then unchanged.
        """
        mapper = HandMapper(
            self.human,
            self._given_robot,
            choice.method,
            ik=choice.ik,
            smoothing=self._smoothing,
        )
        self.samples = self._map(mapper)
        self._robot, self.choice = mapper.robot, choice

    def is_released(self, index: int) -> bool:
        """Return whether the robot is released at a sample."""
        earlier = [i for i in self.switches if i <= index]
        return bool(earlier) and self.switches[max(earlier)]

    def _map(self, mapper: HandMapper) -> tuple[ViewSample, ...]:
        motion, steps = self._motion, []
        for i, sample in enumerate(recording_samples(self._recording)):
            if i in self.switches:
                (mapper.release if self.switches[i] else mapper.clutch)()
            steps.append(mapper.map_sample(sample))
        # Until the hand is first seen, show the reference.
        followed = [not step.is_held for step in steps]
        first = followed.index(True) if any(followed) else 0
        steps[:first] = [steps[first]] * first
        return tuple(
            view_sample(float(time), q, wrist, step, is_seen=is_followed)
            for time, q, wrist, step, is_followed in zip(
                self.time, motion.q, motion.wrist, steps, followed, strict=True
            )
        )


def view_sample(
    time: float,
    human_q: np.ndarray,
    human_wrist: np.ndarray,
    step: MapStep,
    *,
    is_seen: bool = True,
) -> ViewSample:
    """Return what the view shows of one step of a mapper.

    Args:
        time: Time since the start [s].
        human_q: Joint angles of the human, to draw it [rad], shape (n_human,).
        human_wrist: Its wrist pose, shape (4, 4).
        step: Result of the step.
        is_seen: Whether the robot followed the sample.

    Returns:
        The sample.
    """
    stages = motion_stages(step)
    return ViewSample(
        time=time,
        human_q=human_q,
        human_wrist=human_wrist,
        human_points=step.human_points,
        robot_q=step.command.q,
        robot_wrist=step.command.wrist,
        robot_points=step.points,
        targets=None if step.status == "released" else step.targets,
        deformation=None if stages is None else stages.motion_deformation[:3, :3],
        pivot=None if stages is None else stages.pivot,
        is_limited=step.at_bound,
        status=f"{step.status}: {step.rule}" if step.rule else step.status,
        duration=step.duration,
        is_seen=is_seen,
    )
