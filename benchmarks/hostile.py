"""Hostile random steps, and a tally of their results.

`IkRun` runs the inverse kinematics alone, from postures inside, at and outside limits to targets
near, far and absurd. `MapperRun` runs the whole mapping with samples of a human hand, some of them
invalid, and changes its acceleration limit. `checker.Checker` judges the motion of both; NaN,
infinities and undocumented exceptions are counted here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
from checker import Checker

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
from handmap_qp.hands.spec import Mount
from handmap_qp.ik.limits import Motion
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
    """

    steps: int = 0
    violations: Counter[str] = field(default_factory=Counter)
    worst: dict[str, float] = field(default_factory=dict)
    not_finite: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    undocumented: list[str] = field(default_factory=list)

    @property
    def is_exact(self) -> bool:
        """Whether all limits held, all results are finite and all exceptions are documented."""
        wrong = self.violations.total() + self.not_finite + len(self.undocumented)
        return wrong == 0

    def check_finite(self, *arrays: np.ndarray) -> None:
        """Count a result whose arrays are not all finite."""
        self.not_finite += not all(np.isfinite(array).all() for array in arrays)

    def add(self, checker: Checker) -> None:
        """Add what the judge of a run found."""
        self.violations += checker.violations
        for what, value in checker.worst.items():
            self.worst[what] = max(self.worst.get(what, -np.inf), value)


class IkRun:
    """Steps of the inverse kinematics on one hand.

    Args:
        hand: The hand.
        options: Options of the inverse kinematics.
        seed: Seed of the random numbers.
    """

    def __init__(self, hand: Hand, options: IkOptions, seed: int) -> None:
        self.name = f"ik on {hand.name}, {hand.mount}, seed {seed}"
        self._hand = hand
        self._rng = np.random.default_rng(seed)
        if hand.spec.collision is None:
            options = options.replaced(avoids_self_collision=False)
        self._ik, self.checker = PointIk(hand, options), Checker(hand)
        self._place()

    def step(self, tally: Tally) -> None:
        """One step into the tally."""
        ik, rng = self._ik, self._rng
        if rng.random() < 0.05:
            self._place()
        dt = _time(rng)
        try:
            result = ik.solve(self._targets(), self._wrist_target(), dt)
        except Exception as error:
            _note(tally, self.name, error)
            self._place()
            return
        tally.statuses[result.status] += 1
        tally.check_finite(
            ik.configuration.q,
            ik.configuration.wrist.homogeneous,
            result.points,
            result.errors,
        )
        self.checker.take(ik.configuration.q, dt, ik.options.max_acceleration)

    def _place(self) -> None:
        hand, rng = self._hand, self._rng
        q = rng.uniform(hand.lower_limits, hand.upper_limits)
        kind = rng.integers(4)
        if kind == 1:
            q = np.where(rng.random(len(q)) < 0.5, hand.lower_limits, hand.upper_limits)
        elif kind == 2:
            q = np.zeros(len(q))
        elif kind == 3:
            q = rng.uniform(
                hand.lower_limits - MOST_OUTSIDE, hand.upper_limits + MOST_OUTSIDE
            )
        self._ik.place(
            hand.configuration_vector(
                q, _pose(rng, 10.0 ** rng.uniform(-2, 3)) if hand.is_floating else None
            )
        )
        self.checker.start(self._ik.configuration.q)

    def _targets(self) -> np.ndarray:
        rng, points = self._rng, self._ik.configuration.points.copy()
        kind = rng.integers(8)
        if kind == 0:
            return points
        if kind == 1:
            return np.tile(points.mean(axis=0), (len(points), 1))
        if kind == 2:
            return 2.0 * points.mean(axis=0) - points
        size = 10.0 ** (
            rng.uniform(1, np.log10(FARTHEST)) if kind == 3 else rng.uniform(-4, 0)
        )
        return points + size * rng.normal(size=points.shape)

    def _wrist_target(self) -> np.ndarray | None:
        rng, wrist = self._rng, self._ik.configuration.wrist.homogeneous
        kind = rng.integers(6)
        if kind == 0:
            return None
        if kind == 1:
            return wrist
        if kind == 2:
            # Half a turn: the logarithm has two values.
            return wrist @ np.diag([*rng.permutation([1.0, -1.0, -1.0]), 1.0])
        if kind == 3:
            return _pose(rng, 10.0 ** rng.uniform(0, 6))
        return (
            wrist
            @ pin.exp6(10.0 ** rng.uniform(-9, 0) * rng.normal(size=6)).homogeneous
        )


class MapperRun:
    """Steps of the whole mapping.

    Args:
        human: The human hand.
        robot: The robot hand.
        mapping: Options of the mapping that differ from `MappingOptions()`.
        seed: Seed of the random numbers.
    """

    def __init__(
        self, human: Hand, robot: Hand, mapping: dict[str, Any], seed: int
    ) -> None:
        self.name = (
            f"{human.name} to {robot.name}, {robot.mount}, {mapping}, seed {seed}"
        )
        self._rng = np.random.default_rng(seed)
        self._mapper = HandMapper(human, robot, MappingOptions(**mapping))
        self.checker = Checker(robot)
        self._q, self._wrist = human.rest.copy(), np.eye(4)
        self._last: np.ndarray | None = None

    def step(self, tally: Tally) -> None:
        """One step into the tally."""
        mapper, rng = self._mapper, self._rng
        before, dt = mapper.point_ik.configuration.q.copy(), _time(rng)
        try:
            if rng.random() < 0.03:
                self._interrupt()
            # One sample in a hundred is invalid.
            step = (
                self._map_invalid(dt) if rng.random() < 0.01 else self._map_random(dt)
            )
        except HandmapError as error:
            tally.refused[type(error).__name__] += 1
            # Only a rejected reference may have placed the hand.
            if self._last is not None and not np.array_equal(
                mapper.point_ik.configuration.q, before
            ):
                _note(tally, self.name, RuntimeError("moved by a rejected sample"))
            return
        except Exception as error:
            _note(tally, self.name, error)
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
            self.checker.start(now)
        else:
            self.checker.take(now, dt, mapper.ik.max_acceleration)
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
            mapper.reset(
                robot_q=rng.uniform(
                    mapper.robot.lower_limits, mapper.robot.upper_limits
                )
            )
        else:
            self._last = None
            mapper.reset(self._q, self._wrist)

    def _map_random(self, dt: float) -> MapStep:
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
            return mapper.map_step(self._q, self._wrist, dt=dt)
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
        return mapper.map_points(points, self._wrist, dt=dt)

    def _map_invalid(self, dt: float) -> MapStep:
        invalid = (
            self._map_invalid_joints,
            self._map_invalid_wrist,
            self._map_invalid_points,
        )
        return invalid[self._rng.integers(len(invalid))](dt)

    def _map_invalid_joints(self, dt: float) -> MapStep:
        rng, q = self._rng, self._q.copy()
        kind = rng.integers(5)
        if kind == 0:
            q[rng.integers(len(q))] = rng.choice([np.nan, np.inf, -np.inf, 1e300])
        elif kind == 1:
            q = q[:-1]
        elif kind == 2:
            q = q + rng.choice([-1.0, 1.0]) * 4.0
        elif kind == 3:
            dt = rng.choice([0.0, -1.0, np.nan, np.inf])
        return self._mapper.map_step("hand" if kind == 4 else q, self._wrist, dt=dt)

    def _map_invalid_wrist(self, dt: float) -> MapStep:
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
        return self._mapper.map_step(self._q, wrist, dt=dt)

    def _map_invalid_points(self, dt: float) -> MapStep:
        mapper, rng = self._mapper, self._rng
        points = mapper.human.points(mapper.human.rest)
        kind = rng.integers(4)
        if kind == 0:
            points[rng.integers(len(points))] = np.nan
        elif kind == 1:
            points = points[:-1]
        elif kind == 2:
            points = 10.0 ** rng.uniform(3, np.log10(FARTHEST)) * points
        return mapper.map_points(points, None if kind == 3 else self._wrist, dt=dt)


def hostile_runs(seed: int = 0) -> Iterator[IkRun | MapperRun]:
    """Yield runs over all hands of the package without end, with floating and fixed wrists.

    Runs of the inverse kinematics and of the mapping alternate.
    """
    while True:
        for i, (name, mount) in enumerate(_available_hands()):
            robot = _hand(name, mount, (None, "fingertips_middle")[(seed + i) % 2])
            yield IkRun(robot, IKS[seed % len(IKS)], seed)
            mapping = dict(MAPPINGS[seed % len(MAPPINGS)])
            if not robot.is_floating:
                mapping["rigid_from"] = "none"
            human = _hand(
                "human_left" if robot.side == "left" else "human", "floating", "joints"
            )
            yield MapperRun(human, robot, mapping, seed)
            seed += 1


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
        run = next(runs)
        for _ in range(min(steps_per_run, steps - tally.steps)):
            run.step(tally)
            tally.steps += 1
        tally.add(run.checker)
        yield tally


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


def _note(tally: Tally, name: str, error: Exception) -> None:
    # Keep the first few.
    if len(tally.undocumented) < 20:
        tally.undocumented.append(f"{name}: {type(error).__name__}: {error}")


def _time(rng: np.random.Generator) -> float:
    """Random time between samples [s]: mostly 1 to 100 ms, sometimes absurd."""
    return float(
        10.0 ** (rng.uniform(-9, 2) if rng.random() < 0.05 else rng.uniform(-3, -1))
    )


def _pose(rng: np.random.Generator, distance: float) -> np.ndarray:
    quat = rng.normal(size=4)
    return pin.SE3(
        pin.Quaternion(quat / np.linalg.norm(quat)), distance * rng.normal(size=3)
    ).homogeneous
