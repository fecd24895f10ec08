"""Mappings of a user beside those of the package: `user_method`, of a file of Python.

`handmap_qp.apps.offline.user_file` reads the file. What it defines is run here on takes.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter, thread_time
from typing import cast

import numpy as np

from handmap_core.errors import HandmapError, InvalidInputError, expect, warn
from handmap_core.se3 import Array, inverse_pose
from handmap_qp.hands import Hand
from handmap_qp.mapping import (
    CustomMethod,
    HandMapper,
    JointAnswer,
    LandmarkFunction,
    Method,
    Preset,
    joint_positions,
)
from handmap_qp.stream import SMOOTH_IK
from .comparison import (
    LIMITS,
    SMOOTH,
    ComparedMethod,
    SampleProgress,
    Take,
)
from .limited import clip_motion
from .trajectory import RobotMotion, held_samples, map_recording
from .user_file import UserCodeError, UserMapping, read_user_mapping

_TRIED = 2
"""Samples that are mapped before all others, to find mistakes early."""
_LONG = 60.0
"""A mapping of a recording that takes longer is announced [s]."""
_QUIET: SampleProgress = lambda _: None  # noqa: E731


def user_method(name: str, argument: str = "--methods") -> ComparedMethod:
    """Return a mapping of a user by `FILE.py` or `FILE.py:NAME`.

    `+smooth` at the end asks for smoother motion of a method; `+limits` clips the joints of a
    function by the robot's limits.

    Raises:
        InvalidInputError: If there is no such file or name, or it is no mapping.
        UserCodeError: If the file raises an error.
    """
    base = name.removesuffix(SMOOTH).removesuffix(LIMITS)
    user = read_user_mapping(base, argument)
    return ComparedMethod(
        Path(name).name,
        partial(_map, user, name),
        partial(_check, user, name),
        partial(_map, user, name),
    )


def _map(
    user: UserMapping,
    name: str,
    take: Take,
    robot: Hand,
    progress: SampleProgress = _QUIET,
) -> RobotMotion:
    """Map a take.

    Raises:
        UserCodeError: If the user's code raises an error, or returns what is no motion.
    """
    made = user.for_hands(take.human, robot)
    is_smooth = name.endswith(SMOOTH)
    is_limited = name.endswith(LIMITS)
    if isinstance(made, Method | Preset):
        expect(
            not is_limited,
            "--methods",
            f"{user.name}, which keeps the limits",
            got=name,
        )
        return _map_method(user, made, take, robot, progress, is_smooth=is_smooth)
    if not callable(made):
        problem = (
            "has `reset` and `map`, which --tasks takes; gestures and recordings need"
        )
        if not {"reset", "map"} <= {*dir(made)}:
            problem = f"made {type(made).__name__}, expected"
        raise UserCodeError(
            user.name,
            f"{problem} a function from landmarks to joint angles, or a method",
        )
    expect(not is_smooth, "--methods", f"{user.name}, a function of joints", got=name)
    function = cast("LandmarkFunction", made)
    motion = _map_function(user, function, take, robot, progress)
    return clip_motion(motion) if is_limited else motion


def _map_method(
    user: UserMapping,
    made: Method | Preset,
    take: Take,
    robot: Hand,
    progress: SampleProgress,
    *,
    is_smooth: bool,
) -> RobotMotion:
    """Map a take by the QP of this package."""
    method = made.method if isinstance(made, Preset) else made
    human = take.human
    if isinstance(method, CustomMethod) and method.human_points:
        human = human.with_points(method.human_points)
    ik = made.ik if isinstance(made, Preset) else None
    try:
        mapper = HandMapper(human, robot, method, ik=ik)
        if is_smooth:
            weights = mapper.ik.replaced(**SMOOTH_IK)
            mapper = HandMapper(human, robot, method, ik=weights)
        motion = map_recording(
            mapper, take.recording, progress, wrist_poses=take.wrist, is_guarded=False
        )
    except HandmapError as error:
        raise UserCodeError(user.name, str(error)) from error
    except Exception as error:
        raise user.failed(error) from error
    failed = np.flatnonzero(motion.status == "failed")
    if len(failed):
        problem = f"no finite targets in {_counted(failed, len(motion.time))}"
        raise UserCodeError(user.name, f"{problem}: return numbers in every sample")
    return replace(motion, robot=robot)


def _map_function(
    user: UserMapping,
    function: LandmarkFunction,
    take: Take,
    robot: Hand,
    progress: SampleProgress,
) -> RobotMotion:
    """Take the joints that a function returns; the last ones where the hand was not seen."""
    recording = take.recording
    q = np.full((len(recording), len(robot.joint_names)), np.nan)
    step_cpu = np.full(len(recording), np.nan)
    for i in np.flatnonzero(recording.valid).tolist():
        started = thread_time()
        q[i] = _joints(user, function, recording.landmarks[i], robot)
        step_cpu[i] = thread_time() - started
        progress(i + 1)
    missing = np.flatnonzero(recording.valid & ~np.isfinite(q).all(axis=1))
    if len(missing):
        problem = f"joints are not finite in {_counted(missing, len(recording))}"
        advice = "return the last joints where there is no answer"
        raise UserCodeError(user.name, f"{problem}: {advice}")
    return joints_on_human(take, robot, q[held_samples(recording.valid)], step_cpu)


def _joints(
    user: UserMapping, function: LandmarkFunction, landmarks: Array, robot: Hand
) -> Array:
    """Call a function for a sample."""
    answer = cast("JointAnswer", user.run(function, landmarks.copy()))
    try:
        return joint_positions(answer, robot)
    except InvalidInputError as error:
        raise UserCodeError(user.name, str(error)) from error


def joints_on_human(
    take: Take, robot: Hand, q: Array, step_cpu: Array, about: str = ""
) -> RobotMotion:
    """Return a motion of joints (T, n) whose palm lies on the human's."""
    wrist = take.trace.palm @ inverse_pose(robot.wrist_to_palm)
    return RobotMotion(
        robot, take.recording.time, q, wrist, step_cpu, about, moves_wrist=False
    )


def _check(user: UserMapping, name: str, take: Take, robot: Hand) -> None:
    """Map the first samples of a take, and say so if all will take long.

    Raises:
        HandmapError: If they cannot be mapped.
    """
    recording = take.recording
    first = np.flatnonzero(recording.valid)[:_TRIED]
    started = perf_counter()
    _map(user, name, take.part(first), robot)
    needed = (perf_counter() - started) / len(first) * int(recording.valid.sum())
    if needed > _LONG:
        warn(f"{name} takes about {needed / 60.0:.0f} min on {take.name}")


def _counted(samples: Array, total: int) -> str:
    """Return how many samples there are, and the first, in words."""
    return f"{len(samples)} of {total} samples, the first is sample {samples[0]}"
