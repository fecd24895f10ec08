"""Joints of any program, written to a file: `trajectory_method`.

The file is an npz with

    time         instants of the recording [s], shape (T,)
    q            joint positions [rad or m], shape (T, n)
    joint_names  names of the n joints, in any order; those of joints that follow others may be left
                 out or given
    wrist        poses of the robot's wrist in the world, shape (T, 4, 4); may be left out

A trajectory of `handmap retarget` is such a file. For several recordings, a folder has one for
each, by the name of the recording.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from handmap_core.errors import InvalidInputError, RecordingError, did_you_mean, expect
from handmap_core.se3 import Array, Arrays, as_floats
from handmap_qp.hands import Hand, hand_names
from handmap_qp.mapping.custom_method import shortened
from handmap_qp.trackers import read_archive
from .comparison import ComparedMethod, Take
from .trajectory import RobotMotion, held_samples
from .user_mapping import joints_on_human

KEYS = ("time", "q", "joint_names")
"""Arrays that a file must have."""
_NEAR = 1e-3
"""How far an instant may be from the recording's [s]."""
_TURNS = 4.0 * np.pi
"""A joint angle beyond is taken for one in degrees [rad]."""
_ARGUMENT = "--trajectory"


def trajectory_method(path: Path) -> ComparedMethod:
    """Return the trajectory of a file, or of a folder with a file for each recording.

    Raises:
        InvalidInputError: If there is no such file or folder.
    """
    expect(path.exists(), _ARGUMENT, "a file or folder that exists", got=str(path))
    name = path.name.removesuffix(".npz")
    return ComparedMethod(name, partial(_read, path), partial(_check, path))


def file_name(recording: str) -> str:
    """Return the name of the file that a folder has for a recording."""
    return re.sub(r"[^\w.+-]+", "_", recording) + ".npz"


def _check(path: Path, take: Take, robot: Hand) -> None:
    """Read the file of a take before anything is mapped; see `_read`."""
    _read(path, take, robot)


def _read(path: Path, take: Take, robot: Hand) -> RobotMotion:
    """Read the trajectory of a take.

    Raises:
        InvalidInputError: If the file is not of this robot and this recording.
    """
    file = path / file_name(take.name) if path.is_dir() else path
    wanted = f"{file_name(take.name)} in {path}, for the recording {take.name}"
    expect(file.is_file(), _ARGUMENT, wanted, got="no such file")
    try:
        arrays = read_archive(file)
    except (RecordingError, ValueError, OSError) as error:
        raise InvalidInputError(f"{error}", argument=_ARGUMENT) from error
    if missing := [key for key in KEYS if key not in arrays]:
        raise InvalidInputError(
            argument=_ARGUMENT,
            expected=f"{', '.join(KEYS)} in {file}",
            got=f"no {', '.join(missing)}, only {', '.join(arrays) or 'nothing'}",
            advice="np.savez(FILE, time=recording_time, q=joints, joint_names=names)",
        )
    count = len(take.recording)
    _check_times(file, arrays, take)
    q = _in_order(file, arrays, robot)
    valid = take.recording.valid
    unknown_rows = ~np.isfinite(q).all(axis=1)
    bad = np.flatnonzero(valid & unknown_rows)
    if len(bad):
        raise _wrong(
            file,
            f"q is not finite in {len(bad)} of {count} samples, the first is {bad[0]}",
            "repeat the last posture where your program has none",
        )
    # Where the hand was not seen, a program may have no answer.
    q[unknown_rows] = q[held_samples(valid)[unknown_rows]]
    largest = np.abs(q).max(initial=0.0)
    if largest > _TURNS:
        problem = f"q has values up to {largest:.3g}, expected radians (or metres)"
        raise _wrong(file, problem, "convert degrees by np.radians")
    unknown = np.full(count, np.nan)
    motion = joints_on_human(take, robot, q, unknown, f"joints of {file.name}")
    if "wrist" not in arrays or not robot.is_floating:
        return motion
    try:
        wrist = as_floats(arrays["wrist"], "wrist", shape=(count, 4, 4), is_finite=True)
    except ValueError as error:
        raise _wrong(file, str(error), "leave wrist out to lay palm on palm") from error
    return RobotMotion(robot, motion.time, q, wrist, unknown, motion.about)


def _check_times(file: Path, arrays: Arrays, take: Take) -> None:
    """Reject instants that are not the recording's."""
    wanted = take.recording.time
    name = take.name
    try:
        time = as_floats(arrays["time"], "time", shape=("T",), is_finite=True)
    except ValueError as error:
        raise _wrong(file, str(error), "write the recording's own time") from error
    if len(time) != len(wanted):
        raise _wrong(
            file,
            f"time has {len(time)} samples, and the recording {name} has {len(wanted)}, from "
            f"{wanted[0]:.3f} to {wanted[-1]:.3f} s",
            "give one row for each sample of the recording, with its time",
        )
    off = time - wanted
    bad = np.flatnonzero(np.abs(off) > _NEAR)
    if not len(bad):
        return
    i = bad[0]
    problem = (
        f"time differs from that of {name} in {len(bad)} of {len(wanted)} samples: sample {i} is "
        f"at {time[i]:.4f} s, expected {wanted[i]:.4f} s"
    )
    if np.ptp(off) <= _NEAR:
        problem = f"time is {off[0]:+.4f} s off that of {name} in every sample"
    raise _wrong(file, problem, "write the recording's own time")


def _in_order(file: Path, arrays: Arrays, robot: Hand) -> Array:
    """Return q in the order of the robot's joints, shape (T, n)."""
    given = [str(name) for name in np.ravel(arrays["joint_names"])]
    count = len(arrays["time"])
    try:
        q = as_floats(arrays["q"], "q", shape=(count, len(given)))
    except ValueError as error:
        advice = "q has a row for each time, and a column for each of joint_names"
        raise _wrong(file, str(error), advice) from error
    if len({*given}) < len(given):
        raise _wrong(file, "joint_names has a name twice", "name each column once")
    names = robot.joint_names
    missing = [name for name in names if name not in given]
    unknown = [name for name in given if name not in robot.all_joint_names]
    if missing or unknown:
        whose = _robot_of(arrays, robot)
        problem = f"joint_names lacks {shortened(missing)}" if missing else ""
        if unknown:
            problem += f"{' and' * bool(missing)} has unknown {shortened(unknown)}"
        hint = did_you_mean(unknown[0], names) if unknown else ""
        raise _wrong(
            file,
            f"is not of {robot.name}: {problem.strip()}",
            whose or hint or f"the joints of {robot.name} are {shortened(names)}",
        )
    return q[:, [given.index(name) for name in names]]


def _robot_of(arrays: Arrays, robot: Hand) -> str:
    """Return what the file says of its robot, as advice; empty if it does not say another one."""
    if "robot" not in arrays:
        return ""
    name = str(arrays["robot"])
    if name == robot.name:
        return ""
    known = f": --robot {name}" if name in hand_names() else ""
    return f"the file says that it is of {name}{known}"


def _wrong(file: Path, problem: str, advice: str) -> InvalidInputError:
    """Return the error of a file."""
    return InvalidInputError(f"{file}: {problem}", argument=_ARGUMENT, advice=advice)
