"""Hostile streams: samples of one hand, or of both hands of a robot, at hostile instants.

Hands come together, in turns, and at unequal rates; stamps repeat and go back; there are gaps, and
one hand is lost and comes back. A run follows time stamps (`Follower`, `RobotFollower`), or gives a
mapper the instants of its commands, or the times between them. Between samples the robot brakes, is
released, engages again, or gets another limit of acceleration. `checker.py` judges the commands by
their instants alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import hostile
import numpy as np
from checker import SHORTEST, Checker

from handmap_qp import Follower, HandmapError, HandMapper, HumanSample, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.robot import load_robot, robot_files
from handmap_qp.hands.spec import Side
from handmap_qp.human.sample import human_name
from handmap_qp.ik.limits import Motion
from handmap_qp.mapping.presets import get_preset
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.stream.robot_follower import RobotFollower

LIMITS = (None, 2.0, 10.0, 30.0, 100.0)
"""Limits of acceleration that runs have [rad/s^2, m/s^2]."""
RATES = (120.0, 90.0, 60.0, 45.0, 30.0, 10.0)
"""Rates of a hand's samples [Hz]."""
GAPS = (0.05, 0.1, 0.2, 0.3, 0.6, 2.0, 20.0)
"""Times without a sample [s]."""
_FIRST = 1.0 / 60.0  # what the first command takes [s]

Kind = Literal["stamps", "instants", "times"]


class Event(NamedTuple):
    """Hands that have a sample, with the time stamp of it [s]."""

    stamp: float
    sides: tuple[Side, ...]


def events(sides: tuple[Side, ...], rng: np.random.Generator) -> Iterator[Event]:
    """Yield hostile instants of the samples of hands, without end."""
    now = 1.0
    while True:
        rates = rng.choice(RATES, len(sides))
        if rng.random() < 0.5:
            rates[:] = rates[0]
        # Together, or each by itself; one hand may be lost.
        is_together = rng.random() < 0.3
        lost = rng.choice(sides) if len(sides) > 1 and rng.random() < 0.3 else ""
        following = now + rng.uniform(0.0, 1.0, len(sides)) / rates
        end = now + rng.uniform(0.1, 1.5)
        was_late = False
        while now < end:
            k = int(following.argmin())
            now = float(following[k])
            following[k] += 1.0 / rates[k]
            if rng.random() < 0.1:
                following[k] += rng.uniform(-0.4, 2.0) / rates[k]
            own = sides if is_together else (sides[k],)
            if lost in own:
                own = tuple(side for side in own if side != lost)
            if not own:
                continue
            kind = rng.random()
            if kind < 0.03 and not was_late:
                # Late, by less than what says that a clock was set.
                was_late = True
                yield Event(now - rng.uniform(0.0, 0.5), own)
                continue
            was_late = False
            yield Event(now, own)
            if kind > 0.97:
                yield Event(now, own)
        if rng.random() < 0.3:
            now += float(rng.choice(GAPS))


class Person:
    """Hands that move fast enough for limits, and smoothly enough for a guard.

    Args:
        sides: The hands.
        rng: Random numbers.
    """

    def __init__(self, sides: tuple[Side, ...], rng: np.random.Generator) -> None:
        self.hands = {
            side: load_hand(human_name(side), points="landmarks") for side in sides
        }
        self._rates = rng.uniform(1.0, 9.0, (len(sides), 7))
        self._phases = rng.uniform(0.0, 2.0 * np.pi, (len(sides), 7))

    def landmarks(self, side: Side, time: float) -> np.ndarray:
        """Return the landmarks of a hand at an instant [m], shape (21, 3)."""
        hand = self.hands[side]
        k = [*self.hands].index(side)
        waves = np.sin(self._rates[k] * time + self._phases[k])
        share = 0.5 + 0.5 * waves[0]
        q = hand.rest + share * (0.6 * hand.upper_limits - hand.rest)
        q = np.clip(q, hand.lower_limits, hand.upper_limits)
        wrist = np.eye(4)
        turn = 0.8 * waves[1:4]
        cosines, sines = np.cos(turn), np.sin(turn)
        for i, (cos, sin) in enumerate(zip(cosines, sines, strict=True)):
            rotation = np.eye(3)
            a, b = (i + 1) % 3, (i + 2) % 3
            rotation[[a, b], [a, b]] = cos
            rotation[a, b], rotation[b, a] = -sin, sin
            wrist[:3, :3] = wrist[:3, :3] @ rotation
        sign = 1.0 if side == "left" else -1.0
        wrist[:3, 3] = 0.25 * waves[4:7] + np.array([0.0, 0.3 * sign, 0.0])
        return hand.points(q, wrist)


class StreamRun:
    """One stream of a hand, or of both hands of a robot.

    Args:
        name: The hand or the robot.
        seed: Seed of the random numbers.
    """

    def __init__(self, name: str, seed: int) -> None:
        rng = self._rng = np.random.default_rng(seed)
        kinds: tuple[Kind, ...] = ("stamps", "instants", "times")
        self._kind: Kind = kinds[int(rng.integers(len(kinds)))]
        self.name = f"{name}, {self._kind}, seed {seed}"
        preset = get_preset("teleoperation")
        self._ik = preset.ik
        ik = self._ik.replaced(max_acceleration=LIMITS[rng.integers(len(LIMITS))])
        self._is_robot = name in robot_files()
        self._mapper: Any
        self._follower: Any
        if self._is_robot:
            robot = load_robot(name)
            sides: tuple[Side, ...] = tuple(robot.by_side)
            self._person = Person(sides, rng)
            self._mapper = RobotMapper(
                robot, self._person.hands, "teleoperation", ik=ik
            )
            self._follower = RobotFollower(self._mapper)
        else:
            robot = load_hand(name, mount="fixed" if rng.random() < 0.3 else None)
            sides = (robot.side,)
            self._person = Person(sides, rng)
            (human,) = self._person.hands.values()
            self._mapper = HandMapper(human, robot, "teleoperation", ik=ik)
            self._follower = Follower(self._mapper)
        self._events = events(sides, rng)
        self.checker = Checker(self._mapper.robot)
        self._is_placed = not self.robot.is_floating
        self._is_started = False
        self._last = 0.0

    @property
    def robot(self) -> Hand:
        """What moves."""
        return self._mapper.robot

    def advance(self, count: int, tally: hostile.Tally) -> None:
        """Take steps into the tally."""
        for _ in range(count):
            event = next(self._events)
            try:
                self._interrupt()
                step = self._take(event)
            except HandmapError as error:
                tally.refused[type(error).__name__] += 1
                continue
            except Exception as error:
                hostile.note(tally, self.name, error)
                return
            tally.statuses[step.status] += 1
            tally.check_finite(step.command.q, step.targets, step.points)
            self._judge(step.command, event.stamp)

    def _take(self, event: Event) -> Any:
        """Let the robot take samples."""
        if not self._is_started:
            self.checker.start(self._mapper.motion.q, event.stamp - _FIRST)
            self._last = event.stamp - _FIRST
            self._is_started = True
        landmarks = {
            side: self._person.landmarks(side, event.stamp) for side in event.sides
        }
        if self._kind == "stamps":
            is_valid = self._rng.random() > 0.02
            samples = {
                side: HumanSample(event.stamp, side, points, None, is_valid, 1.0)
                for side, points in landmarks.items()
            }
            if self._is_robot:
                return self._follower.map_samples(samples)
            (sample,) = samples.values()
            return self._follower.map_sample(sample)
        # The first command of a clock takes the mapper's own time.
        times = {"time": event.stamp}
        if self._kind == "times":
            times = {"dt": max(event.stamp - self._last, SHORTEST)}
        if self._is_robot:
            return self._mapper.map_landmarks(landmarks, **times)
        (points,) = landmarks.values()
        return self._mapper.map_landmarks(points, **times)

    def _judge(self, command: Any, stamp: float) -> None:
        """Judge a command at an instant [s]."""
        robot = self.robot
        wrist = command.wrist if robot.is_floating else None
        vector = robot.configuration_vector(command.q, wrist)
        if not self._is_placed:
            # It has moved from the posture of its reference already.
            self._is_placed = True
            self._mapper.motion = Motion.at_rest(
                vector, self._mapper.point_ik.configuration.nv
            )
            self.checker.start(vector, max(stamp, self.checker.time))
        else:
            self.checker.take(vector, stamp, self._mapper.ik.max_acceleration)
        self._last = self.checker.time

    def _interrupt(self) -> None:
        """Do something between samples, now and then."""
        mapper, rng = self._mapper, self._rng
        kind = rng.integers(200)
        if kind == 0:
            mapper.release()
        elif kind in (1, 2, 3):
            mapper.clutch()
        elif kind == 4:
            limit = LIMITS[rng.integers(len(LIMITS))]
            mapper.configure(ik=self._ik.replaced(max_acceleration=limit))
        elif kind == 5 and not self._is_robot and self._is_started and self._is_placed:
            # A stop of somebody else takes time that the next sample then has not.
            dt = float(10.0 ** rng.uniform(-3.0, -1.5))
            self._judge(mapper.hold(dt).command, self._last + dt)
