"""Map recorded motions to a robot: `map_hands` and `map_recording` return a `Trajectory`."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from time import thread_time
from typing import Any

import numpy as np

from handmap_core.errors import InvalidInputError
from handmap_core.se3 import Array, Arrays, lengths
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.hands import Hand, Names
from handmap_qp.human import (
    RULES,
    Person,
    Recording,
    Rule,
    by_parts,
    sample_columns,
    scaled_human,
)
from handmap_qp.mapping import HandMapper, MapStep, RobotMapper, RobotStep
from handmap_qp.stream import (
    RULE_NAMES,
    STATUS_NAMES,
    Follower,
    RobotFollower,
    StepTable,
    follow_recording,
    paired,
)

Progress = Callable[[int], None] | None
"""Called after each sample with the number of samples done."""


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """A robot's motion after a human's, as columns of T samples.

    Attributes:
        robot: The robot hand.
        time: Instants [s], shape (T,).
        q: Joint positions in the order of `robot.joint_names` [rad or m], shape (T, n).
        wrist: Wrist poses in the robot's world, shape (T, 4, 4).
        step_cpu: CPU time of each step [s], shape (T,); NaN where the robot was held.
        about: Version and settings of what made it, in words.
        moves_wrist: Whether that moves the wrist; else a floating robot's palm lies on the human's.
    """

    robot: Hand
    time: Array
    q: Array
    wrist: Array
    step_cpu: Array
    about: str = ""
    moves_wrist: bool = True

    @property
    def speeds(self) -> Array:
        """Speeds of the joints from each sample to the next [rad/s or m/s], shape (T - 1, n).

        By the instants of the samples, and not by the times that the mapper granted.
        """
        return np.diff(self.q, axis=0) / np.diff(self.time)[:, None]

    @property
    def accelerations(self) -> Array:
        """Changes of the speeds over the time of the later step [rad/s^2], shape (T - 2, n).

        In that time a motor has to change its speed, also where steps are unequal.
        """
        return np.diff(self.speeds, axis=0) / np.diff(self.time)[1:, None]

    def at(self, i: int) -> Array:
        """Return the configuration of the robot in a sample, shape (nq,)."""
        wrist = self.wrist[i] if self.robot.is_floating else None
        return self.robot.configuration_vector(self.q[i], wrist)


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory(RobotMotion):
    """A robot's motion by a mapper of the package, with all that is known of its steps.

    Attributes:
        targets: Targets of the reference points in the robot's world [m], shape (T, m, 3).
        points: Positions of the reference points [m], shape (T, m, 3).
        point_error: Distance from each point to its target [m], shape (T, m).
        wrist_error: Distance from the wrist to its target [m], shape (T,).
        valid: Whether the robot followed the sample, shape (T,). Elsewhere the tracker did not see
            the hand, or the guard found that the sample makes no sense, and the robot held still.
        at_limit: Whether each joint is at one of its position limits, shape (T, n).
        at_speed_limit: Whether a limit of speed (or of acceleration, where one is set) kept each
            joint from moving farther, shape (T, n).
        status: `MapStep.status` of each sample, shape (T,).
        rule: What is wrong with each sample (`human.sample.RULES`), shape (T,); empty where
            nothing is.
        consistency: RMS difference of bones and palm from the person's [m], shape (T,); NaN where
            it was not measured.
        confidence: The tracker's own confidence, from 0 to 1, shape (T,).
        object_pose: Poses of the robot's object in its world, shape (T, 4, 4); None without one.
    """

    targets: Array
    points: Array
    point_error: Array
    wrist_error: Array
    valid: Array
    at_limit: Array
    at_speed_limit: Array
    status: Array
    rule: Array
    consistency: Array
    confidence: Array
    object_pose: Array | None = None

    @property
    def limit_violation(self) -> float:
        """Largest excess over a position limit [rad or m]; 0 if all limits hold."""
        limits = self.robot.limits
        outside = by_parts(
            lambda q: np.abs(q - np.clip(q, *limits)).max(axis=1, initial=0.0), self.q
        )
        return outside.max(initial=0.0)

    @property
    def columns(self) -> Arrays:
        """Plain arrays by name, without those that follow from them and the robot; rad and m."""
        robot = self.robot
        arrays = {
            name: column
            for name, column in vars(self).items()
            if isinstance(column, Array) and name != "step_cpu"
        }
        return arrays | {
            "joint_names": np.array(robot.joint_names),
            "point_names": np.array([point.name for point in robot.reference_points]),
            "robot": np.array(robot.name),
        }

    @property
    def all_columns(self) -> Arrays:
        """Plain arrays by name, as written to a file of one recording; rad and m."""
        robot = self.robot
        return self.columns | {
            "all_joint_names": np.array(robot.all_joint_names),
            "all_joint_roles": np.array(robot.all_joint_roles),
            "all_q": robot.all_joints(self.q),
            "versions": np.array(package_versions()),
            **{
                name: np.array([hand.frame_pose("wrist", q) for q in self.q])
                for name, hand in self.wrist_columns.items()
            },
        }

    @property
    def wrist_columns(self) -> dict[str, Hand]:
        """Names of the arrays of wrist poses in a file of a robot with two hands, by hand."""
        return {f"wrist_{hand.side}": hand for hand in self.robot.parts}


@cache
def package_versions() -> Names:
    """Return the versions of the packages that the motion depends on."""
    packages = ("handmap-qp", "pin", "daqp", "numpy")
    return tuple(f"{package} {version(package)}" for package in packages)


def map_recording(
    mapper: HandMapper,
    recording: Recording,
    progress: Progress = None,
    *,
    wrist_poses: Array | None = None,
    is_guarded: bool = True,
) -> Trajectory:
    """Map the landmarks of a recording as a live stream: by a `Follower`.

    Where the recording has an object, the method can touch it, and samples are guarded,
    `ObjectFollower` does. The robot holds its last posture in samples that are not valid or make no
    sense.

    Args:
        mapper: The mapper; its human hand must be scaled to the person.
        recording: The recording.
        progress: Called after each sample with the number of samples done.
        wrist_poses: Poses of the human model's wrist frame, shape (T, 4, 4); fitted to the palm's
            landmarks if omitted.
        is_guarded: False to follow every valid sample, whatever it shows: to compare mappings.

    Returns:
        The robot's trajectory, with one entry per sample of `recording`.

    Raises:
        InvalidInputError: If no sample makes sense, or a sample cannot be mapped.
    """
    follower = Follower(mapper)
    samples = sample_columns(recording, wrist_poses)
    if not is_guarded:
        steps = (
            follower.map(mapper.landmarks.read(sample.landmarks, sample.wrist)[0], dt)
            if sample.valid
            else None
            for sample, dt in zip(samples, recording.steps, strict=True)
        )
    elif recording.object_shape:
        steps = follow_recording(follower, recording, wrist_poses)
    else:
        table = follower.map_samples(samples, progress)
        return trajectory_of_table(mapper.robot, recording.time, table)
    return trajectory_of(mapper.robot, recording.time, steps, progress)


def trajectory_of(
    robot: Hand,
    time: Array,
    mapped: Iterator[MapStep | None],
    progress: Progress = None,
) -> Trajectory:
    """Collect the steps of samples; None stands for one that is not valid.

    The robot then holds the posture before it. Before the first sample that is followed, it is
    where that one puts it.

    Args:
        robot: The robot hand, with the reference points that the method moves.
        time: Instants [s], shape (T,).
        mapped: The steps, which are computed one by one.
        progress: Called after each sample with the number of samples done.

    Raises:
        InvalidInputError: If no sample is followed.
    """
    table = StepTable(robot, len(time))
    objects = np.full((len(time), 4, 4), np.nan)
    for i in range(len(time)):
        started = thread_time()
        if step := next(mapped):
            table.write(i, step, thread_time() - started)
            objects[i] = step.diagnostics.get("object_pose", np.nan)
        if progress:
            progress(i + 1)
    made = trajectory_of_table(robot, time, table)
    is_known = np.isfinite(objects[:, 0, 0])
    if not is_known.any():
        return made
    return replace(made, object_pose=objects[held_samples(is_known)])


def nothing_followed(rules: Array) -> InvalidInputError:
    """Return the error of a motion in which no sample is followed.

    Args:
        rules: What is wrong with each sample, as an index in `RULE_NAMES`, shape (T,).
    """
    names = np.array(RULE_NAMES)[rules.astype(int)]
    (name, count), *_ = Counter[Rule](names.tolist()).most_common(1)
    return InvalidInputError(
        argument="motion",
        expected="at least one sample that makes sense",
        got=f"none of {len(names)}; in {count}, {RULES.get(name, name)}",
    )


def trajectory_of_table(robot: Hand, time: Array, table: StepTable) -> Trajectory:
    """Fill the samples without a step, and measure; see `trajectory_of`."""
    status, rule, is_held, consistency, confidence, step_cpu = table.columns[6:]
    is_held = is_held > 0.0
    if is_held.all():
        raise nothing_followed(rule)
    rule = np.array(RULE_NAMES)[rule.astype(int)]
    is_placed = ~np.isnan(table.rows[:, 0])
    is_placed[: np.argmin(is_held)] = False
    placed = held_samples(is_placed)
    q, wrist, wrist_target, targets, points, at_bound = (
        column[placed] for column in table.columns[:6]
    )
    at_limit = robot.at_position_limit(q)
    return Trajectory(
        robot=robot,
        time=time,
        q=q,
        wrist=wrist,
        targets=targets,
        points=points,
        point_error=lengths(targets - points),
        wrist_error=lengths((wrist - wrist_target)[:, :3, 3]),
        valid=~is_held,
        at_limit=at_limit,
        at_speed_limit=(at_bound > 0.0) & ~at_limit & ~is_held[:, None],
        status=np.array(STATUS_NAMES)[status.astype(int)],
        step_cpu=np.where(is_held, np.nan, step_cpu),
        rule=rule,
        consistency=consistency,
        confidence=confidence,
    )


def map_hands(
    recordings: Sequence[Recording],
    robot: Hand,
    person: Person,
    arguments: MappingArguments,
    progress: Progress = None,
) -> tuple[Trajectory, Any, Array]:
    """Map recordings of a person with the options of a command.

    Args:
        recordings: A recording for the robot hand, or of each hand of the robot in its order.
        robot: The robot hand, or the hands of the robot as one.
        person: The person.
        arguments: Reference points and options.
        progress: Called after each sample with the number of samples done.

    Returns:
        The motion of the whole robot at the instants of the longest recording; the method; and
        whether each hand was followed, shape (T, number of hands). Points are of all hands, one
        after the other, and wrist poses of the first.

    Raises:
        HandmapError: If a recording cannot be mapped.
    """
    first = recordings[0]
    if not robot.parts:
        mapper = hand_mapper(first, robot, person, arguments)
        trajectory = map_recording(mapper, first, progress)
        return trajectory, mapper.method, trajectory.valid[:, None]
    used = {recording.side: recording for recording in recordings}
    follower, method = robot_follower(recordings, robot, person, arguments)
    followed = []

    def steps() -> Iterator[RobotStep]:
        for samples in paired(used):
            step = follower.map_samples(samples)
            followed.append(followed_hands(step))
            yield step

    time = max(recordings, key=len).time
    trajectory = trajectory_of(follower.mapper.robot, time, steps(), progress)
    return trajectory, method, np.array(followed)


def robot_follower(
    recordings: Sequence[Recording],
    robot: Hand,
    person: Person,
    arguments: MappingArguments,
) -> tuple[RobotFollower, object]:
    """Return what lets a robot follow both hands of a person with the options of a command.

    Args:
        recordings: A recording of each hand of the robot in its order; sides and the world of the
            first one count.
        robot: The hands of the robot as one.
        person: The person.
        arguments: Reference points and options.

    Returns:
        The follower, and the method that maps.

    Raises:
        HandmapError: If the options do not fit.
    """
    first = recordings[0]
    humans = {
        recording.side: scaled_human(
            recording, points=arguments.human_points, lengths=person.lengths
        )
        for recording in recordings
    }
    human = humans[first.side]
    _, method, ik = arguments.preset_for(human, robot.hands[0], first.upright)
    return RobotFollower(RobotMapper(robot, humans, method, ik=ik)), method


def followed_hands(step: RobotStep) -> list[bool]:
    """Return whether each hand was followed in a step of a robot."""
    # A hand that has had no sample yet has no verdict.
    return [bool(hand.verdict) and not hand.is_held for hand in step.hands.values()]


def hand_mapper(
    recording: Recording, robot: Hand, person: Person, arguments: MappingArguments
) -> HandMapper:
    """Return what maps a recording of a person to a robot hand with the options of a command.

    Args:
        recording: The recording; its side and its world count.
        robot: The robot hand.
        person: The person.
        arguments: Reference points and options.

    Raises:
        HandmapError: If the options do not fit.
    """
    human = scaled_human(
        recording, points=arguments.human_points, lengths=person.lengths
    )
    _, method, ik = arguments.preset_for(human, robot, recording.upright)
    return HandMapper(human, robot, method, ik=ik)


def held_samples(valid: Array) -> Array:
    """Return for every sample the index of the last valid one, at the start of the first, (T,)."""
    index = np.where(valid, np.arange(len(valid)), np.argmax(valid))
    return np.maximum.accumulate(index)


def stretches(flags: Array) -> list[slice]:
    """Return the stretches of samples whose flags are set; flags of shape (T,)."""
    return np.ma.clump_masked(np.ma.array(flags, mask=flags))


def rms_derivative(values: Array, time: Array, valid: Array, *, order: int) -> float:
    """RMS of a time derivative, by divided differences, which allow uneven sampling.

    Args:
        values: Columns over time, shape (T, n).
        time: Instants, strictly increasing [s], shape (T,).
        valid: Samples to use, shape (T,); a difference needs `order + 1` consecutive ones.
        order: Order of the derivative: 1 for speed, 3 for jerk.

    Returns:
        RMS over columns and instants [unit/s^order]; NaN without `order + 1` consecutive valid
        samples.
    """
    differences = values
    usable = valid
    for k in range(1, order + 1):
        # k! f[t_0 .. t_k] is the k-th derivative of the polynomial through k + 1 samples.
        differences = k * np.diff(differences, axis=0) / (time[k:] - time[:-k])[:, None]
        usable = usable[1:] & usable[:-1]
    found = differences[usable]
    return math.sqrt(np.mean(np.square(found))) if len(found) else math.nan
