"""`handmap drive`: the motors of a hand follow a session."""

import os
import select
import sys
import termios
import tty
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from math import hypot, inf
from pathlib import Path
from time import monotonic
from typing import Annotated

from tyro.conf import Positional, arg

from handmap_qp.apps.arguments import KeyFiles, hinted
from handmap_qp.apps.connection import connected, only_session
from handmap_qp.apps.refusals import naming
from handmap_qp.apps.tables import print_result
from handmap_qp.client import Client, ServiceError, ServiceTimeoutError
from handmap_qp.errors import InvalidInputError, expect, warn
from handmap_qp.hands import load_hand
from handmap_qp.output_files import check_output
from .drive import HOTTEST, Loop
from .driver import Driver
from .loads import FingerLoads
from .recorder import Recorder
from .running import Effort, MotorsFile, effort_of, find_driver, stopping
from .space import Space, Vector
from .tuning import Compensated, read_tuning

_HELD = 0.25
"""Time since the last key but one in which a key counts as held [s]: terminals repeat it sooner."""


def finger_loads(client: Client, driver: Driver) -> FingerLoads:
    """Return what turns torques of a driver into loads of the watched robot's fingers.

    The service says which finger a joint belongs to: it knows hands that are not installed here.

    Raises:
        InvalidInputError: If no motor belongs to a finger.
    """
    fingers = client.status().fingers
    is_any = any(name in fingers for name in driver.joint_names)
    expect(is_any, "--haptics", "motors of fingers that the hand names")
    return FingerLoads(driver.joint_names, fingers)


@contextmanager
def held_key() -> Iterator[Callable[[], bool]]:
    """Watch the space bar of the terminal, and yield whether it is held.

    A terminal says only that a key is repeated. So a single stroke does not count.
    """
    expect(
        sys.stdin.isatty(),
        "--no-deadman",
        "a terminal whose space bar is held",
        advice="without one, give it",
    )
    before = termios.tcgetattr(sys.stdin)
    strokes = deque([0.0, 0.0], maxlen=2)

    def is_held() -> bool:
        if select.select([sys.stdin], [], [], 0.0)[0]:
            count = os.read(sys.stdin.fileno(), 1024).count(b" ")
            strokes.extend([monotonic()] * count)
        return monotonic() - strokes[0] < _HELD

    try:
        tty.setcbreak(sys.stdin)
        yield is_held
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def compensated(driver: Driver, file: Path, down: Vector | None) -> Compensated:
    """Return goals that compensate what `handmap calibrate-actuators` found, and weights.

    Raises:
        HandmapError: If the file is not that of a tuned hand with these motors.
    """
    tuning = read_tuning(file)
    joints = Compensated(driver, tuning)
    if not down:
        return joints
    # Not before: motors of another hand are reported as such.
    hand = load_hand(file, mount="fixed")
    return Compensated(driver, tuning, Space(hand, driver, down).weights)


def tell_stiffness(client: Client, file: Path) -> None:
    """Tell a session by which stiffness the joints of a tuned hand press, if that is known.

    A session that is not shared, or does not grip, is left as it is, with a warning.

    Raises:
        HandError: If the file is not that of a tuned hand.
    """
    stiffness = read_tuning(file).stiffness
    if stiffness is None:
        return
    try:
        client.configure(grip={"stiffness": stiffness})
    except ServiceError as error:
        warn(f"the session does not take the stiffness of the joints: {error}")


def watch_session(client: Client, session: str | None) -> None:
    """Watch a session: the given one, or the only open one.

    Raises:
        InvalidInputError: If there is none, or none of that name, or several are open and none is
            given; the message lists those that are open.
    """
    name = only_session(client, session, "SESSION")
    if not name:
        raise InvalidInputError(
            f"no session is open at {client.address}",
            argument="SESSION",
            advice="start a client that opens one, such as handmap track replay",
        )
    try:
        client.watch(name)
    except ServiceTimeoutError:
        raise
    except ServiceError as error:
        names = ", ".join(client.status().names)
        raise InvalidInputError(
            f"the service refused the session: {error}",
            argument="SESSION",
            advice=f"open are {names}" if names else "no session is open",
        ) from error


@dataclass(frozen=True)
class Drive:
    """Drive the motors of a hand by the commands of a session, while the space bar is held.

    Motors approach slowly. They have no torque while the key is not held, and while the session is
    stopped, lost or restarted. Ends by Ctrl-C, or when motors do not answer, are too hot or
    report a fault.

    Examples:
        handmap drive --driver simulated --port leap_right:1 --no-deadman
        handmap drive lab --driver leap --port /dev/ttyUSB0
        handmap drive lab --driver leap --port /dev/ttyUSB0 --effort 0.1
        handmap drive lab --driver servos --motors mine.yaml --port /dev/ttyACM0
        handmap drive lab --driver leap --port /dev/ttyUSB0 --tuning my_leap.yaml
        handmap drive lab --driver leap --port /dev/ttyUSB0 --log cups.npz --task "lift a cup"

    Attributes:
        session: Public name of the session. Without it, several open sessions are listed.
        driver: What motors they are: leap, inspire_right, inspire_left, ability, servos of your own
            table, simulated, or a driver of another package.
        port: Port of the motors.
        source: Address of the service's requests.
        motors: Table of motors, in place of the driver's own.
        tuning: A hand.yaml of `handmap calibrate-actuators`: joints go where they are commanded.
        down: Direction of gravity to the side, the fingertips and the back of the hand, as 0 0 1
            where it lies on its back: makes up for the weights of links.
        effort: Limit of the torque, a share of the motors' largest.
        temperature: Largest temperature of a motor [degrees Celsius].
        deadman: Whether motors move only while the space bar is held.
        log: File to write what the joints did while they followed, for `handmap convert`: measured
            and commanded angles, and with --tuning torques [N m].
        task: What is done, in words, for the log.
        keys: For an encrypted service, the files NAME.key_secret and server.key.
        haptics: Say the load of each finger to the session, which must be shared or your own: the
            page of a headset shows it.
        json: Print the summary as one JSON object instead of a table.
    """

    driver: str
    port: str
    session: Positional[
        Annotated[str | None, hinted("[SESSION]", "(default: the only open session)")]
    ] = None
    source: Annotated[str, arg(name="from", metavar="HOST[:PORT]")] = "127.0.0.1"
    motors: MotorsFile = None
    tuning: Annotated[Path | None, hinted("HAND.yaml")] = None
    down: Annotated[Vector | None, hinted("X Y Z", "(default: not known)")] = None
    effort: Effort = None
    temperature: float = HOTTEST
    deadman: bool = True
    log: Annotated[Path | None, hinted("FILE.npz", "(default: none)")] = None
    task: str = ""
    keys: KeyFiles = None
    haptics: bool = False
    json: bool = False

    def run(self) -> None:
        """Drive until Ctrl-C or an error."""
        maker = find_driver(self.driver)
        if self.down:
            is_direction = 0.0 < hypot(*self.down) < inf
            expect(is_direction, "--down", "a direction", value=self.down)
            expect(self.tuning is not None, "--down", "--tuning too")
        is_limit = self.temperature > 0.0
        expect(is_limit, "--temperature", "more than 0", value=self.temperature)
        log = check_output("--log", self.log, (".npz",)) if self.log else None
        expect(log or not self.task, "--task", "--log too")
        with connected("--from", self.source, self.keys, refused="SESSION") as client:
            watch_session(client, self.session)
        key = held_key() if self.deadman else nullcontext(lambda: True)
        with client, key as is_held, naming("--port"):
            while not (command := client.latest(1.0)):
                warn("waiting for a command")
            driver = maker(self.port, command.joint_names, self.motors)
            joints = None
            if self.tuning:
                joints = compensated(driver, self.tuning, self.down)
            effort = effort_of(driver, self.effort)
            loads = finger_loads(client, driver) if self.haptics else None
            driver.connect()
            if self.tuning:
                tell_stiffness(client, self.tuning)
            recorder = Recorder(driver.joint_names) if log else None
            loop = Loop(
                driver, command, effort, self.temperature, joints, recorder, loads
            )
            try:
                with stopping(driver) as over:
                    loop.run(client, is_held, over)
            finally:
                rows = loop.summary()
                print_result(rows, {self.driver: rows}, as_json=self.json)
                if recorder and log:
                    recorder.save(log, self.driver, self.task)
