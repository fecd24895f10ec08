"""The whole chain on one machine: recording, service, `handmap drive`, emulated motors, picture.

    handmap demo --drive

The picture shows the person's hand, what the service commanded, and where the emulated motors were.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from subprocess import PIPE
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import interp1d

from handmap_qp import Hand, Recording, load_hand, read_recording
from handmap_qp.apps.drawing import require_matplotlib, save_contact_sheet
from handmap_qp.apps.offline.fidelity import CLOSED
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.offline.trajectory import Progress
from handmap_qp.apps.tables import print_rows, progress
from handmap_qp.client import Client
from handmap_qp.errors import HandmapError, expect
from handmap_qp.output_files import output_folder
from handmap_qp.stream import measure_person
from handmap_qp.trackers import DEMO
from . import DRIVERS
from .processes import Emulator, Process

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
command = partial(Process, "handmap_qp.cli", stderr=PIPE)
"""A command of the package, as a process."""


def slowed(recording: Recording, share: float) -> Recording:
    """Return a recording of the same motion that takes longer, with as many samples a second."""
    samples = np.arange(len(recording))
    at = np.linspace(0.0, samples[-1], round(share * len(recording)))
    return Recording(
        recording.name,
        np.interp(at, samples, share * recording.time),
        interp1d(samples, recording.landmarks, axis=0)(at),
        recording.valid[at.astype(int)],
        recording.side,
    )


@dataclass(frozen=True, eq=False)
class Driven:
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

    def rms_at(self, delay: float) -> float:
        """Return how far they were from the commands then, over all joints [rad]."""
        return float(np.sqrt(np.mean((self.joints(delay) - self.q) ** 2)))

    @cached_property
    def delay(self) -> float:
        """The delay at which joints are nearest to the commands [s]."""
        return min(np.arange(0.0, LONGEST_DELAY, 0.002).tolist(), key=self.rms_at)

    @property
    def rms(self) -> float:
        """How far they were from the commands at `delay`, over all joints [rad]."""
        return self.rms_at(self.delay)

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


class Chain(NamedTuple):
    """Service, motors and `handmap drive`, ready for samples.

    Attributes:
        robot: The robot hand.
        recording: What the person is to do.
        order: The robot's joints among the motors.
        log: File that the motors write at their end.
        motors: The emulated motors.
        service: The service.
        client: The client that leads the session.
        drive: `handmap drive`.
    """

    robot: Hand
    recording: Recording
    order: list[int]
    log: Path
    motors: Emulator
    service: Process
    client: Client
    drive: Process

    def approach(self) -> None:
        """Send a hand that holds still, until the motors have torque and are there."""
        first = self.recording.landmarks[0]
        random = np.random.default_rng(0)
        end = np.inf
        while time.monotonic() < end and self.drive.poll() is None:
            # Landmarks that repeat exactly would be frozen data.
            self.client.step(landmarks=first + 1e-7 * random.random())
            time.sleep(PERIOD)
            if end == np.inf and self.motors.order()["torque"].all():
                end = time.monotonic() + APPROACH

    def lead(self, advance: Progress = None) -> tuple[np.ndarray, np.ndarray]:
        """Send the recording; return times [s], shape (T,), and commands [rad], shape (T, n).

        Args:
            advance: Called after each sample with the number of samples done.
        """
        recording, rows = self.recording, []
        start = time.monotonic() - recording.time[0]
        for at, points in zip(recording.time, recording.landmarks, strict=True):
            time.sleep(max(0.0, start + at - time.monotonic()))
            command = self.client.step(landmarks=points, time=start + at)
            rows.append((command.server_time, *command.q))
            if advance:
                advance(len(rows))
        times, *q = np.array(rows).T
        return times, np.array(q).T

    def end(self, times: np.ndarray, q: np.ndarray) -> Driven:
        """End the command and the motors, and return what happened."""
        time.sleep(LONGEST_DELAY)
        out, said = self.drive.end()
        if self.drive.returncode:
            raise HandmapError(said.splitlines()[-1].removeprefix("handmap: "))
        self.motors.end()
        log = np.load(self.log)
        return Driven(
            self.robot,
            self.recording,
            times,
            q,
            log["time"],
            log["angle"][:, self.order],
            log["limit"][:, self.order],
            json.loads(out.splitlines()[-1]),
            said,
        )


@contextmanager
def started(
    robot: str,
    recording: Recording,
    servos: tuple[str, Path] | None = None,
    *,
    timeout: float = 10.0,
    **orders: Any,
) -> Iterator[Chain]:
    """Start a chain, and end it.

    Args:
        robot: One of `HANDS`, or the hand.yaml of one.
        recording: The recording that leads it.
        servos: In place of the hand's own motors, emulated servos and their table.
        timeout: Longest wait for an answer of the service [s].
        **orders: Orders to the emulated motors, such as `loss`.

    Raises:
        HandmapError: If the hand cannot be loaded, or has no emulated motors.
    """
    hand = load_hand(robot)
    names = ", ".join(HANDS)
    expect(hand.name in HANDS, "--robot", f"one of {names}", value=robot)
    driver, kind, slower = HANDS[hand.name]
    table = None
    if servos:
        driver, (kind, table) = "servos", servos
    own = DRIVERS[driver]("", hand.joint_names, table).joint_names
    order = [own.index(name) for name in hand.joint_names]
    recording = slowed(recording, slower)
    extra = ("--hand", robot) if robot.endswith(".yaml") else ()
    ports = "--port", "0", "--stream-port", "0", "--health-port", "-1"
    with ExitStack() as closing:
        start = closing.enter_context
        log = Path(start(TemporaryDirectory())) / "log.npz"
        motors = start(Emulator(kind, "--log", str(log)))
        motors.order(**orders)
        service = start(command("serve", *ports, "--log-level", "error", *extra))
        address = f"127.0.0.1:{service.line()['ports']['requests']}"
        client = start(Client(f"tcp://{address}", timeout=timeout))
        person = measure_person(recording).session_fields()
        client.open(
            hand.name,
            name="demo",
            input="landmarks",
            side=recording.side,
            is_shared=True,
            **person,
        )
        words = ["drive", "demo", "--driver", driver, "--port", motors.port]
        words += ["--motors", str(table)] if table else []
        words += ["--from", address, "--no-deadman", "--json"]
        drive = start(command(*words))
        yield Chain(hand, recording, order, log, motors, service, client, drive)


def drive_demo(robot: str | None, folder: Path) -> None:
    """Run the chain once, print what happened, and draw it; the demo `handmap demo --drive`.

    Args:
        robot: One of `HANDS`, or the hand.yaml of one; a LEAP hand if omitted.
        folder: Folder of `drive.png`, created if it does not exist.

    Raises:
        HandmapError: If that is not possible.
    """
    require_matplotlib()
    recording = read_recording(DEMO, "right")
    chained = started(robot or "leap_right", recording)
    with output_folder(folder) as writing, chained as chain:
        with progress("driving", len(chain.recording)) as advance:
            chain.approach()
            driven = chain.end(*chain.lead(advance))
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
