"""`RobotLog`: what a robot did while it followed a person, measured, for data sets.

`handmap drive --log` writes one; a ROS 2 bag with the topics of `handmap ros2` is one, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from handmap_core.errors import RecordingError, expect
from handmap_core.se3 import Array, Arrays, as_floats, frozen
from handmap_qp.apps.arguments import check_names
from handmap_qp.hands import Names
from handmap_qp.human import newest_at
from handmap_qp.trackers import read_archive, reading
from handmap_qp.trackers.formats.archive import member_names, save_npz
from handmap_qp.trackers.formats.mcap import (
    JointStates,
    bag_topics,
    is_bag_folder,
    read_joint_states,
)
from .training_sets import Columns, Episode, Frames, write_lerobot, write_robomimic

_OWN = {"time", "joint_names", "q", "action"}
"""Arrays that every log has."""
_STATES, _COMMANDS = "joint_states", "joint_commands"
"""Ends of the names of the topics of a bag: what a robot did, and what it was commanded."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotLog:
    """Measured joints of a robot, and what it was commanded, over time; its arrays are read-only.

    Attributes:
        name: Name of the file, without its suffix.
        time: Instants, strictly increasing [s], shape (T,), T >= 2.
        joint_names: Names of n joints.
        q: Where they were measured [rad or m], shape (T, n).
        action: Where they were commanded to be [rad or m], shape (T, n).
        effort: Their torques [N m], or forces where they slide [N], shape (T, n); NaN where they
            are not known. They are positive in the direction in which the joint's angle grows.
        episode: Number of the episode of each instant, which only grows, shape (T,).
        task: What was done, in words; empty if it is not known.
        robot: Name of the robot.

    Raises:
        InvalidInputError: If an array has another shape or type than expected, time does not
            increase, an angle is not finite, or two joints have one name.
    """

    name: str
    time: Array
    joint_names: Names
    q: Array
    action: Array
    effort: Array
    episode: Array
    task: str = ""
    robot: str = "robot"

    def __post_init__(self) -> None:
        """Check the arrays, and replace them by read-only copies."""
        time = as_floats(self.time, "time", shape=("T",), is_finite=True)
        count, joints = len(time), len(self.joint_names)
        expect(count > 1, "time", "two instants or more", value=count)
        expect((np.diff(time) > 0.0).all(), "time", "strictly increasing instants")
        check_names("joint_names", self.joint_names, "joints of different names")
        shape = (count, joints)
        columns = {
            "time": time,
            "q": as_floats(self.q, "q", shape=shape, is_finite=True),
            "action": as_floats(self.action, "action", shape=shape, is_finite=True),
            "effort": as_floats(self.effort, "effort", shape=shape),
            "episode": as_floats(
                self.episode, "episode", shape=(count,), is_finite=True
            ),
        }
        grows = (np.diff(columns["episode"]) >= 0.0).all()
        expect(grows, "episode", "numbers that do not fall")
        for name, array in columns.items():
            object.__setattr__(self, name, frozen(array.copy()))

    def __len__(self) -> int:
        """Number of instants."""
        return len(self.time)

    @property
    def has_episode(self) -> bool:
        """Whether an episode has two instants or more, so that `episodes` yields one."""
        return bool((np.diff(self.episode) == 0.0).any())

    @property
    def known_efforts(self) -> Array:
        """Whether the effort of each joint is known at all instants, shape (n,)."""
        return np.all(np.isfinite(self.effort), axis=0)

    def episodes(self, fps: float, known: Array) -> Iterator[Episode]:
        """Yield its episodes at a fixed rate; one of a single instant is left out.

        Args:
            fps: Frames per second.
            known: Joints whose efforts are wanted, shape (n,).
        """
        ends = np.flatnonzero(np.diff(self.episode)) + 1
        for own in np.split(np.arange(len(self)), ends):
            time = self.time[own]
            count = int((time[-1] - time[0]) * fps + 1e-6) + 1
            if len(own) < 2:
                continue
            instants = time[0] + np.arange(count) / fps
            state, action, effort = (
                _resampled(instants, time, column[own])
                for column in (self.q, self.action, self.effort[:, known])
            )
            frames = Frames(state, action, np.zeros((count, 0), dtype=bool), effort)
            yield Episode(
                self.name, self.task or "teleoperation", count, parts=[frames]
            )


def _resampled(instants: Array, time: Array, columns: Array) -> Array:
    """Interpolate columns (T, n), or none, at instants (N,); shape (N, n).

    An instant that is later than all, by rounding, has the last row.
    """
    rows = [np.interp(instants, time, column) for column in columns.T]
    return np.reshape(rows, (len(rows), len(instants))).T


def is_robot_log(path: Path) -> bool:
    """Return whether a file, or the folder of a bag, is a log of a robot.

    What cannot be read is none, and neither is a bag with landmarks: it is a recording of a hand.
    """
    with suppress(RecordingError):
        if path.suffix == ".npz" and path.is_file():
            return member_names(path) >= _OWN
        if _is_bag(path):
            topics = bag_topics(path)
            has_commands = any(name.endswith(_COMMANDS) for name in topics.joint_states)
            return has_commands and not topics.landmarks
    return False


def _is_bag(path: Path) -> bool:
    return is_bag_folder(path) or (path.suffix == ".mcap" and path.is_file())


def read_robot_log(path: Path) -> RobotLog:
    """Read a log of a robot.

    An `.npz` has the arrays of `RobotLog`, of which `effort` and `episode` may be missing. In place
    of `effort`, `current` [A], shape (T, n), and `torque_constant`, the torque of each joint for
    one ampere [N m/A], shape (n,), NaN where it is not known, give the same. A bag, a file of MCAP
    or a folder, has `.../joint_states`, whose efforts are those of ROS, in N m, and
    `.../joint_commands`.

    Raises:
        RecordingError: If it cannot be read, lacks something, or is not as `RobotLog` wants it.
        MissingExtraError: If the package of the format is not installed.
    """
    with reading(path, "is not a log of a robot"):
        return _of_bag(path) if _is_bag(path) else _of_archive(path)


def _of_archive(path: Path) -> RobotLog:
    arrays = read_archive(path)
    for name in sorted(_OWN - arrays.keys()):
        raise RecordingError("is missing", file=path, array=name)
    time = arrays["time"]
    words = {
        name: str(arrays[name].item()) for name in ("task", "robot") if name in arrays
    }
    return RobotLog(
        name=path.stem,
        time=time,
        joint_names=tuple(map(str, arrays["joint_names"].tolist())),
        q=arrays["q"],
        action=arrays["action"],
        effort=_effort_of(path, arrays),
        episode=arrays.get("episode", np.zeros(len(time))),
        **words,
    )


def _effort_of(path: Path, arrays: Arrays) -> Array:
    """Return the efforts of an archive [N m or N], shape (T, n); NaN where it has none."""
    if "effort" in arrays:
        return arrays["effort"]
    shape = arrays["q"].shape
    if "current" not in arrays:
        return np.full(shape, np.nan)
    if "torque_constant" not in arrays:
        problem = "is missing: it turns currents into torques"
        raise RecordingError(problem, file=path, array="torque_constant")
    current = as_floats(arrays["current"], "current", shape=shape)
    name = "torque_constant"
    return current * as_floats(arrays[name], name, shape=shape[1:])


def _of_bag(path: Path) -> RobotLog:
    topics = read_joint_states(path)
    states = _topic(path, topics, _STATES)
    commands = _topic(path, topics, _COMMANDS)
    names = commands.names
    if missing := [name for name in names if name not in states.names]:
        problem = f"its {_STATES} lack {', '.join(missing)}"
        raise RecordingError(problem, file=path)
    columns = [states.names.index(name) for name in names]
    # The newest command at each instant; before the first one, the robot had no command.
    newest = newest_at(commands.time, states.time)
    led = newest >= 0
    return RobotLog(
        name=path.stem,
        time=states.time[led],
        joint_names=names,
        q=states.position[led][:, columns],
        action=commands.position[newest[led]],
        effort=states.effort[led][:, columns],
        episode=np.zeros(led.sum()),
    )


def _topic(path: Path, topics: dict[str, JointStates], end: str) -> JointStates:
    """Return the messages of the only topic whose name ends so."""
    found = [states for topic, states in topics.items() if topic.endswith(end)]
    if len(found) != 1:
        problem = f"has {len(found)} topics .../{end}, expected one"
        raise RecordingError(problem, file=path)
    return found[0]


def save_robot_log(path: Path, log: RobotLog, argument: str = "path") -> None:
    """Write a log of a robot as an `.npz` file; an earlier file stays if writing fails.

    Args:
        path: The file; its folder must exist.
        log: The log.
        argument: Argument or option that names the file, for errors.

    Raises:
        InvalidInputError: If it cannot be written.
    """
    words: dict[str, Any] = {"task": log.task, "robot": log.robot}
    arrays: Arrays = {name: np.array(word) for name, word in words.items()}
    arrays |= {
        "time": log.time,
        "joint_names": np.array(log.joint_names),
        "q": log.q,
        "action": log.action,
        "effort": log.effort,
        "episode": log.episode,
    }
    save_npz(path, arrays, argument)


def write_robot_logs(
    logs: Sequence[RobotLog],
    path: Path,
    form: Literal["lerobot", "robomimic"],
    fps: float | None = None,
) -> Names:
    """Write a data set of logs of one robot.

    States are measured joints, and actions commanded ones. Efforts are those of the joints that
    have them in all logs.

    Args:
        logs: The logs.
        path: Folder, or file of robomimic, to write.
        form: Form of the data set.
        fps: Frames per second; the logs' own rate if omitted.

    Returns:
        Names of the joints whose efforts are left out.

    Raises:
        InvalidInputError: If the logs are of different joints or have no episode, or it cannot be
            written.
        MissingExtraError: If the package of the format is not installed.
    """
    expect(logs, "IN", "one log or more", got="none")
    first = logs[0]
    for log in logs[1:]:
        expect(
            log.joint_names == first.joint_names,
            "IN",
            f"logs of one robot, with the joints {', '.join(first.joint_names)}",
            got=f"{', '.join(log.joint_names)} in {log.name}",
        )
    is_any = any(log.has_episode for log in logs)
    expect(is_any, "IN", "an episode of two instants or more", got="none")
    if fps is None:
        fps = max(1, round(1.0 / np.median(np.diff(first.time))))
    known = np.all([log.known_efforts for log in logs], axis=0)
    by_effort = tuple(zip(first.joint_names, known, strict=True))
    efforts = tuple(name for name, is_known in by_effort if is_known)
    columns = Columns(first.joint_names, effort=efforts)
    episodes = (episode for log in logs for episode in log.episodes(fps, known))
    if form == "robomimic":
        write_robomimic(episodes, path, columns, robot=first.robot, argument="OUT")
    else:
        write_lerobot(
            episodes, path, columns, fps=fps, robot=first.robot, argument="OUT"
        )
    return tuple(name for name, is_known in by_effort if not is_known)
