"""Smooth a whole recording with look-ahead: zero lag, and short gaps filled.

A Whittaker-Henderson smoother (Whittaker 1923; Eilers, Anal. Chem. 75 (2003) 3631): for each column
y over the instants t,

    min  sum_i w_i (x_i - y_i)^2 dt_i  +  (2 pi f)^-4  integral of (x'')^2 dt

with w_i = 0 where the hand was not seen. It passes a motion of frequency f at half its amplitude,
slower ones unchanged, and has no phase: it looks as far ahead as back. In a gap it is the cubic
spline between both sides. The palm's motion and the landmarks in the palm are smoothed apart, so
that the hand keeps its size while it turns.

The smooth recording is mapped as any other, with the costs of speed and acceleration that go with
smoothing (`SMOOTH_IK`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.hands import Hand
from handmap_qp.human import PALM, Person, Recording, scaled_human
from handmap_qp.mapping import HandMapper, RobotMapper, RobotStep
from handmap_qp.se3 import (
    Array,
    affine,
    inverse_pose,
    rigid_fit,
    rotation_from_quat_wxyz,
    transform_points,
)
from handmap_qp.stream import SMOOTH_IK, RobotFollower, paired
from .trajectory import (
    Told,
    Trajectory,
    held_samples,
    map_recording,
    stretches,
    trajectory_of,
)


@dataclass(frozen=True)
class LookAhead:
    """How a recording is smoothed.

    Attributes:
        cutoff: Frequency that is passed at half its amplitude [Hz].
        longest_gap: Gaps up to this time are filled [s]; in longer ones the robot holds.
    """

    cutoff: float = 6.0
    longest_gap: float = 0.5


def look_ahead(recording: Recording, options: LookAhead = LookAhead()) -> Recording:
    """Smooth a recording forwards and backwards in time, and fill its short gaps.

    Args:
        recording: The recording.
        options: How; the defaults if omitted.

    Returns:
        The smoothed recording; samples in filled gaps are valid. Wrist poses and confidences of the
        tracker are left out, because the filled samples have none.
    """
    time = recording.time
    valid = recording.valid
    filled = valid.copy()
    for last, following in pairwise(np.flatnonzero(valid)):
        if time[following] - time[last] <= options.longest_gap:
            filled[last:following] = True
    landmarks = recording.landmarks.copy()
    for part in stretches(filled):
        if valid[part].sum() < 3:
            filled[part] &= valid[part]
        else:
            landmarks[part] = _smoothed(recording.part(part), options)
    return replace(
        recording, landmarks=landmarks, valid=filled, wrist=None, confidence=None
    )


def smooth_poses(time: Array, poses: Array, valid: Array, options: LookAhead) -> Array:
    """Smooth poses forwards and backwards in time.

    Args:
        time: Instants, strictly increasing [s], shape (T,), T >= 3.
        poses: Poses, shape (T, 4, 4); ignored where not valid.
        valid: Poses to use, at least two of them, shape (T,).
        options: How; gaps of any length are filled.

    Returns:
        The smoothed poses, shape (T, 4, 4).
    """
    held = poses[held_samples(valid)]
    rows = np.hstack([continuous_quats(held[:, :3, :3]), held[:, :3, 3]])
    smooth = whittaker(time, rows, valid, options.cutoff)
    return affine(rotation_from_quat_wxyz(smooth[:, :4], "poses"), smooth[:, 4:])


def whittaker(
    time: Array,
    values: Array,
    weight: Array,
    cutoff: float,
) -> Array:
    """Smooth columns by a penalty on their second derivative.

    Args:
        time: Instants, strictly increasing [s], shape (T,), T >= 3.
        values: Columns, shape (T, n); ignored where the weight is 0.
        weight: Weight of each sample, >= 0, at least two of them > 0, shape (T,); or whether it
            counts.
        cutoff: Frequency that is passed at half its amplitude [Hz].

    Returns:
        The smoothed columns, shape (T, n).
    """
    # Imported when used: it takes a quarter of the start of a worker, and most look at the past.
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    before = np.diff(time)[:-1]
    after = np.diff(time)[1:]
    span = before + after
    # Second derivative by divided differences: rows of three factors over three samples.
    factors = 2.0 / (before * span), -2.0 / (before * after), 2.0 / (after * span)
    second = diags_array(factors, offsets=(0, 1, 2), shape=(len(span), len(time)))
    penalty = diags_array(0.5 * span * (2.0 * np.pi * cutoff) ** -4)
    weights = weight * np.gradient(time)
    matrix = diags_array(weights) + second.T @ penalty @ second
    known = np.where(weight[:, None] > 0.0, values, 0.0)
    return splu(matrix.tocsc()).solve(weights[:, None] * known)


def map_hands(
    recordings: Sequence[Recording],
    robot: Hand,
    person: Person,
    arguments: MappingArguments,
    progress: Told = None,
    *,
    smoother: LookAhead | None = None,
) -> tuple[Sequence[Recording], Trajectory, Any, Array]:
    """Map recordings of a person with the options of a command.

    Args:
        recordings: A recording for the robot hand, or of each hand of the robot in its order.
        robot: The robot hand, or the hands of the robot as one.
        person: The person.
        arguments: Reference points and options.
        progress: Called after each sample with the number of samples done.
        smoother: How the recordings are smoothed as a whole; None for a mapping that knows the past
            only, as online.

    Returns:
        The recordings as they were mapped; the motion of the whole robot at the instants of the
        longest; the method; and whether each hand was followed, shape (T, number of hands). Points
        are of all hands, one after the other, and wrist poses of the first.

    Raises:
        HandmapError: If a recording cannot be mapped.
    """
    if smoother:
        recordings = [look_ahead(recording, smoother) for recording in recordings]
    used = {recording.side: recording for recording in recordings}
    humans = {
        side: scaled_human(
            recording, points=arguments.human_points, lengths=person.lengths
        )
        for side, recording in used.items()
    }
    first = recordings[0]
    human = humans[first.side]
    choice = arguments.preset_for(human, robot.hands[0], first.upright)
    ik = choice.ik.replaced(**SMOOTH_IK) if smoother else choice.ik
    if not robot.parts:
        mapper = HandMapper(human, robot, choice.method, ik=ik)
        trajectory = map_recording(mapper, first, progress)
        return recordings, trajectory, mapper.method, trajectory.valid[:, None]
    follower = RobotFollower(RobotMapper(robot, humans, choice.method, ik=ik))
    followed = []

    def steps() -> Iterator[RobotStep]:
        for samples in paired(used):
            step = follower.map_samples(samples)
            # A hand that has had no sample yet has no verdict.
            hands = step.hands.values()
            followed.append([bool(h.verdict) and not h.is_held for h in hands])
            yield step

    time = max(recordings, key=len).time
    trajectory = trajectory_of(follower.mapper.robot, time, steps(), progress)
    return recordings, trajectory, choice.method, np.array(followed)


def continuous_quats(rotations: Array) -> Array:
    """Return quaternions wxyz of rotations (T, 3, 3) without jumps of sign, shape (T, 4)."""
    # Imported when used: it takes a quarter of the start of a worker, and most look at the past.
    from scipy.spatial.transform import Rotation

    # A copy: SciPy before 1.16 takes no array that is read-only.
    turns = Rotation.from_matrix(rotations.copy())
    quats = turns.as_quat(canonical=True, scalar_first=True)
    flips = np.vecdot(quats[1:], quats[:-1]) < 0.0
    quats[1:][np.cumsum(flips) % 2 == 1] *= -1.0
    return quats


def _smoothed(recording: Recording, options: LookAhead) -> Array:
    """Smooth landmarks, shape (T, 21, 3): the palm's motion, and what moves in the palm."""
    time = recording.time
    valid = recording.valid
    held = recording.landmarks[held_samples(valid)]
    points = held[:, PALM]
    palms = rigid_fit(points[0] - points[0].mean(axis=0), points)
    local = transform_points(inverse_pose(palms), held)
    inside = whittaker(time, local.reshape(len(time), -1), valid, options.cutoff)
    poses = smooth_poses(time, palms, valid, options)
    return transform_points(poses, inside.reshape(local.shape))
