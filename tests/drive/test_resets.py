"""Motors that are reset, and other faults at random, through each driver in simulated time.

A wire carries the bytes of a driver to emulated motors in this process, with a clock of its own. A
judge on the wire sees each goal, torque and joint with its time. It shares no code with the loop.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import pytest
from handmap_drive.driver import DriverError
from marks import crossed

for module in ("dynamixel_sdk", "scservo_sdk", "pymodbus"):
    pytest.importorskip(module, reason="needs packages/drive and what it installs")

from handmap_drive.ability import Ability  # noqa: E402
from handmap_drive.drive import UNREAD, Loop, State  # noqa: E402
from handmap_drive.emulated_hands import AbilityHand, InspireHand  # noqa: E402
from handmap_drive.emulated_motors import EmulatedMotors  # noqa: E402
from handmap_drive.emulated_servos import Dynamixel, Feetech  # noqa: E402
from handmap_drive.inspire import Inspire  # noqa: E402
from handmap_drive.servos import Servos  # noqa: E402
from pymodbus.exceptions import ModbusIOException  # noqa: E402
from pymodbus.framer import FramerRTU  # noqa: E402

from handmap_qp.client import Command  # noqa: E402

STEP = 0.001
"""Steps of the emulated joints [s]."""
MESSAGE = 0.0005
"""Time of a message and its answer on the wire [s]."""
WAIT = 0.005
"""Time that a driver waits for bytes that do not come, in one call [s]."""
PROMISED = 0.5
"""Speed of the approach, as docs/drive.md promises [rad/s]."""
SAG = 1.0
"""Speed at which joints without torque fall to an end of their range [rad/s]."""
SPEED = 6.0
"""`speed` of the tables [rad/s]."""
EFFORT = 0.2
GAINS = [[84, 2, 600], [80, 2, 200]]
"""Set-up of the Dynamixel motors."""


class Event(NamedTuple):
    """What a judge saw after a message.

    Attributes:
        time: Of the message [s].
        goal: Goals [rad].
        angle: Joints [rad].
        limit: Limits of torque, 0 without torque.
        is_bare: Whether some motor has torque without its set-up.
    """

    time: float
    goal: np.ndarray
    angle: np.ndarray
    limit: np.ndarray
    is_bare: bool


class Wire:
    """A serial port with emulated motors behind it, in simulated time.

    Args:
        motors: The motors.
        random: Chooses the messages that get lost.
    """

    def __init__(self, motors: EmulatedMotors, random: Random) -> None:
        self.motors = motors
        self.now = 0.0
        self.loss = 0.0
        self.random = random
        self.events: list[Event] = []
        # Pending resets: when, which motor, and how long it starts.
        self.resets: list[tuple[float, int, float]] = []
        # When motors with torque were reset.
        self.powered_resets: list[float] = []
        self._arrived = bytearray()
        self._answers = bytearray()

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self.now < end:
            step = min(STEP, end - self.now)
            self.now += step
            self.motors.move(step, self.now)
            self.sag(step)
            while self.resets and self.resets[0][0] <= self.now:
                _, number, boot = self.resets.pop(0)
                if self.motors.allowed.any():
                    self.powered_resets.append(self.now)
                self.motors.reboot(number, boot, self.now)
                self.note()

    def sag(self, dt: float) -> None:
        """Let joints without torque fall."""
        motors = self.motors
        fallen = np.clip(motors.angle - SAG * dt, 0.0, motors.wall[1])
        motors.angle = np.where(motors.allowed > 0.0, motors.angle, fallen)

    def note(self) -> None:
        """Let the judge see the motors."""
        motors = self.motors
        arrays = (motors.goal, motors.angle, motors.allowed)
        copies = (each.copy() for each in arrays)
        self.events.append(Event(self.now, *copies, self.is_bare()))

    def is_bare(self) -> bool:
        """Return whether some motor has torque without its set-up."""
        motors = self.motors
        # An Ability hand has no limit of torque, and nothing else that is set up.
        if isinstance(motors, AbilityHand):
            return False
        is_wrong = motors.allowed > EFFORT + 0.002
        # A hand that was reset and holds has its own force.
        if isinstance(motors, InspireHand):
            is_wrong &= np.abs(motors.goal - motors.angle) > 2e-3
        if isinstance(motors, Dynamixel):
            has_mode = motors.memory[:, 11] == 5
            has_gain = motors.memory[:, 84:86].view("<u2")[:, 0] == 600
            is_wrong |= (motors.allowed > 0.0) & ~(has_mode & has_gain)
        return bool(is_wrong.any())

    def carry(self) -> bool:
        """Let a message pass; return whether it arrives."""
        self.advance(MESSAGE)
        self.motors.heard = self.now
        return self.random.random() >= self.loss

    # The interface of `serial.Serial`, as far as drivers use it.
    exclusive = True
    timeout = write_timeout = 0.0

    def write(self, data: bytes) -> int:
        self._arrived += bytes(data)
        for message in self.motors.messages(self._arrived):
            if self.carry():
                for answer in self.motors.obey(message):
                    if self.random.random() >= self.loss:
                        self._answers += answer
                self.note()
        return len(data)

    def read(self, size: int) -> bytes:
        if not self._answers:
            self.advance(WAIT)
        data = bytes(self._answers[:size])
        del self._answers[:size]
        return data

    def read_until(self, end: bytes) -> bytes:
        at = self._answers.find(end) + 1
        return self.read(at or len(self._answers))

    def reset_input_buffer(self) -> None:
        self._answers.clear()

    flush = reset_input_buffer

    def close(self) -> None: ...


class Modbus:
    """The client of `pymodbus` for a wire."""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire

    def _carry(self) -> InspireHand:
        hand = self.wire.motors
        assert isinstance(hand, InspireHand)
        if not self.wire.carry() or hand.is_booting.any():
            self.wire.advance(10.0 * WAIT)
            raise ModbusIOException("no answer")
        return hand

    def read_holding_registers(self, at: int, *, count: int, device_id: int) -> Any:
        words = self._carry().read(at)
        assert len(words) == count
        return SimpleNamespace(registers=words, isError=lambda: False)

    def write_registers(self, at: int, *, values: list[int], device_id: int) -> Any:
        assert self._carry().write(at, np.array(values)) == 0
        self.wire.note()
        return SimpleNamespace(isError=lambda: False)


class Kind(NamedTuple):
    """Motors and their driver.

    Attributes:
        bus: Its name in a table.
        driver: The driver.
        full: Units of the largest torque.
        place: Fields of each motor in the table.
        least: Shortest time of a start that can be seen [s].
        rate: Turns of the loop [Hz].
    """

    bus: str
    driver: Any
    full: int
    place: dict[str, float]
    least: float = 0.0
    rate: float = 80.0


KINDS = {
    "dynamixel": Kind("dynamixel", Servos, 2352, {"zero": np.pi}),
    "feetech": Kind("feetech", Servos, 1000, {"zero": np.pi}),
    "inspire": Kind(
        "inspire", Inspire, 1000, {"zero": 1000.0, "ratio": -1000.0 / 1.47}, rate=40.0
    ),
    # Its answers do not show a start that takes no time.
    "ability": Kind("ability", Ability, 621, {"zero": 0.0}, least=0.07),
}
MAKERS: dict[str, Any] = {
    "dynamixel": lambda: Dynamixel(range(3), 0.3),
    "feetech": lambda: Feetech(range(3), 0.3),
    "inspire": lambda: InspireHand(FramerRTU, range(6), 0.3),
    "ability": lambda: AbilityHand(range(6), 0.3),
}
NAMES = ("a", "b", "c")


@contextmanager
def wired(kind: str, folder: Path, seed: int = 0) -> Iterator[tuple[Wire, Any]]:
    """Yield a wire, and a driver that is connected to it."""
    own = KINDS[kind]
    motors = [
        {"joint": [name], "id": i, "range": [0.0, 1.4]} | own.place
        for i, name in enumerate(NAMES)
    ]
    table = {
        "bus": own.bus,
        "address": 80 if kind == "ability" else 1,
        "baud": 1000000,
        "rate": own.rate,
        "speed": SPEED,
        "effort": EFFORT,
        "full": own.full,
        "setup": GAINS if kind == "dynamixel" else [],
        "motors": motors,
    }
    file = folder / "motors.yaml"
    file.write_text(json.dumps(table))
    wire = Wire(MAKERS[kind](), Random(seed))
    wire.motors.heard = 0.0

    def clock() -> float:
        return wire.now

    with ExitStack() as patches:
        enter = patches.enter_context
        enter(patch("serial.Serial", lambda *_, **__: wire))
        enter(
            patch("pymodbus.client.ModbusSerialClient", lambda *_, **__: Modbus(wire))
        )
        for sdk in ("dynamixel_sdk", "scservo_sdk"):
            fake = SimpleNamespace(time=clock)
            enter(patch(f"{sdk}.port_handler.time", fake))
        enter(patch("handmap_drive.ability.monotonic", clock))
        enter(patch("handmap_drive.drive.monotonic", clock))
        enter(patch("handmap_drive.inspire.time.sleep", wire.advance))
        driver = own.driver("", "/dev/none", NAMES, file)
        driver.connect()
        yield wire, driver


class Session:
    """A loop whose session moves all joints slowly, in the wire's time."""

    def __init__(self, wire: Wire, driver: Any) -> None:
        self.wire = wire
        self.driver = driver
        self.status = "converged"
        self.epoch = 0
        self.shift = 0.0
        self.targets: list[tuple[float, float]] = []
        self.states: list[tuple[float, State]] = []
        self.loop = Loop(driver, self.command(), EFFORT, 60.0)
        self._due = wire.now

    def command(self) -> Command:
        now = self.wire.now
        q = 0.7 + 0.3 * np.sin(now) + self.shift
        self.targets.append((now, q))
        fields: Any = {"seq": 1, "name": "lab", "time": 0.0, "wrist": None}
        fields |= {"status": self.status, "epoch": self.epoch, "server_time": now}
        return Command(joint_names=NAMES, q=(q, q, q), **fields)

    def go(self, seconds: float) -> None:
        """Let turns pass."""
        end = self.wire.now + seconds
        while self.wire.now < end:
            self._due = max(self._due + 1.0 / self.driver.rate, self.wire.now)
            self.wire.advance(self._due - self.wire.now)
            self.loop.hear(self.command(), self.wire.now)
            self.loop.look(self.wire.now)
            looked = self.wire.now
            self.loop.act(looked)
            self.states.append((looked, self.loop.state))

    def follow(self) -> None:
        """Let turns pass until the motors follow."""
        for _ in range(100):
            self.go(0.1)
            if self.loop.state is State.FOLLOWING:
                return
        raise AssertionError("the motors do not follow")


def judge(session: Session) -> None:
    """Check the promises by what was on the wire."""
    wire, driver = session.wire, session.driver
    count = len(NAMES)
    turn = 1.0 / driver.rate
    resolution = 2.0 * 1.5 / 1000.0
    bare_since = np.inf
    times, targets = np.array(session.targets).T
    is_near = np.zeros(count, bool)
    before = wire.events[0]
    written = np.full(count, before.time)
    for event in wire.events[1:]:
        target = np.interp(event.time, times, targets)
        goal = event.goal[:count]
        is_on = event.limit[:count] > 0.0
        was_on = before.limit[:count] > 0.0
        moved = np.abs(goal - before.goal[:count])
        # The watchdog of the motors themselves: they stay where they are.
        stays = np.abs(goal - event.angle[:count]) < 2e-3
        is_near &= was_on
        # Where torque comes, the goal is where the joint is.
        comes = is_on & ~was_on
        ahead = np.abs(goal - event.angle[:count])
        assert (ahead[comes] <= 3.0 * turn * PROMISED + resolution).all(), event
        speed = np.where(is_near, SPEED, PROMISED)
        allowed = speed * (event.time - written + 2.0 * turn) + resolution
        assert (moved <= allowed)[is_on & was_on & ~stays].all(), (event, before)
        is_near |= is_on & (np.abs(goal - target) < 0.03)
        written = np.where((moved > 0.0) | ~was_on, event.time, written)
        # What is given between two looks is seen in the second one.
        bare_since = min(bare_since, event.time) if event.is_bare else np.inf
        assert event.time - bare_since < UNREAD + 2.0 * turn, event
        before = event


@pytest.mark.parametrize(
    ("kind", "boot"), crossed(list(KINDS), [0.0, 0.02, 0.1, 0.3], every=2)
)
def test_a_motor_that_is_reset_is_a_stop_and_an_approach(
    kind: str, boot: float, tmp_path: Path
) -> None:
    boot = max(boot, KINDS[kind].least)
    with wired(kind, tmp_path) as (wire, driver):
        session = Session(wire, driver)
        session.follow()
        assert session.loop.summary()["stops"] == 0
        wire.resets.append((wire.now + 0.1, 1, boot))
        session.go(0.6)
        # Now the session is far away from where the joints would have stayed.
        session.follow()
        judge(session)
        assert session.loop.summary()["stops"] == 1
        if isinstance(wire.motors, Dynamixel):
            memory = wire.motors.memory
            assert (memory[:, 84:86].view("<u2") == 600).all()
            assert (memory[:, 80:82].view("<u2") == 200).all()


def afflict(session: Session, random: Random, least: float) -> None:
    """Let something go wrong, or right again; a start takes some time at least [s]."""
    wire = session.wire
    match random.randrange(8):
        case 0 | 1 | 2:
            boot = random.choice([0.0, 0.01, 0.05, 0.1, 0.3])
            wire.resets.append((wire.now, random.randrange(3), max(boot, least)))
        case 3:
            wire.loss = random.choice([0.0, 0.0, 0.02, 0.1])
        case 4:
            # This computer is late.
            wire.advance(random.uniform(0.0, 0.5))
        case 5:
            session.status = random.choice(["converged", "stopped"])
        case 6:
            session.epoch += 1
            session.shift = random.uniform(-0.3, 0.3)
        case 7:
            # A jump that the session does not report.
            session.shift = random.uniform(-0.3, 0.3)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), crossed(list(KINDS), range(5), every=3))
def test_random_faults_keep_the_promises(kind: str, seed: int, tmp_path: Path) -> None:
    random = Random(seed)
    with wired(kind, tmp_path, seed) as (wire, driver):
        session = Session(wire, driver)
        # It ends where motors do not answer for too long, as it should.
        with suppress(DriverError):
            session.go(1.0)
            for _ in range(15):
                session.go(random.uniform(0.02, 0.6))
                afflict(session, random, KINDS[kind].least)
            wire.loss = 0.0
            session.status = "converged"
            session.follow()
        end, _ = session.states[-1]
        wire.loss = 0.0
        driver.stop()
        assert not wire.motors.allowed[:3].any()
        judge(session)
        stopped = [at for at, state in session.states if state is State.STOPPED]
        # A motor whose torque was not read yet gets it again, from where it is.
        unread = 3.0 / driver.rate
        for reset in wire.powered_resets:
            is_seen = any(reset - unread <= at < reset + 0.3 for at in stopped)
            assert is_seen or end < reset + 0.3, reset
