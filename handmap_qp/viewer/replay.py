"""What the view shows at one instant, and a recording as a sequence of that, mapped anew whenever options change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.mapping.step import MapStep
from handmap_qp.trackers.recording import HumanMotion


@dataclass(frozen=True, slots=True, eq=False)
class ViewSample:
    """One instant of both hands.

    Attributes:
        time: Since the start [s].
        human_q: Human joint angles [rad], shape (n_human,); None where only the points are known.
        human_wrist: Human wrist pose in W, shape (4, 4).
        human_points: Human reference points in W [m], shape (n_h, 3).
        robot_q: Robot joint angles [rad], shape (n,).
        robot_wrist: Robot wrist pose in V, shape (4, 4).
        robot_points: Robot reference points in V [m], shape (n_r, 3).
        targets: Where those should be [m], shape (n_r, 3); None where the source does not say, or
            the robot was let go.
        deformation: Linear part of T_def, shape (3, 3); None where the source does not say.
        pivot: Where T takes the human's pivot [m], shape (3,); goes with `deformation`.
        at_limit: Robot joints that a limit holds, shape (n,).
        status: How the inverse kinematics ended.
        duration: Wall time of the mapping's step [s].
        is_seen: Whether the tracker saw the hand; else this is the instant before, held.
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
    at_limit: np.ndarray
    status: str
    duration: float
    is_seen: bool = True

    @property
    def point_error(self) -> np.ndarray:
        """Distance of the robot's points from their targets [m], shape (n_r,).

        Empty where there are no targets.
        """
        if self.targets is None:
            return np.empty(0)
        return np.linalg.norm(self.targets - self.robot_points, axis=1)


class Replay:
    """A recorded motion, mapped as a whole with whatever options are asked for.

    Args:
        motion: The human's motion.
        human: The human hand with the reference points to use.
        robot: The robot hand.
        mapping: The mapping's choices.
        ik: Weights and settings of the QP.

    Attributes:
        human: The human hand.
        robot: The robot hand.
        time: Instants since the first one [s], shape (T,).
        mapping: The options of the present `samples`.
        ik: Theirs, too.
        switches: Where the user released (True) or clutched (False), by sample.
        samples: One per instant.

    Raises:
        InvalidInputError: If no sample of the motion is valid.
        HandmapError: If options and hands do not go together.
    """

    def __init__(
        self, motion: HumanMotion, human: Hand, robot: Hand, mapping: MappingOptions, ik: IkOptions
    ) -> None:
        if not motion.valid.any():
            raise InvalidInputError("motion: no sample is valid, there is nothing to show")
        self.human, self.robot = human, robot
        self.time = motion.time - motion.time[0]
        self.switches: dict[int, bool] = {}
        self._motion = motion
        self.remap(mapping, ik)

    def remap(self, mapping: MappingOptions, ik: IkOptions) -> None:
        """Map the motion anew, from its reference to its end.

        Args:
            mapping: The mapping's choices.
            ik: Weights and settings of the QP.

        Raises:
            HandmapError: If the options cannot be used; everything is then as it was before.
        """
        self.samples = self._map(HandMapper(self.human, self.robot, mapping, ik=ik))
        self.mapping, self.ik = mapping, ik

    def is_released(self, index: int) -> bool:
        """Whether the robot holds still at a sample because the user let go."""
        earlier = [i for i in self.switches if i <= index]
        return bool(earlier) and self.switches[max(earlier)]

    def _map(self, mapper: HandMapper) -> tuple[ViewSample, ...]:
        motion = self._motion
        # Before the hand is first seen, the view shows the reference.
        first = int(np.argmax(motion.valid))
        step = mapper.map_step(motion.q[first], motion.wrist[first], dt=motion.dt[first])
        mapper.reset()
        samples = []
        for i in range(len(motion.time)):
            if i in self.switches:
                act = mapper.release if self.switches[i] else mapper.clutch
                act()
            if motion.valid[i]:
                step = mapper.map_step(motion.q[i], motion.wrist[i], dt=motion.dt[i])
            samples.append(
                view_sample(
                    float(self.time[i]),
                    motion.q[i],
                    motion.wrist[i],
                    step,
                    is_seen=bool(motion.valid[i]),
                )
            )
        return tuple(samples)


def view_sample(
    time: float,
    human_q: np.ndarray,
    human_wrist: np.ndarray,
    step: MapStep,
    *,
    is_seen: bool = True,
) -> ViewSample:
    """What the view shows of one step of a mapper.

    Args:
        time: Since the start [s].
        human_q: Joint angles that were mapped [rad], shape (n_human,).
        human_wrist: Wrist pose that was mapped, shape (4, 4).
        step: The mapper's answer.
        is_seen: Whether the tracker saw the hand.

    Returns:
        The sample.
    """
    return ViewSample(
        time=time,
        human_q=human_q,
        human_wrist=human_wrist,
        human_points=step.human_points,
        robot_q=step.command.q,
        robot_wrist=step.command.wrist,
        robot_points=step.points,
        targets=None if step.status == "released" else step.targets,
        deformation=step.motion_deformation[:3, :3],
        pivot=step.transfer.image,
        at_limit=step.at_limit,
        status=step.status,
        duration=step.duration,
        is_seen=is_seen,
    )
