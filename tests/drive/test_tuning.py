"""`handmap calibrate-actuators`: what is found of joints, and commands that make up for it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGTERM, Signals, getsignal, raise_signal, signal
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from handmap_drive import tune
from handmap_drive.cli import compensated, tell_stiffness
from handmap_drive.drive import Loop
from handmap_drive.driver import DriverError, Health
from handmap_drive.fit import fit_encoders, fit_joint
from handmap_drive.gate import APPROACH, Gate
from handmap_drive.joint_map import Direct
from handmap_drive.joints import free_groups, free_spans, measure_joints
from handmap_drive.motion import Log, Motion
from handmap_drive.pinches import plan_pinches
from handmap_drive.ritual import find_tuning
from handmap_drive.running import stopping
from handmap_drive.simulated import Simulated
from handmap_drive.space import Space
from handmap_drive.tuning import (
    BOUNDS,
    STILL,
    Compensated,
    Joint,
    Tuning,
    read_tuning,
    tuned,
)
from service_tools import client_of, serving

from handmap_qp import Hand, load_hand
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.onboarding.edit import open_description
from handmap_qp.apps.onboarding.write import write_hand
from handmap_qp.client import Command
from handmap_qp.errors import HandError, InvalidInputError
from handmap_qp.hands import Names

HAND = "allegro_right"
RATE = 100.0
STRONGEST = 0.4
"""The largest torque of a joint of a heavy hand [N m]."""


def simulated(seed: int = 3) -> Simulated:
    return Simulated(f"{HAND}:{seed}", load_hand(HAND).joint_names)


def motion_of(motors: Simulated) -> Motion:
    return Motion(motors, motors.effort, (k / RATE for k in count()))


sagged: list[tuple[int, np.ndarray]] = []
"""Turns before which the hand of `found` had no torque, and where it was then [rad]."""


@pytest.fixture(scope="module")
def found() -> tuple[Simulated, Motion, Tuning]:
    """Return a simulated hand, its motion in the ritual, and what was found."""
    motors = simulated()
    motion = motion_of(motors)
    stop = motors.stop

    def sag() -> None:
        stop()
        motors.q = motors.q + 0.1
        sagged.append((motion.count, motors.q))

    motors.stop = sag
    return motors, motion, find_tuning(motion, load_hand(HAND, mount="fixed"))


def path(*ways: tuple[float, float]) -> np.ndarray:
    """Return a motion on straight ways, each an end [rad] and a speed [rad/s]."""
    rows = [np.zeros(40)]
    for end, speed in ways:
        begin = rows[-1][-1]
        n = max(2, round(abs(end - begin) / speed * RATE))
        rows.append(np.linspace(begin, end, n + 1)[1:])
    return np.concatenate([*rows, np.full(40, rows[-1][-1])])


def played(
    told: np.ndarray, joint: Joint, weight: float = 0.0
) -> tuple[np.ndarray, ...]:
    """Return where a joint goes, its torque, and that of its link: play, friction, a weight."""
    time = np.arange(len(told)) / RATE
    goals = joint.gain * np.interp(time - joint.delay, time, told) + joint.zero
    q, rows, half = goals[0], [], 0.5 * joint.backlash
    for goal in goals:
        load = weight * np.sin(q)
        torques = joint.weight * load + np.array([1.0, -1.0]) * joint.friction
        q = np.clip(q, *(goal - joint.stretch * torques - half * np.sign(torques)))
        pull = goal - q
        slack = np.clip(pull, -half, half)
        rows.append((q, (pull - slack) / joint.stretch, load))
    return tuple(np.transpose(rows))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("weight", "within"), [(0.0, 5e-3), (0.06, 5e-2)])
def test_a_joint_without_noise_is_found(
    seed: int, weight: float, within: float
) -> None:
    random = np.random.default_rng(seed)
    least = [0.8, -0.1, 0.02, 0.02, 0.1, 0.03]
    most = [1.1, 0.1, 0.12, 0.08, 0.4, 0.08]
    true = random.uniform(least, most)
    # A delay between two of those that are tried would leave a rest.
    true[2] = true[2].round(3)
    joint = Joint(*true.tolist(), -2.0, 2.0, weight=1.6)
    slow = [(0.15, 0.5), (-0.15, 0.04), (0.15, 0.04)]
    fast = [(0.15, 2.0), (-0.15, 2.0), (0.15, 2.0), (-0.15, 2.0)]
    told = path(*slow, *fast, (1.0, 0.8), (0.0, 0.8))
    q, torque, load = played(told, joint, weight)
    columns = (values[:, None] for values in (told, q, torque))
    log = Log(np.arange(len(told)) / RATE, *columns)
    *found, held = fit_joint(log, 0, 1.0, load)
    np.testing.assert_allclose(found, true, rtol=within)
    np.testing.assert_allclose(held, 1.6 * bool(weight), rtol=within)


def test_weights_of_links_are_the_slopes_of_their_height() -> None:
    hand = load_hand(HAND, mount="fixed")
    motors = simulated()
    down = np.array([0.3, -0.5, 0.8])
    space = Space(hand, motors, tuple(down))
    palm = hand.frame_pose("palm", hand.rest)[:3, :3]
    axis = palm @ down / np.linalg.norm(down)
    model, data = hand.model, hand.model.createData()

    def energy(q: np.ndarray) -> float:
        at = hand.configuration_vector(space.posture(q))
        links = range(1, model.njoints)
        pin.forwardKinematics(model, data, at)
        centers = [data.oMi[i].act(model.inertias[i].lever) for i in links]
        masses = [model.inertias[i].mass for i in links]
        return -9.81 * float(np.dot(masses, centers @ axis))

    q = motors.range[0] + 0.3 * np.ptp(motors.range, axis=0)
    steps = 1e-5 * np.eye(len(q))
    slopes = [(energy(q + step) - energy(q - step)) / 2e-5 for step in steps]
    np.testing.assert_allclose(space.weights(q[None])[0], slopes, atol=1e-8)


def heavy(hand: Hand) -> tuple[Simulated, Space]:
    """Return a simulated hand whose links have weights, and its space."""
    motors = simulated()
    space = Space(hand, motors)

    def load() -> np.ndarray:
        return space.weights(motors.q[None])[0] / STRONGEST

    motors.load = load
    # More than friction, so that it would be taken for a stop.
    assert (np.abs(load()) > motors.friction + 0.02).any()
    return motors, space


def check_heavy(motors: Simulated, space: Space, tuning: Tuning) -> None:
    """Assert that play and weights of a heavy hand were found."""
    found = tuning.arrays(motors.joint_names)
    for name, floor in {"gain": 0.0, "zero": 5e-3, "backlash": 5e-3}.items():
        true = getattr(motors, name)
        error = np.abs(getattr(found, name) - true)
        assert (error <= np.maximum(0.1 * true, floor)).mean() > 0.9, name
    np.testing.assert_allclose(np.median(found.weight), 1.0 / STRONGEST, rtol=0.1)
    assert not found.meet(motors.load(), space.weights(motors.q[None])[0]).any()


def test_the_play_of_a_hand_with_heavy_links_is_found() -> None:
    motors, space = heavy(load_hand(HAND, mount="fixed"))
    motion = motion_of(motors)
    motion.start()
    spans = free_spans(space)
    groups = free_groups(space, spans)
    joints = measure_joints(motion, space, spans, groups, lambda *_: None)
    check_heavy(motors, space, Tuning.of(motors.joint_names, joints, {}))


@pytest.mark.full
def test_tips_of_a_hand_with_heavy_links_meet() -> None:
    """The suite measures the joints of a heavy hand, and lets tips of a light one meet."""
    hand = load_hand(HAND, mount="fixed")
    motors, space = heavy(hand)
    tuning = find_tuning(motion_of(motors), hand)
    check_heavy(motors, space, tuning)
    assert len(tuning.pinches) == 3


def test_all_parameters_of_a_hand_are_found(
    found: tuple[Simulated, Motion, Tuning],
) -> None:
    motors, motion, tuning = found
    joints = [tuning.joints[name] for name in motors.joint_names]
    # At least .3 degrees or 5 ms; stretch by the torque that is used.
    floors = {"gain": 0.0, "zero": 5e-3, "delay": 5e-3, "backlash": 5e-3}
    for name, floor in (floors | {"stretch": 5e-3 / 0.3, "friction": 0.0}).items():
        true = getattr(motors, name)
        error = np.abs([getattr(joint, name) for joint in joints] - true)
        assert (error <= np.maximum(0.1 * true, floor)).mean() > 0.9, name
    # Joints go along .98 of each line, where a stop may not be met yet.
    lower, upper = tuning.arrays(motors.joint_names).range - motors.stops
    assert np.maximum(upper, -lower).max() < 0.03
    assert motion.count / RATE < 120.0


def test_the_ritual_keeps_all_limits_and_touches_with_tips_alone(
    found: tuple[Simulated, Motion, Tuning],
) -> None:
    motors, motion, _ = found
    log = motion.log()
    low, high = motors.range
    assert ((low <= log.commanded) & (log.commanded <= high)).all()
    # A count of the encoder.
    assert ((low - 0.0016 < log.q) & (log.q < high + 0.0016)).all()
    true = log.q[::20] + motors.encoder
    assert GapMeter(load_hand(HAND, mount="fixed")).nearest(true).min() > -0.02


def test_a_finger_that_another_one_pushes_stays_in_its_limits(
    found: tuple[Simulated, Motion, Tuning],
) -> None:
    motors, _, tuning = found
    spec = tuned(load_hand(HAND).spec, tuning, motors.effort)
    _, end = Hand(spec, mount="fixed").limits
    driver = Compensated(motors, tuning)
    shares = np.minimum(np.linspace(0.8, 1.2, 200), 1.0)
    *_, told = [driver.command(share * end) for share in shares]
    # By the largest torque, through all of its play.
    pushed = motors.gain * told + motors.zero + 0.5 * motors.backlash
    pushed += motors.stretch * motors.effort
    assert (pushed < motors.range[1] + 2e-3).all()


def test_a_hand_that_had_no_torque_goes_on_from_where_it_is(
    found: tuple[Simulated, Motion, Tuning],
) -> None:
    motors, motion, _ = found
    # A process that takes tests from others may have tuned the hand twice.
    turn, q = sagged[-1]
    goal = motors.gain * motion.log().commanded[turn] + motors.zero
    # What it goes in a turn, and what is not known of it.
    assert np.abs(goal - q).max() < 0.03


def test_encoders_are_right_where_tips_meet(
    found: tuple[Simulated, Motion, Tuning],
) -> None:
    motors, _, tuning = found
    meter = GapMeter(hand := load_hand(HAND, mount="fixed"))
    met = []
    pinches = plan_pinches(Space(hand, motors), tuning, motors.effort)
    for finger, (_, near, last) in ((p.finger, way) for p in pinches for way in p.ways):
        ways = near + np.linspace(0.0, 1.0, 2000)[:, None] * (last - near)
        gaps = meter.pinches(ways + motors.encoder)[finger]
        met.append((finger, ways[np.abs(gaps).argmin()]))
    held_back, tried = met[::4], [way for i, way in enumerate(met) if i % 4]
    error, told = fit_encoders(hand, tried)

    def gaps_of(met: list[tuple[str, np.ndarray]], error: np.ndarray) -> np.ndarray:
        gaps = [meter.pinches((q + error)[None])[finger] for finger, q in met]
        return np.concatenate(gaps)

    np.testing.assert_allclose(told, gaps_of(tried, 0.0 * error))
    assert np.abs(told).max() > 1e-3
    assert np.abs(gaps_of(tried, error)).max() < 3e-4
    assert np.abs(gaps_of(held_back, error)).max() < 1e-3
    # No encoder is blamed for more than it takes.
    assert np.linalg.norm(error) < np.linalg.norm(motors.encoder)


JOINT = Joint(0.85, 0.03, 0.0, 0.05, 0.3, 0.06, -0.8, 0.9)
STIFF = Joint(1.1, -0.02, 0.0, 0.03, 0.1, 0.04, -0.7, 1.5)
PAIR = Tuning({"b": JOINT, "a": STIFF})


class Played:
    """Motors whose joints have play, gain and zero, and remember what they were told."""

    joint_names: Names = ("b", "a")
    range = np.array([[-1.0, -1.0], [1.0, 2.0]])
    rate, speed, effort = RATE, 5.0, 0.4
    load = 0.0

    def __init__(self, *joints: Joint) -> None:
        self.found = Tuning(dict(zip("ba", joints, strict=True))).arrays(("b", "a"))
        self.q = np.zeros(2)
        self.written: list[np.ndarray] = []

    def connect(self) -> None: ...

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        return self.q, np.zeros(2), Health(np.full(2, 30.0), ())

    def write(self, q: np.ndarray, effort: float) -> None:
        goal = self.found.gain * q + self.found.zero
        friction = np.array([[1.0], [-1.0]]) * self.found.friction
        torques = self.found.weight * self.load + friction
        lags = 0.5 * self.found.backlash * np.sign(torques)
        lags += self.found.stretch * torques
        self.q = np.clip(self.q, *(goal - lags))
        self.written.append(q)

    def stop(self) -> None: ...


class Told:
    """Motors whose joints are told where to go: commands by the tuning, through the gate."""

    def __init__(
        self,
        motors: Played,
        tuning: Tuning,
        weights: Callable[[np.ndarray], np.ndarray] = np.zeros_like,
    ) -> None:
        self.joints = Compensated(motors, tuning, weights)
        self.gate = Gate(motors)
        self._turn = 0
        self.begin()

    def begin(self) -> None:
        q, *_ = self.gate.read()
        self.joints.restart(self.joints.angles(q))

    def write(self, goal: np.ndarray) -> np.ndarray:
        """Take a turn; return where the joints are."""
        self._turn += 1
        self.gate.write(self.joints.command(goal), 0.1, self._turn / RATE)
        return self.joints.angles(self.gate.read()[0])


@pytest.mark.parametrize(("seed", "load"), [(0, 0.0), (1, 0.0), (2, 0.015), (3, -0.1)])
def test_joints_go_where_they_are_told_inside_the_dead_band(
    seed: int, load: float
) -> None:
    heavy = [msgspec.structs.replace(joint, weight=1.5) for joint in (JOINT, STIFF)]
    motors = Played(*heavy)
    motors.load = load
    tuning = Tuning(dict(zip("ba", heavy, strict=True)))
    told = Told(motors, tuning, lambda q: np.full_like(q, load))
    random = np.random.default_rng(seed)
    time = np.arange(0.0, 10.0, 1.0 / RATE)
    waves = random.uniform(0.2, 1.5, (2, 3)), random.uniform(0.0, 6.0, (2, 3))
    goals = 0.25 * np.sin(time[:, None, None] * waves[0] + waves[1]).sum(axis=2)
    # The approach.
    for _ in range(300):
        told.write(goals[0])
    errors = []
    for goal in goals:
        q = told.write(goal)
        errors.append(np.abs(q - goal))
    # Until it has moved once, it is not known on which side of the play a joint is.
    late = np.array(errors)[100:]
    assert late.max() < STILL + 2e-3
    assert np.median(late) < 1e-9
    written = np.array(motors.written)
    assert (np.abs(np.diff(written, axis=0)) <= motors.speed / RATE + 1e-12).all()


def test_a_hand_that_is_still_gets_commands_that_are_still() -> None:
    motors = Played(JOINT, STIFF)
    driver = Told(motors, PAIR)
    random = np.random.default_rng(0)
    for goal in np.linspace(0.0, 0.5, 100):
        driver.write(np.full(2, goal))
    before = len(motors.written)
    for _ in range(300):
        driver.write(0.5 + random.uniform(-0.4, 0.4, 2) * STILL)
    noise = np.ptp(motors.written[before:], axis=0)
    # It is neither amplified beyond the gain, nor does it take the play from side to side.
    assert (noise <= 0.8 * STILL / np.array([JOINT.gain, STIFF.gain]) + 1e-12).all()
    for _ in range(10):
        driver.write(np.full(2, 0.5))
    np.testing.assert_array_equal(np.ptp(motors.written[-9:], axis=0), 0.0)


@pytest.mark.parametrize("seed", range(2))
def test_no_command_leaves_the_limits(seed: int) -> None:
    motors = Played(JOINT, STIFF)
    driver = Told(motors, PAIR)
    random = np.random.default_rng(seed)
    for goal in random.uniform(-4.0, 4.0, (300, 2)).repeat(30, axis=0):
        driver.write(goal)
        low, high = np.array([(j.lower, j.upper) for j in (JOINT, STIFF)]).T
        assert (low - 1e-9 <= motors.q).all()
        assert (motors.q <= high + 1e-9).all()
    written = np.array(motors.written)
    assert (written >= motors.range[0]).all()
    assert (written <= motors.range[1]).all()


def test_joints_wait_for_the_slowest_one() -> None:
    plain = Joint(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 1.0)
    late = msgspec.structs.replace(plain, delay=0.055)
    motors = Played(plain, late)
    joints = Compensated(motors, Tuning({"b": plain, "a": late}))
    for k in range(100):
        told = joints.command(np.full(2, 0.01 * k))
    # 55 ms at 1 rad/s; the slow one is told at once.
    np.testing.assert_allclose(told, [0.99 - 0.055, 0.99])
    joints.restart(np.zeros(2))
    np.testing.assert_array_equal(joints.command(np.zeros(2)), 0.0)


def test_the_loop_brings_joints_where_the_session_wants_them() -> None:
    motors = Played(JOINT, STIFF)
    command = Command(  # Of a session whose joints are in another order.
        **{"seq": 1, "name": "lab", "time": 0.0, "server_time": 0.0, "wrist": None},
        **{"joint_names": ("a", "b"), "q": (0.5, -0.3), "status": "converged"},
    )
    with patch("handmap_drive.drive.monotonic", return_value=0.0):
        loop = Loop(motors, command, 0.1, 60.0, Compensated(motors, PAIR))
    for k in range(1, 300):
        loop.hear(command, k / RATE)
        loop.turn(k / RATE)
    np.testing.assert_allclose(loop.measured, [0.5, -0.3], atol=1e-9)
    assert np.abs(motors.written[-1] - [-0.3, 0.5]).min() > 0.01


def test_the_tuning_of_another_hand_is_refused() -> None:
    other = Tuning({"a": JOINT, "c": JOINT})
    with pytest.raises(
        InvalidInputError, match=r"--tuning: expected .* b, a, got a, c"
    ):
        Compensated(Played(JOINT, STIFF), other)


def spoil_reading(motors: Simulated, change: Callable[..., Any]) -> None:
    """Change the joints and torques that motors answer."""
    read = motors.read

    def changed() -> Any:
        q, torque, health = read()
        return *change(q, torque), health

    motors.read = changed


def spoil(fault: str, motors: Simulated) -> None:
    """Give the second joint a fault."""
    is_second, others = np.arange(16) == 1, range(6, 16)
    match fault:
        case "dead":
            motors.stretch[1] = 1e6
        case "frozen":
            spoil_reading(
                motors, lambda q, torque: (np.where(is_second, 0.5, q), torque)
            )
        case "blocked":
            motors.friction[1] = 1.0
        case "swapped":
            write = motors.write
            motors.write = lambda q, effort: write(
                q[[0, 5, 2, 3, 4, 1, *others]], effort
            )
        case "reversed":
            motors.gain[1] *= -1.0
            motors.zero[1] += 0.6
        case "other":
            motors.gain[1] = 0.4
        case "mute":
            spoil_reading(
                motors, lambda q, torque: (q, np.where(is_second, 0.0, torque))
            )
        case "jam":
            motors.stops[1, 1] = 0.8


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("dead", "joint_1.0: its motor has no torque"),
        ("frozen", "joint_1.0: its motor pulls, but its encoder does not move"),
        ("blocked", "joint_1.0: it does not move with the torque of --effort"),
        ("swapped", "joint_1.0: joint_5.0 moves in its place: ids are swapped"),
        ("reversed", "joint_1.0: it turns the other way"),
        ("other", r"joint_1.0: it moves 0.4 times as far as it is commanded"),
        ("mute", "joint_1.0: its torque is not measured"),
        ("jam", r"joint_1.0: it stops at 0.80. rad on its way to 1.61"),
    ],
)
def test_each_fault_is_named(fault: str, text: str) -> None:
    motors = simulated()
    spoil(fault, motors)
    with pytest.raises(DriverError, match=text):
        find_tuning(motion_of(motors), load_hand(HAND, mount="fixed"))


def test_a_hand_that_is_where_it_cannot_be_is_not_moved() -> None:
    motors = simulated()
    motors.q = motors.q + 2.0 * (np.arange(16) == 5)
    motion = motion_of(motors)
    with pytest.raises(InvalidInputError, match=r"joint_5.0: expected .* rad, got"):
        find_tuning(motion, load_hand(HAND, mount="fixed"))
    assert not motion.count


def test_lost_answers_are_met_and_silence_is_not() -> None:
    motion = Motion(Played(JOINT, STIFF), 0.1, (k / RATE for k in count()))
    motion.start()
    for _ in range(2):
        with patch.object(Played, "read", side_effect=DriverError("no answer")):
            motion.go(motion.goal + 0.4, 1.0)
        motion.go(motion.goal + 0.1, 1.0)
    assert motion.count == 20
    with (
        patch.object(Played, "read", side_effect=DriverError("no answer")),
        pytest.raises(DriverError, match="no answer"),
    ):
        motion.go(motion.goal + 0.6, 1.0)


def test_the_ritual_writes_nothing_to_motors_that_were_not_read() -> None:
    motors = Played(JOINT, STIFF)
    motion = Motion(motors, 0.1, (k / RATE for k in count()))
    motion.start()
    with patch.object(Played, "read", side_effect=DriverError("no answer")):
        motion.go(motion.goal + 0.2, 1.0)
    # The first one, after which the answer is missing.
    assert len(motors.written) == 1
    # From there, no faster than before.
    start = motors.written[0]
    motion.go(motion.goal, 1.0)
    motion.go(motion.goal + 0.1, 1.0)
    steps = np.abs(np.diff([start, *motors.written[1:]], axis=0))
    assert steps.max() <= 2.0 * motors.speed / RATE


def test_a_motor_that_loses_its_torque_ends_the_ritual() -> None:
    motors = Played(JOINT, STIFF)
    motion = Motion(motors, 0.1, (k / RATE for k in count()))
    motion.start()
    motion.go(motion.goal + 0.1, 1.0)
    written = len(motors.written)
    health = Health(np.full(2, 30.0), (), ("a",))
    answer = (motors.q, np.zeros(2), health)
    with (
        patch.object(Played, "read", return_value=answer),
        pytest.raises(DriverError, match="a: torque lost"),
    ):
        motion.go(motion.goal + 0.1, 1.0)
    assert len(motors.written) == written + 1


def at_once(rate: float, _: object) -> Iterator[float]:
    return (k / rate for k in count())


def command(out: Path, **more: object) -> tune.Tune:
    fields = {"driver": "simulated", "port": f"{HAND}:3", "out": out} | more
    return tune.Tune(HAND, **fields)  # ty: ignore[invalid-argument-type]


def test_an_interrupted_ritual_writes_nothing_and_stops(tmp_path: Path) -> None:
    def interrupted(*_: object) -> Iterator[float]:
        yield from np.arange(500) / RATE
        raise KeyboardInterrupt

    stops = []
    with (
        patch.object(tune, "turns", interrupted),
        patch.object(Simulated, "stop", lambda _: stops.append(1)),
        pytest.raises(KeyboardInterrupt),
    ):
        command(tmp_path / "a.yaml").run()
    assert stops
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("number", [SIGINT, SIGTERM, SIGHUP])
def test_each_way_to_end_it_takes_the_torque(number: Signals) -> None:
    before = {each: getsignal(each) for each in (SIGINT, SIGTERM, SIGHUP)}
    motors = Played(JOINT, STIFF)
    with patch.object(Played, "stop", side_effect=OSError) as stop:
        try:
            with stopping(motors) as over:
                raise_signal(number)
                assert over.is_set()
        finally:
            for each, handler in before.items():
                signal(each, handler)
    # A message may be lost.
    assert stop.call_count == 3


def test_the_hand_is_written_and_read_again(
    tmp_path: Path,
    found: tuple[Simulated, Motion, Tuning],
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, picture = tmp_path / "mine.yaml", tmp_path / "mine.png"
    with (
        patch.object(tune, "turns", at_once),
        patch.object(tune, "Motion", lambda *_: found[1]),
        patch.object(tune, "find_tuning", lambda *_: found[2]),
    ):
        command(out, picture=picture, json=True).run()
    assert json.loads(capsys.readouterr().out.splitlines()[0])["joints"]
    assert picture.stat().st_size > 10_000
    assert read_tuning(out) == found[2]
    text = out.read_text()
    assert text.startswith("# mine: written by `handmap calibrate-actuators`.")
    # Four decimals at most, as in the tables.
    assert not re.search(r"\d\.\d{5}", text[text.index("limits:") :])
    hand = load_hand(out)
    joints = found[2].arrays(hand.joint_names)
    np.testing.assert_allclose(hand.limits, joints.range)
    assert hand.name == "mine"
    # With the palm down, links pull the other way.
    motors, home = simulated(), Space(hand, found[0]).home
    told = []
    for direction in (None, (0.0, 0.0, 1.0), (0.0, 0.0, -2.0)):
        goals = compensated(motors, out, direction)
        goals.restart(home)
        told.append(goals.command(home))
    without, up, down = np.array(told)
    heavy = Space(load_hand(HAND, mount="fixed"), motors).weights(home[None])[0]
    gain, stretch, held = joints.gain, joints.stretch, joints.weight * heavy
    np.testing.assert_allclose(up + down, 2.0 * without, atol=1e-12)
    assert ((up - without) * held >= 0.0).all()
    assert (np.abs(up - without) >= np.abs(stretch * held / gain) - 1e-12).all()
    # Motors of another hand are told so before weights are asked for.
    with pytest.raises(InvalidInputError, match="--tuning: expected a hand with"):
        compensated(Played(JOINT, STIFF), out, (0.0, 0.0, 1.0))
    # `handmap hands edit` keeps it.
    write_hand(open_description(out), tmp_path / "again.yaml")
    assert read_tuning(tmp_path / "again.yaml") == found[2]
    with pytest.raises(InvalidInputError, match="exists"):
        command(out).run()
    with pytest.raises(InvalidInputError, match="--port: expected HAND:SEED"):
        command(tmp_path / "b.yaml", port="x").run()


def test_a_hand_that_is_not_tuned_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "hand.yaml"
    write_hand(open_description(Path(HAND)), file)
    with pytest.raises(
        HandError, match=r"tuning: .*joints.*: run `handmap calibrate-actuators`"
    ):
        read_tuning(file)


LIES: list[tuple[str, float, str]] = [
    ("gain", 0.02, "0.5 to 1.6"),
    ("gain", -1.0, "0.5 to 1.6"),
    ("gain", np.nan, "0.5 to 1.6"),
    ("zero", -1.5, "-0.5 to 0.5"),
    ("delay", 1e6, "0 to 0.25"),
    ("delay", -0.1, "0 to 0.25"),
    ("backlash", 2.0, "0 to 0.5"),
    ("stretch", np.inf, "0 to 5"),
    ("friction", 2.0, "0 to 1"),
    ("lower", -1e9, "-10 to 10"),
    ("upper", 1e9, "-10 to 10"),
    ("encoder", 1.0, "-0.5 to 0.5"),
    ("weight", 1e9, "0 to 100"),
    ("lower", 1.0, "at most upper"),
]


@pytest.mark.parametrize(("name", "value", "text"), LIES)
def test_a_number_that_no_joint_has_is_neither_written_nor_read(
    name: str, value: float, text: str, tmp_path: Path
) -> None:
    wrong = msgspec.structs.replace(JOINT, **{name: value})
    expected = f"tuning.joints.b.{name}: expected {text}"
    with pytest.raises(InvalidInputError) as raised:
        Tuning({"a": STIFF, "b": wrong})
    assert str(raised.value).startswith(expected)
    rows = msgspec.structs.astuple(wrong)
    arrays = (
        Tuning({"b": JOINT})
        .arrays(("b",))
        ._replace(
            **dict(
                zip(
                    type(PAIR.arrays(("b",)))._fields,
                    np.array(rows)[:, None],
                    strict=True,
                )
            )
        )
    )
    with pytest.raises(InvalidInputError) as raised:
        Tuning.of(("b",), arrays, {})
    assert str(raised.value).startswith(expected)
    file = tmp_path / "hand.yaml"
    write_hand(open_description(Path(HAND)), file)
    joint = msgspec.to_builtins(JOINT) | {name: value}
    tuning = msgspec.yaml.encode({"tuning": {"joints": {"b": joint}}}).decode()
    file.write_text(f"{file.read_text()}\n{tuning}")
    if not np.isfinite(value):
        # YAML of a number that is not finite is refused by each hand.yaml.
        with pytest.raises(HandError):
            read_tuning(file)
        return
    with pytest.raises(HandError) as refused:
        read_tuning(file)
    said = str(refused.value)
    assert expected in said
    assert "\n" not in said


def test_the_bounds_are_those_of_all_fields() -> None:
    assert [*BOUNDS] == [*Joint.__struct_fields__]


@pytest.mark.parametrize("gain", BOUNDS["gain"])
@pytest.mark.parametrize("zero", BOUNDS["zero"])
def test_a_tuning_that_lies_moves_no_motor_faster_than_the_approach(
    gain: float, zero: float
) -> None:
    plain = Joint(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 2.0)
    lie = msgspec.structs.replace(
        plain, gain=gain, zero=zero, backlash=0.5, stretch=5.0, friction=1.0
    )
    motors = Played(plain, plain)
    joints = Compensated(motors, Tuning({"b": lie, "a": lie}))
    fields: dict[str, Any] = {"seq": 1, "name": "lab", "time": 0.0, "wrist": None}
    fields |= {"joint_names": ("a", "b"), "server_time": 0.0}
    here = Command(q=(0.3, 0.2), status="converged", **fields)
    stopped = Command(q=(0.3, 0.2), status="stopped", **fields)
    with patch("handmap_drive.drive.monotonic", return_value=0.0):
        loop = Loop(motors, here, 0.1, 60.0, joints)
    way = [motors.q]
    now = 0.0
    for _ in range(3):
        for heard in [here] * 20 + [stopped] * 3:
            now += 1.0 / RATE
            loop.hear(heard, now)
            count = len(motors.written)
            loop.turn(now)
            way += motors.written[count:]
        # Without torque it is pushed.
        motors.q = motors.q + 0.1
        way = [*way, motors.q]
    steps = np.abs(np.diff(np.array(way), axis=0)).max(axis=1)
    pushes = np.isclose(steps, 0.1)
    assert pushes.sum() == 3
    assert steps[~pushes].max() <= APPROACH / RATE + 1e-12


def test_the_stiffness_is_what_gives_way_to_a_newton_metre() -> None:
    soft, hard = (
        msgspec.structs.replace(JOINT, stretch=stretch, weight=weight)
        for stretch, weight in ((0.5, 1.0), (0.25, 0.5))
    )
    # The largest torques are 1 and 2 N m.
    assert Tuning({"a": soft}).stiffness == pytest.approx(1.0 / 0.5)
    assert Tuning({"a": hard}).stiffness == pytest.approx(2.0 / 0.25)
    # Joints whose weights told nothing do not count.
    unknown = msgspec.structs.replace(soft, weight=0.0)
    assert Tuning({"a": hard, "b": unknown}).stiffness == pytest.approx(8.0)
    assert Tuning({"b": unknown}).stiffness is None


@pytest.mark.slow
def test_a_session_is_told_the_stiffness_of_tuned_joints(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "hand.yaml"
    known = msgspec.structs.replace(JOINT, stretch=0.25, weight=1.0)
    monkeypatch.setattr("handmap_drive.cli.read_tuning", lambda _: Tuning({"a": known}))
    choices: dict[str, Any] = {
        "preset": "teleoperation",
        "input": "landmarks",
        "hand_length": 0.18,
    }
    with serving() as server, client_of(server) as owner, client_of(server) as driver:
        owner.open("allegro_right", name="lab", is_shared=True, **choices)
        driver.watch("lab")
        tell_stiffness(driver, file)
        (session,) = server.dispatcher.sessions.by_secret.values()
        assert session.request.grip == {"stiffness": 4.0}
        # One without a grip only leads to a warning.
        owner.open("allegro_right", name="bare", is_shared=True, grip=False, **choices)
        driver.watch("bare")
        assert capsys.readouterr().err == ""
        tell_stiffness(driver, file)
        assert "stiffness of the joints" in capsys.readouterr().err


def test_torques_are_known_where_weights_told_the_largest() -> None:
    # A share of the largest per N m: the largest is half a newton metre.
    known = msgspec.structs.replace(JOINT, weight=2.0)
    motors = Played(known, STIFF)
    joints = Compensated(motors, Tuning({"b": known, "a": STIFF}))
    found = joints.torques(np.array([-0.3, 0.3]))
    np.testing.assert_allclose(found, [-0.15, np.nan])
    assert np.isnan(Direct(motors).torques(np.array([0.1, 0.2]))).all()
