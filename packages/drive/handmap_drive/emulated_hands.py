"""Emulated hands: Modbus of an Inspire RH56, and messages of an Ability Hand.

Registers and the form of messages are those of the drivers, which tests compare with the makers'
documents. What values mean is written here again, so that an error in one of both is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from pymodbus.framer import FramerBase
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersResponse,
    WriteMultipleRegistersResponse,
)

from . import ability, inspire
from .emulated_motors import EmulatedMotors

READ, WRITE = 3, 16
"""Modbus codes."""
UNKNOWN, WRONG = 2, 3
"""Reasons to refuse a message: its registers, or their values."""
MOTORS = range(6)
"""Numbers of a hand's motors."""


class InspireHand(EmulatedMotors):
    """An RH56; its joints are open at 0 rad.

    Args:
        framer: That of RTU or TCP.
        numbers: See `EmulatedMotors`.
        angle: See `EmulatedMotors`.
    """

    own = MOTORS
    closed = np.array([1.47, 1.47, 1.47, 1.47, 0.6, 1.308])
    ends = np.zeros(6), closed

    def __init__(
        self, framer: Callable[[DecodePDU], FramerBase], numbers: range, angle: float
    ) -> None:
        super().__init__(numbers, angle)
        self.framer = framer(DecodePDU(is_server=True))
        self.speed = np.full(6, 1000)

    def forget(self, which: np.ndarray) -> None:
        """See `EmulatedMotors`."""
        super().forget(which)
        self.speed = np.full(6, 1000)

    def messages(self, buffer: bytearray) -> Iterator[ModbusPDU]:
        """See `EmulatedMotors`."""
        while buffer:
            used, message = self.framer.handleFrame(bytes(buffer), 0, 0)
            del buffer[:used]
            if message is None:
                return
            if message.dev_id == 1:
                yield message

    def obey(self, message: ModbusPDU) -> Iterator[bytes]:
        """See `EmulatedMotors`."""
        code, at, count = message.function_code, message.address, message.count
        is_deaf = code == WRITE and at in self.deaf
        if self.silent or is_deaf or self.is_booting.any():
            return
        answer: ModbusPDU = ExceptionResponse(code, UNKNOWN)
        if code == READ and len(words := self.read(at)) == count:
            answer = ReadHoldingRegistersResponse(registers=words)
        elif code == WRITE and count == len(self.numbers):
            problem = self.write(at, np.array(message.registers))
            answer = WriteMultipleRegistersResponse(address=at, count=count)
            if problem:
                answer = ExceptionResponse(code, problem)
        answer.dev_id, answer.transaction_id = message.dev_id, message.transaction_id
        yield self.framer.buildFrame(answer)

    def read(self, at: int) -> list[int]:
        """Return the words of a field; nothing if it cannot be read."""
        values = {
            inspire.SPEED_SET: self.speed,
            inspire.ANGLE_ACT: 1000.0 * (1.0 - self.angle / self.closed),
            inspire.FORCE_ACT: 1000.0 * self.effort,
            inspire.ERROR: self.is_loaded + 2 * self.is_hot,
            inspire.TEMPERATURE: self.temperature,
        }
        if at not in values:
            return []
        whole = np.rint(values[at]).astype(inspire.FORMS[at])
        return whole.view("<u2").tolist()

    def write(self, at: int, values: np.ndarray) -> int:
        """Write a field; return why that cannot be, 0 if it can."""
        stays = (values == inspire.HOLD) & (at == inspire.ANGLE_SET)
        if (values[~stays] > 1000).any():
            return WRONG
        match at:
            case inspire.ANGLE_SET:
                goal = self.closed * (1.0 - values / 1000.0)
                self.goal = np.where(stays, self.angle, goal)
                self.has_torque = (self.speed > 0) & ~self.is_faulty
            case inspire.FORCE_SET:
                self.limit = values / 1000.0
            case inspire.SPEED_SET:
                self.speed = values
            case _:
                return UNKNOWN
        return 0


class AbilityHand(EmulatedMotors):
    """An Ability Hand. Without a message for 0.3 s, its motors hold.

    That is an assumption: the document says that the hand leaves its API mode then.
    """

    own = MOTORS
    ends = np.array([[0.0] * 5 + [-1.745], [1.745] * 5 + [0.0]])
    unit = 32767 / 150
    """Of positions, per degree."""
    address = 0x50
    positions, currents = 0x10, 0x30
    """Kinds of messages that give motors something to do."""

    def messages(self, buffer: bytearray) -> Iterator[tuple[int, bytes]]:
        """See `EmulatedMotors`."""
        while ability.FLAG in buffer:
            piece, _, buffer[:] = bytes(buffer).partition(ability.FLAG)
            message = ability.unstuffed(piece)
            if len(message) > 1 and message[0] == self.address:
                yield message[1], message[2:]

    def obey(self, message: tuple[int, bytes]) -> Iterator[bytes]:
        """See `EmulatedMotors`."""
        header, body = message
        if self.silent or header in self.deaf or self.is_booting.any():
            return
        kind = header & 0xF0
        if kind in (self.positions, self.currents):
            self.has_torque[:] = kind == self.positions
            self.has_torque &= ~self.is_faulty
        if kind == self.positions:
            self.goal = np.radians(np.frombuffer(body, "<i2") / self.unit)
            self.patience[:] = 0.3
        place = np.rint(self.unit * np.degrees(self.angle))
        current = np.rint(621 * self.effort)
        hot = np.packbits(self.is_faulty, bitorder="little")[0]
        motors = [*zip(place, current, strict=True)]
        state = np.array((header, motors, 0, hot), ability.STATE)
        # Adapters for RS485 add zeros.
        yield b"\0\0" + ability.stuffed(state.tobytes()) + b"\0\0"
