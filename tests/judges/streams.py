"""Hostile streams: samples of one hand, or of both hands of a robot, at hostile instants.

Hands come together, in turns, and at unequal rates; stamps repeat and go back; there are gaps, and
one hand is lost and comes back. A run follows time stamps (`Follower`, `RobotFollower`), some with
times of arrival, or gives a mapper the instants of its commands, or the times between them. Between
samples the robot brakes, is
released, engages again, or gets another limit of acceleration. `checker.py` judges the commands by
their instants alone. Landmarks are computed, and commands are judged, many at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby, islice
from typing import Any, Literal, NamedTuple

import hostile
import numpy as np
import pinocchio as pin
from checker import SHORTEST, Checker, counted

from handmap_core.human.sample import human_name
from handmap_core.ik.motion import Motion
from handmap_qp import Follower, HandmapError, HandMapper, HumanSample, load_hand
from handmap_qp.hands import Side
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.robot import load_robot, robot_files
from handmap_qp.mapping.hand_pair import points_in_palm
from handmap_qp.mapping.presets import get_preset
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.se3 import transform_points
from handmap_qp.stream.guard import GAP
from handmap_qp.stream.robot_follower import RobotFollower

ROBOTS = ("g1", "ur5_pair", "panda_pair", "romeo", "tiago_dual", "alex")
"""Robots with two hands."""
LIMITS = (None, 2.0, 10.0, 30.0, 100.0)
"""Limits of acceleration that runs have [rad/s^2, m/s^2]."""
RATES = (120.0, 90.0, 60.0, 45.0, 30.0, 10.0)
"""Rates of a hand's samples [Hz]."""
GAPS = (0.05, 0.1, 0.2, 0.3, 0.6, 2.0, 20.0)
"""Times without a sample [s]."""
JITTERS = (0.0, 0.001, 0.004, 0.02)
"""Largest delays of a sample on its way [s]."""
PACKETS = (0.0, 0.0, 0.03, 0.1, 0.2)
"""Periods at which all samples since the last packet arrive at once [s]; 0 for each by itself."""
_FIRST = 1.0 / 60.0  # what the first command takes [s]
_AHEAD = 200  # events whose landmarks are computed at a time

Kind = Literal["stamps", "instants", "times"]


class Event(NamedTuple):
    """Hands that have a sample, with the time stamp of it [s]."""

    stamp: float
    sides: tuple[Side, ...]


class Sample(NamedTuple):
    """Landmarks of the hands that have a sample [m], shape (21, 3), with its time stamp [s]."""

    stamp: float
    landmarks: dict[Side, np.ndarray]


class Commanded(NamedTuple):
    """A command that waits to be judged.

    Attributes:
        q: Joint positions [rad or m], shape (n,).
        wrist: Pose of the wrist, shape (4, 4); None if it is fixed.
        stamp: Time stamp [s].
        limit: Limit of acceleration that it was given under [rad/s^2]; None for none.
    """

    q: np.ndarray
    wrist: np.ndarray | None
    stamp: float
    limit: float | None


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

    def samples(self, instants: Iterator[Event]) -> Iterator[Sample]:
        """Yield the samples of events."""
        while ahead := [*islice(instants, _AHEAD)]:
            stamps = np.array([event.stamp for event in ahead])
            rows = {side: self.landmarks(side, stamps) for side in self.hands}
            for k, event in enumerate(ahead):
                yield Sample(event.stamp, {side: rows[side][k] for side in event.sides})

    def landmarks(self, side: Side, times: np.ndarray) -> np.ndarray:
        """Return the landmarks of a hand [m], shape (T, 21, 3), at instants [s], shape (T,)."""
        hand = self.hands[side]
        k = [*self.hands].index(side)
        waves = np.sin(self._rates[k] * times[:, None] + self._phases[k])
        share = 0.5 + 0.5 * waves[:, :1]
        q = hand.rest + share * (0.6 * hand.upper_limits - hand.rest)
        q = np.clip(q, hand.lower_limits, hand.upper_limits)
        wrists = np.tile(np.eye(4), (len(times), 1, 1))
        for axis in range(3):
            turns = _turns(axis, 0.8 * waves[:, 1 + axis])
            wrists[:, :3, :3] = wrists[:, :3, :3] @ turns
        sign = 1.0 if side == "left" else -1.0
        wrists[:, :3, 3] = 0.25 * waves[:, 4:7] + np.array([0.0, 0.3 * sign, 0.0])
        return transform_points(wrists @ hand.wrist_to_palm, points_in_palm(hand, q))


def _turns(axis: int, angles: np.ndarray) -> np.ndarray:
    """Return rotations about a coordinate axis by angles [rad], shape (T, 3, 3)."""
    turns = np.tile(np.eye(3), (len(angles), 1, 1))
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turns[:, a, a] = turns[:, b, b] = np.cos(angles)
    turns[:, b, a] = np.sin(angles)
    turns[:, a, b] = -turns[:, b, a]
    return turns


class Arrivals:
    """When samples arrive: one after the other, behind a delay that varies, or many at once.

    No stall is longer than a follower promises to accept (`GAP`). Half of all streams do not know
    arrivals, and half of the others know those of half of their samples.

    Args:
        rng: Random numbers.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._known = float(rng.choice([0.0, 0.0, 0.5, 1.0]))
        self._jitter = float(rng.choice(JITTERS))
        self._packet = float(rng.choice(PACKETS))
        self._stamp = -np.inf
        self._last = -np.inf

    def arrival(self, stamp: float) -> float | None:
        """Return when the next sample arrives [s], by its time stamp; None if it is not known."""
        arrival = stamp + self._rng.uniform(0.0, self._jitter)
        if self._packet > 0.0:
            arrival = float(np.ceil(arrival / self._packet)) * self._packet
        # What the stamp adds to the last one is part of the stall.
        longest = max(GAP - max(stamp - self._stamp, 0.0), 0.0)
        self._last = max(self._last, min(arrival, stamp + longest))
        self._stamp = max(self._stamp, stamp)
        return self._last if self._rng.random() < self._known else None


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
        # Events have random numbers of their own, because they are drawn ahead.
        ahead, arriving = rng.spawn(2)
        self._arrivals = Arrivals(arriving)
        self._samples = self._person.samples(events(sides, ahead))
        self.checker = Checker(self._mapper.robot)
        self._waiting: list[Commanded] = []
        self._is_placed = not self.robot.is_floating
        self._is_started = False
        self._last = 0.0

    @property
    def robot(self) -> Hand:
        """What moves."""
        return self._mapper.robot

    def advance(self, count: int, tally: hostile.Tally) -> None:
        """Take steps into the tally; all commands are judged when it returns."""
        try:
            self._steps(count, tally)
        finally:
            self._judge_waiting()

    def _steps(self, count: int, tally: hostile.Tally) -> None:
        for sample in islice(self._samples, count):
            try:
                self._interrupt()
                step = self._take(sample)
            except HandmapError as error:
                tally.refused[type(error).__name__] += 1
                continue
            except Exception as error:
                hostile.note(tally, self.name, error)
                return
            tally.statuses[step.status] += 1
            tally.check_finite(step.command.q, step.targets, step.points)
            self._judge(step.command, sample.stamp)

    def _take(self, sample: Sample) -> Any:
        """Let the robot take samples."""
        stamp, landmarks = sample
        if not self._is_started:
            self._last = stamp - _FIRST
            self.checker.start(self._mapper.motion.q, self._last)
            self._is_started = True
        if self._kind == "stamps":
            is_valid = self._rng.random() > 0.02
            samples = {
                side: HumanSample(stamp, side, points, None, is_valid, 1.0)
                for side, points in landmarks.items()
            }
            arrival = self._arrivals.arrival(stamp)
            if self._is_robot:
                return self._follower.map_samples(samples, arrival=arrival)
            (only,) = samples.values()
            return self._follower.map_sample(only, arrival=arrival)
        # The first command of a clock takes the mapper's own time.
        times = {"time": stamp}
        if self._kind == "times":
            times = {"dt": max(stamp - self._last, SHORTEST)}
        if self._is_robot:
            return self._mapper.map_landmarks(landmarks, **times)
        (points,) = landmarks.values()
        return self._mapper.map_landmarks(points, **times)

    def _judge(self, command: Any, stamp: float) -> None:
        """Judge a command at an instant [s], together with those that follow it."""
        self._last = counted(stamp, self._last)
        # Copies, so that the command is judged as it was given, whatever becomes of its arrays.
        wrist = command.wrist.copy() if self.robot.is_floating else None
        limit = self._mapper.ik.max_acceleration
        self._waiting.append(Commanded(command.q.copy(), wrist, stamp, limit))
        if not self._is_placed:
            # It has moved from the posture of its reference already.
            self._is_placed = True
            (vector,) = configurations(self.robot, self._waiting)
            self._waiting.clear()
            self._mapper.motion = Motion.at_rest(
                vector, self._mapper.point_ik.configuration.nv
            )
            self.checker.start(vector, self._last)

    def _judge_waiting(self) -> None:
        """Judge the commands that wait, all of one limit in one call."""
        waiting, self._waiting = self._waiting, []
        for limit, group in groupby(waiting, key=lambda each: each.limit):
            commands = [*group]
            stamps = np.array([each.stamp for each in commands])
            self.checker.take(configurations(self.robot, commands), stamps, limit)

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


def configurations(robot: Hand, commands: list[Commanded]) -> np.ndarray:
    """Return the Pinocchio configurations of commands, shape (T, nq).

    Joints that follow others stay at zero: a judge without shapes does not look at them. Numbers
    that are not finite stay what they are, so that the judge finds them.

    Args:
        robot: The robot.
        commands: Its commands.
    """
    vectors = np.zeros((len(commands), robot.model.nq))
    vectors[:, robot.q_indices] = [each.q for each in commands]
    if robot.is_floating:
        root = pin.XYZQUATToSE3(robot.configuration_vector(robot.rest)[:7])
        for vector, each in zip(vectors, commands, strict=True):
            vector[:7] = pin.SE3ToXYZQUAT(pin.SE3(each.wrist) * root)
    return vectors
