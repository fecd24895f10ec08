"""The gate of the motors: how fast goals move, and where they begin."""

from __future__ import annotations

from itertools import pairwise
from random import Random

import numpy as np
import pytest
from handmap_drive.driver import DriverError, Health
from handmap_drive.gate import APPROACH, Gate

from handmap_qp.errors import InvalidInputError

NAMES = ("a", "b")
RATE = 100.0
TURN = 1.0 / RATE
SPEED = 5.0


class Motors:
    """Motors that go where they are told if they have torque, and fall if they do not."""

    joint_names: tuple[str, ...] = NAMES
    range = np.array([[-2.0, -2.0], [2.0, 2.0]])
    rate = RATE
    speed = SPEED
    effort = 0.4

    def __init__(self) -> None:
        self.q = np.array([0.1, -0.1])
        self.health = Health(np.full(2, 30.0), ())
        self.is_silent = False
        self.written: list[np.ndarray] = []

    def connect(self) -> None: ...

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        if self.is_silent:
            raise DriverError("no answer")
        return self.q, np.zeros(2), self.health

    def write(self, q: np.ndarray, effort: float) -> None:
        self.written.append(q)
        is_off = np.isin(NAMES, self.health.unpowered)
        self.q = np.where(is_off, self.q - 0.02, q)

    def stop(self) -> None: ...

    def lose(self, *names: str) -> None:
        self.health = self.health._replace(unpowered=names)


@pytest.fixture
def motors() -> Motors:
    return Motors()


@pytest.fixture
def gate(motors: Motors) -> Gate:
    gate = Gate(motors)
    gate.read()
    return gate


def go(gate: Gate, target: float, turns: int, start: float = 0.0) -> float:
    """Write a target and read in turns; return the time after them [s]."""
    for _ in range(turns):
        start += TURN
        gate.write(np.full(2, target), 0.1, start)
        gate.read()
    return start


def speeds(written: list[np.ndarray]) -> np.ndarray:
    return np.abs(np.diff(np.array(written), axis=0)) * RATE


def test_goals_begin_where_motors_are_and_approach(motors: Motors, gate: Gate) -> None:
    start = motors.q
    go(gate, 1.5, 100)
    assert speeds([start, *motors.written]).max() == pytest.approx(APPROACH)
    assert not gate.has_met.any()
    go(gate, 1.5, 300, start=1.0)
    assert gate.has_met.all()
    np.testing.assert_array_equal(motors.q, 1.5)


def test_the_limit_grows_after_the_approach(motors: Motors, gate: Gate) -> None:
    now = go(gate, 0.0, 21)
    assert gate.has_met.all()
    assert speeds(motors.written).max() <= APPROACH + 1e-9
    count = len(motors.written)
    go(gate, 2.0, 100, start=now)
    grown = speeds(motors.written[count - 1 :])[:, 0]
    assert grown.max() == pytest.approx(SPEED)
    # By 20 rad/s^2.
    assert np.diff(grown).max() <= 0.2 + 1e-9
    assert grown[0] <= APPROACH + 0.5


def test_a_target_that_comes_past_the_goal_ends_the_approach(gate: Gate) -> None:
    now = go(gate, 1.5, 3)
    assert not gate.has_met.any()
    # Between two turns it is never within a step of the goal.
    go(gate, -1.5, 1, start=now)
    assert gate.has_met.all()


def test_motors_slower_than_the_approach_keep_their_speed(motors: Motors) -> None:
    motors.speed = 0.2
    gate = Gate(motors)
    gate.read()
    go(gate, 0.3, 300)
    assert speeds(motors.written).max() == pytest.approx(0.2)


@pytest.mark.parametrize("seed", range(5))
def test_the_speed_is_that_of_the_time_between_writes(
    seed: int, motors: Motors, gate: Gate
) -> None:
    random = Random(seed)
    now = 0.0
    times = []
    for _ in range(500):
        # Also a clock that stands still, and a turn that is far too late.
        now += random.choice([0.0, 0.002, TURN, 2.0 * TURN, 0.5])
        times.append(now)
        gate.write(np.full(2, random.uniform(-9.0, 9.0)), 0.1, now)
        gate.read()
    for (before, after), (begin, end) in zip(
        pairwise(motors.written), pairwise(times), strict=True
    ):
        counted = min(end - begin, 2.0 * TURN)
        assert np.abs(after - before).max() <= SPEED * counted + 1e-12
    assert np.abs(motors.written).max() <= 2.0


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_an_angle_that_is_not_a_number_is_not_used(
    wrong: float, motors: Motors, gate: Gate
) -> None:
    now = go(gate, 0.5, 10)
    before = motors.q
    motors.q = np.array([before[0], wrong])
    with pytest.raises(DriverError, match="b: its angle is not a number"):
        gate.read()
    gate.write(np.full(2, 0.5), 0.1, now + TURN)
    assert np.abs(motors.written[-1] - before).max() <= APPROACH * TURN + 1e-12
    # Nor before the first write after a stop.
    gate.stop()
    motors.q = np.array([0.0, wrong])
    with pytest.raises(DriverError):
        gate.read()
    count = len(motors.written)
    with pytest.raises(InvalidInputError, match="goal: expected motors that were read"):
        gate.write(np.full(2, 0.5), 0.1, now + 2.0 * TURN)
    with pytest.raises(InvalidInputError, match="target: expected numbers"):
        gate.write(np.full(2, wrong), 0.1, now + 3.0 * TURN)
    assert len(motors.written) == count


def test_motors_that_lost_their_torque_get_no_goal_before_a_stop(
    motors: Motors, gate: Gate
) -> None:
    now = go(gate, 0.5, 100)
    motors.lose("b")
    motors.q = np.array([0.5, -1.0])
    gate.read()
    assert gate.lost == ("b",)
    count = len(motors.written)
    with pytest.raises(DriverError, match="b: torque lost"):
        gate.write(np.full(2, 0.5), 0.1, now + TURN)
    assert len(motors.written) == count
    gate.stop()
    gate.read()
    assert gate.lost == ()
    go(gate, 0.5, 1, start=now + 2.0 * TURN)
    np.testing.assert_allclose(motors.written[-1], [0.5, -1.0 + APPROACH * TURN])


def test_goals_wait_where_motors_are_until_they_have_torque(
    motors: Motors, gate: Gate
) -> None:
    motors.lose("a", "b")
    now = go(gate, 1.5, 50)
    # They fell all the time, and are not near although they pass targets.
    ahead = motors.written[-1] - (motors.q + 0.02)
    np.testing.assert_allclose(ahead, APPROACH * TURN)
    assert gate.lost == ()
    now = go(gate, float(motors.q[0]), 5, start=now)
    assert not gate.has_met.any()
    motors.lose()
    start = motors.q
    count = len(motors.written)
    go(gate, 1.5, 50, start=now)
    assert speeds([start, *motors.written[count:]]).max() <= APPROACH + 1e-9
