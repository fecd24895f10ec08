"""Hostile random steps, and a tally of their results.

`IkRun` runs the inverse kinematics alone, from postures inside, at and outside limits to targets
near, far and absurd. `MapperRun` runs the whole mapping with samples of a human hand, some of them
invalid, and changes its acceleration limit. `FollowerRun` and `RobotRun` follow time stamps: those
of a hand alone, and those of both hands of a robot in turns, at unequal rates, with gaps, with
stamps that repeat or go back, one hand lost and back. `checker.Checker` judges the motion of all by
the instants of the commands; NaN, infinities and undocumented exceptions are counted here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Protocol

import numpy as np
import pinocchio as pin
from checker import SHORTEST, Checker

from handmap_core.ik.motion import Motion
from handmap_qp import (
    HandmapError,
    HandMapper,
    IkOptions,
    MappingOptions,
    MapStep,
    MissingExtraError,
    hand_names,
    load_hand,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs
from handmap_qp.hands.spec import Mount
from handmap_qp.ik.qp import PointIk
from handmap_qp.se3 import nearest_rotation

MOST_OUTSIDE = 0.5
"""Largest distance of a joint from inside its limits at the start [rad]."""
FARTHEST = 1e9
"""Largest distance of targets [m]."""
MAPPINGS: tuple[dict[str, Any], ...] = (
    {},
    {"rigid_from": "wrist"},
    {"rigid_from": "none"},
    {"rigid_from": "wrist", "pivot": "palm", "residual_gain": 0.5},
    {"alignment": "palm", "deformation_gain": 0.5, "scale": 2.0},
    {"reference": "previous"},
    {"reference": "previous", "rigid_from": "none", "ridge": 0.01},
    {"pivot": "world", "ridge": 0.0},
)

IKS: tuple[IkOptions, ...] = (
    IkOptions(),
    IkOptions(avoids_self_collision=True),
    IkOptions(max_acceleration=50.0),
    IkOptions(error_damping=0.0, damping=0.01, rest_weight=0.0, max_iterations=5),
)

LIMITS = (None, 1.0, 10.0, 100.0)
"""Acceleration limits that a mapper changes between [rad/s^2]."""
MARGINS = (-0.001, 0.006)
"""Least and largest margin of a pair of shapes [m]."""
_BATCH, _STRETCH, _TRIES = 200, 20, 30


@dataclass(slots=True)
class Tally:
    """Results of the steps.

    Attributes:
        steps: Number of steps.
        violations: Number of steps by what they violate; see `Checker`.
        worst: Worst figures; see `Checker`.
        not_finite: Number of results with a NaN or an infinity.
        statuses: Number of results by status.
        refused: Number of documented errors by class.
        undocumented: Other exceptions, and rejections that moved the hand: the first few, with
            their runs.
        found: Runs that violate something, what, and where first.
        postures: Number of postures that were examined for overlaps.
    """

    steps: int = 0
    violations: Counter[str] = field(default_factory=Counter)
    worst: dict[str, float] = field(default_factory=dict)
    not_finite: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    undocumented: list[str] = field(default_factory=list)
    found: list[str] = field(default_factory=list)
    postures: int = 0

    @property
    def is_exact(self) -> bool:
        """Whether all limits held, all results are finite and all exceptions are documented."""
        wrong = self.violations.total() + self.not_finite + len(self.undocumented)
        return wrong == 0

    def check_finite(self, *arrays: np.ndarray) -> None:
        """Count a result whose arrays are not all finite."""
        self.not_finite += not all(np.isfinite(array).all() for array in arrays)

    def add(self, checker: Checker, name: str = "") -> None:
        """Add what the judge of a run found, under the name of the run."""
        self._count(checker)
        self.found += [
            f"{name}: {what} at command {first}, {checker.violations[what]} in all, "
            f"worst {checker.worst[what]:.9g}"
            for what, first in checker.first.items()
        ]

    def merge(self, other: Tally) -> None:
        """Add the results of other steps."""
        self._count(other)
        self.steps += other.steps
        self.not_finite += other.not_finite
        self.statuses += other.statuses
        self.refused += other.refused
        self.found += other.found
        self.undocumented += other.undocumented

    def _count(self, other: Checker | Tally) -> None:
        self.postures += other.postures
        self.violations += other.violations
        for what, value in other.worst.items():
            self.worst[what] = max(self.worst.get(what, -np.inf), value)


class IkRun:
    """Steps of the inverse kinematics on one hand.

    Stretches of steps go to one place each: to a random posture, to one point of all fingers,
    turned inside out, or far away, with noise of every size. Between batches the acceleration limit
    changes, the hand brakes without targets, or is placed somewhere else.

    Args:
        hand: The hand.
        options: Options of the inverse kinematics.
        seed: Seed of the random numbers.
        shapes: Pairs of shapes to keep apart and to judge; none if omitted.
        paths: As of `Checker`.
        limits: Acceleration limits that it changes between [rad/s^2]; that of the options if
            omitted.
    """

    def __init__(
        self,
        hand: Hand,
        options: IkOptions,
        seed: int,
        shapes: ShapePairs | None = None,
        *,
        paths: int = 1,
        limits: Sequence[float | None] = (),
    ) -> None:
        self.name = f"ik on {hand.name}, {hand.mount}, seed {seed}"
        self._hand, self._rng = hand, np.random.default_rng(seed)
        if hand.spec.collision is None:
            options = options.replaced(avoids_self_collision=False)
        self.ik = PointIk(hand, options, contacts=shapes)
        self.checker, self._shapes = Checker(hand, shapes, paths), shapes
        self._limits = limits or (options.max_acceleration,)
        self._iks = {options.max_acceleration: self.ik}
        self._place()

    def advance(self, count: int, tally: Tally) -> None:
        """Take steps into the tally."""
        while count > 0:
            self._interrupt()
            size = min(count, _BATCH)
            self._batch(size, tally)
            count -= size

    def _batch(self, count: int, tally: Tally) -> None:
        rng, ik = self._rng, self.ik
        points, wrists, speed = self._targets(count)
        dt = _times(rng, count)
        margins = None
        if self._shapes is not None and rng.random() < 0.7:
            margins = rng.uniform(*MARGINS, len(self._shapes.fingers))
        try:
            q, statuses = self._solve(points, wrists, dt, speed, margins)
        except Exception as error:
            note(tally, self.name, error)
            self._place()
            return
        tally.statuses.update(statuses)
        tally.not_finite += int((~np.isfinite(q).all(axis=1)).sum())
        self.checker.take(q, self._instants(dt), ik.options.max_acceleration)

    def _instants(self, dt: np.ndarray) -> np.ndarray:
        """Return the instants of commands that are by these times behind each other [s]."""
        return self.checker.time + np.cumsum(np.maximum(dt, SHORTEST))

    def _solve(
        self,
        points: np.ndarray,
        wrists: np.ndarray | None,
        dt: np.ndarray,
        speed: np.ndarray,
        margins: np.ndarray | None,
    ) -> tuple[np.ndarray, list[str]]:
        """Return configurations, shape (T, nq), and statuses of many samples."""
        found = [
            self.ik.solve(
                points[i],
                None if wrists is None else wrists[i],
                dt[i],
                margins=margins,
                speed=speed[i],
            )
            for i in range(len(dt))
        ]
        return np.array([each.q for each in found]), [each.status for each in found]

    def _interrupt(self) -> None:
        rng = self._rng
        if rng.random() < 0.1:
            self._place()
        if rng.random() < 0.3:
            self._change_limit(self._limits[int(rng.integers(len(self._limits)))])
        if rng.random() < 0.1:
            for dt in _times(rng, int(rng.integers(1, 8))):
                self.ik.hold(dt)
                self.checker.take(
                    self.ik.gate.motion.q,
                    self._instants(np.array([dt])),
                    self.ik.options.max_acceleration,
                )

    def _change_limit(self, limit: float | None) -> None:
        before = self.ik.gate.motion
        if limit not in self._iks:
            options = self.ik.options.replaced(max_acceleration=limit)
            self._iks[limit] = PointIk(
                self.ik.hand, options, before, contacts=self._shapes
            )
        self.ik = self._iks[limit]
        self.ik.gate.motion = before

    def _place(self) -> None:
        for _ in range(_TRIES):
            q = self._posture()
            meter = self.checker.meter
            if meter is None or meter.depth(q) == 0.0:
                break
        else:
            q = self._hand.configuration_vector(self._hand.rest)
        self.ik.place(q)
        self.checker.start(q)

    def _posture(self) -> np.ndarray:
        hand, rng = self._hand, self._rng
        q = rng.uniform(hand.lower_limits, hand.upper_limits)
        kind = rng.integers(5)
        if kind == 1:
            q = np.where(rng.random(len(q)) < 0.5, hand.lower_limits, hand.upper_limits)
        elif kind == 2:
            q = np.zeros(len(q))
        elif kind == 3:
            q = rng.uniform(
                hand.lower_limits - MOST_OUTSIDE, hand.upper_limits + MOST_OUTSIDE
            )
        elif kind == 4:
            q = hand.rest + rng.uniform(-MOST_OUTSIDE, MOST_OUTSIDE, len(q))
        return hand.configuration_vector(
            q, _pose(rng, 10.0 ** rng.uniform(-2, 3)) if hand.is_floating else None
        )

    def _targets(self, count: int) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Return points, shape (T, m, 3), wrists, shape (T, 4, 4), and speeds, shape (T,)."""
        rng, wrist = self._rng, self.ik.configuration.wrist.homogeneous
        points = np.empty((count, len(self._hand.reference_points), 3))
        wrists, speed = np.empty((count, 4, 4)), np.ones(count)
        start = 0
        while start < count:
            stretch = slice(start, start + int(rng.geometric(1.0 / _STRETCH)))
            size = len(speed[stretch])
            base = (
                wrist
                @ pin.exp6(10.0 ** rng.uniform(-4, 0) * rng.normal(size=6)).homogeneous
            )
            points[stretch] = self._point_targets(base, size)
            wrists[stretch] = self._wrist_targets(base, size)
            if rng.random() < 0.5:
                speed[stretch] = rng.uniform(0.01, 1.0)
            start = stretch.stop
        return points, None if rng.random() < 0.2 else wrists, speed

    def _point_targets(self, wrist: np.ndarray, count: int) -> np.ndarray:
        hand, rng = self._hand, self._rng
        kind = rng.integers(9)
        if kind == 0:
            points = self.ik.configuration.points
        else:
            q = rng.uniform(hand.lower_limits, hand.upper_limits)
            if rng.random() < 0.3:
                q = np.where(rng.random(len(q)) < 0.5, hand.lower_limits, q)
            points = hand.points(q, wrist if hand.is_floating else None)
        middle = points.mean(axis=0)
        if kind in (1, 2):
            points = np.tile(middle, (len(points), 1))
        elif kind == 3:
            points = 2.0 * middle - points
        elif kind == 4:
            size = 10.0 ** rng.uniform(1, np.log10(FARTHEST))
            points = points + size * rng.normal(size=points.shape)
        noise = 10.0 ** rng.uniform(-9, -1 if kind < 8 else 1)
        return points + noise * rng.normal(size=(count, *points.shape))

    def _wrist_targets(self, base: np.ndarray, count: int) -> np.ndarray:
        rng = self._rng
        kind = rng.integers(6)
        if kind == 1:
            # Half a turn from where the hand is: the logarithm has two values.
            turn = np.diag([*rng.permutation([1.0, -1.0, -1.0]), 1.0])
            base = self.ik.configuration.wrist.homogeneous @ turn
        elif kind == 2:
            base = _pose(rng, 10.0 ** rng.uniform(0, 6))
        noise = 10.0 ** rng.uniform(-9, 0) if kind > 2 else 0.0
        quaternions = np.array([0.0, 0.0, 0.0, 1.0]) + noise * rng.normal(
            size=(count, 4)
        )
        return base @ _poses(quaternions, noise * rng.normal(size=(count, 3)))


class MapperRun:
    """Steps of the whole mapping.

    Args:
        human: The human hand.
        robot: The robot hand.
        mapping: Options of the mapping that differ from `MappingOptions()`, or name of a preset.
        seed: Seed of the random numbers.
        shapes: Pairs of shapes that the preset keeps apart, to judge; none if omitted.
        paths: As of `Checker`.
    """

    def __init__(
        self,
        human: Hand,
        robot: Hand,
        mapping: dict[str, Any] | str,
        seed: int,
        shapes: ShapePairs | None = None,
        paths: int = 1,
    ) -> None:
        self.name = (
            f"{human.name} to {robot.name}, {robot.mount}, {mapping}, seed {seed}"
        )
        self._rng = np.random.default_rng(seed)
        method = mapping if isinstance(mapping, str) else MappingOptions(**mapping)
        self._mapper = HandMapper(human, robot, method)
        self.checker = Checker(robot, shapes, paths)
        self._q, self._wrist = human.rest.copy(), np.eye(4)
        self._last: np.ndarray | None = None
        # Runs give the time since the robot's last command, or instants of a clock of their own.
        self._gives_instants = self._rng.random() < 0.5
        self._now = 0.0

    def advance(self, count: int, tally: Tally) -> None:
        """Take steps into the tally."""
        for _ in range(count):
            self._step(tally)

    def _step(self, tally: Tally) -> None:
        mapper, rng = self._mapper, self._rng
        before, dt = mapper.point_ik.configuration.q.copy(), float(_times(rng, 1)[0])
        times: dict[str, float] = {"dt": dt}
        if self._gives_instants:
            # One in ten is not later than the last.
            self._now += dt if rng.random() < 0.9 else -min(dt, 0.5)
            times = {"time": self._now}
        try:
            if rng.random() < 0.03:
                self._interrupt()
            # One sample in a hundred is invalid.
            step = (
                self._map_invalid(times)
                if rng.random() < 0.01
                else self._map_random(times)
            )
        except HandmapError as error:
            tally.refused[type(error).__name__] += 1
            # Only a rejected reference may have placed the hand.
            if self._last is not None and not np.array_equal(
                mapper.point_ik.configuration.q, before
            ):
                note(tally, self.name, RuntimeError("moved by a rejected sample"))
            return
        except Exception as error:
            note(tally, self.name, error)
            self._last = None
            return
        tally.statuses[step.status] += 1
        tally.check_finite(
            step.command.q,
            step.command.wrist,
            step.motion,
            step.motion_rigid,
            step.motion_deformation,
            step.targets,
            step.points,
        )
        tally.check_finite(
            step.residual_norms, step.stretches, step.point_error, step.wrist_target
        )
        robot = mapper.robot
        now = robot.configuration_vector(
            step.command.q, step.command.wrist if robot.is_floating else None
        )
        if self._last is None:
            # It has moved from the posture of its reference already.
            mapper.motion = Motion.at_rest(now, mapper.point_ik.configuration.nv)
            # The robot's clock is never set back.
            self.checker.start(now, max(self._now, self.checker.time))
        else:
            time = self._now
            if not self._gives_instants:
                time = self.checker.time + max(dt, SHORTEST)
            self.checker.take(now, time, mapper.ik.max_acceleration)
        self._last = now

    def _interrupt(self) -> None:
        mapper, rng = self._mapper, self._rng
        kind = rng.integers(5)
        if kind == 0:
            mapper.clutch()
        elif kind == 1:
            mapper.release()
        elif kind == 4:
            limit = LIMITS[rng.integers(len(LIMITS))]
            mapper.configure(ik=mapper.ik.replaced(max_acceleration=limit))
        elif kind == 2:
            self._last = None
            mapper.reset(robot_q=self._robot_posture())
        else:
            self._last = None
            mapper.reset(self._q, self._wrist)

    def _robot_posture(self) -> np.ndarray:
        robot, meter = self._mapper.robot, self.checker.meter
        for _ in range(_TRIES):
            q = self._rng.uniform(robot.lower_limits, robot.upper_limits)
            if meter is None or meter.depth(robot.configuration_vector(q)) == 0.0:
                return q
        return robot.rest

    def _map_random(self, times: dict[str, float]) -> MapStep:
        mapper, rng = self._mapper, self._rng
        human = mapper.human
        if rng.random() < 0.1:
            self._q = rng.uniform(human.lower_limits, human.upper_limits)
            self._wrist = _pose(rng, 10.0 ** rng.uniform(-2, 4))
        else:
            self._q = np.clip(
                self._q + 0.1 * rng.normal(size=len(self._q)),
                human.lower_limits - 0.2,
                human.upper_limits + 0.2,
            )
            self._wrist = self._wrist @ pin.exp6(0.05 * rng.normal(size=6)).homogeneous
            self._wrist[:3, :3] = nearest_rotation(self._wrist[:3, :3])
        if rng.random() < 0.8:
            return mapper.map_step(self._q, self._wrist, **times)
        points = human.points(
            np.clip(self._q, human.lower_limits, human.upper_limits), self._wrist
        )
        kind = rng.integers(4)
        if kind == 0:
            points = points + 0.01 * rng.normal(size=points.shape)
        elif kind == 1:
            points[:] = points[0]
        elif kind == 2:
            points = points[0] + np.outer(
                rng.normal(size=len(points)), rng.normal(size=3)
            )
        return mapper.map_points(points, self._wrist, **times)

    def _map_invalid(self, times: dict[str, float]) -> MapStep:
        invalid = (
            self._map_invalid_joints,
            self._map_invalid_wrist,
            self._map_invalid_points,
        )
        return invalid[self._rng.integers(len(invalid))](times)

    def _map_invalid_joints(self, times: dict[str, float]) -> MapStep:
        rng, q = self._rng, self._q.copy()
        kind = rng.integers(5)
        if kind == 0:
            q[rng.integers(len(q))] = rng.choice([np.nan, np.inf, -np.inf, 1e300])
        elif kind == 1:
            q = q[:-1]
        elif kind == 2:
            q = q + rng.choice([-1.0, 1.0]) * 4.0
        elif kind == 3:
            times = {
                name: rng.choice([0.0, -1.0, np.nan, np.inf])
                if name == "dt"
                else rng.choice([np.nan, np.inf, -np.inf])
                for name in times
            }
        return self._mapper.map_step("hand" if kind == 4 else q, self._wrist, **times)

    def _map_invalid_wrist(self, times: dict[str, float]) -> MapStep:
        rng, wrist = self._rng, self._wrist.copy()
        kind = rng.integers(3)
        if kind == 0:
            wrist[rng.integers(4), rng.integers(4)] = rng.choice(
                [np.nan, np.inf, FARTHEST]
            )
        elif kind == 1:
            wrist[:3, :3] *= rng.choice([-1.0, 0.0, 1.01])
        else:
            wrist = wrist[:3]
        return self._mapper.map_step(self._q, wrist, **times)

    def _map_invalid_points(self, times: dict[str, float]) -> MapStep:
        mapper, rng = self._mapper, self._rng
        points = mapper.human.points(mapper.human.rest)
        kind = rng.integers(4)
        if kind == 0:
            points[rng.integers(len(points))] = np.nan
        elif kind == 1:
            points = points[:-1]
        elif kind == 2:
            points = 10.0 ** rng.uniform(3, np.log10(FARTHEST)) * points
        return mapper.map_points(points, None if kind == 3 else self._wrist, **times)


def wild_options(rng: np.random.Generator) -> IkOptions:
    """Draw options of the inverse kinematics; every combination is valid."""
    return IkOptions(
        point_weight=float(10.0 ** rng.uniform(-1, 2)),
        rest_weight=float(rng.choice([0.0, 0.2, 10.0, 1e3])),
        damping=float(10.0 ** rng.uniform(-3, 0)),
        error_damping=float(rng.choice([0.0, 0.7])),
        max_iterations=int(rng.integers(1, 6)),
        step_tolerance=float(rng.choice([0.0, 0.1])),
        points_follow_wrist=bool(rng.random() < 0.5),
    )


def hostile_runs(seed: int = 0) -> Iterator[IkRun | MapperRun]:
    """Yield runs over all hands of the package without end, with floating and fixed wrists.

    Runs of the inverse kinematics and of the mapping alternate.
    """
    while True:
        for i, (name, mount) in enumerate(_available_hands()):
            robot = _hand(name, mount, (None, "fingertips_middle")[(seed + i) % 2])
            yield IkRun(robot, IKS[seed % len(IKS)], seed)
            yield mapper_run(robot, MAPPINGS[seed % len(MAPPINGS)], seed)
            seed += 1


def mapper_run(
    robot: Hand,
    mapping: dict[str, Any] | str,
    seed: int,
    shapes: ShapePairs | None = None,
    paths: int = 1,
) -> MapperRun:
    """Return a run of the mapping from the human hand of the robot's side; see `MapperRun`."""
    if not isinstance(mapping, str) and not robot.is_floating:
        mapping = mapping | {"rigid_from": "none"}
    human = _hand(
        "human_left" if robot.side == "left" else "human",
        "floating",
        "landmarks" if isinstance(mapping, str) else "joints",
    )
    return MapperRun(human, robot, mapping, seed, shapes, paths)


def drive(
    runs: Iterator[IkRun | MapperRun], steps: int, steps_per_run: int = 500
) -> Iterator[Tally]:
    """Take steps from one run after the other.

    Args:
        runs: Result of `hostile_runs`.
        steps: Number of steps in total.
        steps_per_run: Number of steps of each run.

    Yields:
        The tally so far, after each run.
    """
    tally = Tally()
    while tally.steps < steps:
        take(next(runs), min(steps_per_run, steps - tally.steps), tally)
        yield tally


class Run(Protocol):
    """Steps of one robot, with what judges them."""

    name: str
    checker: Checker

    def advance(self, count: int, tally: Tally) -> None:
        """Take steps into the tally."""
        ...


def take(run: Run, steps: int, tally: Tally) -> None:
    """Take steps of one run into a tally, with what its checker found."""
    run.advance(steps, tally)
    tally.steps += steps
    tally.add(run.checker, run.name)


@cache
def _available_hands() -> tuple[tuple[str, Mount], ...]:
    found: list[tuple[str, Mount]] = []
    for name in hand_names():
        try:
            hand = load_hand(name)
        except MissingExtraError:
            continue
        # A hand on an arm has a fixed base.
        found.extend(
            ((name, "floating"), (name, "fixed"))
            if hand.is_floating
            else ((name, "fixed"),)
        )
    return tuple(found)


@cache
def _hand(name: str, mount: Mount, points: str | None) -> Hand:
    hand = load_hand(name, mount=mount)
    return hand.with_points(points) if points in hand.spec.sets else hand


def note(tally: Tally, name: str, error: Exception) -> None:
    """Count an exception that is not documented; the first few are kept."""
    if len(tally.undocumented) < 20:
        tally.undocumented.append(f"{name}: {type(error).__name__}: {error}")


def _times(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw times between samples [s]: even, jittering, wild or absurd ones."""
    kind = rng.integers(8)
    if kind == 0:
        return 10.0 ** rng.uniform(-9, 2, count)
    if kind < 3:
        return 10.0 ** rng.uniform(-4, 0, count)
    times = np.full(count, 10.0 ** rng.uniform(-3, -1))
    return times if kind < 5 else times * rng.uniform(0.1, 2.0, count)


def _pose(rng: np.random.Generator, distance: float) -> np.ndarray:
    return _poses(rng.normal(size=4), distance * rng.normal(size=3))


def _poses(quaternions: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return poses, shape (..., 4, 4), of quaternions (xyzw) of any length, and positions [m]."""
    lengths = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    *vector, w = np.moveaxis(quaternions / lengths, -1, 0)
    u = np.stack(vector, axis=-1)
    cross = np.cross(u[..., None, :], np.eye(3))
    poses = np.zeros((*w.shape, 4, 4))
    # Rows of `cross` are u x e_i, columns of its transpose.
    skew = np.swapaxes(cross, -1, -2)
    poses[..., :3, :3] = np.eye(3) + 2.0 * (w[..., None, None] * skew + skew @ skew)
    poses[..., :3, 3] = positions
    poses[..., 3, 3] = 1.0
    return poses
