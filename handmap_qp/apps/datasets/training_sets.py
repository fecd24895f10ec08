"""Data sets for training, of LeRobot v3 or in the form of robomimic: episodes of a robot's motion.

Efforts are a column of their own, in newton metres, or newtons where a joint slides: the torque of
a joint, not of its motor. A data set whose efforts nobody knows has no such column.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handmap_core.se3 import Array
from handmap_qp.hands import Names
from handmap_qp.trackers.formats.hdf5 import check_room, created
from handmap_qp.trackers.formats.lerobot import Feature, writing_set


class Columns(NamedTuple):
    """Names of the numbers in the columns of a data set; a column without any is left out.

    Attributes:
        state: Of states and actions.
        valid: Of the hands that may be seen.
        effort: Of the joints whose efforts are known.
    """

    state: Names
    valid: Names = ()
    effort: Names = ()


class Frames(NamedTuple):
    """Consecutive frames of an episode.

    Attributes:
        state: States of the robot, shape (N, n).
        action: What it is told to do in each of them, shape (N, n).
        valid: Whether each hand was seen, shape (N, number of hands).
        effort: Efforts of joints in each state [N m or N], shape (N, e).
    """

    state: Array
    action: Array
    valid: Array
    effort: Array


class Episode(NamedTuple):
    """An episode of a data set, whose frames come by parts: one of hours may not fit into memory.

    Attributes:
        sources: What it was made of.
        task: What is done, in words.
        count: Number of its frames.
        parts: Its frames in the order of time; read once.
    """

    sources: str
    task: str
    count: int
    parts: Iterable[Frames]


def write_lerobot(
    episodes: Iterable[Episode],
    root: Path,
    columns: Columns,
    *,
    fps: float,
    robot: str,
    argument: str,
    overwrite: bool = False,
) -> None:
    """Write a folder of LeRobot v3, with `observation.effort` if efforts are known.

    Args:
        episodes: The episodes; taken one by one.
        root: The folder.
        columns: Names of the numbers in their columns.
        fps: Frames per second.
        robot: Name of the robot.
        argument: Argument or option that names the folder, for errors.
        overwrite: Whether to replace a folder that exists.

    Raises:
        InvalidInputError: If it cannot be written.
        MissingExtraError: If pyarrow is not installed.
    """
    features = {
        "observation.state": Feature("float32", columns.state),
        "action": Feature("float32", columns.state),
        "observation.valid": Feature("bool", columns.valid),
        "observation.effort": Feature("float32", columns.effort),
    }
    known = {name: feature for name, feature in features.items() if feature.names}
    with writing_set(
        root,
        fps=fps,
        features=known,
        robot_type=robot,
        argument=argument,
        overwrite=overwrite,
    ) as writer:
        for episode in episodes:
            about = {"source": episode.sources}
            parts = (
                {name: array for name, array in by_name.items() if name in known}
                for frames in episode.parts
                for by_name in [dict(zip(features, frames, strict=True))]
            )
            writer.add_parts(parts, episode.count, episode.task, about)


def write_robomimic(
    episodes: Iterable[Episode],
    path: Path,
    columns: Columns,
    *,
    robot: str,
    argument: str,
) -> None:
    """Write an HDF5 file in the form of robomimic, with `obs/effort` if efforts are known.

    Args:
        episodes: The episodes; taken one by one.
        path: The file; an earlier one is replaced.
        columns: Names of the numbers in their columns; those of states and efforts are in
            `env_args`.
        robot: Name of the robot.
        argument: Argument or option that names the file, for errors.

    Raises:
        InvalidInputError: If it cannot be written.
        MissingExtraError: If h5py is not installed.
    """
    names = {"state_names": columns.state}
    if columns.effort:
        names["effort_names"] = columns.effort
    env = {"env_name": robot, "env_type": 2, "env_kwargs": names}
    total = 0
    with created(path, argument) as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps(env)
        for i, episode in enumerate(episodes):
            demo = data.create_group(f"demo_{i}")
            count = episode.count
            demo.attrs.update(
                num_samples=count, source=episode.sources, task=episode.task
            )
            done = 0
            for frames in episode.parts:
                if not done:
                    state = frames.state
                    check_room(file, 5 * count * state.itemsize * state.shape[1])
                _write_frames(demo, frames, columns, done, count)
                done += len(frames.state)
            assert done == count
            total += count
        data.attrs["total"] = total


def _write_frames(
    demo: Any, frames: Frames, columns: Columns, start: int, count: int
) -> None:
    """Write consecutive frames of an episode under the names of robomimic.

    Args:
        demo: The `h5py.Group` of the episode.
        frames: The frames.
        columns: Names of the numbers in their columns.
        start: Number of frames that are written already.
        count: Number of frames of the episode.
    """
    stop = start + len(frames.state)
    found = {
        "actions": frames.action,
        "states": frames.state,
        "rewards": np.zeros(stop - start),
        "dones": (np.arange(start, stop) == count - 1).astype(np.int64),
        "obs/state": frames.state,
    }
    if columns.valid:
        found["obs/valid"] = frames.valid
    followed = {"next_obs/state": frames.state}
    if columns.effort:
        found["obs/effort"] = frames.effort
        followed["next_obs/effort"] = frames.effort
    for name, rows in (found | followed).items():
        if not start:
            demo.create_dataset(name, (count, *rows.shape[1:]), rows.dtype)
    for name, rows in found.items():
        demo[name][start:stop] = rows
    for name, rows in followed.items():
        # Each frame is the next one of that before it, and the last one is its own.
        if start:
            demo[name][start - 1] = rows[0]
        demo[name][start:stop] = next_frames(rows)


def next_frames(frames: Array) -> Array:
    """Return the frame after each one, shape (N, n); the last one repeats."""
    return np.concatenate([frames[1:], frames[-1:]])
