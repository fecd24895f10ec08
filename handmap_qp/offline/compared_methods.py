"""The methods that `handmap compare` runs by name: the package's own, and programs outside it.

An outside program is a file `compare.py` in a folder of its own. It is run with this interpreter:

- `compare.py list HAND` prints JSON, `[{"name": ..., "about": ...}, ...]`: its methods for a hand;
- `compare.py run METHOD HAND IN.npz OUT.npz` maps a recording.

HAND is the name of a hand of this package or the path of its `hand.yaml`. IN is a recording. OUT
holds `q (T, n)` [rad] in the order of the hand's `joint_names`, `step_time (T,)` [s], and `wrist
(T, 4, 4)` if the method moves the wrist. On failure, it exits with another code than 0, and the
last line on stderr says why.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.method import Method
from handmap_qp.mapping.presets import PRESETS, preset_choice
from handmap_qp.offline.both_ways import map_both_ways
from handmap_qp.offline.comparison import RobotMotion
from handmap_qp.offline.look_ahead import LookAhead, look_ahead, smooth_poses
from handmap_qp.offline.takes import Take
from handmap_qp.offline.trajectory import Trajectory, follow_recording
from handmap_qp.se3 import as_floats
from handmap_qp.stream.smoothing import SMOOTH_IK, Smoothing
from handmap_qp.trackers.formats.archive import read_archive

PROGRAM = "compare.py"
"""File that a folder of outside methods must hold."""
SMOOTH = "+smooth"
"""Ending of a name that asks for smoothed samples and motion, as `--smooth` of `handmap map`."""
LOOK_AHEAD = "+look-ahead"
"""Ending of a name that asks for smoothing with the future too, as `--look-ahead` of a batch."""
# fixed_wrist is for hands that cannot follow a palm.
_LEFT_OUT = ("fixed_wrist",)


class OutsideError(HandmapError):
    """An outside program cannot be run or failed; the message is one line."""


@dataclass(frozen=True, slots=True)
class OwnMethod:
    """A method of this package.

    Attributes:
        name: Name of a preset; with `+smooth` for smoothed samples, with `+look-ahead` for
            smoothing with the future too.
    """

    name: str

    def map_take(self, take: Take, robot: Hand) -> RobotMotion:
        """Map the landmarks of a take, with the palm that it is measured against."""
        _, method, ik = preset_choice(base_name(self.name), take.contact_gap)
        smoothing = None
        if self.name.endswith(SMOOTH):
            smoothing, ik = Smoothing(), ik.replaced(**SMOOTH_IK)
        if self.name.endswith(LOOK_AHEAD):
            trajectory = _map_ahead(take, robot, method, ik)
        else:
            mapper = HandMapper(take.human, robot, method, ik=ik)
            # Mappings are compared, not how faults of the tracker are met: peers meet none.
            trajectory = follow_recording(
                mapper, take.recording, wrist_poses=take.wrist, smoothing=smoothing
            )
        return RobotMotion(trajectory.q, trajectory.wrist, trajectory.step_cpu)


@dataclass(frozen=True, slots=True)
class OutsideMethod:
    """A method of a program outside this package.

    Attributes:
        name: Its name there.
        about: Version and settings, in words.
        folder: The folder of the program.
        hand: The robot hand as the program is told, name or path.
    """

    name: str
    about: str
    folder: Path
    hand: str

    def map_take(self, take: Take, robot: Hand) -> RobotMotion:
        """Run the program on a take."""
        with tempfile.TemporaryDirectory(prefix="handmap-") as folder:
            given, made = Path(folder) / f"{take.name}.npz", Path(folder) / "made.npz"
            recording = take.recording
            np.savez(
                given,
                time=recording.time,
                landmarks=recording.landmarks,
                valid=recording.valid,
                handedness=np.array(recording.side),
            )
            _call(self.folder, "run", self.name, self.hand, str(given), str(made))
            return self._read(made, len(recording), len(robot.joint_names))

    def _read(self, made: Path, count: int, joints: int) -> RobotMotion:
        try:
            values = read_archive(made)
            q = as_floats(values["q"], "q", shape=(count, joints), is_finite=True)
            step_time = as_floats(values["step_time"], "step_time", shape=(count,))
            wrist = values.get("wrist")
            if wrist is not None:
                wrist = as_floats(wrist, "wrist", shape=(count, 4, 4), is_finite=True)
        except (KeyError, ValueError) as error:
            raise OutsideError(
                f"{self.folder / PROGRAM}: {self.name}: bad result: {error}"
            ) from error
        return RobotMotion(q, wrist, step_time, self.about)


def own_methods() -> tuple[str, ...]:
    """Return the names of the package's own methods, without `+smooth`."""
    return tuple(name for name in PRESETS if name not in _LEFT_OUT)


def own_method(name: str) -> OwnMethod:
    """Return a method of the package.

    Raises:
        InvalidInputError: If there is no such method.
    """
    if base_name(name) not in own_methods():
        raise InvalidInputError(
            argument="--methods", expected=f"some of {', '.join(own_methods())}", value=name
        )
    return OwnMethod(name)


def _map_ahead(take: Take, robot: Hand, method: Method, ik: IkOptions) -> Trajectory:
    """Map a take with its future: smoothed, without lag."""
    recording, options = take.recording, LookAhead()
    wrist = smooth_poses(recording.time, take.wrist, recording.valid, options)
    smooth = look_ahead(recording, options)
    return map_both_ways(take.human, robot, method, ik, smooth, wrist_poses=wrist)


def base_name(name: str) -> str:
    """Return the name of a method without its ending."""
    return name.removesuffix(SMOOTH).removesuffix(LOOK_AHEAD)


class _Listed(msgspec.Struct):
    name: str
    about: str = ""


def outside_methods(folder: Path, hand: str) -> list[OutsideMethod]:
    """Ask an outside program for its methods.

    Args:
        folder: The folder of its `compare.py`.
        hand: The robot hand, by name or path.

    Returns:
        Its methods for this hand.

    Raises:
        OutsideError: If there is no such program, or it cannot run.
    """
    if not (folder / PROGRAM).is_file():
        raise OutsideError(f"no {PROGRAM} in {folder}: --peers needs a checkout with benchmarks/")
    answer = _call(folder, "list", hand)
    try:
        listed = msgspec.json.decode(answer, type=list[_Listed])
    except msgspec.DecodeError as error:
        raise OutsideError(
            f"{folder / PROGRAM}: expected a JSON list of methods: {error}"
        ) from error
    return [OutsideMethod(item.name, item.about, folder, hand) for item in listed]


def _call(folder: Path, *words: str) -> str:
    """Run the program and return its stdout."""
    command = [sys.executable, str(folder / PROGRAM), *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise OutsideError(f"{folder / PROGRAM}: {error}") from error
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise OutsideError(lines[-1])
    return done.stdout
