"""Map a recording without lag: forwards, backwards, and then through the QP once more.

A robot that is slower than the hand trails behind it. Mapped backwards in time, it runs ahead by as
much. The mean of both motions has no lag, and is inside all limits of position and speed, because
these are convex. Links may overlap in it, so a last pass of the QP follows the mean, with contact
rows and limits: what it returns holds them all as exactly as online.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.human.recording import Recording, recording_samples
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.method import Method
from handmap_qp.mapping.step import MapStep
from handmap_qp.offline.trajectory import Trajectory, map_recording, trajectory_of
from handmap_qp.stream.follower import Follower

# The last pass follows joint angles, which are inside the limits already.
_FOLLOW = {"rest_weight": 3.0, "max_iterations": 3, "step_tolerance": 0.02, "error_damping": 0.0}


def map_both_ways(
    human: Hand,
    robot: Hand,
    method: Method,
    ik: IkOptions,
    recording: Recording,
    *,
    wrist_poses: np.ndarray | None = None,
    progress: Callable[[int], None] | None = None,
) -> Trajectory:
    """Map a recording as a whole, without lag.

    Args:
        human: The human hand, scaled to the person.
        robot: The robot hand.
        method: The mapping method.
        ik: Weights and settings of the QP.
        recording: The recording, smoothed (`look_ahead`).
        wrist_poses: Poses of the human model's wrist frame, shape (T, 4, 4); fitted to the palm's
            landmarks if omitted.
        progress: Called after each sample of the first pass with the number of samples done.

    Returns:
        The trajectory. The wrist is that of the forward pass: it follows within its limits but for
        the fastest reaches.

    Raises:
        InvalidInputError: If no sample makes sense, or a sample cannot be mapped.
    """
    first, margins = HandMapper(human, robot, method, ik=ik), []
    steps = Follower(first).map_samples(recording_samples(recording, wrist_poses))
    forward = trajectory_of(first.robot, recording.time, _note_margins(steps, margins), progress)
    turned = replace(
        recording,
        time=-recording.time[::-1],
        landmarks=recording.landmarks[::-1],
        valid=recording.valid[::-1],
        wrist=None,
        confidence=None,
    )
    poses = None if wrist_poses is None else wrist_poses[::-1]
    backward = map_recording(HandMapper(human, robot, method, ik=ik), turned, wrist_poses=poses)
    mean = 0.5 * (forward.q + backward.q[::-1])
    bound = method.bind(human, robot)
    solver = PointIk(bound.robot, ik.replaced(**_FOLLOW), contacts=bound.contacts)
    return _followed(solver, forward, mean, recording.steps, margins)


def _note_margins(steps: Iterator[MapStep], margins: list[np.ndarray | None]) -> Iterator[MapStep]:
    """Note the margins of the contact rows [m], shape (k,): those before where the robot holds."""
    for step in steps:
        before = margins[-1] if margins else None
        margins.append(before if step.is_held else step.asked.margins)
        yield step


def _followed(
    solver: PointIk,
    forward: Trajectory,
    mean: np.ndarray,
    steps: np.ndarray,
    margins: list[np.ndarray | None],
) -> Trajectory:
    """Follow joint angles, with all limits and contact rows."""
    robot = forward.robot
    q, points = np.empty_like(mean), np.empty_like(forward.points)
    at_bound = np.zeros(q.shape, dtype=bool)
    solver.place(robot.configuration_vector(mean[0], forward.wrist[0]))
    for i, angles in enumerate(mean):
        targets = robot.points(angles, forward.wrist[i])
        result = solver.solve(
            targets, forward.wrist[i], float(steps[i]), rest=angles, margins=margins[i]
        )
        q[i] = solver.configuration.q[robot.q_indices]
        points[i] = result.points
        at_bound[i] = result.active[result.joint_columns] != 0
    at_limit = robot.at_position_limit(q)
    return replace(
        forward,
        q=q,
        points=points,
        point_error=np.linalg.norm(points - forward.targets, axis=2),
        at_limit=at_limit,
        at_speed_limit=at_bound & ~at_limit,
    )
