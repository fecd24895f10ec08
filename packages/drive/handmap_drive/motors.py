"""Tables of motors: YAML files that say which motor belongs to which joint."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct

from handmap_qp.apps.refusals import naming
from handmap_qp.errors import InvalidInputError, expect, reason_of
from handmap_qp.hands import Names
from handmap_qp.options import LARGEST, number

_Finite = Annotated[float, number(-LARGEST)]
_Count = Annotated[int, Meta(ge=1)]
_Rate = Annotated[float, number(5.0, 1000.0)]
"""Slower loops count as late in each turn, and no bus is faster."""
_Speed = Annotated[float, number(high=100.0, above=True)]
"""No joint of a hand is faster."""
_Patience = Annotated[float, number(0.001, 60.0)]
"""A loop that waits longer for one answer has ended."""


class Motor(Struct, frozen=True, forbid_unknown_fields=True):
    """A motor and its joint.

    Attributes:
        joint: Name of the joint; several if models of the hand differ.
        id: Number of the motor on its bus, or its place in the registers of the hand.
        range: Least and largest angle of the joint [rad].
        zero: Where the motor is when the joint is at 0 [rad, or units of the hand].
        ratio: How far it moves per rad of the joint; negative if it turns the other way.
    """

    joint: Annotated[Names, Meta(min_length=1)]
    id: int
    range: tuple[_Finite, _Finite]
    zero: _Finite
    ratio: _Finite = 1.0

    def __post_init__(self) -> None:
        low, high = self.range
        expect(low <= high, "range", "the least angle first", value=self.range)
        expect(self.ratio, "ratio", "not 0", value=self.ratio)


class Motors(Struct, frozen=True, forbid_unknown_fields=True):
    """A table of motors.

    Attributes:
        baud: Speed of the port [bit/s].
        rate: As in `Driver`, 5 to 1000 Hz.
        speed: As in `Driver`, at most 100 rad/s.
        effort: See `Driver`.
        full: The largest torque, in units of the motors.
        motors: The motors.
        bus: Family of servos, or the hand.
        address: Number of a hand on its bus.
        setup: Further registers of servos to write at the start: address, bytes, value.
        patience: Longest wait for an answer [s], 0.001 to 60; the driver's own if omitted. A slow
            adapter or network needs more.
    """

    baud: _Count
    rate: _Rate
    speed: _Speed
    effort: Annotated[float, number(high=1.0, above=True)]
    full: _Count
    motors: Annotated[tuple[Motor, ...], Meta(min_length=1)]
    bus: Literal["dynamixel", "feetech", "inspire", "ability"] = "dynamixel"
    address: Annotated[int, Meta(ge=0, le=255)] = 1
    setup: tuple[tuple[int, Literal[1, 2, 4], int], ...] = ()
    patience: _Patience | None = None

    def __post_init__(self) -> None:
        for _, size, value in self.setup:
            is_right = 0 <= value < 256**size
            expect(is_right, "setup", f"a value of {size} bytes", value=value)


def read_motors(file: Path) -> Motors:
    """Read a table.

    Raises:
        InvalidInputError: If it cannot be used.
    """
    try:
        with naming("--motors", str(file)):
            return msgspec.yaml.decode(file.read_bytes(), type=Motors)
    except msgspec.MsgspecError as error:
        problem = f"{file}: {reason_of(error)}"
        raise InvalidInputError(problem, argument="--motors") from error


class TableDriver:
    """What drivers with a table share; attributes as in `Driver`.

    Args:
        own: Name of the package's table; empty if there is none.
        port: The port.
        joints: Joints of the session; those without a motor are left out.
        file: The user's table, in place of the package's.

    Raises:
        InvalidInputError: If the table cannot be used, or has joints that the session does not.
    """

    buses: ClassVar[Mapping[str, float]]
    """What `bus` may be in the table, and what one step of its motors is in units of `zero`."""
    numbers: ClassVar[range]
    """What the `id` of a motor may be in the table."""

    def __init__(
        self, own: str, port: str, joints: Names, file: Path | None = None
    ) -> None:
        expect(own or file, "--motors", "a table of the servos")
        self._table = table = read_motors(
            file or Path(__file__).with_name(f"{own}.yaml")
        )
        motors = table.motors
        kinds = " or ".join(self.buses)
        expect(table.bus in self.buses, "--motors", f"bus: {kinds}", value=table.bus)
        self._ids = [motor.id for motor in motors]
        expect(
            {*self._ids} <= {*self.numbers} and len({*self._ids}) == len(motors),
            "--motors",
            f"each id once, in {self.numbers[0]} to {self.numbers[-1]}",
            got=", ".join(map(str, self._ids)),
        )
        self.rate, self.speed, self.effort = table.rate, table.speed, table.effort
        names = [[n for n in motor.joint if n in joints] for motor in motors]
        expect(
            all(len(own) == 1 for own in names),
            "--motors" if file else "--driver",
            f"each motor at one joint of the session, {', '.join(joints)}",
            got=", ".join("/".join(motor.joint) for motor in motors),
        )
        self.joint_names = tuple(name for (name,) in names)
        self.range = np.array([motor.range for motor in motors]).T
        places = np.array([(motor.zero, motor.ratio) for motor in motors])
        self._zero, self._ratio = places.T / self.buses[table.bus]
        self._port_name = port

    def _angles(self, places: np.ndarray) -> np.ndarray:
        """Return the angles of joints [rad] whose motors are at places [steps]."""
        return (places - self._zero) / self._ratio

    def _goals(self, q: np.ndarray) -> np.ndarray:
        """Return the places of motors [whole steps] whose joints are at angles [rad]."""
        return np.rint(self._zero + self._ratio * q)

    def _torques(self, values: np.ndarray) -> np.ndarray:
        """Return the torques of joints, shares of the largest, by what motors tell."""
        return np.sign(self._ratio) * values / self._table.full

    def _faults(self, states: Iterable[int], texts: Mapping[int, str]) -> Names:
        """Return what motors report: each bit that is set in their states, as its text."""
        return tuple(
            f"{name}: {text}"
            for name, state in zip(self.joint_names, states, strict=True)
            for bit, text in texts.items()
            if state >> bit & 1
        )
