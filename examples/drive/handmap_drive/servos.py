"""Servos on a serial bus: Dynamixel X by `dynamixel-sdk`, Feetech STS by `feetech-servo-sdk`.

Both packages have the same classes. What differs between the families is in `servos.yaml`.
"""

import importlib
import termios
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import msgspec
import numpy as np

from handmap_qp.errors import expect
from handmap_qp.hands import Names
from .driver import DriverError, Health, insisting
from .motors import TableDriver

STEPS = 4096
"""Steps of a turn."""
_WRITING, _READING = 1.0, 0.01
"""Longest waits of one call of the port [s]; a missing answer counts after some 40 ms."""
_ALERT = 128
"""Bit in an answer of a motor with a fault, which `read` tells."""


_FILE = Path(__file__).with_suffix(".yaml")
FAMILIES = {
    name: SimpleNamespace(**family, layout=np.dtype(family["registers"]))
    for name, family in msgspec.yaml.decode(_FILE.read_bytes()).items()
}
"""What differs between families, as `servos.yaml` says; and the registers as a type."""


class Servos(TableDriver):
    """The servos of a table; arguments and attributes as of `TableDriver`."""

    buses: ClassVar = dict.fromkeys(FAMILIES, 2.0 * np.pi / STEPS)
    numbers = range(253)

    def __init__(
        self, own: str, port: str, joints: Names, file: Path | None = None
    ) -> None:
        super().__init__(own, port, joints, file)
        self._family = family = FAMILIES[self._table.bus]
        low, high = family.places
        ends = self._goals(self.range)
        expect(
            ((ends >= low) & (ends <= high)).all(),
            "--motors",
            f"zero, ratio and range that lead to {low} to {high}",
            got=f"{ends.min():.0f} to {ends.max():.0f}",
        )
        self._has_torque, self._limit = False, np.array(-1)

    def connect(self) -> None:
        """See `Driver`."""
        self._open()
        family = self._family
        first = min(family.registers["offsets"])
        size = family.layout.itemsize - first
        self._state = self._sdk.GroupSyncRead(self._port, self._packets, first, size)
        for motor in self._ids:
            self._state.addParam(motor)
            for register in (*family.setup, *self._table.setup):
                insisting(self._set, motor, *register)

    def _open(self) -> None:
        """Open the port, for this process alone."""
        family, baud = self._family, self._table.baud
        self._sdk = sdk = importlib.import_module(family.module)
        self._packets = sdk.PacketHandler(family.protocol)
        self._port = port = sdk.PortHandler(self._port_name)
        is_known = port.setBaudRate(baud)
        expect(is_known, "--motors", f"a baud of {family.package}", value=baud)
        serial = port.ser
        serial.exclusive = True
        serial.write_timeout, serial.timeout = _WRITING, _READING

        def clear() -> None:
            # Of a port that is gone, this is no OSError; the next call raises one.
            with suppress(termios.error):
                serial.reset_input_buffer()

        port.clearPort = clear

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        """See `Driver`."""
        family = self._family
        state = self._registers()
        # What is armed is less than 0 after it has stopped the motor.
        needed = ("torque", *dict(family.arm))
        self._has_torque = all((state[name] > 0).all() for name in needed)
        self._limit = state.limit
        effort = state.effort.astype(int)
        effort = np.where(effort & family.sign, family.sign - effort, effort)
        health = Health(state.temperature, self._faults(state.fault, family.faults))
        return self._angles(state.position), self._torques(effort), health

    def _registers(self) -> np.recarray:
        """Return the registers of all motors.

        Raises:
            DriverError: If an answer is missing, damaged, or one to another message.
        """
        group = self._state
        blocks = group.data_dict
        # After a motor that does not answer, the others are not read: no block of before may stay.
        blocks.update(dict.fromkeys(blocks, b""))
        result = group.txRxPacket()
        for motor, block in blocks.items():
            # An answer to another message is shorter, and no error of the package.
            if len(block) != group.data_length:
                self._check(motor, result or self._sdk.COMM_RX_CORRUPT)
        unread = bytes(group.start_address)
        tables = b"".join(unread + bytes(block) for block in blocks.values())
        return np.rec.array(tables, self._family.layout)

    def write(self, q: np.ndarray, effort: float) -> None:
        """See `Driver`."""
        limit = round(effort * self._table.full)
        orders: list[tuple[str, Any]] = [("limit", limit), ("goal", self._goals(q))]
        if not self._has_torque:
            # Not before the limit is known to have arrived.
            torque = (self._limit == limit).all()
            orders = [*self._family.arm, *orders, ("torque", torque)]
        for register, values in orders:
            self._put(register, values)

    def stop(self) -> None:
        """See `Driver`."""
        self._put("torque", 0)

    def _put(self, register: str, values: Any) -> None:
        """Write a register of all motors in one message, which they do not answer."""
        # After an error of the port, it would stay in use for ever.
        self._port.is_using = False
        form, at = self._family.layout.fields[register]
        rows = np.empty(len(self._ids), [("motor", "u1"), ("value", form)])
        rows["motor"], rows["value"] = self._ids, values
        data = rows.tobytes()
        self._packets.syncWriteTxOnly(self._port, at, form.itemsize, data, len(data))

    def _set(self, motor: int, at: int, size: int, value: int) -> None:
        """Write a register of one motor, which answers."""
        data = value.to_bytes(size, "little")
        result, error = self._packets.writeTxRx(self._port, motor, at, size, data)
        self._check(motor, result, error)

    def _check(self, motor: int, result: int, error: int = 0) -> None:
        """Raise `DriverError` for a result of the package, or an error in an answer."""
        if result or error & ~_ALERT:
            said = self._packets
            why = said.getTxRxResult(result) if result else said.getRxPacketError(error)
            # It begins with its kind, in brackets.
            _, _, reason = why.rpartition("] ")
            raise DriverError(f"motor {motor}: {reason}")
