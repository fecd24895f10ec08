"""Servos on a serial bus: Dynamixel X by `dynamixel-sdk`, Feetech STS by `feetech-servo-sdk`.

Both packages have the same classes. The registers are in `servos.yaml`.
"""

import importlib
import termios
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np

from handmap_qp.hands import Names
from .driver import DriverError, Health
from .motors import TableDriver

_WRITING, _READING = 1.0, 0.01
"""Longest waits of one call of the port [s]; a missing answer counts after some 40 ms."""
_ATTEMPTS = 3
_ALERT = 128
"""Bit in an answer of a motor with a fault, which `read` tells."""


class Servos(TableDriver):
    """The servos of a table; arguments and attributes as of `TableDriver`."""

    buses = ("dynamixel", "feetech")
    numbers = range(253)

    def __init__(
        self, own: str, port: str, joints: Names, file: Path | None = None
    ) -> None:
        super().__init__(own, port, joints, file)
        families = msgspec.yaml.decode(Path(__file__).with_suffix(".yaml").read_bytes())
        self._own = family = SimpleNamespace(**families[self._table.bus])
        self._fields = np.dtype(family.fields)
        self._zero, self._ratio = (
            value * family.turn / (2.0 * np.pi) for value in (self._zero, self._ratio)
        )
        self._has_torque, self._limit = False, np.array(-1)

    def connect(self) -> None:
        """See `Driver`."""
        own = self._own
        self._sdk = sdk = importlib.import_module(own.module)
        self._port = port = sdk.PortHandler(self._port_name)
        self._packets = packets = sdk.PacketHandler(own.protocol)
        port.setBaudRate(self._table.baud)
        port.ser.write_timeout, port.ser.timeout = _WRITING, _READING

        def clear() -> None:
            # Of a port that is gone, this is no OSError; the next call raises one.
            with suppress(termios.error):
                port.ser.reset_input_buffer()

        port.clearPort = clear
        size = self._fields.itemsize
        self._state = sdk.GroupSyncRead(port, packets, own.state, size)
        for motor in self._ids:
            self._state.addParam(motor)
            for at, size, value in ((*own.torque, 0), *own.setup, *self._table.setup):
                data = value.to_bytes(size, "little")
                for _ in range(_ATTEMPTS):
                    result, error = packets.writeTxRx(port, motor, at, size, data)
                    if not result:
                        break
                self._check(motor, result, error)

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        """See `Driver`."""
        own = self._own
        result = self._state.txRxPacket()
        blocks = self._state.data_dict
        for motor, block in blocks.items():
            # After a motor that does not answer, the others are not read.
            self._check(motor, 0 if len(block) == self._fields.itemsize else result)
        state = np.rec.array(b"".join(map(bytes, blocks.values())), self._fields)
        self._has_torque = (state.torque & (state.watchdog >= own.alive)).all()
        self._limit = state.limit
        faults = tuple(
            f"{name}: {text}"
            for name, bits in zip(self.joint_names, state.fault, strict=True)
            for bit, text in own.faults.items()
            if bits >> bit & 1
        )
        effort = state.effort.astype(int)
        effort = np.where(effort & own.sign, own.sign - effort, effort)
        return (
            (state.position - self._zero) / self._ratio,
            np.sign(self._ratio) * effort / self._table.full,
            Health(state.temperature, faults),
        )

    def write(self, q: np.ndarray, effort: float) -> None:
        """See `Driver`."""
        own = self._own
        limit = round(effort * self._table.full)
        goal = self._zero + self._ratio * q
        orders = [(own.limit, limit), (own.goal, goal)]
        if not self._has_torque:
            # Not before the limit is known to have arrived.
            torque = (self._limit == limit).all()
            orders = [*own.arm, *orders, (own.torque, torque)]
        for register, values in orders:
            self._put(register, values)

    def stop(self) -> None:
        """See `Driver`."""
        self._has_torque = False
        self._put(self._own.torque, 0)

    def _put(self, register: tuple[int, int], values: Any) -> None:
        """Write a register of all motors in one message, which they do not answer."""
        # After an error of the port, it would stay in use for ever.
        self._port.is_using = False
        group = self._sdk.GroupSyncWrite(self._port, self._packets, *register)
        for motor, value in np.broadcast(self._ids, np.rint(values)):
            data = int(value).to_bytes(register[1], "little", signed=value < 0)
            group.addParam(motor, data)
        group.txPacket()

    def _check(self, motor: int, result: int, error: int = 0) -> None:
        """Raise `DriverError` for a result of the package, or an error in an answer."""
        if result or error & ~_ALERT:
            said = self._packets
            why = said.getTxRxResult(result) if result else said.getRxPacketError(error)
            raise DriverError(f"motor {motor}: {why}")
