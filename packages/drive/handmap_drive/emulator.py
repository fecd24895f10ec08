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
    {"reboot": {"3": 0.2}}         motors lose their supply: registers as at the start, no answer
                                   for a time [s]; any of a hand: all of it
    {"deaf": [102]}                registers for which messages to all motors get lost
    {"unplug": true}               the port is gone

A state has the time, and of each motor goal, angle, limit of torque (0 for none) and torque.
`--log FILE.npz` writes all states at the end: after SIGTERM or the end of stdin. Time is
`time.monotonic()`, the same for all processes of a machine.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import select
import signal
import socket
import sys
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, TextIO

import numpy as np
from pymodbus.framer import FramerRTU, FramerSocket

from .emulated_hands import AbilityHand, InspireHand
from .emulated_motors import EmulatedMotors
from .emulated_servos import Dynamixel, Feetech

STEP = 0.004  # s
_LONGEST = 0.02
"""Longest motion between two looks at the port [s].

Motors hear messages when they arrive. If this process is late, those that arrived meanwhile are not
later than the motion that is due.
"""
KINDS: dict[str, Callable[[range, float], EmulatedMotors]] = {
    "dynamixel": Dynamixel,
    "feetech": Feetech,
    "inspire": partial(InspireHand, FramerRTU),
    "inspire-tcp": partial(InspireHand, FramerSocket),
    "ability": AbilityHand,
}


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
            self.open.close()
            self.open = self.server
        return data

    def close(self) -> None:
        self.open.close()
        self.server.close()


class Bus:
    """Motors behind a port.

    Args:
        kind: One of `KINDS`.
        numbers: Numbers of the motors; those of a hand are its own.
        angle: Where they are at the start [rad].
        is_logging: Whether to remember all states.
    """

    def __init__(
        self, kind: str, numbers: range, angle: float, *, is_logging: bool = False
    ) -> None:
        self.motors = KINDS[kind](numbers, angle)
        self.line = Loopback() if kind.endswith("-tcp") else Terminal()
        self.loss = self.damage = self.latency = 0.0
        self.buffer = bytearray()
        self.random = random.Random(0)
        self.then = time.monotonic()
        self.is_logging = is_logging
        self.log: list[dict[str, Any]] = []

    def advance(self) -> None:
        """Advance all joints towards the present, which further calls reach."""
        now = min(time.monotonic(), self.then + _LONGEST)
        while now - self.then > STEP:
            self.then += STEP
            self.motors.move(STEP, self.then)
            if self.is_logging:
                self.log.append(self.state)

    def receive(self) -> None:
        """Read what has been written to the port, and answer."""
        self.buffer += self.line.read()
        for message in self.motors.messages(self.buffer):
            if self.random.random() >= self.loss:
                self.motors.heard = self.then
                for answer in self.motors.obey(message):
                    self.send(bytearray(answer))

    def send(self, answer: bytearray) -> None:
        """Send an answer, unless it gets lost."""
        if self.random.random() < self.loss:
            return
        if self.random.random() < self.damage:
            answer[self.random.randrange(len(answer))] ^= 0x41
        time.sleep(self.latency)
        os.write(self.line.fd, answer)

    def change(self, orders: dict[str, Any]) -> None:
        """Carry out a line of orders."""
        motors = self.motors
        for name, order in orders.items():
            match name:
                case "loss" | "damage" | "latency":
                    setattr(self, name, order)
                case "silent" | "deaf":
                    setattr(motors, name, order)
                case "wall" | "temperature":
                    for number, value in order.items():
                        i = motors.numbers.index(int(number))
                        getattr(motors, name)[..., i] = value
                case "reboot":
                    for number, seconds in order.items():
                        motors.reboot(int(number), seconds, self.then)
                case "unplug":
                    self.line.close()

    @property
    def state(self) -> dict[str, Any]:
        """What all motors do now, in the order of their numbers."""
        return {"time": self.then} | self.motors.state

    def save(self, file: str) -> None:
        """Write what happened."""
        log: Any = {name: [each[name] for each in self.log] for name in self.state}
        np.savez(file, **log)


def emulate(bus: Bus, orders: TextIO, answers: TextIO) -> None:
    """Let motors act until the orders end.

    Args:
        bus: The motors.
        orders: Lines of orders.
        answers: Where the state after each of them is written to.
    """
    while True:
        watched = [orders, *([bus.line.fd] if bus.line.fd >= 0 else [])]
        ready, _, _ = select.select(watched, [], [], STEP)
        bus.advance()
        if bus.line.fd in ready:
            bus.receive()
        if orders in ready:
            if not (line := orders.readline()):
                return
            bus.change(json.loads(line))
            state = json.dumps(bus.state, default=np.ndarray.tolist)
            print(state, file=answers, flush=True)


def main() -> None:
    """Emulate until SIGTERM or the end of stdin."""
    parser = argparse.ArgumentParser(description="Emulated motors.")
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--ids", default="0-15", help="first and last number")
    parser.add_argument("--angle", type=float, default=0.3, help="at the start [rad]")
    parser.add_argument("--log", help="file (.npz) to write at the end")
    given = parser.parse_args()
    first, last = map(int, given.ids.split("-"))
    numbers = range(first, last + 1)
    bus = Bus(given.kind, numbers, given.angle, is_logging=bool(given.log))
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    print(json.dumps({"port": bus.line.port}), flush=True)
    with suppress(KeyboardInterrupt):
        emulate(bus, sys.stdin, sys.stdout)
    if given.log:
        bus.save(given.log)


if __name__ == "__main__":
    main()
