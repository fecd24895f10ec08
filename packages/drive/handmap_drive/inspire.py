"""Inspire RH56 hands by Modbus: RTU on a serial port, or TCP; by `pymodbus`.

Registers are those of the maker's manuals (RH56 user manual V1.09, RH56DFTP V1.0.0). Each field is
read by itself, as the maker's examples do. The hand has no order that takes its torque away.
"""

import importlib
import logging
import time
from contextlib import suppress
from itertools import compress, cycle
from typing import Any, ClassVar

import numpy as np

from handmap_qp.errors import expect, warn
from handmap_qp.hands import Names
from .driver import DriverError, Health, insisting
from .motors import TableDriver

ANGLE_SET, FORCE_SET, SPEED_SET = 1486, 1498, 1522
"""Registers to write, a word for each motor: little to index finger, bend and turn of the thumb."""
ANGLE_ACT, FORCE_ACT, ERROR, TEMPERATURE = 1546, 1582, 1606, 1618
"""Registers to read."""
FORMS = {
    SPEED_SET: "<i2",
    ANGLE_ACT: "<i2",
    FORCE_ACT: "<i2",
    ERROR: "u1",
    TEMPERATURE: "u1",
}
"""What they have for each motor: a word, or a byte."""
OPEN = 1000
"""Angle of an open finger, and the largest force and speed; a closed finger is at 0."""
MARK = OPEN - 1
"""Speed that the driver sets. A hand that was reset has its default again, which is `OPEN`."""
HOLD = 0xFFFF
"""In place of an angle: the motor stays where it is."""
FAULTS = dict(
    enumerate(("locked rotor", "overheating", "overcurrent", "motor", "communication"))
)
"""Bits of `ERROR`."""
_PATIENCE = 0.05
"""Longest wait for an answer, unless the table has another one [s]."""
_UNKNOWN = -1
"""Force of a hand that did not answer to the last one."""
_OTHERS = FORCE_ACT, ERROR, TEMPERATURE
"""Registers that are read in turns, one in each."""


class _NoAnswerError(DriverError):
    """A message or its answer was lost or damaged."""


class Inspire(TableDriver):
    """An RH56 hand; arguments and attributes as in `TableDriver`.

    The port is that of a serial adapter, or HOST:PORT for Modbus TCP.
    """

    buses: ClassVar = {"inspire": 1.0}
    numbers = range(6)

    def connect(self) -> None:
        """See `Driver`."""
        # It tells each lost answer.
        logging.getLogger("pymodbus").addHandler(logging.NullHandler())
        modbus = importlib.import_module("pymodbus.client")
        self._refusals = importlib.import_module("pymodbus.exceptions")
        host, _, number = self._port_name.rpartition(":")
        self._patience = self._table.patience or _PATIENCE
        more: dict[str, Any] = {"timeout": self._patience, "retries": 0}
        # Names of serial ports may have colons, too.
        if host and "/" not in host:
            is_right = number.isdecimal() and int(number) < 65536
            expect(is_right, "--port", "HOST:PORT", value=self._port_name)
            self._client = modbus.ModbusTcpClient(host, port=int(number), **more)
        else:
            baud = self._table.baud
            self._client = modbus.ModbusSerialClient(
                self._port_name, baudrate=baud, **more
            )
        self._is_late = False
        for at, value in ((FORCE_SET, 0), (ANGLE_SET, HOLD), (SPEED_SET, MARK)):
            insisting(self._put, at, value)
        self._force = 0
        self._has_force = False
        self._is_marked = True
        # A hand that does not tell its speed cannot show that it was reset.
        self._has_mark = bool((insisting(self._get, SPEED_SET) == MARK).all())
        if not self._has_mark:
            warn(f"{self._port_name}: a reset of this hand cannot be seen")
        self._seen = {at: insisting(self._get, at) for at in _OTHERS}
        self._next = cycle(_OTHERS)

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        """See `Driver`; torques and health are of one of the last three calls."""
        angle = self._get(ANGLE_ACT)
        unpowered = self._find_reset()
        if not self._has_force:
            unpowered = self.joint_names
        at = next(self._next)
        self._seen[at] = self._get(at)
        force, error, temperature = self._seen.values()
        health = Health(temperature, self._faults(error, FAULTS), unpowered)
        # A force is positive where a finger closes, and its angle becomes less.
        return self._angles(angle), -self._torques(force), health

    def _find_reset(self) -> Names:
        """Return the joints whose motor does not have the speed that the driver set."""
        if not self._has_mark:
            return ()
        is_reset = self._get(SPEED_SET) != MARK
        if is_reset.any():
            self._is_marked = False
            self._has_force = False
        return tuple(compress(self.joint_names, is_reset))

    def write(self, q: np.ndarray, effort: float) -> None:
        """See `Driver`."""
        force = round(effort * self._table.full)
        goal = np.clip(self._goals(q), 0, OPEN)
        # Without an answer, the hand does not get the angles. What it refuses is an error.
        with suppress(_NoAnswerError):
            if not self._is_marked:
                self._put(SPEED_SET, MARK)
                self._is_marked = True
            if not self._has_force:
                # The hand has the goal of the stop, which may be far from where it sagged to.
                self._set_force(0)
                self._put(ANGLE_SET, goal)
                self._set_force(force)
                self._has_force = True
                return
            if force != self._force:
                self._set_force(force)
            self._put(ANGLE_SET, goal)

    def stop(self) -> None:
        """Hold where the motors are, with the least force."""
        self._has_force = False
        with suppress(DriverError):
            self._put(ANGLE_SET, HOLD)
        with suppress(DriverError):
            self._set_force(0)

    def _set_force(self, force: int) -> None:
        """Write the limit of the force of all motors.

        Raises:
            DriverError: If there is no answer; the hand may have the old one, or this one.
        """
        self._force = _UNKNOWN
        self._put(FORCE_SET, force)
        self._force = force

    def _get(self, at: int) -> np.ndarray:
        """Read a field of the table's motors."""
        form = np.dtype(FORMS[at])
        count = len(self.numbers) * form.itemsize // 2
        words = self._ask("read_holding_registers", at, count=count).registers
        if len(words) != count:
            self._is_late = True
            raise _NoAnswerError(f"register {at}: the answer to another message")
        # Of two bytes in a word, the first is the lower one.
        return np.array(words, "<u2").view(form)[self._ids]

    def _put(self, at: int, values: Any) -> None:
        """Write a field of all motors; those that the table does not have stay."""
        words = np.full(len(self.numbers), HOLD if at == ANGLE_SET else 0)
        words[self._ids] = values
        self._ask("write_registers", at, values=words.tolist())

    def _ask(self, name: str, at: int, **more: Any) -> Any:
        """Send a message, and return the answer.

        Raises:
            DriverError: If there is none, or it is an error.
            OSError: If the port is gone.
        """
        if self._is_late:
            # RTU answers have no number: a late one would pass for the next.
            time.sleep(self._patience)
        self._is_late = True
        try:
            answer = getattr(self._client, name)(
                at, device_id=self._table.address, **more
            )
        except self._refusals.ConnectionException as error:
            if self._client.is_socket_open():
                # pyserial counts the time in which this process did not run as a failed write.
                raise _NoAnswerError(f"register {at}: not sent in time") from error
            raise OSError(f"{self._port_name} is gone, or cannot be opened") from error
        except self._refusals.ModbusException as error:
            raise _NoAnswerError(f"register {at}: no answer") from error
        self._is_late = False
        if answer.isError():
            raise DriverError(f"register {at}: refused, code {answer.exception_code}")
        return answer
