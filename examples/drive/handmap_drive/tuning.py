"""What a hand makes of its commands, as its file says, and commands that make up for it."""

from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta
from msgspec.structs import astuple, replace

from handmap_qp.errors import HandError, expect, reason_of
from handmap_qp.hands import (
    Document,
    HandSpec,
    LimitSpec,
    Names,
    read_hand_spec,
)
from .driver import Driver, Health

STILL = 0.01
"""A command that turns back by less than this does not change the side of the play [rad]."""
_Least = Annotated[float, Meta(ge=0.0)]


class Joint(Document, frozen=True):
    """What a joint makes of its commands, as of `Joints`.

    Attributes:
        gain: Angle by which it moves per angle that it is told.
        zero: Where it is when it is told to be at 0 [rad].
        delay: Time from a command to its motion [s].
        backlash: Play between motor and joint [rad].
        stretch: How far it gives way to the largest torque [rad].
        friction: Torque that moves it, a share of the largest.
        lower: How far it can go, inside the limits of the hand's description [rad].
        upper: The same, to the other side.
        encoder: What its encoder misses of its angle, as meeting fingertips tell [rad].
    """

    gain: Annotated[float, Meta(gt=0.0)]
    zero: float
    delay: _Least
    backlash: _Least
    stretch: _Least
    friction: _Least
    lower: float
    upper: float
    encoder: float = 0.0


class Joints(NamedTuple):
    """What joints make of their commands u: `q = gain u(t - delay) + zero - s band`.

    They move to the side s, 1 or -1, and lag by `band = backlash / 2 + stretch friction`.
    Attributes are arrays of those of each `Joint`, shape (n,).
    """

    gain: np.ndarray
    zero: np.ndarray
    delay: np.ndarray
    backlash: np.ndarray
    stretch: np.ndarray
    friction: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    encoder: np.ndarray

    @property
    def band(self) -> np.ndarray:
        """How far they lag behind what they are told [rad]."""
        return 0.5 * self.backlash + self.stretch * self.friction

    @property
    def range(self) -> np.ndarray:
        """Lower and upper ends [rad], shape (2, n)."""
        return np.array([self.lower, self.upper])

    def command(self, q: np.ndarray, side: np.ndarray) -> np.ndarray:
        """Return the commands that bring them to angles [rad] from a side of their play."""
        return (q - self.encoder - self.zero + side * self.band) / self.gain


class Tuning(Document, frozen=True):
    """What `handmap tune` finds of one hand: `tuning` of its hand.yaml.

    Attributes:
        joints: Its joints with a motor.
        pinches: By finger, the gap to the thumb that encoders tell where the tips meet [m].
    """

    joints: Annotated[dict[str, Joint], Meta(min_length=1)]
    pinches: dict[str, float] = msgspec.field(default_factory=dict)

    @classmethod
    def of(cls, names: Names, joints: Joints, pinches: dict[str, float]) -> "Tuning":
        """Return the tuning of joints with these names, to four decimals [rad, s]."""
        rows = np.transpose(joints).round(4).tolist()
        found = zip(names, (Joint(*row) for row in rows), strict=True)
        return cls(dict(found), pinches)

    def arrays(self, names: Names) -> Joints:
        """Return what was found of joints in the order of names."""
        rows = [astuple(self.joints[name]) for name in names]
        return Joints(*np.transpose(rows))


def read_tuning(file: Path) -> Tuning:
    """Read what `handmap tune` found from a hand.yaml.

    Raises:
        HandError: If it is no hand.yaml, or the hand is not tuned.
    """
    spec = read_hand_spec(file)
    try:
        return msgspec.convert(spec.tuning, Tuning)
    except msgspec.ValidationError as error:
        problem = f"{reason_of(error)}: run `handmap tune`"
        raise HandError(problem, file=file, key="tuning") from error


def tuned(spec: HandSpec, tuning: Tuning, kept: float = 0.0) -> HandSpec:
    """Return the description of a hand as it was found: the ranges of its joints are its limits.

    Args:
        spec: The hand's description.
        tuning: What was found.
        kept: How often the band that joints lag by is kept from both ends.
    """
    limits, rest, matched = dict(spec.limits), dict(spec.rest), dict(spec.matched or {})
    joints = tuning.arrays(names := tuple(tuning.joints))
    slack = np.minimum(kept * joints.band, 0.45 * (joints.upper - joints.lower))
    ends = np.transpose([joints.lower + slack, joints.upper - slack]).tolist()
    for name, (lower, upper) in zip(names, ends, strict=True):
        limit = limits.get(name, LimitSpec())
        limits[name] = replace(limit, lower=lower, upper=upper)
        for posture in (rest, matched):
            if name in posture:
                posture[name] = float(np.clip(posture[name], lower, upper))
    found = msgspec.to_builtins(tuning)
    return replace(
        spec, limits=limits, rest=rest, matched=matched or None, tuning=found
    )


class Compensated:
    """Motors whose joints go where they are told; attributes as of `Driver`.

    Goals stay in the motors' range and joints in that of the tuning. No motor is told to be faster
    than before. Joints wait for the slowest one, so that fingers meet as they should.

    Args:
        driver: The motors.
        tuning: What is known of them.

    Raises:
        InvalidInputError: If the tuning is that of another hand.
    """

    def __init__(self, driver: Driver, tuning: Tuning) -> None:
        self._driver = driver
        self.joint_names: Names = driver.joint_names
        expect(
            {*driver.joint_names} == tuning.joints.keys(),
            "--tuning",
            f"a hand with the motors {', '.join(driver.joint_names)}",
            got=", ".join(tuning.joints),
            advice="`handmap tune` writes the file of each hand",
        )
        self.rate, self.speed, self.effort = driver.rate, driver.speed, driver.effort
        self._joints = joints = tuning.arrays(driver.joint_names)
        self.range = np.clip(joints.range, *driver.range)
        self._late = (np.max(joints.delay) - joints.delay) * driver.rate
        self._told: np.ndarray | None = None

    def connect(self) -> None:
        """See `Driver`."""
        self._driver.connect()

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        """See `Driver`."""
        q, torque, health = self._driver.read()
        return q + self._joints.encoder, torque, health

    def write(self, q: np.ndarray, effort: float) -> None:
        """See `Driver`."""
        self._driver.write(self.command(q), effort)

    def command(self, q: np.ndarray) -> np.ndarray:
        """Return what motors are told in a turn so that joints go where they should [rad]."""
        goal = np.clip(q, *self.range)
        step = self.speed / self.rate
        if self._told is None:
            self._delayed = Delayed(self._late, goal)
            self._turn, self._side = goal, np.zeros_like(goal)
            self._told, step = goal, np.inf
        goal = self._delayed(goal)
        away = goal - self._turn
        turns = np.abs(away) > STILL
        self._side = np.where(turns, np.sign(away), self._side)
        # It goes along, so that the way back begins where the way ended.
        self._turn = np.where(turns | (away * self._side > 0.0), goal, self._turn)
        pulled = self._joints.command(goal, self._side)
        told = np.clip(pulled, *self._driver.range)
        self._told = self._told + np.clip(told - self._told, -step, step)
        return self._told

    def stop(self) -> None:
        """See `Driver`."""
        self._told = None
        self._driver.stop()


class Delayed:
    """Returns values as they were some turns ago, on straight lines between turns.

    Args:
        turns: How many turns ago, of each value, shape (n,).
        start: Values before the first turn, shape (n,).
    """

    def __init__(self, turns: np.ndarray, start: np.ndarray) -> None:
        ages = np.arange(np.ceil(turns.max()) + 1.0)[:, None]
        self._weights = np.clip(1.0 - np.abs(ages - turns), 0.0, None)
        self._past = np.tile(start, (len(ages), 1))

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Take the values of a turn; return the late ones."""
        self._past = np.vstack([values, self._past[:-1]])
        return np.sum(self._weights * self._past, axis=0)
