"""Map a recorded motion to a robot: `map_motion` and `map_recording` return a `Trajectory`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from time import thread_time_ns

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.step import MapStep
from handmap_qp.output_files import replaced_file
from handmap_qp.trackers.recording import HumanMotion, Recording


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A robot's motion as columns of T samples.

    Attributes:
        robot: The robot hand.
        time: Instants [s], shape (T,).
        q: Joint angles in the order of `robot.joint_names` [rad], shape (T, n).
        wrist: Wrist poses in the robot's world, shape (T, 4, 4).
        targets: Targets of the reference points in the robot's world [m], shape (T, m, 3).
        points: Positions of the reference points [m], shape (T, m, 3).
        point_error: Distance from each point to its target [m], shape (T, m).
        wrist_error: Distance from the wrist to its target [m], shape (T,).
        valid: Whether the tracker saw the hand, shape (T,). The robot holds still where it did not.
        at_limit: Whether each joint is at one of its position limits, shape (T, n).
        at_speed_limit: Whether a limit of speed (or of acceleration, where one is set) kept each
            joint from moving farther, shape (T, n).
        status: `MapStep.status` of each sample, shape (T,).
        step_cpu: CPU time of each step [s], shape (T,); NaN where the robot was held.
    """

    robot: Hand
    time: np.ndarray
    q: np.ndarray
    wrist: np.ndarray
    targets: np.ndarray
    points: np.ndarray
    point_error: np.ndarray
    wrist_error: np.ndarray
    valid: np.ndarray
    at_limit: np.ndarray
    at_speed_limit: np.ndarray
    status: np.ndarray
    step_cpu: np.ndarray

    @property
    def limit_violation(self) -> float:
        """Largest excess over a position limit [rad or m]; 0 if all limits hold."""
        outside = np.maximum(self.robot.lower_limits - self.q, self.q - self.robot.upper_limits)
        return max(0.0, float(outside.max()))

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Plain arrays by name, as written to a file; angles in rad, lengths in m."""
        return {
            "time": self.time,
            "joint_names": np.array(self.robot.joint_names),
            "q": self.q,
            "all_joint_names": np.array(self.robot.all_joint_names),
            "all_joint_roles": np.array(self.robot.all_joint_roles),
            "all_q": self.robot.all_joints(self.q),
            "wrist": self.wrist,
            "targets": self.targets,
            "points": self.points,
            "point_names": np.array([point.name for point in self.robot.reference_points]),
            "point_error": self.point_error,
            "wrist_error": self.wrist_error,
            "valid": self.valid,
            "at_limit": self.at_limit,
            "at_speed_limit": self.at_speed_limit,
            "status": self.status,
            "robot": np.array(self.robot.name),
            "versions": np.array(
                [
                    f"{package} {version(package)}"
                    for package in ("handmap-qp", "pin", "daqp", "numpy")
                ]
            ),
        }


def map_motion(
    mapper: HandMapper, motion: HumanMotion, progress: Callable[[int], None] | None = None
) -> Trajectory:
    """Map a whole human motion.

    The robot holds its last posture in samples that are not valid.

    Args:
        mapper: The mapper; its human hand must have the joints of `motion.human`.
        motion: The human motion.
        progress: Called after each sample with the number of samples done.

    Returns:
        The robot's trajectory, with one entry per sample of `motion`.

    Raises:
        InvalidInputError: If no sample of `motion` is valid, or a sample cannot be mapped.
    """
    return _map_samples(
        mapper,
        motion.time,
        motion.valid,
        lambda i: mapper.map_step(motion.q[i], motion.wrist[i], dt=motion.dt[i]),
        progress,
    )


def map_recording(
    mapper: HandMapper,
    recording: Recording,
    progress: Callable[[int], None] | None = None,
    *,
    wrist_poses: np.ndarray | None = None,
) -> Trajectory:
    """Map the landmarks of a recording, without joint angles of the human.

    The robot holds its last posture in samples that are not valid.

    Args:
        mapper: The mapper; its human hand must be scaled to the person.
        recording: The recording.
        progress: Called after each sample with the number of samples done.
        wrist_poses: Poses of the human model's wrist frame, shape (T, 4, 4); fitted to the palm's
            landmarks if omitted.

    Returns:
        The robot's trajectory, with one entry per sample of `recording`.

    Raises:
        InvalidInputError: If no sample is valid, or a sample cannot be mapped.
    """
    steps = recording.steps
    return _map_samples(
        mapper,
        recording.time,
        recording.valid,
        lambda i: mapper.map_landmarks(
            recording.landmarks[i], None if wrist_poses is None else wrist_poses[i], dt=steps[i]
        ),
        progress,
    )


def _map_samples(
    mapper: HandMapper,
    time: np.ndarray,
    valid: np.ndarray,
    map_sample: Callable[[int], MapStep],
    progress: Callable[[int], None] | None,
) -> Trajectory:
    """Map every valid sample, by index, and hold the last posture in the others."""
    count = len(time)
    steps: list[MapStep | None] = []
    step_cpu = np.full(count, np.nan)
    for i in range(count):
        if valid[i]:
            started = thread_time_ns()
            step = map_sample(i)
            step_cpu[i] = 1e-9 * (thread_time_ns() - started)
            steps.append(step)
        else:
            steps.append(steps[-1] if steps else None)
        if progress is not None:
            progress(i + 1)
    first = next((step for step in steps if step is not None), None)
    if first is None:
        raise InvalidInputError(
            argument="motion", expected="at least one valid sample", got=f"none of {count}"
        )
    filled = [step or first for step in steps]
    q = np.array([step.command.q for step in filled])
    wrist = np.array([step.command.wrist for step in filled])
    wrist_targets = np.array([step.wrist_target for step in filled])
    at_limit = mapper.robot.at_position_limit(q)
    still = np.zeros(q.shape[1], dtype=bool)
    at_bound = np.array(
        [
            step.at_bound if step is not None and is_seen else still
            for step, is_seen in zip(steps, valid, strict=True)
        ]
    )
    return Trajectory(
        robot=mapper.robot,
        time=time,
        q=q,
        wrist=wrist,
        targets=np.array([step.targets for step in filled]),
        points=np.array([step.points for step in filled]),
        point_error=np.array([step.point_error for step in filled]),
        wrist_error=np.linalg.norm(wrist[:, :3, 3] - wrist_targets[:, :3, 3], axis=1),
        valid=valid,
        at_limit=at_limit,
        at_speed_limit=at_bound & ~at_limit,
        status=np.array([step.status for step in filled]),
        step_cpu=step_cpu,
    )


def save_npz(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Write arrays to an `.npz` file atomically: an earlier file stays if writing fails.

    Args:
        path: The file; its folder must exist.
        columns: Arrays by name.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    with replaced_file(path, "path") as file:
        np.savez_compressed(file, allow_pickle=False, **columns)
