"""Tables of motors: YAML files that say which motor belongs to which joint."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from handmap_qp.apps.refusals import naming
from handmap_qp.errors import InvalidInputError, reason_of
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
        bus: Family of servos.
        setup: Further registers to write at the start: address, bytes, value.
    """

    baud: int
    rate: float
    speed: float
    effort: float
    full: int
    motors: Annotated[tuple[Motor, ...], Meta(min_length=1)]
    bus: Literal["dynamixel", "feetech"] = "dynamixel"
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
