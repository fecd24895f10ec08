"""Protocols of emulated hands: Modbus of an Inspire RH56, and messages of an Ability Hand.

They share nothing with the drivers, so that an error in one of both is seen.
"""

from __future__ import annotations

import re
import struct
from enum import IntEnum
from typing import TYPE_CHECKING, ClassVar

import numpy as np

if TYPE_CHECKING:
    from .emulator import Bus, Servo

READ, WRITE = 3, 16
"""Modbus codes."""
STAY = 0xFFFF
"""In place of the goal of an RH56's motor."""


class Field(IntEnum):
    """First register of each field of an RH56: maker's user manual V1.09.

    A field has a word for each motor; the last three have a byte.
    """

    ANGLE_SET = 1486
    FORCE_SET = 1498
    SPEED_SET = 1522
    ANGLE_ACT = 1546
    FORCE_ACT = 1582
    ERROR = 1606
    STATUS = 1612
    TEMPERATURE = 1618


SIZES = {at: 3 if at >= Field.ERROR else 6 for at in Field}
"""Registers of each field."""


def modbus_crc(data: bytes) -> bytes:
    """Return the checksum of RTU, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            is_odd = crc & 1
            crc >>= 1
            if is_odd:
                crc ^= 0xA001
    return crc.to_bytes(2, "little")


class Modbus:
    """What messages of an RH56 do. At 0 rad a joint is open."""

    walls: ClassVar = dict(enumerate([(0.0, 1.47)] * 4 + [(0.0, 0.6), (0.0, 1.308)]))

    def __init__(self) -> None:
        self.speed = [1000] * 6

    def obey(self, bus: Bus, envelope: bytes, pdu: bytes) -> None:
        """Do what a message says, and answer."""
        code, at, count = struct.unpack(">BHH", pdu[:5])
        if bus.silent or (code == WRITE and at in bus.deaf):
            return
        is_known = count == SIZES.get(at)
        refused = code | 0x80
        answer = bytes([refused, 2])
        if is_known and code == READ:
            answer = bytes([code, 2 * count]) + self.read(bus, at)
        elif is_known and code == WRITE:
            values = struct.unpack(f">{count}H", pdu[6:])
            is_right = self.write(bus, at, values)
            answer = pdu[:5] if is_right else bytes([refused, 3])
        bus.send(self.packed(envelope, answer))

    def read(self, bus: Bus, at: int) -> bytes:
        """Return a field as it is sent."""
        state = [round(self.value(at, n, servo)) for n, servo in bus.motors.items()]
        if SIZES[Field(at)] == len(state):
            return struct.pack(">6h", *state)
        # The first of two motors has the lower byte of their word.
        return np.array(state, "<u1").reshape(3, 2)[:, ::-1].tobytes()

    def value(self, at: int, n: int, servo: Servo) -> float:
        """Return what a field says of a motor."""
        family = servo.family
        faults = servo.get(family.fault)
        match at:
            case Field.ANGLE_ACT:
                _, closed = self.walls[n]
                return 1000.0 * (1.0 - servo.angle / closed)
            case Field.FORCE_ACT:
                return 1000.0 * servo.effort
            case Field.ERROR:
                is_locked = bool(faults & family.overload)
                is_hot = bool(faults & family.overheating)
                return is_locked + 2 * is_hot
            case Field.TEMPERATURE:
                return servo.temperature
        return 0.0

    def write(self, bus: Bus, at: int, values: tuple[int, ...]) -> bool:
        """Write a field; return whether that is possible."""
        is_goal = at == Field.ANGLE_SET
        if any(v > 1000 and not (is_goal and v == STAY) for v in values):
            return False
        for (n, servo), value in zip(bus.motors.items(), values, strict=True):
            match at:
                case Field.ANGLE_SET:
                    self.lead(n, servo, value)
                case Field.FORCE_SET:
                    servo.put(servo.family.limit, value)
                case Field.SPEED_SET:
                    self.speed[n] = value
                case _:
                    return False
        return True

    def lead(self, n: int, servo: Servo, value: int) -> None:
        """Give a motor its goal."""
        family = servo.family
        goal = servo.angle
        if value != STAY:
            _, closed = self.walls[n]
            goal = closed * (1.0 - value / 1000.0)
        servo.put(family.goal, servo.units(goal))
        has_torque = self.speed[n] > 0 and not servo.get(family.fault)
        servo.put(family.torque, has_torque)

    def packed(self, envelope: bytes, pdu: bytes) -> bytes:
        raise NotImplementedError


class ModbusRtu(Modbus):
    """Messages on a serial line: number of the hand, what it says, checksum."""

    def take(self, buffer: bytearray) -> tuple[bytes, bytes] | None:
        """Remove the first message; return envelope and content, None if it is not complete."""
        while len(buffer) >= 8:
            number, code = buffer[:2]
            is_known = number == 1 and code in (READ, WRITE)
            size = 9 + buffer[6] if code == WRITE else 8
            if is_known and len(buffer) < size:
                return None
            message = bytes(buffer[: size - 2])
            checksum = buffer[size - 2 : size]
            if is_known and modbus_crc(message) == checksum:
                del buffer[:size]
                return message[:1], message[1:]
            del buffer[0]
        return None

    def packed(self, envelope: bytes, pdu: bytes) -> bytes:
        message = envelope + pdu
        return message + modbus_crc(message)


class ModbusTcp(Modbus):
    """Messages by TCP: number of the message, length, number of the hand, what it says."""

    def take(self, buffer: bytearray) -> tuple[bytes, bytes] | None:
        """Remove the first message, as `ModbusRtu.take`."""
        size = 6 + int.from_bytes(buffer[4:6], "big")
        if len(buffer) < max(size, 8):
            return None
        message = bytes(buffer[:size])
        del buffer[:size]
        return message[:7], message[7:]

    def packed(self, envelope: bytes, pdu: bytes) -> bytes:
        size = len(pdu) + 1
        return envelope[:4] + size.to_bytes(2, "big") + envelope[6:] + pdu


def flipped(found: re.Match[bytes]) -> bytes:
    """Return a byte as the Ability Hand has it after an escape, or back."""
    return bytes([found[1][0] ^ 0x20])


class AbilityProtocol:
    """Messages of the Ability Hand: ABILITY-HAND-ICD. Without any for 0.3 s, its motors hold.

    What a hand does then is an assumption: the document says that it leaves the API mode.
    """

    walls: ClassVar = dict(enumerate([(0.0, 1.745)] * 5 + [(-1.745, 0.0)]))
    unit = 32767 / 150
    address = 0x50
    positions, currents = 0x10, 0x30
    """Kinds of messages that give motors something to do."""

    def take(self, buffer: bytearray) -> tuple[int, bytes] | None:
        """Remove the first message; return header and content, None if it is not complete."""
        while b"~" in buffer:
            piece, _, rest = bytes(buffer).partition(b"~")
            buffer[:] = rest
            message = re.sub(rb"}(.)", flipped, piece, flags=re.DOTALL)
            is_right = len(message) > 2 and sum(message) % 256 == 0
            if is_right and message[0] == self.address:
                return message[1], message[2:-1]
        return None

    def obey(self, bus: Bus, header: int, body: bytes) -> None:
        """Do what a message says, and answer."""
        if bus.silent or header in bus.deaf:
            return
        kind = header & 0xF0
        if kind in (self.positions, self.currents):
            values = struct.unpack("<6h", body)
            for servo, value in zip(bus.motors.values(), values, strict=True):
                family = servo.family
                is_led = kind == self.positions and not servo.get(family.fault)
                servo.put(family.torque, is_led)
                if kind == self.positions:
                    goal = np.radians(value / self.unit)
                    servo.put(family.goal, servo.units(goal))
                    servo.memory[family.watchdog] = 15
        bus.send(self.answer(bus, header))

    def answer(self, bus: Bus, header: int) -> bytes:
        """Return positions, currents and speeds, as the hand sends them."""
        state: list[int] = []
        hot = 0
        for i, servo in enumerate(bus.motors.values()):
            degrees = float(np.degrees(servo.angle))
            state.append(round(self.unit * degrees))
            state.append(round(621 * servo.effort))
            is_faulty = bool(servo.get(servo.family.fault))
            hot |= is_faulty << i
        speeds = [0] * 6
        body = struct.pack("<B18hB", header, *state, *speeds, hot)
        checksum = -sum(body) % 256
        body += bytes([checksum])
        sent = re.sub(rb"([}~])", lambda found: b"}" + flipped(found), body)
        # Adapters for RS485 add zeros.
        return b"\0\0~" + sent + b"~\0\0"
