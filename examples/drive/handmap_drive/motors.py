"""Tables of motors: YAML files that say which motor belongs to which joint."""

from pathlib import Path
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct

from handmap_qp.apps.refusals import naming
from handmap_qp.errors import InvalidInputError, expect, reason_of
from handmap_qp.hands import Names


class Motor(Struct, frozen=True, forbid_unknown_fields=True):
    """A motor and its joint.

    Attributes:
        joint: Name of the joint; several if models of the hand differ.
        id: Number of the motor on its bus, or its place in the registers of the hand.
        range: Least and largest angle of the joint [rad].
        zero: Where the motor is when the joint is at 0 [rad, or units of the hand].
        ratio: How far it moves per rad of the joint; negative if it turns the other way.
    """

    joint: Names
    id: int
    range: tuple[float, float]
    zero: float
    ratio: float = 1.0


class Motors(Struct, frozen=True, forbid_unknown_fields=True):
    """A table of motors.

    Attributes:
        baud: Speed of the port [bit/s].
        rate: As of `Driver`.
        speed: As of `Driver`.
        effort: As of `Driver`.
        full: The largest torque, in units of the motors.
        motors: The motors.
        bus: Family of servos, or the hand.
        address: Number of a hand on its bus.
        setup: Further registers of servos to write at the start: address, bytes, value.
    """

    baud: int
    rate: float
    speed: float
    effort: float
    full: int
    motors: Annotated[tuple[Motor, ...], Meta(min_length=1)]
    bus: Literal["dynamixel", "feetech", "inspire", "ability"] = "dynamixel"
    address: int = 1
    setup: tuple[tuple[int, int, int], ...] = ()


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
    """What drivers with a table share; attributes as of `Driver`.

    Args:
        own: Name of the package's table; empty if there is none.
        port: The port.
        joints: Joints of the session; those without a motor are left out.
        file: The user's table, in place of the package's.

    Raises:
        InvalidInputError: If the table cannot be used, or has joints that the session does not.
    """

    buses: ClassVar[Names]
    numbers: ClassVar[range]
    """What `bus` and the `id` of a motor may be in the table."""

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
            {*self._ids} <= {*self.numbers},
            "--motors",
            f"each id in {self.numbers[0]} to {self.numbers[-1]}",
            got=", ".join(map(str, self._ids)),
        )
        self.rate, self.speed, self.effort = table.rate, table.speed, table.effort
        self.joint_names = tuple(n for m in motors for n in m.joint if n in joints)
        expect(
            len(self.joint_names) == len(motors),
            "--motors",
            f"joints of the session, {', '.join(joints)}",
            got=", ".join(motor.joint[0] for motor in motors),
        )
        self.range = np.array([motor.range for motor in motors]).T
        places = np.array([(motor.zero, motor.ratio) for motor in motors])
        self._zero, self._ratio = places.T
        self._port_name = port
