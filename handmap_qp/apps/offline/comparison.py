"""Methods side by side on recordings: `compare_methods` measures each on the same samples.

Methods are the package's own by name (`own_method`), and those of programs outside it. An outside
program is a file `compare.py` in a folder of its own. It is run with this interpreter:

- `compare.py list HAND` prints JSON, `[{"name": ..., "about": ...}, ...]`: its methods for a hand;
- `compare.py run METHOD HAND IN.npz OUT.npz` maps a recording.
- `compare.py live METHOD HAND` maps sample by sample, for tasks in closed loop. It prints a line of
  JSON when it is ready, and answers each line of its stdin: landmarks (21, 3) [m] by joints in the
  order of the hand's `joint_names` [rad], the string "reset" by an empty list.

HAND is the name of a hand of this package or the path of its `hand.yaml`. IN is a recording. OUT
holds `q (T, n)` [rad] in the order of the hand's `joint_names`, `step_time (T,)` [s], and `wrist
(T, 4, 4)` if the method moves the wrist. On failure, it exits with another code than 0, and the
last line on stderr says why.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from handmap_core.errors import HandmapError, InvalidInputError, expect, reason_of
from handmap_core.se3 import Array, as_floats, inverse_pose
from handmap_qp.apps.arguments import check_names
from handmap_qp.hands import Hand, Names, Side, Values, find_fingers
from handmap_qp.human import (
    Person,
    Recording,
    fit_recording,
    mirrored,
    scaled_human,
    turned,
)
from handmap_qp.mapping import (
    PRESETS,
    HandMapper,
    Shape,
    parse_object,
    preset_choice,
    rotation_onto,
)
from handmap_qp.stream import SMOOTH_IK, measure_person
from handmap_qp.trackers import NpzFormat, read_archive
from .contacts import contact_metrics
from .fidelity import SETTLING, assess_fidelity
from .hand_trace import HandTrace, trace_human, trace_robot
from .limited import clip_motion
from .look_ahead import look_ahead, smooth_poses
from .metrics import mean_values
from .surface_gaps import whose_shapes
from .trajectory import RobotMotion, held_samples, map_recording

PROGRAM = "compare.py"
"""File that a folder of outside methods must hold."""
SMOOTH = "+smooth"
"""Ending of a name that asks for smoother motion, as `--smooth` of `handmap retarget`."""
LOOK_AHEAD = "+look-ahead"
"""Ending of a name that asks for smoothing with the future too, as `--look-ahead` of a batch."""
LIMITS = "+limits"
"""Ending of a peer's name whose joints are to be clipped."""

# How names of the peers' methods begin, and what to do if one of them cannot run.
_PEER_NAMES = ("dex-", "dexi-")
_PEER_ADVICE = (
    "those of dex-retargeting need torch and six, beside the extra peers of handmap-qp"
)

Progress = Callable[[int, str], None]
"""Takes how much is done, and in words what comes next."""
SampleProgress = Callable[[int], None]
"""Called after each sample with the number of samples done."""


class OutsideError(HandmapError):
    """An outside program cannot be run or failed; the message is one line."""


@dataclass(frozen=True, eq=False)
class Take:
    """One recording of a human hand, on the robot's side.

    Attributes:
        recording: The recording; mirrored if the robot is a hand of the other side.
        is_mirrored: Whether it is.
        human: The human hand, scaled to the person.
        trace: What the human did, by the raw landmarks. Samples that are not valid hold the one
            before.
        wrist: Pose of the human model's wrist frame in the world, shape (T, 4, 4).
        q: The human's joint angles, fitted for the jerk alone [rad], shape (T, 20).
        shape: Shape of the object that it has; None if none is known.
    """

    recording: Recording
    is_mirrored: bool
    human: Hand
    trace: HandTrace
    wrist: Array
    q: Array
    shape: Shape | None = None

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name

    @property
    def has_wrist(self) -> bool:
        """Whether the palm is the tracker's; otherwise it is fitted to its landmarks."""
        return self.recording.wrist is not None

    def part(self, samples: Array) -> "Take":
        """Return some of the samples, by index in the order of time.

        Raises:
            InvalidInputError: If none of them is valid.
        """
        return replace(
            self,
            recording=self.recording.part(samples),
            trace=self.trace.part(samples, self.trace.names),
            wrist=self.wrist[samples],
            q=self.q[samples],
        )


class ComparedMethod(NamedTuple):
    """A way from a human's landmarks to a robot's motion.

    Attributes:
        name: Short name.
        map_take: Maps a take; raises `HandmapError` if the method cannot.
        check: Rejects a take before any mapping, by the same errors; None if nothing is checked.
        map_slowly: Does what `map_take` does, and calls back after each sample: of methods that may
            be slow.
    """

    name: str
    map_take: Callable[[Take, Hand], RobotMotion]
    check: Callable[[Take, Hand], None] | None = None
    map_slowly: Callable[[Take, Hand, SampleProgress], RobotMotion] | None = None


class Run(NamedTuple):
    """One method on one take.

    Attributes:
        method: Name of the method.
        take: The take.
        values: Every metric by its key; NaN where a question does not arise or the method failed.
        fingers: As in `Fidelity`; None if the method failed.
        pinch_samples: See `Fidelity`.
        motion: What the method made of the take; None if it failed.
        problem: Why it failed; empty if it did not.
    """

    method: str
    take: Take
    values: Values
    fingers: dict[str, Values] | None = None
    pinch_samples: int = 0
    motion: RobotMotion | None = None
    problem: str = ""


class Comparison(NamedTuple):
    """Methods side by side.

    Attributes:
        robot: The robot hand.
        takes: The recordings, in the order given.
        methods: Names of the methods, in the order given.
        runs: Every method on every take, takes first.
        shapes: The robot by the description whose shapes pinches and penetration are measured with;
            None for its own.
    """

    robot: Hand
    takes: Sequence[Take]
    methods: Names
    runs: Sequence[Run]
    shapes: Hand | None = None

    def of_method(self, method: str) -> list[Run]:
        """Return the runs of a method, a take each."""
        return [run for run in self.runs if run.method == method]

    @property
    def whose_shapes(self) -> str:
        """Whose shapes pinches and penetration are measured with, in words."""
        return whose_shapes(self.shapes or self.robot)

    @property
    def overall(self) -> dict[str, Values]:
        """By method, each metric's mean over the takes in which it is not NaN."""
        return {
            method: mean_values([run.values for run in self.of_method(method)])
            for method in self.methods
        }

    def notes(self) -> list[str]:
        """Return a line for everything that a method did not do."""
        lines = []
        for method in self.methods:
            runs = self.of_method(method)
            problems = {run.problem for run in runs}
            if len(problems) == 1 and all(problems):
                lines.append(f"{method}: {problems.pop().removeprefix(f'{method}: ')}")
                continue
            failed = [run for run in runs if run.problem]
            lines += [f"{method} on {run.take.name}: {run.problem}" for run in failed]
        still = {
            run.method: None
            for run in self.runs
            if run.motion and not run.motion.moves_wrist
        }
        if still:
            lines.append(
                f"{', '.join(still)}: the wrist is not moved; the robot's palm is put on the "
                "human's, and the palm's error is not measured"
            )
        return lines


def prepare_take(
    recording: Recording, side: Side = "right", *, person: Person | None = None
) -> Take:
    """Describe what the human did in a recording.

    Args:
        recording: Landmarks of a hand, and the tracker's wrist poses if it gave any.
        side: Side of the robot; a recording of the other hand is mirrored.
        person: The person; measured in the recording if omitted.

    Raises:
        InvalidInputError: If the landmarks are not those of a hand in metres, or no sample is valid
            after the first half second.
    """
    is_late = recording.time >= recording.time[0] + SETTLING
    expect(
        (recording.valid & is_late).any(),
        recording.name,
        "valid samples after the first half second",
        got="none",
    )
    is_mirrored = recording.side != side
    if is_mirrored:
        recording = mirrored(recording)
    held = held_samples(recording.valid)
    poses = recording.wrist
    of_object = recording.object_shape
    lengths = (person or measure_person(recording)).lengths
    human = scaled_human(recording, lengths=lengths)
    wrist = None if poses is None else poses[held]
    trace = trace_human(recording.landmarks[held], lengths, side, wrist)
    return Take(
        recording=recording,
        is_mirrored=is_mirrored,
        human=human,
        trace=trace,
        wrist=trace.palm @ inverse_pose(human.wrist_to_palm),
        q=fit_recording(recording, lengths=lengths).q,
        shape=parse_object(of_object, recording.name) if of_object else None,
    )


def in_world_of(robot: Hand, recording: Recording) -> Recording:
    """Return a recording in the world of a robot on an arm, as far as both are known."""
    turn = rotation_onto(robot, recording.upright)
    if turn is None:
        return recording
    return turned(recording, turn, np.eye(4), upright=robot.spec.upright)


def compare_methods(
    takes: Sequence[Take],
    robot: Hand,
    methods: Sequence[ComparedMethod],
    progress: Progress = lambda *_: None,
    shapes: Hand | None = None,
) -> Comparison:
    """Run every method on every take, and measure what the robot does.

    A method that cannot map a take gets a run without values, which says why.

    Args:
        takes: What the human did.
        robot: The robot hand.
        methods: The methods.
        progress: Called before each run, and after the last, with the number of runs done, and the
            name of the run.
        shapes: The robot by another description (`with_urdf`), whose shapes pinches and penetration
            are measured with.

    Raises:
        InvalidInputError: If there is nothing to compare, two takes or methods have one name, a
            take is of another side than the robot, or the robot has no finger with a human name.
        HandmapError: If a method that checks takes first rejects one.
    """
    check_names("takes", [take.name for take in takes])
    names = tuple(method.name for method in methods)
    check_names("methods", names)
    for take in takes:
        expect(
            take.recording.side == robot.side,
            "takes",
            f"a {robot.side} hand, as {robot.name} is",
            got=f"{take.name} ({take.recording.side})",
            advice="prepare_take mirrors it",
        )
    if not find_fingers(robot):
        raise InvalidInputError(
            f"{robot.name} has no finger with a human name, so nothing can be compared",
            argument="robot",
            advice="name the fingers of its points in hand.yaml",
        )
    runs = []
    total = len(takes) * len(methods)
    for take, method in product(takes, methods):
        if method.check:
            progress(0, f"checking {method.name} on {take.name}")
            method.check(take, robot)
    for take, method in product(takes, methods):
        done = len(runs)
        text = f"{method.name} on {take.name} ({done} of {total})"
        progress(done, text)
        mapping = method.map_take
        if method.map_slowly:
            telling = _telling(progress, done, text, len(take.recording))
            mapping = partial(_map_slowly, method.map_slowly, telling)
        runs.append(_run(method.name, mapping, take, robot, shapes))
    progress(total, "measured")
    return Comparison(robot, takes, names, runs, shapes)


def peers_program() -> Path:
    """Return the folder of the program that runs the peers: of the checkout, or of the package."""
    package = Path(__file__).parents[2]
    checkout = package.parent / "benchmarks" / "peers"
    return checkout if checkout.is_dir() else package / "outside" / "peers"


def is_peer(name: str) -> bool:
    """Return whether a method is one of the peers, by its name."""
    return name.startswith(_PEER_NAMES)


def own_methods() -> Names:
    """Return the names of the package's own methods, without `+smooth`."""
    # `fixed_wrist` is for hands that cannot follow a palm.
    return tuple(name for name in PRESETS if name != "fixed_wrist")


def own_method(name: str, outside: Sequence[str] = ()) -> ComparedMethod:
    """Return a method of the package.

    Args:
        name: Name of a preset; with `+smooth` for smoother motion, with `+look-ahead` for
            smoothing with the future too.
        outside: Names of outside methods, for the message.

    Raises:
        InvalidInputError: If there is no such method.
    """
    known = own_methods()
    expect(
        base_name(name) in known,
        "--methods",
        f"some of {', '.join((*known, *outside))}, one of ours with {SMOOTH} or {LOOK_AHEAD}, or "
        "FILE.py:NAME",
        got=name,
        advice=_PEER_ADVICE if is_peer(name) else "",
    )
    return ComparedMethod(name, partial(_map_own, name))


def base_name(name: str) -> str:
    """Return the name of a method without its ending."""
    return name.removesuffix(SMOOTH).removesuffix(LOOK_AHEAD)


class _Listed(msgspec.Struct):
    name: str
    about: str = ""


def outside_methods(folder: Path, hand: str) -> dict[str, ComparedMethod]:
    """Ask the outside program in a folder for its methods, by name, for a hand, by name or path.

    Raises:
        OutsideError: If there is no such program, or it cannot run.
    """
    program = folder / PROGRAM
    if not program.is_file():
        raise OutsideError(
            f"no {PROGRAM} in {folder}: expected the program of benchmarks/peers"
        )
    answer = _call(program, "list", hand)
    try:
        listed = msgspec.json.decode(answer, type=list[_Listed])
    except msgspec.DecodeError as error:
        problem = f"{program}: expected a JSON list of methods: {error}"
        raise OutsideError(problem) from error
    return {
        one.name: ComparedMethod(one.name, partial(_map_outside, program, one, hand))
        for one in listed
    }


def with_limited(methods: Mapping[str, ComparedMethod]) -> dict[str, ComparedMethod]:
    """Return outside methods by name, each followed by itself within the limits of the robot.

    The second is named with `+limits`. On a take that the first was just run on, it does not run
    again.
    """
    found = {}
    for name, method in methods.items():
        latest = lru_cache(maxsize=1)(method.map_take)
        limited = partial(_map_limited, latest)
        found[name] = ComparedMethod(name, latest)
        found[name + LIMITS] = ComparedMethod(name + LIMITS, limited)
    return found


def _map_limited(
    map_take: Callable[[Take, Hand], RobotMotion], take: Take, robot: Hand
) -> RobotMotion:
    """Run a method, and clip its joints."""
    return clip_motion(map_take(take, robot))


def _map_own(name: str, take: Take, robot: Hand) -> RobotMotion:
    """Map the landmarks of a take, with the palm that it is measured against."""
    _, method, ik = preset_choice(base_name(name), take.human)
    recording = take.recording
    wrist = take.wrist
    if name.endswith(LOOK_AHEAD):
        wrist = smooth_poses(recording.time, wrist, recording.valid)
        recording = look_ahead(recording)
    if name != base_name(name):
        ik = ik.replaced(**SMOOTH_IK)
    mapper = HandMapper(take.human, robot, method, ik=ik)
    # Mappings are compared, not how faults of the tracker are met: peers meet none. Only what knows
    # of an object is on guard too.
    is_guarded = take.shape is not None
    motion = map_recording(mapper, recording, wrist_poses=wrist, is_guarded=is_guarded)
    # The hand as it was given: its workspace is sampled once, and pictures show its own points.
    return replace(motion, robot=robot)


def _map_outside(
    program: Path, listed: _Listed, hand: str, take: Take, robot: Hand
) -> RobotMotion:
    """Run an outside program on a take."""
    recording = take.recording
    count = len(recording)
    with tempfile.TemporaryDirectory(prefix="handmap-") as temporary:
        given = Path(temporary) / f"{take.name}.npz"
        made = Path(temporary) / "made.npz"
        NpzFormat().write([replace(recording, wrist=None)], given)
        _call(program, "run", listed.name, hand, given, made)
        try:
            values = read_archive(made)
            shape = (count, len(robot.joint_names))
            q = as_floats(values["q"], "q", shape=shape, is_finite=True)
            step_time = as_floats(values["step_time"], "step_time", shape=(count,))
            on_human = take.trace.palm @ inverse_pose(robot.wrist_to_palm)
            wrist = values.get("wrist", on_human)
            wrist = as_floats(wrist, "wrist", shape=on_human.shape, is_finite=True)
        except (KeyError, ValueError) as error:
            problem = f"{program}: {listed.name}: bad result: {error}"
            raise OutsideError(problem) from error
    return RobotMotion(
        robot, recording.time, q, wrist, step_time, listed.about, "wrist" in values
    )


def _call(program: Path, *words: str | Path) -> str:
    """Run the program and return its stdout."""
    command = [sys.executable, program, *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise OutsideError(f"{program}: {error}") from error
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise OutsideError(lines[-1])
    return done.stdout


def _telling(progress: Progress, done: int, text: str, total: int) -> SampleProgress:
    """Return what shows the samples of a run that are done."""

    def tell(count: int) -> None:
        progress(done, f"{text}, {count} of {total} samples")

    return tell


def _map_slowly(
    mapping: Callable[[Take, Hand, SampleProgress], RobotMotion],
    progress: SampleProgress,
    take: Take,
    robot: Hand,
) -> RobotMotion:
    """Map a take, and show how far it is."""
    return mapping(take, robot, progress)


def _run(
    name: str,
    map_take: Callable[[Take, Hand], RobotMotion],
    take: Take,
    robot: Hand,
    shapes: Hand | None,
) -> Run:
    """Run a method on a take, and measure what the robot does."""
    try:
        motion = map_take(take, robot)
    except HandmapError as error:
        return Run(name, take, mean_values([]), problem=reason_of(error))
    recording = take.recording
    wrist = motion.wrist if robot.is_floating else None
    trace = trace_robot(robot, motion.q, wrist)
    fidelity = assess_fidelity(
        take.trace,
        trace,
        recording.time,
        recording.valid,
        motion,
        take.q,
        shapes,
    )
    if not motion.moves_wrist:
        fidelity.values.update(palm_deg=np.nan, palm_mm=np.nan)
    if take.shape:
        shape = take.shape
        found = contact_metrics(take.trace, trace, recording, shape, motion)
        fidelity.values.update(found)
    return Run(name, take, *fidelity, motion)
