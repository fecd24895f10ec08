"""Methods side by side on recordings: `compare_methods` measures each on the same samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.hands.fingers import Finger, find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.offline.fidelity import Fidelity, JointMotion, assess_fidelity
from handmap_qp.offline.finger_traces import HandTrace, trace_robot
from handmap_qp.offline.key_vectors import sample_workspace
from handmap_qp.offline.metrics import mean_values, metric_values
from handmap_qp.offline.surface_gaps import measure_gaps
from handmap_qp.offline.takes import Take


@dataclass(frozen=True, slots=True, eq=False)
class RobotMotion:
    """What a method makes of a take.

    Attributes:
        q: Joint positions in the order of `robot.joint_names` [rad or m], shape (T, n).
        wrist: Poses of the robot's wrist frame in the human's world, shape (T, 4, 4). None if the
            method does not move the wrist: the robot's palm then lies on the human's.
        step_time: CPU time of each sample [s], NaN where the robot was held, shape (T,).
        about: Version and settings, in words.
    """

    q: np.ndarray
    wrist: np.ndarray | None
    step_time: np.ndarray
    about: str = ""


class ComparedMethod(Protocol):
    """A way from a human's landmarks to a robot's motion."""

    @property
    def name(self) -> str:
        """Short name."""
        ...

    def map_take(self, take: Take, robot: Hand) -> RobotMotion:
        """Map a take; raise `HandmapError` if the method cannot."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One method on one take.

    Attributes:
        method: Name of the method.
        take: The take.
        values: Every metric by its key; NaN where a question does not arise or the method failed.
        fidelity: The same with each finger's; None if the method failed.
        motion: What the method made of the take; None if it failed.
        trace: The robot's motion as it was measured; None if the method failed.
        problem: Why it failed; empty if it did not.
    """

    method: str
    take: Take
    values: dict[str, float]
    fidelity: Fidelity | None = None
    motion: RobotMotion | None = None
    trace: HandTrace | None = None
    problem: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Methods side by side.

    Attributes:
        robot: The robot hand.
        takes: The recordings, in the order given.
        methods: Names of the methods, in the order given.
        runs: Every method on every take, takes first.
    """

    robot: Hand
    takes: tuple[Take, ...]
    methods: tuple[str, ...]
    runs: tuple[Run, ...]

    def run(self, method: str, take: str) -> Run:
        """Return the run of a method on a take, by their names."""
        return next(r for r in self.runs if r.method == method and r.take.name == take)

    def of_method(self, method: str) -> list[Run]:
        """Return the runs of a method, a take each."""
        return [run for run in self.runs if run.method == method]

    def overall(self, method: str) -> dict[str, float]:
        """Return each metric's mean over the takes in which it is not NaN."""
        return mean_values([run.values for run in self.of_method(method)])

    def notes(self) -> list[str]:
        """Return a line for everything that a method did not do."""
        lines = []
        for method in self.methods:
            runs = self.of_method(method)
            failed = {run.take.name: run.problem for run in runs if run.problem}
            if failed and len(failed) == len(runs) and len(set(failed.values())) == 1:
                lines.append(f"{method}: {next(iter(failed.values()))}")
            else:
                lines += [f"{method} on {take}: {problem}" for take, problem in failed.items()]
        still = [m for m in self.methods if any(_lets_wrist_be(run) for run in self.of_method(m))]
        if still:
            lines.append(
                f"{', '.join(still)}: the wrist is not moved; the robot's palm is put on the "
                "human's, and the palm's error is not measured"
            )
        return lines


def compare_methods(
    takes: Sequence[Take],
    robot: Hand,
    methods: Sequence[ComparedMethod],
    progress: Callable[[str, int, int], None] | None = None,
) -> Comparison:
    """Run every method on every take, and measure what the robot does.

    A method that cannot map a take gets a run without values, which says why.

    Args:
        takes: What the human did.
        robot: The robot hand.
        methods: The methods.
        progress: Called before each run, and after the last, with the name of the run, the number
            of runs done and their total number.

    Returns:
        All runs.

    Raises:
        InvalidInputError: If there is nothing to compare, two takes or methods have one name, a
            take is of another side than the robot, or the robot has no finger with a human name.
    """
    chains = find_fingers(robot)
    _check(takes, robot, methods, chains)
    workspace = sample_workspace(robot, chains)
    runs, total = [], len(takes) * len(methods)
    for take in takes:
        for method in methods:
            if progress is not None:
                progress(f"{method.name} on {take.name}", len(runs), total)
            runs.append(_run(method, take, robot, chains, workspace))
    if progress is not None:
        progress("measured", total, total)
    return Comparison(robot, tuple(takes), tuple(method.name for method in methods), tuple(runs))


def _run(
    method: ComparedMethod,
    take: Take,
    robot: Hand,
    chains: dict[str, Finger],
    workspace: dict[str, np.ndarray],
) -> Run:
    try:
        motion = method.map_take(take, robot)
    except HandmapError as error:
        return Run(method.name, take, mean_values([]), problem=" ".join(str(error).split()))
    wrist = motion.wrist
    if wrist is None:
        wrist = take.trace.palm @ np.linalg.inv(robot.wrist_to_palm)
    trace = trace_robot(robot, motion.q, wrist if robot.is_floating else None, chains)
    fidelity = assess_fidelity(
        take.trace,
        trace,
        take.recording.time,
        valid=take.recording.valid,
        gaps=measure_gaps(robot, motion.q, chains),
        joints=JointMotion(motion.q, robot.lower_limits, robot.upper_limits, robot.velocity_limits),
        human_q=take.q,
        workspace=workspace,
        step_time=motion.step_time,
    )
    values = metric_values(fidelity)
    if motion.wrist is None:
        values |= {"palm_deg": float("nan"), "palm_mm": float("nan")}
    return Run(method.name, take, values, fidelity, motion, trace)


def _lets_wrist_be(run: Run) -> bool:
    return run.motion is not None and run.motion.wrist is None


def _check(
    takes: Sequence[Take],
    robot: Hand,
    methods: Sequence[ComparedMethod],
    chains: dict[str, Finger],
) -> None:
    for argument, names in (
        ("takes", [take.name for take in takes]),
        ("methods", [method.name for method in methods]),
    ):
        if not names:
            raise InvalidInputError(argument=argument, expected="at least one", got="none")
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InvalidInputError(
                argument=argument, expected="different names", got=f"{twice} twice"
            )
    for take in takes:
        if take.recording.side != robot.spec.side:
            raise InvalidInputError(
                argument="takes",
                expected=f"a {robot.spec.side} hand, as {robot.name} is",
                got=f"{take.name} ({take.recording.side})",
                advice="prepare_take mirrors it",
            )
    if not chains:
        raise InvalidInputError(
            argument="robot",
            problem=f"{robot.name} has no finger with a human name, so nothing can be compared",
            advice="name the fingers of its points in hand.yaml",
        )
