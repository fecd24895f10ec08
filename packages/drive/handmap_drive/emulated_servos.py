"""Emulated servos: protocol 2 of Dynamixel, and the protocol of Feetech STS.

The table of registers is that of the driver, which tests compare with the makers' own.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from dynamixel_sdk import PacketHandler

from .emulated_motors import EmulatedMotors
from .servos import FAMILIES

TURN = 4096
PING, READ, WRITE, READ_MANY, WRITE_MANY = 1, 2, 3, 0x82, 0x83
"""Instructions; those of many motors come last."""
READ_ONLY, TOO_LARGE, LOCKED = 4, 6, 7
"""Errors in answers."""
Message = tuple[int, int, bytes]
"""Motor, instruction and parameters."""
_number = partial(int.from_bytes, byteorder="little")


class EmulatedServos(EmulatedMotors):
    """Servos, whose registers are rows of an array.

    A message is header, motor, length, instruction, parameters and checksum.
    """

    family: ClassVar[SimpleNamespace]
    full: ClassVar[int]
    """The largest torque, in units of the motors."""
    header: ClassVar[bytes]
    width: ClassVar[int]
    """Bytes of lengths, addresses and checksums."""
    status = b""
    """What an answer has in place of the instruction."""
    alert = 0
    """Bit in the answers of a motor with a fault."""
    defaults: ClassVar[dict[int, bytes]] = {}
    """Values of registers after a start, by address; others are 0."""
    stuffing = b"", b""
    """What parameters must not have, and what they have in its place."""

    def __init__(self, numbers: range, angle: float) -> None:
        super().__init__(numbers, angle)
        layout = np.dtype(self.family.registers | {"itemsize": 256})
        self.registers: Any = np.zeros(len(numbers), layout)
        self.memory = self.registers.view("u1").reshape(len(numbers), -1)
        self.forget(np.ones(len(numbers), bool))

    def forget(self, which: np.ndarray) -> None:
        """See `EmulatedMotors`; what is before the torque's register is kept without supply."""
        _, volatile = self.family.layout.fields["torque"]
        self.memory[which, volatile:] = 0
        for at, value in self.defaults.items():
            self.memory[which, at : at + len(value)] = [*value]
        self.registers["limit"][which] = self.full
        self.registers["goal"][which] = self.place[which]
        self.take()

    @abstractmethod
    def checksum(self, message: bytes) -> int:
        """Return the checksum of a message."""

    def messages(self, buffer: bytearray) -> Iterator[Message]:
        """See `EmulatedMotors`."""
        number = len(self.header)
        start = number + 1 + self.width
        while (at := buffer.find(self.header)) >= 0:
            del buffer[:at]
            size = start + _number(buffer[number + 1 : start])
            if len(buffer) < size:
                return
            end = size - self.width
            message = bytes(buffer[:end])
            checksum = _number(buffer[end:size])
            del buffer[:size]
            if self.checksum(message) == checksum:
                content, stuffed = self.stuffing
                parameters = message[start + 1 :].replace(stuffed, content)
                yield message[number], message[start], parameters

    def answer(self, i: int, error: int, data: bytes) -> bytes:
        """Return the answer of a motor."""
        error |= self.alert * int(self.is_faulty[i])
        body = self.status + bytes([error]) + data
        body = body.replace(*self.stuffing)
        size = len(body) + self.width
        message = self.header + bytes([self.numbers[i]]) + self.bytes_of(size) + body
        return message + self.bytes_of(self.checksum(message))

    def bytes_of(self, number: int) -> bytes:
        """Return a length or a checksum as it is sent."""
        return number.to_bytes(self.width, "little")

    def obey(self, message: Message) -> Iterator[bytes]:
        """See `EmulatedMotors`."""
        self.measure()
        motor, instruction, content = message
        at, rest = self.split(content)
        size, rows = self.split(rest)
        if instruction == PING:
            size = 3
        if instruction == WRITE_MANY and at not in self.deaf:
            each = np.frombuffer(rows, "u1").reshape(-1, size + 1)
            for number, *data in each.tolist():
                for i in self.indices([number]):
                    self.write(i, at, bytes(data))
        for i in self.indices(rows if instruction == READ_MANY else [motor]):
            error, data = 0, self.memory[i, at : at + size].tobytes()
            if instruction == WRITE:
                error, data = self.write(i, at, rest), b""
            if self.numbers[i] not in self.silent and not self.is_booting[i]:
                yield self.answer(i, error, data)
        self.take()

    def split(self, content: bytes) -> tuple[int, bytes]:
        """Return the number that parameters begin with, and the rest."""
        return _number(content[: self.width]), content[self.width :]

    def indices(self, numbers: Iterable[int]) -> list[int]:
        """Return where those motors are that there are."""
        return [self.numbers.index(n) for n in numbers if n in self.numbers]

    def write(self, i: int, at: int, data: bytes) -> int:
        """Write registers of a motor; return the error, 0 for none."""
        if self.is_booting[i]:
            return 0
        _, limit = self.family.layout.fields["limit"]
        if at == limit and _number(data) > self.full:
            return TOO_LARGE
        self.memory[i, at : at + len(data)] = [*data]
        return 0

    def take(self) -> None:
        """Do what registers say."""
        registers = self.registers
        self.goal = (registers["goal"] / TURN - 0.5) * 2.0 * np.pi
        self.limit = registers["limit"] / self.full
        self.has_torque = (registers["torque"] > 0) & ~self.is_faulty

    def measure(self) -> None:
        """Write what is measured into registers."""
        registers = self.registers
        registers["torque"] = self.has_torque
        registers["position"] = self.place
        registers["effort"] = self.load
        registers["temperature"] = np.rint(self.temperature)
        registers["fault"] = 4 * self.is_hot + 32 * self.is_loaded

    @property
    def place(self) -> np.ndarray:
        """Where motors are [steps]; 0 rad is at half a turn."""
        return np.rint((self.angle / (2.0 * np.pi) + 0.5) * TURN)

    @property
    def load(self) -> np.ndarray:
        """Torques as registers have them."""
        return np.rint(self.full * self.effort)


class Dynamixel(EmulatedServos):
    """Dynamixel X."""

    family = FAMILIES["dynamixel"]
    full = 2352
    header = b"\xff\xff\xfd\x00"
    width = 2
    status = b"\x55"
    defaults: ClassVar = {84: (400).to_bytes(2, "little")}
    alert = 128
    stuffing = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"

    def checksum(self, message: bytes) -> int:
        """See `EmulatedServos`; by the maker's package."""
        return PacketHandler(2.0).updateCRC(0, message, len(message))

    def write(self, i: int, at: int, data: bytes) -> int:
        """See `EmulatedServos`."""
        if at < 64 and self.has_torque[i]:
            return LOCKED
        if at in (102, 116) and self.registers["watchdog"][i] < 0:
            return READ_ONLY
        return super().write(i, at, data)

    def take(self) -> None:
        """See `EmulatedServos`."""
        super().take()
        # In other operating modes, the goal current means nothing.
        self.limit[self.memory[:, 11] != 5] = 1.0
        watchdog = self.registers["watchdog"]
        self.patience = np.where(watchdog > 0, 0.02 * watchdog, np.inf)

    def hold(self, late: np.ndarray) -> None:
        """See `EmulatedMotors`; the watchdog has to be armed again."""
        self.registers["watchdog"][late] = -1
        self.registers["goal"][late] = self.place[late]
        self.take()


class Feetech(EmulatedServos):
    """Feetech STS."""

    family = FAMILIES["feetech"]
    full = 1000
    header = b"\xff\xff"
    width = 1

    def checksum(self, message: bytes) -> int:
        """See `EmulatedServos`; the sum of all but the header, inverted."""
        return ~sum(message[2:]) & 255

    @property
    def load(self) -> np.ndarray:
        """See `EmulatedServos`; a bit is the sign."""
        load = super().load
        return np.where(load < 0.0, 0x400 - load, load)
