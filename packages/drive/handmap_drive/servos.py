"""Servos on a serial bus: Dynamixel X by `dynamixel-sdk`, Feetech STS by `feetech-servo-sdk`.

Both packages have the same classes. What differs between the families is in `servos.yaml`.
"""

import importlib
import termios
from contextlib import suppress
from itertools import compress
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
"""Longest waits of one call of the port [s]. Both packages wait some 36 ms for an answer."""
_ALERT = 128
"""Bit in an answer of a motor with a fault, which `read` tells."""


_FILE = Path(__file__).with_suffix(".yaml")
FAMILIES = {
    name: SimpleNamespace(**family, layout=np.dtype(family["registers"]))
    for name, family in msgspec.yaml.decode(_FILE.read_bytes()).items()
}
"""What differs between families, as `servos.yaml` says; and the registers as a type."""


class Servos(TableDriver):
    """The servos of a table; arguments and attributes as in `TableDriver`."""

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
        self._first = min(family.registers["offsets"])
        self._has_torque = False
        # Where motors do not have torque although it was confirmed, they were reset.
        self._was_given = False
        self._limit = np.array(-1)
        # Limits that were written since the last stop; a message may be lost.
        self._limits: set[int] = set()
        # Which motors do not have their set-up.
        self._is_bare = np.ones(len(self._ids), bool)

    def connect(self) -> None:
        """See `Driver`."""
        self._open()
        first = self._first
        size = self._family.layout.itemsize - first
        self._state = self._sdk.GroupSyncRead(self._port, self._packets, first, size)
        for motor in self._ids:
            self._state.addParam(motor)
        self._set_up()

    def _set_up(self) -> None:
        """Write the set-up of motors that do not have it, which takes their torque away.

        Raises:
            DriverError: If one of them does not answer.
        """
        for i in np.flatnonzero(self._is_bare):
            for register in (*self._family.setup, *self._table.setup):
                insisting(self._set, self._ids[i], *register)
            self._is_bare[i] = False
        # They get torque as at the start.
        self._was_given = False

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
        patience = self._table.patience
        if patience is not None:

            def begin_waiting(_length: int) -> None:
                port.setPacketTimeoutMillis(1e3 * patience)

            port.setPacketTimeout = begin_waiting

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        """See `Driver`."""
        family = self._family
        tables = self._tables()
        state = np.rec.array(tables, family.layout)
        # What is armed is less than 0 after it has stopped the motor.
        needed = ("torque", *dict(family.arm))
        has_torque = np.all([state[name] > 0 for name in needed], axis=0)
        has_limit = np.isin(state.limit, [*self._limits])
        was_reset = self._was_given & ~(has_torque & has_limit)
        self._is_bare = self._is_bare | was_reset | ~self._has_setup(tables)
        self._has_torque = bool(has_torque.all())
        self._limit = state.limit
        is_unpowered = ~has_torque | self._is_bare
        unpowered = tuple(compress(self.joint_names, is_unpowered))
        if not unpowered and self._limits:
            self._was_given = True
        effort = state.effort.astype(int)
        effort = np.where(effort & family.sign, family.sign - effort, effort)
        faults = self._faults(state.fault, family.faults)
        health = Health(state.temperature, faults, unpowered)
        return self._angles(state.position), self._torques(effort), health

    def _has_setup(self, tables: bytes) -> np.ndarray:
        """Return which motors have the registers of their set-up that are read, shape (n,).

        Others are kept without supply (EEPROM). That of the torque changes.
        """
        has_setup = np.ones(len(self._ids), bool)
        size = self._family.layout.itemsize
        rows = np.frombuffer(tables, "u1").reshape(-1, size)
        _, torque = self._family.layout.fields["torque"]
        # Of registers that are written twice, the last value counts.
        last = {at: (length, value) for at, length, value in self._table.setup}
        for at, (length, value) in last.items():
            if self._first <= at <= size - length and at != torque:
                wanted = np.frombuffer(value.to_bytes(length, "little"), "u1")
                has_setup &= (rows[:, at : at + length] == wanted).all(axis=1)
        return has_setup

    def _tables(self) -> bytes:
        """Return the registers of all motors, from 0 on; those before the first one are 0.

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
        return b"".join(unread + bytes(block) for block in blocks.values())

    def write(self, q: np.ndarray, effort: float) -> None:
        """See `Driver`."""
        if self._is_bare.any():
            # Motors that still start do not answer: the next turn tries again.
            with suppress(DriverError):
                self._set_up()
            # They are read before they get torque.
            return
        limit = round(effort * self._table.full)
        self._limits.add(limit)
        orders: list[tuple[str, Any]] = [("limit", limit), ("goal", self._goals(q))]
        if not self._has_torque:
            # Not before the limit is known to have arrived.
            torque = (self._limit == limit).all()
            orders = [*self._family.arm, *orders, ("torque", torque)]
        for register, values in orders:
            self._put(register, values)

    def stop(self) -> None:
        """See `Driver`."""
        self._was_given = False
        self._has_torque = False
        self._limits = set()
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
            packets = self._packets
            why = (
                packets.getTxRxResult(result)
                if result
                else packets.getRxPacketError(error)
            )
            # It begins with its kind, in brackets.
            _, _, reason = why.rpartition("] ")
            raise DriverError(f"motor {motor}: {reason}")
