"""What a hand makes of its commands, as its file says, and commands that make up for it."""

from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from msgspec.structs import replace

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
    """What a joint makes of its commands u: `q = gain u(t - delay) + zero - s band`.

    It moves to the side s, 1 or -1, and lags by `band = backlash / 2 + stretch friction`.

    Attributes:
        gain: Angle by which it moves per angle that it is told.
        zero: Where it is when it is told to be at 0 [rad].
        delay: Time from a command to its motion [s].
        backlash: Play between motor and joint [rad].
        stretch: How far it gives way to the largest torque [rad].
        friction: Torque that moves it, a share of the largest.
        range: Where it can go, inside the limits of the hand's description [rad].
        encoder: What its encoder misses of its angle, as meeting fingertips tell [rad].
    """

    gain: Annotated[float, Meta(gt=0.0)]
    zero: float
    delay: _Least
    backlash: _Least
    stretch: _Least
    friction: _Least
    range: tuple[float, float]
    encoder: float = 0.0

    @property
    def band(self) -> float:
        """How far it lags behind what it is told [rad]."""
        return 0.5 * self.backlash + self.stretch * self.friction


class Tuning(Document, frozen=True):
    """What `handmap tune` finds of one hand: `tuning` of its hand.yaml.

    Attributes:
        joints: Its joints with a motor.
        pinches: By finger, the gap to the thumb that encoders tell where the tips meet [m].
    """

    joints: Annotated[dict[str, Joint], Meta(min_length=1)]
    pinches: dict[str, float] = msgspec.field(default_factory=dict)


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
    for name, joint in tuning.joints.items():
        low, high = joint.range
        slack = min(kept * joint.band, 0.45 * (high - low))
        ends = low + slack, high - slack
        limits[name] = replace(
            limits.get(name, LimitSpec()), lower=ends[0], upper=ends[1]
        )
        for posture in (rest, matched):
            if name in posture:
                posture[name] = float(np.clip(posture[name], *ends))
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
        joints = [tuning.joints[name] for name in driver.joint_names]
        self.rate, self.speed, self.effort = driver.rate, driver.speed, driver.effort
        self._encoder = np.array([joint.encoder for joint in joints])
        ranges = np.array([joint.range for joint in joints]).T
        self.range = np.clip(ranges, *driver.range)
        self._gain = np.array([joint.gain for joint in joints])
        self._zero = np.array([joint.zero for joint in joints])
        self._band = np.array([joint.band for joint in joints])
        delays = np.array([joint.delay for joint in joints])
        self._late = (delays.max() - delays) * self.rate
        self._told: np.ndarray | None = None

    def connect(self) -> None:
        """See `Driver`."""
        self._driver.connect()

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        """See `Driver`."""
        q, torque, health = self._driver.read()
        return q + self._encoder, torque, health

    def write(self, q: np.ndarray, effort: float) -> None:
        """See `Driver`."""
        goal = np.clip(q, *self.range)
        if self._told is None:
            self._turn, self._side = goal, np.zeros_like(goal)
            self._goals = [goal] * (2 + int(self._late.max()))
        goal = self._together(goal)
        away = goal - self._turn
        turns = np.abs(away) > STILL
        self._side = np.where(turns, np.sign(away), self._side)
        # It goes along, so that the way back begins where the way ended.
        self._turn = np.where(turns | (away * self._side > 0.0), goal, self._turn)
        pulled = goal - self._encoder - self._zero + self._side * self._band
        told = np.clip(pulled / self._gain, *self._driver.range)
        if self._told is not None:
            step = self.speed / self.rate
            told = self._told + np.clip(told - self._told, -step, step)
        self._told = told
        self._driver.write(told, effort)

    def _together(self, goal: np.ndarray) -> np.ndarray:
        """Return the goals that joints reach together with the slowest one's goal now."""
        self._goals = [*self._goals[1:], goal]
        ago = np.floor(self._late).astype(int)
        newer, older = (
            np.choose(ago + k, self._goals[::-1], mode="clip") for k in (0, 1)
        )
        return newer + (self._late - ago) * (older - newer)

    def stop(self) -> None:
        """See `Driver`."""
        self._told = None
        self._driver.stop()
