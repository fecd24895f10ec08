"""Golden files: what the engine commanded when they were written, to hold every later one to.

    python tests/support/golden.py                 # write all of them, into tests/data/golden
    python tests/support/golden.py hands robots    # some of them

Do not write them to make a test pass. If a change must not move a command, the files from before it
are the reference: write a case that is missing before the change. If a change moves a command on
purpose, write them again after it, in the same commit, which says what moved and why.

`hands` has every hand of the package by every preset, `robots` the robots with two hands,
`streams` a tracker's faults, and `problems` single QPs. The person's motion is the recording
`demo`. Numbers are stored as multiples of 1e-10, and read back to half of that.

Where rounding alone moves a command, because the QP has a choice there, equality means little. So
all is computed a second time, from samples that differ by 1e-13 m, and each case keeps by how much
the second differs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from faulty_recordings import faulty
from meeting_hands import meeting_hands

from handmap_core.core import core
from handmap_core.human.recording import Recording, mirrored
from handmap_core.human.sample import human_name
from handmap_core.stream.rejoin import RejoinKind
from handmap_core.stream.step_table import RULE_NAMES, STATUS_NAMES
from handmap_qp import HandMapper, load_hand
from handmap_qp.errors import (
    InvalidOptionsError,
    MissingExtraError,
    MissingPackageError,
)
from handmap_qp.hands import Side
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import HUMAN_HANDS, hand_names, robot_files
from handmap_qp.hands.robot import load_robot
from handmap_qp.mapping.presets import PRESETS
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.trackers.formats import read_recording

FOLDER = Path(__file__).parents[1] / "data" / "golden"
SAMPLES = 100
"""Commands that are kept of the motion of a hand or robot, spread over all of it."""
TOLERANCE = 1e-9
"""How far joints may be from the golden ones [rad or m], where rounding moves them by less."""

_RESOLUTION = 1e-10
_SHIFT = 1e-13
# Differences by rounding count this often, because a run has other rounding than the second one.
_MARGIN = 100.0
_DEMO = read_recording("demo", "right")
_MOST_COORDINATES = 16
_FOLLOWERS = "leap_right", "three_finger"
_REJOINS: dict[str, RejoinKind] = {"glide": "glide", "clutch": "clutch"}
_FAULTS = (
    *("dropout@0.7+0.3", "silence@0.7+0.6", "frozen@0.7+0.8", "zero@0.7+0.1"),
    *("jump@0.7+0.2:0.2", "flip@0.7+0.4", "mirror@0.7+0.2", "outlier@0.7+0.1:0.1"),
    *("clock@0.7:5", "noise@0.7+0.5:0.005"),
)


class Case(NamedTuple):
    """What was commanded in one motion, or found in many problems.

    Attributes:
        numbers: Joint positions of T commands [rad or m], shape (T, n), or solutions.
        codes: What was said about each, shape (T, k): indices of status, rule, and so on.
        rounding: Largest difference that samples which differ by 1e-13 m make.
    """

    numbers: np.ndarray
    codes: np.ndarray
    rounding: float = 0.0

    @property
    def tolerance(self) -> float:
        """How far numbers may be off, more where rounding decides between answers."""
        return max(TOLERANCE, _MARGIN * self.rounding)


Cases = dict[str, Case]
Make = Callable[[str, float], Case]
"""Computes a case by its name, from samples that are moved by a distance [m]."""


def hand_case(name: str, shift: float = 0.0) -> Case:
    """Map the motion to a hand by a preset, both named as in `allegro_right/paper`.

    A preset that does not take the hand has no samples.
    """
    hand, preset = name.split("/")
    robot = load_hand(hand)
    human, motion = _person(robot.side, shift)
    try:
        mapper = HandMapper(human, robot, preset)
    except InvalidOptionsError:
        return Case(np.zeros((0, len(robot.joint_names))), np.zeros((0, 1), np.int8))
    numbers, codes = [], []
    dt = float(np.median(motion.steps))
    for landmarks in motion.landmarks:
        step = mapper.map_landmarks(landmarks, dt=dt)
        numbers.append(step.command.q)
        codes.append([STATUS_NAMES.index(step.status)])
    return _thinned(numbers, codes)


def robot_case(name: str, shift: float = 0.0) -> Case:
    """Map hands that meet to a robot with two."""
    robot = load_robot(name)
    hands = meeting_hands()
    dt = float(np.median(hands["left"].steps))
    people = {side: load_hand(human_name(side), points="landmarks") for side in hands}
    mapper = RobotMapper(robot, people)
    numbers, codes = [], []
    for i in range(len(hands["left"])):
        samples = {side: each.landmarks[i] + shift for side, each in hands.items()}
        step = mapper.map_landmarks(samples, dt=dt)
        numbers.append(step.command.q)
        codes.append([STATUS_NAMES.index(step.status)])
    return _thinned(numbers, codes)


def stream_case(name: str, shift: float = 0.0) -> Case:
    """Follow a tracker with a fault, named as in `leap_right/glide/dropout@0.7`."""
    hand, rejoin, fault = name.split("/")
    human, _ = _person("right", 0.0)
    guard = StreamGuard(human)
    mapper = HandMapper(human, load_hand(hand))
    follower = Follower(mapper, rejoin=_REJOINS[rejoin])
    numbers, codes = [], []
    for seen in faulty(fault):
        sample = replace(seen, landmarks=seen.landmarks + shift)
        verdict = guard.check(sample)
        step = follower.map_sample(sample)
        numbers.append(step.command.q)
        codes.append(
            [
                STATUS_NAMES.index(step.status),
                RULE_NAMES.index(verdict.rule),
                verdict.is_held,
                verdict.is_return,
            ]
        )
    return Case(np.array(numbers), np.array(codes, np.int8))


def problem_case(name: str, shift: float = 0.0) -> Case:
    """Solve 100 QPs with bounds and rows, drawn from a seed; a row each, zeros behind it."""
    random = np.random.default_rng(int(name))
    numbers = np.zeros((100, _MOST_COORDINATES))
    codes = np.zeros((100, 1), np.int8)
    for k in range(100):
        n = int(random.integers(2, _MOST_COORDINATES + 1))
        half = random.normal(size=(n + 2, n))
        H = half.T @ half + 0.01 * np.eye(n)
        c = random.normal(size=n) + shift
        lower, upper = np.sort(random.normal(scale=0.5, size=(2, n)), axis=0)
        inside = random.uniform(lower, upper)
        G = random.normal(size=(int(random.integers(1, 9)), n))
        h = G @ inside + random.exponential(0.1, len(G))
        is_found, solution, _ = core.solve_qp(H, c, lower, upper, G, h)
        codes[k] = is_found
        numbers[k, :n] = solution
    return Case(numbers, codes)


MAKERS: dict[str, Make] = {
    "hands": hand_case,
    "robots": robot_case,
    "streams": stream_case,
    "problems": problem_case,
}
"""What computes the cases of each file."""


def case_names(file: str) -> list[str]:
    """Return the names of the cases that can be computed here."""
    if file == "hands":
        hands = [name for name in hand_names() if name not in HUMAN_HANDS]
        return [f"{hand}/{preset}" for hand in hands for preset in PRESETS]
    if file == "robots":
        return [name for name in robot_files() if _is_installed(name)]
    if file == "streams":
        ways = [(hand, rejoin) for hand in _FOLLOWERS for rejoin in _REJOINS]
        return [f"{hand}/{way}/{fault}" for hand, way in ways for fault in _FAULTS]
    return [str(seed) for seed in range(10)]


def read(file: str) -> Cases:
    """Read the golden cases of a file."""
    with np.load(FOLDER / f"{file}.npz") as arrays:
        names = {key.rpartition("|")[0]: None for key in arrays}
        return {
            name: Case(
                _unpacked(arrays[f"{name}|numbers"]),
                arrays[f"{name}|codes"],
                float(arrays[f"{name}|rounding"]),
            )
            for name in names
        }


def write(file: str) -> None:
    """Compute the cases of a file, twice each, and write them."""
    make = MAKERS[file]
    arrays: dict[str, np.ndarray] = {}
    for name in case_names(file):
        case = make(name, 0.0)
        other = make(name, _SHIFT)
        rounding = np.abs(other.numbers - case.numbers).max(initial=0.0)
        arrays[f"{name}|numbers"] = _packed(case.numbers)
        arrays[f"{name}|codes"] = case.codes
        arrays[f"{name}|rounding"] = np.array(rounding)
        print(f"{file} {name}: {len(case.numbers)} samples, rounding {rounding:.1e}")
    FOLDER.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(FOLDER / f"{file}.npz", allow_pickle=False, **arrays)


def _packed(numbers: np.ndarray) -> np.ndarray:
    """Return the bytes of whole numbers by their place, of second differences: they shrink."""
    whole = np.round(numbers / _RESOLUTION).astype(np.int64)
    zeros = np.zeros((2, whole.shape[1]), np.int64)
    changes = np.diff(whole, n=2, axis=0, prepend=zeros)
    return np.moveaxis(changes[..., None].view(np.uint8), -1, 0)


def _unpacked(packed: np.ndarray) -> np.ndarray:
    """Return the numbers of `_packed`."""
    changes = np.ascontiguousarray(np.moveaxis(packed, 0, -1)).view(np.int64)[..., 0]
    whole: np.ndarray = changes.cumsum(axis=0).cumsum(axis=0)
    return _RESOLUTION * whole


@cache
def _person(side: Side, shift: float) -> tuple[Hand, Recording]:
    """Return the person's hand, and the motion with all landmarks moved by a distance [m]."""
    human = load_hand(human_name(side), points="landmarks")
    motion = _DEMO if side == "right" else mirrored(_DEMO)
    return human, replace(motion, landmarks=motion.landmarks + shift)


def _thinned(numbers: list[np.ndarray], codes: list[list[int]]) -> Case:
    """Keep some of the commands of a motion: each depends on all before it."""
    kept = np.linspace(0, len(numbers) - 1, SAMPLES).astype(int)
    return Case(np.array(numbers)[kept], np.array(codes, np.int8)[kept])


def _is_installed(robot: str) -> bool:
    try:
        load_robot(robot)
    except (MissingExtraError, MissingPackageError):
        return False
    return True


if __name__ == "__main__":
    for chosen_file in sys.argv[1:] or MAKERS:
        write(chosen_file)
