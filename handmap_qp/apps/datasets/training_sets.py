"""Data sets for training, of LeRobot v3 or in the form of robomimic: episodes of a robot's motion.

Efforts are a column of their own, in newton metres, or newtons where a joint slides: the torque of
a joint, not of its motor. A data set whose efforts nobody knows has no such column.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array, Arrays
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


class Episode(NamedTuple):
    """An episode of a data set.

    Attributes:
        sources: What it was made of.
        task: What is done, in words.
        state: States of the robot, shape (N, n).
        action: What it is told to do in each of them, shape (N, n).
        valid: Whether each hand was seen, shape (N, number of hands).
        effort: Efforts of joints in each state [N m or N], shape (N, e).
    """

    sources: str
    task: str
    state: Array
    action: Array
    valid: Array
    effort: Array


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
        for sources, task, *arrays in episodes:
            by_name = dict(zip(features, arrays, strict=True))
            frames = {name: by_name[name] for name in known}
            writer.add(frames, task, {"source": sources})


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
            check_room(file, 5 * episode.state.nbytes)
            demo = data.create_group(f"demo_{i}")
            count = len(episode.state)
            demo.attrs.update(
                num_samples=count, source=episode.sources, task=episode.task
            )
            for name, column in _robomimic_columns(episode, columns).items():
                demo[name] = column
            total += count
        data.attrs["total"] = total


def _robomimic_columns(episode: Episode, columns: Columns) -> Arrays:
    """Return the columns of an episode under the names of robomimic."""
    count = len(episode.state)
    found = {
        "actions": episode.action,
        "states": episode.state,
        "rewards": np.zeros(count),
        "dones": (np.arange(count) == count - 1).astype(np.int64),
        "obs/state": episode.state,
    }
    if columns.valid:
        found["obs/valid"] = episode.valid
    found["next_obs/state"] = next_frames(episode.state)
    if columns.effort:
        found["obs/effort"] = episode.effort
        found["next_obs/effort"] = next_frames(episode.effort)
    return found


def next_frames(frames: Array) -> Array:
    """Return the frame after each one, shape (N, n); the last one repeats."""
    return np.concatenate([frames[1:], frames[-1:]])
