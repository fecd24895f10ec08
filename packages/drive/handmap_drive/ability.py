"""PSYONIC's Ability Hand on a serial port, by `pyserial`.

Messages are those of the maker's ABILITY-HAND-ICD and of his package `ability-hand`. The package is
not used: at its import it writes a file `config.py` into the current folder, its client needs
threads and ends the process if the hand does not answer, and it keeps matplotlib below 3.10.1.
"""

import termios
from contextlib import suppress
from itertools import compress
from time import monotonic
from typing import Any, ClassVar

import numpy as np
import serial

from handmap_qp.hands import Names
from .driver import DriverError, Health, insisting
from .motors import TableDriver

POSITION, TORQUE, READ = 0x12, 0x32, 0xA2
"""Messages: go to positions, give currents, only tell; all with the answer `STATE`."""
STATE = np.dtype(
    [
        ("header", "u1"),
        ("motor", [("position", "<i2"), ("current", "<i2")], 6),
        ("speed", "<i2", 6),
        ("hot", "u1"),
    ]
)
"""Answer without its checksum: the message's header, then the state of the motors."""
_FARTHEST = 32767
"""Largest position, 150 degrees; a larger one would pass for one on the other side."""
SCALE = np.radians(150.0) / _FARTHEST
"""Unit of positions [rad]."""
NONE = (0,) * 6
"""Currents of motors without torque."""
FLAG, ESCAPE = b"\x7e", b"\x7d"
_WRITING, _PATIENCE = 1.0, 0.05
"""Longest waits of one call of the port [s]; the second one unless the table has another one."""
FAULTS = {0: "too hot, or a collision"}
"""Bits of what a motor reports."""
_YIELDING = 0.1
"""Time in which a motor comes back to its share of the current [s]."""
_SILENT = 0.05
"""Time without an answer after which the hand may have restarted [s]."""
_AWAY, _SLACK, _LONGEST = 0.1, 0.005, 0.1
"""A motor so far from its goal [rad], with a smaller share of the current, for so long [s]: off."""
_PIECES = 8
"""Flags that are waited for; an answer has two."""


def stuffed(body: bytes) -> bytes:
    """Return a message with its checksum, between flags and without flags inside."""
    body += bytes([-sum(body) & 255])
    for byte in (ESCAPE, FLAG):
        body = body.replace(byte, ESCAPE + bytes([byte[0] ^ 0x20]))
    return FLAG + body + FLAG


def unstuffed(piece: bytes) -> bytes:
    """Return what was between flags, without its checksum; nothing if that is wrong."""
    for byte in (FLAG, ESCAPE):
        piece = piece.replace(ESCAPE + bytes([byte[0] ^ 0x20]), byte)
    return b"" if sum(piece) & 255 else piece[:-1]


class Ability(TableDriver):
    """An Ability Hand; arguments and attributes as in `TableDriver`.

    The hand itself has no limit of torque where it goes to positions. So a motor whose current is
    more than its share gets goals that are nearer and nearer to where it is, within some 0.1 s.
    """

    buses: ClassVar = {"ability": SCALE}
    numbers = range(6)

    def connect(self) -> None:
        """See `Driver`."""
        self._port = serial.Serial(
            self._port_name,
            self._table.baud,
            timeout=self._table.patience or _PATIENCE,
            write_timeout=_WRITING,
            exclusive=True,
        )
        self._share = np.ones(len(self._ids))
        self._written = monotonic()
        self._answered = self._written
        self._is_missed = False
        # No torque yet, by what the driver has sent to the hand.
        self._is_off = True
        self._was_silent = False
        insisting(self._ask, TORQUE, NONE)

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        """See `Driver`; the hand does not tell temperatures, nor whether it has torque."""
        self._ask(READ)
        faults = self._faults(self._state["hot"] >> np.array(self._ids), FAULTS)
        unknown = np.full(len(self._ids), np.nan)
        return *self._joints(), Health(unknown, faults, self._find_unpowered())

    def _find_unpowered(self) -> Names:
        """Return joints without torque: all after a silence, or those that do not pull."""
        if self._is_off or self._was_silent:
            return self.joint_names
        here, torque = self._joints()
        now = monotonic()
        is_slack = (np.abs(self._goal - here) > _AWAY) & (np.abs(torque) < _SLACK)
        self._pulled = np.where(is_slack, self._pulled, now)
        return tuple(compress(self.joint_names, now - self._pulled > _LONGEST))

    def _joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Return where joints were [rad], and their torques, by the last answer."""
        motors = self._state["motor"][self._ids]
        return self._angles(motors["position"]), self._torques(motors["current"])

    def write(self, q: np.ndarray, effort: float) -> None:
        """See `Driver`."""
        now = monotonic()
        dt = min(now - self._written, _YIELDING)
        self._written = now
        here, pressed = self._joints()
        # Slower than the hand tells its currents; at most twice as much in this time.
        pressed = np.maximum(np.abs(pressed), 1e-6)
        change = np.minimum(effort / pressed, 2.0) ** (dt / _YIELDING)
        self._share = np.minimum(self._share * change, 1.0)
        near = here + self._share * (q - here)
        goal = self._goals(near)
        values = self._state["motor"]["position"].copy()
        values[self._ids] = np.clip(goal, -_FARTHEST, _FARTHEST)
        if self._is_off or self._was_silent:
            self._pulled = np.full(len(self._ids), now)
        self._goal = near
        self._is_off = False
        self._was_silent = False
        # What the motors do, `read` tells.
        with suppress(DriverError):
            self._ask(POSITION, values)

    def stop(self) -> None:
        """See `Driver`."""
        self._is_off = True
        with suppress(DriverError):
            self._ask(TORQUE, NONE)

    def _ask(self, header: int, values: Any = ()) -> None:
        """Send a message, with a value for each motor, and take the hand's `STATE`.

        Raises:
            DriverError: If no answer arrives, or only damaged ones.
        """
        # Of a port that is gone, this is no OSError; the next call raises one.
        with suppress(termios.error):
            self._port.reset_input_buffer()
        body = bytes([self._table.address, header])
        self._port.write(stuffed(body + np.array(values, "<i2").tobytes()))
        for _ in range(_PIECES):
            piece = self._port.read_until(FLAG)
            if not piece.endswith(FLAG):
                break
            answer = unstuffed(piece[:-1])
            if len(answer) == STATE.itemsize:
                self._state = np.frombuffer(answer, STATE)[0]
                self._note_answer()
                return
        self._is_missed = True
        raise DriverError("the hand does not answer")

    def _note_answer(self) -> None:
        """Note whether an answer came after messages that were not answered for some time."""
        now = monotonic()
        if self._is_missed and now - self._answered > _SILENT:
            self._was_silent = True
        self._is_missed = False
        self._answered = now
