"""The picture of `handmap retarget`: moments of a recording and of the robots that follow it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array, rigid_fit
from handmap_qp.apps.drawing import (
    ShownHand,
    ShownMotion,
    landmarks_in_palm,
    moments_sheet,
    save_picture,
)
from handmap_qp.human import PALM, Recording, measure_hand, newest_at
from handmap_qp.mapping import AlignedOptions, rotation_of
from .trajectory import Trajectory

MOMENTS = 6
"""How many moments the picture has; fewer if the recording is shorter."""


class MappedMotion(NamedTuple):
    """What `map_hands` made of recordings.

    Attributes:
        trajectory: The robot's motion at T instants.
        recordings: A recording of each of its h hands, in their order.
        method: The method, which says how both worlds are aligned.
        followed: At which instants each hand was followed, shape (T, h).
    """

    trajectory: Trajectory
    recordings: Sequence[Recording]
    method: object
    followed: Array


def save_moments(
    path: Path, motions: Sequence[MappedMotion], count: int = MOMENTS
) -> None:
    """Draw moments of one or several mapped motions into one file.

    Args:
        path: The file; its suffix names the format.
        motions: The motions, on one clock; moments are those of the longest one.
        count: How many moments.

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    longest = max(motions, key=lambda motion: len(motion.trajectory.time))
    time = longest.trajectory.time
    chosen = time[find_moments(motions, time, count)]
    figure = moments_sheet(
        [_shown(motion, chosen) for motion in motions],
        (chosen - time[0]).tolist(),
        "; ".join(
            f"{' and '.join(each.name for each in motion.recordings)} to "
            f"{motion.trajectory.robot.name}"
            for motion in motions
        ),
    )
    save_picture(figure, path)


def find_moments(motions: Sequence[MappedMotion], time: Array, count: int) -> Array:
    """Choose instants that are spread over the motion and differ from each other.

    The first one is the first at which all hands are followed. The time from there on is cut into
    equal stretches; each of the further moments is the instant of its stretch whose landmarks
    differ most from those of the moments before it: in the palm frame for bare hands, in the world
    for arms.

    Args:
        motions: The motions.
        time: Instants to choose from, increasing [s], shape (T,).
        count: How many to choose.

    Returns:
        Increasing indices, at most `count` of them and at least one; stretches in which no hand is
        followed have none.
    """
    columns, flags = [], []
    for motion in motions:
        rows = newest(motion.trajectory.time, time)
        flags += [*motion.followed[rows].T]
        for recording in motion.recordings:
            samples = newest(recording.time, time)
            flags.append(recording.valid[samples])
            columns.append(
                recording.landmarks[samples]
                if motion.trajectory.robot.is_on_arm
                else _in_palm(recording)[samples]
            )
    seen = np.all(flags, axis=0)
    if not seen.any():
        # No instant shows all hands: take those that show most.
        counts = np.sum(flags, axis=0)
        seen = counts == counts.max()
    usable = np.flatnonzero(seen)
    landmarks = np.nan_to_num(np.concatenate(columns, axis=1)).reshape(len(time), -1)
    first = usable[0]
    chosen = [first]
    edges = np.linspace(time[first], time[usable[-1]], count)
    for start, end in pairwise(edges):
        near = usable[(time[usable] > start) & (time[usable] <= end)]
        if len(near):
            apart = landmarks[near, None] - landmarks[chosen]
            least = np.square(apart).sum(axis=2).min(axis=1)
            chosen.append(near[np.argmax(least)])
    return np.array(chosen)


def newest(of: Array, time: Array) -> Array:
    """Return the newest of some increasing instants at each time, the first before them, (T,)."""
    return np.maximum(newest_at(of, time), 0)


def _in_palm(recording: Recording) -> Array:
    """Return all landmarks in the palm frame [m], shape (T, 21, 3); NaN where not valid."""
    found = np.full(recording.landmarks.shape, np.nan)
    samples = np.flatnonzero(recording.valid)
    found[samples] = landmarks_in_palm(recording, samples.tolist())
    return found


def _shown(motion: MappedMotion, chosen: Array) -> ShownMotion:
    """Return a motion at chosen instants [s], shape (n,)."""
    trajectory = motion.trajectory
    robot = trajectory.robot
    hands = []
    for hand, recording in zip(robot.hands, motion.recordings, strict=True):
        samples = newest(recording.time, chosen)
        is_seen = recording.valid[samples]
        in_palm = np.full((len(samples), 21, 3), np.nan)
        in_palm[is_seen] = landmarks_in_palm(recording, samples[is_seen].tolist())
        shown = ShownHand(
            hand, recording.side, recording.landmarks[samples], in_palm, is_seen
        )
        hands.append(shown)
    q = trajectory.q[newest(trajectory.time, chosen)]
    return ShownMotion(robot, q, hands, _turn(motion))


def _turn(motion: MappedMotion) -> Array:
    """Return the rotation from the tracker's world to the robot's, shape (3, 3)."""
    if not isinstance(motion.method, AlignedOptions):
        return np.eye(3)
    trajectory = motion.trajectory
    hand, recording = trajectory.robot.hands[0], motion.recordings[0]
    first = np.argmax(recording.valid)
    palm = measure_hand(recording).palm(recording.side)
    return rotation_of(
        motion.method.alignment,
        rigid_fit(palm, recording.landmarks[first, PALM]),
        hand.frame_pose("palm", trajectory.q[0])
        if trajectory.robot.is_on_arm
        else np.eye(4),
    )
