"""Emulated motors on a pseudo-terminal or on loopback: try a driver without a robot.

It speaks protocol 2 of Dynamixel, the protocol of Feetech STS, Modbus of an Inspire RH56 (RTU, or
TCP on loopback) or the messages of an Ability Hand, registers and checksums included. Each motor
follows its goal with a lag, a speed limit, and a torque limited as its registers say.

    python -m handmap_drive.emulator dynamixel --ids 0-15
    python -m handmap_drive.emulator inspire-tcp

The first line that it prints is JSON with the `port` for `handmap drive --port`. After that, it
takes lines of JSON on stdin, and answers each with the state of all motors:

    {}                             nothing changes
    {"loss": 0.01}                 share of messages that get lost, in both directions
    {"damage": 0.01}               share of answers with a wrong byte
    {"latency": 0.002}             time before an answer [s]
    {"wall": {"3": [-1, 0.5]}}     an obstacle: where a motor can move [rad, servos from 180 deg]
    {"temperature": {"3": 75}}     [degrees Celsius]
    {"silent": [3]}                motors that do not answer; any of a hand: all of it
    {"deaf": [102]}                registers for which messages to all motors get lost
    {"unplug": true}               the port is gone

`--log FILE.npz` writes times, goals, positions, limits and torques at the end: after SIGTERM or the
end of stdin. Time is `time.monotonic()`, the same for all processes of a machine.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import time
import tty
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from .emulated_hands import AbilityProtocol, ModbusRtu, ModbusTcp

TURN = 4096
LAG = 0.03  # s
FASTEST = 8.48  # rad/s
STIFFNESS = 0.6
"""Torque, as a share of the largest, per rad between goal and position."""
FRICTION = 0.02
"""Torque without which nothing moves, as a share of the largest."""
OVERLOAD = 0.9
"""Torque that a motor bears for a second only, as a share of the largest."""
STEP = 0.004  # s


class Family(NamedTuple):
    """Registers of a family of servos: address and bytes. From the makers' control tables."""

    torque: tuple[int, int]
    limit: tuple[int, int]
    goal: tuple[int, int]
    position: tuple[int, int]
    effort: tuple[int, int]
    temperature: tuple[int, int]
    fault: tuple[int, int]
    full: int
    overheating: int
    overload: int
    watchdog: int = 0


DYNAMIXEL = Family(
    (64, 1), (102, 2), (116, 4), (132, 4), (126, 2), (146, 1), (70, 1), 2352, 4, 32, 98
)
FEETECH = Family(
    (40, 1), (48, 2), (42, 2), (56, 2), (60, 2), (63, 1), (65, 1), 1000, 4, 32
)


@cache
def crc_of_byte(byte: int) -> int:
    """Divide by the polynomial 0x8005, bit by bit."""
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def crc16(data: bytes) -> int:
    """Return the checksum of protocol 2."""
    crc = 0
    for byte in data:
        crc = crc << 8 & 0xFF00 ^ crc_of_byte(crc >> 8 ^ byte)
    return crc


class ServoProtocol:
    """What messages of servos do."""

    walls: Mapping[int, tuple[float, float]] = {}
    width: int  # of addresses

    def obey(self, bus: Bus, target: int, instruction: int, body: bytes) -> None:
        """Do what a message says, and answer."""
        at = int.from_bytes(body[: self.width], "little")
        size = int.from_bytes(body[self.width : 2 * self.width], "little")
        rest = body[2 * self.width :]
        # Ping, read, write; then those of many motors.
        if instruction == 1:
            bus.say(target, 0, b"\0\0\0")
        elif instruction == 2:
            bus.say(target, 0, bus.read(target, at, size))
        elif instruction == 3 and target in bus.motors:
            error = bus.motors[target].write(at, body[self.width :])
            bus.say(target, error, b"")
        elif instruction == 0x82:
            for number in rest:
                bus.say(number, 0, bus.read(number, at, size))
        elif instruction == 0x83 and at not in bus.deaf:
            for i in range(0, len(rest), size + 1):
                if servo := bus.motors.get(rest[i]):
                    servo.write(at, rest[i + 1 : i + 1 + size])


class Protocol2(ServoProtocol):
    """Dynamixel's messages: header, number, length, instruction, parameters, CRC."""

    header = b"\xff\xff\xfd\x00"
    width = 2

    def take(self, buffer: bytearray) -> tuple[int, int, bytes] | None:
        """Remove the first message: motor, instruction, parameters; None if it is not complete."""
        while (at := buffer.find(self.header)) >= 0:
            del buffer[:at]
            if len(buffer) < 7:
                return None
            size = 7 + int.from_bytes(buffer[5:7], "little")
            if len(buffer) < size:
                return None
            message = bytes(buffer[:size])
            del buffer[:size]
            if crc16(message[:-2]) == int.from_bytes(message[-2:], "little"):
                body = message[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
                return message[4], message[7], body
        return None

    def answer(self, motor: int, error: int, data: bytes) -> bytes:
        body = bytes([0x55, error]) + data
        body = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        size = (len(body) + 2).to_bytes(2, "little")
        message = self.header + bytes([motor]) + size + body
        return message + crc16(message).to_bytes(2, "little")


class ProtocolScs(ServoProtocol):
    """Feetech's messages: header, number, length, instruction, parameters, sum."""

    header = b"\xff\xff"
    width = 1

    def take(self, buffer: bytearray) -> tuple[int, int, bytes] | None:
        """Remove the first message, as `Protocol2.take`."""
        while (at := buffer.find(self.header)) >= 0:
            del buffer[:at]
            if len(buffer) < 4 or len(buffer) < 4 + buffer[3]:
                return None
            message = bytes(buffer[: 4 + buffer[3]])
            del buffer[: len(message)]
            if ~sum(message[2:-1]) & 255 == message[-1]:
                return message[2], message[4], message[5:-1]
        return None

    def answer(self, motor: int, error: int, data: bytes) -> bytes:
        body = bytes([motor, len(data) + 2, error]) + data
        return self.header + body + bytes([~sum(body) & 255])


class Servo:
    """One motor: its registers, and the joint behind it."""

    def __init__(self, family: Family, number: int, angle: float) -> None:
        self.family = family
        self.number = number
        self.memory = bytearray(256)
        self.wall = (-9.0, 9.0)
        self.temperature = 30.0
        self.angle = angle  # from 180 degrees [rad]
        self.effort = 0.0
        self.overloaded = 0.0
        self.heard = time.monotonic()
        self.put(family.limit, family.full)
        self.put(family.goal, self.units(angle))
        self.show()

    def confine(self, wall: tuple[float, float]) -> None:
        """Let the joint move in a range only [rad]."""
        self.wall = wall
        self.angle = float(np.clip(self.angle, *wall))

    def units(self, angle: float) -> int:
        return round((angle / (2.0 * np.pi) + 0.5) * TURN)

    def get(self, register: tuple[int, int]) -> int:
        at, size = register
        return int.from_bytes(self.memory[at : at + size], "little", signed=size == 4)

    def put(self, register: tuple[int, int], value: int) -> None:
        at, size = register
        self.memory[at : at + size] = value.to_bytes(size, "little", signed=value < 0)

    @property
    def goal(self) -> float:
        return (self.get(self.family.goal) / TURN - 0.5) * 2.0 * np.pi

    @property
    def limit(self) -> float:
        # In other modes of Dynamixel, the goal current means nothing.
        if self.family.watchdog and self.memory[11] != 5:
            return 1.0
        return self.get(self.family.limit) / self.family.full

    @property
    def has_torque(self) -> bool:
        return bool(self.get(self.family.torque))

    def write(self, at: int, data: bytes) -> int:
        """Write registers as a message says; return the error, 0 for none."""
        family = self.family
        is_dynamixel = bool(family.watchdog)
        if is_dynamixel and at < 64 and self.has_torque:
            return 7  # access: the EEPROM is locked
        if is_dynamixel and at in (102, 116) and self.memory[family.watchdog] == 255:
            return 4  # data range: goals are read-only after the watchdog
        if at == family.limit[0] and int.from_bytes(data, "little") > family.full:
            return 6  # data limit
        self.memory[at : at + len(data)] = data
        if at == family.torque[0] and self.get(family.fault):
            self.memory[at] = 0
        return 0

    def move(self, dt: float, now: float) -> None:
        """Advance the joint."""
        family = self.family
        watchdog = self.memory[family.watchdog] if family.watchdog else 0
        # -1: the watchdog has stopped it already.
        is_late = 0 < watchdog < 128 and now - self.heard > 0.02 * watchdog
        if self.has_torque and is_late:
            self.memory[family.watchdog] = 255
            self.put(family.goal, self.units(self.angle))
        self.effort = 0.0
        if self.has_torque:
            away = self.goal - self.angle
            self.effort = float(np.clip(STIFFNESS * away, -self.limit, self.limit))
            # A lag of first order; against friction, some torque is needed.
            fastest = FASTEST if self.limit > FRICTION else 0.0
            speed = float(np.clip(away / LAG, -fastest, fastest))
            self.angle = float(np.clip(self.angle + speed * dt, *self.wall))
        self.overloaded = self.overloaded + dt if abs(self.effort) > OVERLOAD else 0.0
        hot = family.overheating if self.temperature > 70.0 else 0
        heavy = family.overload if self.overloaded > 1.0 else 0
        if faults := self.get(family.fault) | hot | heavy:
            self.put(family.fault, faults)
            self.put(family.torque, 0)
        self.show()

    def show(self) -> None:
        """Write what is measured into the registers."""
        family = self.family
        self.put(family.position, self.units(self.angle))
        effort = round(self.effort * family.full)
        if not family.watchdog and effort < 0:
            effort = 0x400 - effort
        self.put(family.effort, effort)
        self.put(family.temperature, round(self.temperature))


KINDS: dict[str, tuple[Family, Callable[[], Any]]] = {
    "dynamixel": (DYNAMIXEL, Protocol2),
    "feetech": (FEETECH, ProtocolScs),
    "inspire": (DYNAMIXEL._replace(full=1000, watchdog=0), ModbusRtu),
    "inspire-tcp": (DYNAMIXEL._replace(full=1000, watchdog=0), ModbusTcp),
    "ability": (DYNAMIXEL, AbilityProtocol),
}
"""Registers in which a motor keeps its state, and the protocol."""


class Terminal:
    """A pseudo-terminal."""

    def __init__(self) -> None:
        self.fd, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)

    def read(self) -> bytes:
        return os.read(self.fd, 65536)

    def close(self) -> None:
        os.close(self.fd)
        os.close(self.slave)
        self.fd = -1


class Loopback:
    """A TCP server on loopback, for one client at a time."""

    def __init__(self) -> None:
        self.server = self.open = socket.create_server(("127.0.0.1", 0))
        self.port = f"127.0.0.1:{self.server.getsockname()[1]}"

    @property
    def fd(self) -> int:
        return self.open.fileno()

    def read(self) -> bytes:
        if self.open is self.server:
            self.open, _ = self.server.accept()
            return b""
        data = self.open.recv(65536)
        if not data:
            self.open = self.server
        return data

    def close(self) -> None:
        self.open.close()
        self.server.close()


class Bus:
    """All motors behind a port."""

    def __init__(self, kind: str, numbers: list[int], angle: float) -> None:
        family, protocol = KINDS[kind]
        self.protocol = protocol()
        self.motors = {
            n: Servo(family, n, angle) for n in self.protocol.walls or numbers
        }
        for number, wall in self.protocol.walls.items():
            self.motors[number].confine(wall)
        self.line = Loopback() if kind.endswith("-tcp") else Terminal()
        self.loss = self.damage = self.latency = 0.0
        self.silent: set[int] = set()
        self.deaf: set[int] = set()
        self.buffer = bytearray()
        self.random = random.Random(0)
        self.then = time.monotonic()
        self.log: list[Any] = []

    def advance(self) -> None:
        """Advance all joints to the present."""
        now = time.monotonic()
        while now - self.then > STEP:
            self.then += STEP
            for servo in self.motors.values():
                servo.move(STEP, self.then)
            rows = [
                (s.goal, s.angle, s.limit * s.has_torque, s.effort)
                for s in self.motors.values()
            ]
            self.log.append((self.then, rows))

    def receive(self) -> None:
        """Read what has been written to the port, and answer."""
        self.buffer += self.line.read()
        while found := self.protocol.take(self.buffer):
            if self.random.random() >= self.loss:
                for servo in self.motors.values():
                    servo.heard = time.monotonic()
                self.protocol.obey(self, *found)

    def read(self, number: int, at: int, size: int) -> bytes:
        servo = self.motors.get(number)
        return bytes(servo.memory[at : at + size]) if servo else b""

    def say(self, number: int, error: int, data: bytes) -> None:
        """Answer as a motor, unless it is silent."""
        servo = self.motors.get(number)
        if servo is None or number in self.silent:
            return
        if servo.family.watchdog and servo.get(servo.family.fault):
            error |= 128
        self.send(self.protocol.answer(number, error, data))

    def send(self, message: bytes) -> None:
        """Send an answer, unless it gets lost."""
        answer = bytearray(message)
        if self.random.random() < self.loss:
            return
        if self.random.random() < self.damage:
            answer[self.random.randrange(len(answer))] ^= 0x41
        if self.latency:
            time.sleep(self.latency)
        os.write(self.line.fd, answer)

    def change(self, orders: dict[str, Any]) -> None:
        """Carry out a line of stdin."""
        for name in {"loss", "damage", "latency"} & orders.keys():
            setattr(self, name, orders[name])
        self.silent = set(orders.get("silent", self.silent))
        self.deaf = set(orders.get("deaf", self.deaf))
        for name in {"wall", "temperature"} & orders.keys():
            for number, value in orders[name].items():
                setattr(self.motors[int(number)], name, value)
        if orders.get("unplug"):
            self.line.close()

    def state(self) -> dict[str, Any]:
        """Return what all motors do, in the order of their numbers."""
        motors = self.motors.values()
        return {
            "time": self.then,
            "goal": [servo.goal for servo in motors],
            "angle": [servo.angle for servo in motors],
            "limit": [servo.limit for servo in motors],
            "torque": [servo.has_torque and servo.limit > 0.0 for servo in motors],
            "effort": [servo.effort for servo in motors],
        }

    def save(self, file: str) -> None:
        times = np.array([time for time, _ in self.log])
        goal, angle, limit, effort = np.moveaxis(
            np.array([rows for _, rows in self.log]), 2, 0
        )
        np.savez(file, time=times, goal=goal, angle=angle, limit=limit, effort=effort)


class Emulator:
    """Emulated motors in a process of their own; also a context manager.

    Args:
        kind: One of `KINDS`.
        *options: Further words of the command line.

    Attributes:
        port: Name of the pseudo-terminal, or HOST:PORT.
    """

    def __init__(self, kind: str, *options: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "handmap_drive.emulator", kind, *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.port = self._read()["port"]

    def __enter__(self) -> Emulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.communicate()

    def order(self, **orders: Any) -> dict[str, np.ndarray]:
        """Send a line of orders, and return the state after it."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(orders) + "\n")
        self.process.stdin.flush()
        return {name: np.array(value) for name, value in self._read().items()}

    def _read(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())


def main() -> None:
    """Emulate until SIGTERM or the end of stdin."""
    parser = argparse.ArgumentParser(description="Emulated motors.")
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--ids", default="0-15", help="first and last number")
    parser.add_argument("--angle", type=float, default=0.3, help="at the start [rad]")
    parser.add_argument("--log", help="file (.npz) to write at the end")
    given = parser.parse_args()
    first, last = map(int, given.ids.split("-"))
    bus = Bus(given.kind, list(range(first, last + 1)), given.angle)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    print(json.dumps({"port": bus.line.port}), flush=True)
    try:
        while True:
            watched = [sys.stdin, *([bus.line.fd] if bus.line.fd >= 0 else [])]
            ready, _, _ = select.select(watched, [], [], STEP)
            bus.advance()
            if bus.line.fd in ready:
                bus.receive()
            if sys.stdin in ready:
                if not (line := sys.stdin.readline()):
                    break
                bus.change(json.loads(line))
                print(json.dumps(bus.state()), flush=True)
    except KeyboardInterrupt:
        pass
    if given.log:
        bus.save(given.log)


if __name__ == "__main__":
    main()
