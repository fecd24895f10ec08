"""Time several programs in turns, a few samples each: the comparison that a shared machine allows.

Every program is a `Worker`, a process of its own that answers requests (`mapping_worker.py` for a
checkout of this package, `peers/timed.py` for a peer). They get the same samples and take turns of
`TURN` samples, so that a change of the machine's load meets all of them alike. Times are CPU times
of the thread.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import common
import numpy as np
import shared_hands
from peers import build

from handmap_qp import Hand, Recording, read_recording
from handmap_qp.human import HumanMotion
from handmap_qp.human.fit import fit_recording
from handmap_qp.human.measure import scaled_human
from handmap_qp.mapping.hand_pair import hand_pair
from handmap_qp.mapping.presets import default_preset
from handmap_qp.stream.measurement import measure_person

TURN = 150
"""Samples that a worker maps before the next one's turn."""
_COLD = 2
"""Samples of each turn that do not count: the caches hold the program before."""
_BENCHMARKS = Path(__file__).resolve().parents[1]


class WorkerError(Exception):
    """A worker ended; the message is the last line of its stderr."""


@dataclass(slots=True)
class Worker:
    """A process that maps samples on request, and what it has measured.

    Attributes:
        name: Name in the tables.
        process: The process.
        facts: What it said when it was ready.
        times: CPU time of each call [s].
        extra: Further numbers of its answers, by name.
        q: Robot joints after every sample of the last round, shape (T, n).
        wrist: Wrist poses likewise; empty of peers.
    """

    name: str
    process: subprocess.Popen[str]
    facts: dict[str, Any] = field(default_factory=dict)
    times: list[float] = field(default_factory=list)
    extra: dict[str, list[float]] = field(default_factory=dict)
    q: list[list[float]] = field(default_factory=list)
    wrist: list[Any] = field(default_factory=list)

    def ask(self, first: int, last: int, *, starts: bool, counts: bool) -> None:
        """Let it map samples `first` to `last`, from the start if `starts`; keep what `counts`."""
        if self.process.stdin is None:
            raise WorkerError(f"{self.name}: no input")
        print(
            json.dumps({"samples": [first, last], "starts": starts}),
            file=self.process.stdin,
            flush=True,
        )
        answer = self.read()
        if starts:
            self.q.clear()
            self.wrist.clear()
        self.q += answer["q"]
        self.wrist += answer.get("wrist", [])
        if counts:
            self.times += [1e-9 * ns for ns in answer["ns"]]
            for name in answer.keys() - {"ns", "q", "wrist"}:
                self.extra.setdefault(name, []).extend(np.ravel(answer[name]).tolist())

    def read(self) -> dict[str, Any]:
        """Return its next answer."""
        while line := self.process.stdout.readline() if self.process.stdout else "":
            # dex-retargeting prints warnings among its answers.
            if line.startswith("{"):
                return json.loads(line)
        self.process.wait()
        said = (
            self.process.stderr.read().strip().splitlines()
            if self.process.stderr
            else []
        )
        raise WorkerError(
            f"{self.name}: {said[-1] if said else 'ended without a word'}"
        )

    def numbers(self) -> dict[str, float]:
        """Return median and 99th percentile [us], and their ratios to one Jacobian if known.

        `least_us` is the median over the samples of the least time of each in all rounds. Other
        processes slow a call down and never quicken it, so it is the time on a quiet machine.
        """
        times = np.reshape(self.times, (-1, len(self.q)))
        times = times[:, np.arange(len(self.q)) % TURN >= _COLD]
        median, p99 = np.percentile(times, [50.0, 99.0])
        least = float(np.median(times.min(axis=0)))
        row = {"median_us": 1e6 * median, "p99_us": 1e6 * p99, "least_us": 1e6 * least}
        if "jacobian_ns" in self.extra:
            one = 1e-9 * float(np.median(self.extra["jacobian_ns"]))
            row |= {
                "jacobian_us": 1e6 * one,
                "ratio": median / one,
                "ratio_p99": p99 / one,
            }
            row["iterations"] = float(np.mean(self.extra["iterations"]))
        return row


def write_inputs(
    recording: Path, robot: str, file: Path, *, points: str, quick: bool
) -> int:
    """Write what all workers map: the valid samples of a recording, the person and the posture.

    Args:
        recording: The recording, of a right hand for the peers.
        robot: The robot hand by name.
        file: The `.npz` file to write: landmarks [m], q [rad] and wrist of the fitted human hand,
            dt [s], the person's lengths and contact gap, the robot's matched posture, and `points`.
        points: Set of the human's reference points; empty for its own.
        quick: Whether to keep 100 samples only.

    Returns:
        The number of samples.
    """
    recorded, motion = _fitted(recording)
    person = measure_person(recorded)
    kept = np.flatnonzero(motion.valid)[: 100 if quick else None]
    np.savez(
        file,
        landmarks=recorded.landmarks[kept],
        q=np.clip(motion.q[kept], motion.human.lower_limits, motion.human.upper_limits),
        wrist=motion.wrist[kept],
        dt=motion.dt[kept],
        bases=person.lengths.bases,
        segments=person.lengths.segments,
        contact_gap=person.contact_gap,
        matched=_matched(scaled_human(recorded, points="landmarks"), robot),
        side=recorded.side,
        points=points,
    )
    return len(kept)


def write_motion(motion: HumanMotion, file: Path) -> None:
    """Write joint angles and wrist poses for workers that call `map_step`.

    Args:
        motion: The motion; the workers take the standard right hand of the package for its human.
        file: The `.npz` file to write.
    """
    human = motion.human
    q = np.clip(motion.q, human.lower_limits, human.upper_limits)
    np.savez(file, q=q, wrist=motion.wrist, dt=motion.dt, side="right", points="")


@cache
def _fitted(recording: Path) -> tuple[Recording, HumanMotion]:
    recorded = read_recording(recording)
    return recorded, fit_recording(recorded)


def _matched(human: Hand, robot: str) -> np.ndarray:
    """Solve the robot's posture for the resting human hand, empty if their fingers do not match."""
    hand = shared_hands.load(robot)
    if default_preset(human, hand) != "teleoperation":
        return np.zeros(0)
    return hand_pair(human, hand).matched


def tree_command(file: Path, robot: str, preset: str, call: str) -> list[str]:
    """Return the command of a worker that maps with a checkout of this package."""
    described = shared_hands.DESCRIPTIONS / f"{robot}.yaml"
    named = str(described) if robot in shared_hands.NAMES else robot
    return [
        sys.executable,
        str(_BENCHMARKS),
        "mapping_worker",
        str(file),
        named,
        preset,
        call,
    ]


def peer_command(file: Path, peer: str, method: str, robot: str) -> list[str]:
    """Return the command of a worker that runs a peer."""
    script = str(_BENCHMARKS / "peers" / "timed.py")
    options = ["--peer", peer, "--method", method, "--robot", robot]
    data = ["--data", str(build.data_folder())]
    return [str(build.environment_python(peer)), script, *options, *data, str(file)]


@contextmanager
def workers(
    commands: dict[str, tuple[list[str], Path | None]],
) -> Iterator[list[Worker]]:
    """Start workers, wait until all are ready, and end them at the exit.

    Args:
        commands: By the worker's name its command, and the checkout whose package it imports; None
            for the environment's own.

    Raises:
        WorkerError: If one cannot start.
    """
    with ExitStack() as stack:
        started = []
        for name, (command, tree) in commands.items():
            environment = {
                key: value for key, value in os.environ.items() if key != "PYTHONPATH"
            }
            environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
            folder = shared_hands.shared_hands_folder()
            if folder is not None:
                environment["HANDMAP_HANDS"] = str(folder)
            if tree is not None:
                environment["PYTHONPATH"] = search_path(tree)
            process = subprocess.Popen(
                command,
                text=True,
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
            )
            stack.callback(_end, process)
            started.append(Worker(name, process))
        for worker in started:
            worker.facts = worker.read()
        yield started


def take_turns(
    working: Sequence[Worker],
    samples: int,
    rounds: int,
    done: Callable[[], None] = lambda: None,
) -> None:
    """Let all workers map all samples, in turns; the first round warms up and does not count.

    Args:
        working: The workers.
        samples: Number of samples.
        rounds: Rounds that count.
        done: Called after each turn of all.
    """
    for k in range(rounds + 1):
        for first in range(0, samples, TURN):
            # Nobody is always first.
            ahead = first // TURN % len(working)
            for worker in [*working[ahead:], *working[:ahead]]:
                last = min(first + TURN, samples)
                worker.ask(first, last, starts=first == 0, counts=k > 0)
            done()


def turns(samples: int, rounds: int) -> int:
    """Return how often `take_turns` calls `done`."""
    return (rounds + 1) * -(-samples // TURN)


def largest_difference(one: Worker, other: Worker) -> float:
    """Return the largest difference of joints and wrists in the last round [rad or m]."""
    pairs = ((one.q, other.q), (one.wrist, other.wrist))
    return max(float(np.abs(np.array(a) - np.array(b)).max()) for a, b in pairs)


def search_path(tree: Path) -> str:
    """Return the PYTHONPATH of a checkout; older ones have no core beside the package."""
    return os.pathsep.join(map(str, (tree, tree / "core")))


def check_tree(folder: Path) -> Path:
    """Return another checkout's folder; stop the program if it is none."""
    if not (folder / "handmap_qp" / "__init__.py").is_file():
        common.stop(
            f"--compare {folder}: expected a checkout, with a folder handmap_qp"
        )
    return folder.resolve()


def _end(process: subprocess.Popen[str]) -> None:
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            stream.close()
    process.wait()
