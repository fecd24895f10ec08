"""Protocols of emulated hands: Modbus of an Inspire RH56, and messages of an Ability Hand.

They share nothing with the drivers, so that an error in one of both is seen.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

if TYPE_CHECKING:
    from .emulator import Bus


def modbus_crc(data: bytes) -> bytes:
    """Return the checksum of RTU, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc.to_bytes(2, "little")


class Modbus:
    """Registers of an RH56: maker's user manual V1.09. At 0 rad a joint is open."""

    walls: ClassVar = dict(enumerate([(0.0, 1.47)] * 4 + [(0.0, 0.6), (0.0, 1.308)]))
    sizes: ClassVar = dict.fromkeys((1486, 1498, 1522, 1546, 1582), 6)
    sizes |= dict.fromkeys((1606, 1612, 1618), 3)
    """Registers of each field, whose first has its number."""

    def __init__(self) -> None:
        self.speed = [1000] * 6

    def obey(self, bus: Bus, envelope: bytes, pdu: bytes) -> None:
        """Do what a message says, and answer."""
        code, at, count = struct.unpack(">BHH", pdu[:5])
        if bus.silent or (code == 16 and at in bus.deaf):
            return
        answer = bytes([code | 0x80, 2])
        is_known = count == self.sizes.get(at)
        if is_known and code == 3:
            answer = bytes([code, 2 * count]) + self.read(bus, at)
        elif is_known and code == 16:
            is_right = self.write(bus, at, struct.unpack(f">{count}H", pdu[6:]))
            answer = pdu[:5] if is_right else bytes([code | 0x80, 3])
        bus.send(self.packed(envelope, answer))

    def read(self, bus: Bus, at: int) -> bytes:
        """Return a field as it is sent."""
        state: list[int] = []
        for n, servo in bus.motors.items():
            faults = servo.get(servo.family.fault)
            values: dict[int, Any] = {
                1546: 1000.0 * (1.0 - servo.angle / self.walls[n][1]),
                1582: 1000.0 * servo.effort,
                1606: bool(faults & 32) | bool(faults & 4) << 1,
                1618: servo.temperature,
            }
            state.append(round(values.get(at, 0)))
        if self.sizes[at] == 6:
            return struct.pack(">6h", *state)
        # The first of two motors has the lower byte of their word.
        return bytes(state[i ^ 1] for i in range(6))

    def write(self, bus: Bus, at: int, values: tuple[int, ...]) -> bool:
        """Write a field; return whether that is possible."""
        if max(values) > 1000 and (at != 1486 or {*values} - {*range(1001), 0xFFFF}):
            return False
        for (n, servo), value in zip(bus.motors.items(), values, strict=True):
            if at == 1486:
                goal = self.walls[n][1] * (1.0 - value / 1000.0)
                goal = servo.angle if value == 0xFFFF else goal
                servo.put(servo.family.goal, servo.units(goal))
                has_torque = self.speed[n] and not servo.get(servo.family.fault)
                servo.put(servo.family.torque, bool(has_torque))
            elif at == 1498:
                servo.put(servo.family.limit, value)
            elif at == 1522:
                self.speed[n] = value
        return at in (1486, 1498, 1522)

    def packed(self, envelope: bytes, pdu: bytes) -> bytes:
        raise NotImplementedError


class ModbusRtu(Modbus):
    """Messages on a serial line: number of the hand, what it says, checksum."""

    def take(self, buffer: bytearray) -> tuple[bytes, bytes] | None:
        """Remove the first message; return envelope and content, None if it is not complete."""
        while len(buffer) >= 8:
            size = 9 + buffer[6] if buffer[1] == 16 else 8
            message = bytes(buffer[:size])
            if buffer[:1] != b"\1" or buffer[1] not in (3, 16):
                del buffer[:1]
            elif len(message) < size:
                return None
            elif modbus_crc(message[:-2]) == message[-2:]:
                del buffer[:size]
                return message[:1], message[1:-2]
            else:
                del buffer[:1]
        return None

    def packed(self, envelope: bytes, pdu: bytes) -> bytes:
        return envelope + pdu + modbus_crc(envelope + pdu)


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
        size = (len(pdu) + 1).to_bytes(2, "big")
        return envelope[:4] + size + envelope[6:] + pdu


class AbilityProtocol:
    """Messages of the Ability Hand: ABILITY-HAND-ICD. Without any for 0.3 s, its motors hold.

    What a hand does then is an assumption: the document says that it leaves the API mode.
    """

    walls: ClassVar = dict(enumerate([(0.0, 1.745)] * 5 + [(-1.745, 0.0)]))
    unit = 32767 / 150

    def take(self, buffer: bytearray) -> tuple[int, bytes] | None:
        """Remove the first message; return header and content, None if it is not complete."""
        while b"~" in buffer:
            piece, _, rest = bytes(buffer).partition(b"~")
            buffer[:] = rest
            message, is_next = bytearray(), False
            for byte in piece:
                if byte == 0x7D:
                    is_next = True
                    continue
                message.append(byte ^ 0x20 if is_next else byte)
                is_next = False
            if len(message) > 2 and sum(message) % 256 == 0 and message[0] == 0x50:
                return message[1], bytes(message[2:-1])
        return None

    def obey(self, bus: Bus, header: int, body: bytes) -> None:
        """Do what a message says, and answer."""
        if bus.silent or header in bus.deaf:
            return
        kind = header & 0xF0
        for i, servo in enumerate(bus.motors.values()):
            if kind == 0x10:
                (value,) = struct.unpack_from("<h", body, 2 * i)
                angle = np.radians(value / self.unit)
                servo.put(servo.family.goal, servo.units(angle))
                servo.memory[servo.family.watchdog] = 15
            if kind in (0x10, 0x30):
                has_torque = kind == 0x10 and not servo.get(servo.family.fault)
                servo.put(servo.family.torque, has_torque)
        bus.send(self.answer(bus, header))

    def answer(self, bus: Bus, header: int) -> bytes:
        """Return positions, currents and speeds, as the hand sends them."""
        values: list[int] = []
        hot = 0
        for i, servo in enumerate(bus.motors.values()):
            degrees = float(np.degrees(servo.angle))
            values += [round(self.unit * degrees), round(621 * servo.effort)]
            hot |= bool(servo.get(servo.family.fault)) << i
        body = struct.pack("<B18hB", header, *values, *[0] * 6, hot)
        sent = bytearray()
        for byte in body + bytes([-sum(body) % 256]):
            sent += bytes([0x7D, byte ^ 0x20] if byte in b"}~" else [byte])
        # Adapters for RS485 add zeros.
        return b"\0\0~" + bytes(sent) + b"~\0\0"
