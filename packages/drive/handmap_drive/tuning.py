"""What a hand makes of its commands, as its file says, and commands that make up for it."""

from collections.abc import Callable
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
from handmap_qp.se3 import Array
from .driver import Driver

STILL = 0.01
"""A command that turns back by less than this does not change the side of the play [rad]."""
TORQUE = 0.01
"""Torques below this are none, as shares of the largest."""
_MEETS = 0.02
"""Torque beyond friction and weights that says that something is in the way."""
SIDES = np.array([[-1.0], [1.0]])
"""To the lower and the upper end, shape (2, 1)."""
BOUNDS: dict[str, tuple[float, float]] = {
    "gain": (0.5, 1.6),
    "zero": (-0.5, 0.5),
    "delay": (0.0, 0.25),
    "backlash": (0.0, 0.5),
    "stretch": (0.0, 5.0),
    "friction": (0.0, 1.0),
    "lower": (-10.0, 10.0),
    "upper": (-10.0, 10.0),
    "encoder": (-0.5, 0.5),
    "weight": (0.0, 100.0),
}
"""Least and largest value of each number of a `Joint`, where it is written and where it is read.

A gain outside is that of another hand. A delay outside would cost memory.
"""


class Joint(Document, frozen=True):
    """What a joint makes of its commands, as in `Joints`; numbers are inside `BOUNDS`.

    Attributes:
        gain: Angle by which it moves per angle that it is commanded.
        zero: Where it is when it is commanded to be at 0 [rad].
        delay: Time from a command to its motion [s].
        backlash: Play between motor and joint [rad].
        stretch: How far it gives way to the largest torque [rad].
        friction: Torque that moves it, a share of the largest.
        lower: How far it can go, inside the limits of the hand's description [rad].
        upper: The same, to the other side.
        encoder: What its encoder misses of its angle, as meeting fingertips tell [rad].
        weight: Torque by that of the weights of links, a share of the largest per N m.
    """

    gain: float
    zero: float
    delay: float
    backlash: float
    stretch: float
    friction: float
    lower: float
    upper: float
    encoder: float = 0.0
    weight: float = 0.0


def check_joint(name: str, joint: Joint) -> None:
    """Check that the numbers of a joint are inside `BOUNDS`.

    Args:
        name: Where it is in its file.
        joint: The joint.

    Raises:
        InvalidInputError: With the field and its range.
    """
    values = astuple(joint)
    for (field, (low, high)), value in zip(BOUNDS.items(), values, strict=True):
        # NaN is in no range.
        is_inside = low <= value <= high
        expect(is_inside, f"{name}.{field}", f"{low:g} to {high:g}", value=value)
    expect(
        joint.lower <= joint.upper,
        f"{name}.lower",
        "at most upper",
        got=f"{joint.lower:g}, and upper {joint.upper:g}",
    )


class Joints(NamedTuple):
    """What joints make of their commands u: `q = gain u(t - delay) + zero - s band`.

    They move to the side s, 1 or -1, and lag by `band = backlash / 2 + stretch friction`, or by
    more or less where the weights of links pull.
    Attributes are arrays of those of each `Joint`, shape (n,).
    """

    gain: Array
    zero: Array
    delay: Array
    backlash: Array
    stretch: Array
    friction: Array
    lower: Array
    upper: Array
    encoder: Array
    weight: Array

    @property
    def range(self) -> Array:
        """Lower and upper ends [rad], shape (2, n)."""
        return np.array([self.lower, self.upper])

    def lag(self, side: Array | float, load: Array | float) -> Array:
        """Return how far they lag that move to a side, where links need a torque [N m]: [rad]."""
        torque = self.weight * load + side * self.friction
        # Where next to nothing pulls, they are anywhere in their play: in the middle by chance.
        pulled = np.clip(torque / TORQUE, -1.0, 1.0)
        return 0.5 * self.backlash * pulled + self.stretch * torque

    def meet(self, torque: Array, load: Array) -> Array:
        """Return which of them something is in the way of, by torques and loads as in `lag`."""
        return np.abs(torque - self.weight * load) > self.friction + _MEETS

    def command(self, q: Array, side: Array, load: Array) -> Array:
        """Return the commands that bring them to angles [rad]; side and load as in `lag`."""
        lag = self.lag(side, load)
        return (q - self.encoder - self.zero + lag) / self.gain

    def reached(self, u: Array, side: Array, load: Array) -> Array:
        """Return the angles to which commands bring them [rad], the inverse of `command`."""
        lag = self.lag(side, load)
        return self.gain * u + self.encoder + self.zero - lag


class Tuning(Document, frozen=True):
    """What `handmap calibrate-actuators` finds of one hand: `tuning` of its hand.yaml.

    Attributes:
        joints: Its joints with a motor.
        pinches: By finger, the gap to the thumb that encoders tell where the tips meet [m].

    Raises:
        InvalidInputError: If a number of a joint is outside `BOUNDS`.
    """

    joints: Annotated[dict[str, Joint], Meta(min_length=1)]
    pinches: dict[str, float] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        # Of a file that is read, and of one that will be written.
        for name, joint in self.joints.items():
            check_joint(f"tuning.joints.{name}", joint)

    @classmethod
    def of(cls, names: Names, joints: Joints, pinches: dict[str, float]) -> "Tuning":
        """Return the tuning of joints with these names, to four decimals [rad, s].

        Raises:
            InvalidInputError: If a number is outside `BOUNDS`.
        """
        rows = np.transpose(joints).round(4).tolist()
        found = {name: Joint(*row) for name, row in zip(names, rows, strict=True)}
        return cls(found, pinches)

    @property
    def stiffness(self) -> float | None:
        """Stiffness of the joints [N m/rad], the median of those of which it is known.

        A joint's largest torque is 1 / `weight` [N m], and stretches it by `stretch`. None where
        weights of links did not tell any.
        """
        known = [
            1.0 / (joint.weight * joint.stretch)
            for joint in self.joints.values()
            if joint.weight * joint.stretch > 0.0
        ]
        return float(np.median(known)) if known else None

    def arrays(self, names: Names) -> Joints:
        """Return what was found of joints in the order of names."""
        rows = [astuple(self.joints[name]) for name in names]
        return Joints(*np.transpose(rows))


def read_tuning(file: Path) -> Tuning:
    """Read what `handmap calibrate-actuators` found from a hand.yaml.

    Raises:
        HandError: If it is no hand.yaml, or the hand is not tuned.
    """
    spec = read_hand_spec(file)
    try:
        return msgspec.convert(spec.tuning, Tuning)
    except msgspec.ValidationError as error:
        problem = f"{reason_of(error)}: run `handmap calibrate-actuators`"
        raise HandError(problem, file=file, key="tuning") from error


def tuned(spec: HandSpec, tuning: Tuning, pushed: float = 0.0) -> HandSpec:
    """Return the description of a hand as it was found: the ranges of its joints are its limits.

    Args:
        spec: The hand's description.
        tuning: What was found.
        pushed: Torque by which contacts push joints; both ends keep what they give way by.
    """
    names = tuple(tuning.joints)
    joints = tuning.arrays(names)
    # Commands are ahead by the band, and a push goes through it and the play.
    way = joints.lag(1.0, 0.0) + 0.5 * joints.backlash + joints.stretch * pushed
    width = joints.upper - joints.lower
    slack = np.minimum(way * (pushed > 0.0), 0.45 * width)
    ends = joints.range - SIDES * slack
    ranges = dict(zip(names, ends.T.tolist(), strict=True))
    limits = {
        name: replace(spec.limits.get(name, LimitSpec()), lower=lower, upper=upper)
        for name, (lower, upper) in ranges.items()
    }

    def inside(posture: dict[str, float]) -> dict[str, float]:
        return {
            name: float(np.clip(at, *ranges.get(name, (at, at))))
            for name, at in posture.items()
        }

    return replace(
        spec,
        limits={**spec.limits, **limits},
        rest=inside(spec.rest),
        neutral_match=spec.neutral_match and inside(spec.neutral_match),
        tuning=msgspec.to_builtins(tuning),
    )


class Compensated:
    """Goals of motors that bring their joints where they should be; attributes as in `JointMap`.

    Goals stay in the motors' range and joints in that of the tuning. Joints wait for the slowest
    one, so that fingers meet as they should. `Gate` limits the speed of the goals.

    Args:
        driver: The motors.
        tuning: What is known of them.
        weights: Returns the torques that hold links by angles [N m]; nothing if omitted.

    Raises:
        InvalidInputError: If the tuning is that of another hand.
    """

    def __init__(
        self,
        driver: Driver,
        tuning: Tuning,
        weights: Callable[[Array], Array] = np.zeros_like,
    ) -> None:
        expect(
            {*driver.joint_names} == tuning.joints.keys(),
            "--tuning",
            f"a hand with the motors {', '.join(driver.joint_names)}",
            got=", ".join(tuning.joints),
            advice="`handmap calibrate-actuators` writes the file of each hand",
        )
        self.weights = weights
        self._limits = driver.range
        self._joints = joints = tuning.arrays(driver.joint_names)
        self.range = np.clip(joints.range, *driver.range)
        longest = joints.delay.max()
        self._late = (longest - joints.delay) * driver.rate
        self.restart(0.5 * self.range.sum(axis=0))

    def restart(self, q: Array) -> None:
        """See `JointMap`."""
        start = np.clip(q, *self.range)
        self._delayed = Delayed(self._late, start)
        # The side of the play is not known before a joint has moved.
        self._side = np.zeros_like(start)
        self._turn = start
        self._load = self.weights(start)

    def command(self, q: Array) -> Array:
        """See `JointMap`; each call is a turn."""
        goal = self._delayed(np.clip(q, *self.range))
        away = goal - self._turn
        self._side = np.where(np.abs(away) > STILL, np.sign(away), self._side)
        # It goes along, so that the way back begins where the way ended.
        self._turn = np.where(away * self._side > 0.0, goal, self._turn)
        self._load = self.weights(goal)
        pulled = self._joints.command(goal, self._side, self._load)
        return np.clip(pulled, *self._limits)

    def reached(self, goal: Array) -> Array:
        """See `JointMap`; by the sides and weights of the last command."""
        return self._joints.reached(goal, self._side, self._load)

    def angles(self, q: Array) -> Array:
        """See `JointMap`."""
        return q + self._joints.encoder

    def torques(self, share: Array) -> Array:
        """See `JointMap`; known of joints whose links have shown how much they weigh."""
        weight = self._joints.weight
        return share / np.where(weight > 0.0, weight, np.nan)


class Delayed:
    """Returns values as they were some turns ago, on straight lines between turns.

    Args:
        turns: How many turns ago, of each value, shape (n,).
        start: Values before the first turn, shape (n,).
    """

    def __init__(self, turns: Array, start: Array) -> None:
        longest = np.ceil(turns.max())
        ages = np.arange(longest + 1.0)[:, None]
        distances = np.abs(ages - turns)
        self._weights = np.maximum(1.0 - distances, 0.0)
        self._past = np.tile(start, (len(ages), 1))

    def __call__(self, values: Array) -> Array:
        """Take the values of a turn; return the late ones."""
        self._past = np.vstack([values, self._past[:-1]])
        weighted = self._weights * self._past
        return weighted.sum(axis=0)
