"""`handmap tune`: what is found of joints, and commands that make up for it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
from handmap_drive import tune
from handmap_drive.drive import Loop
from handmap_drive.driver import DriverError, Health
from handmap_drive.fit import Log, fit_encoders, fit_joint
from handmap_drive.ritual import Ritual
from handmap_drive.simulated import Simulated
from handmap_drive.tuning import STILL, Compensated, Joint, Tuning, read_tuning

from handmap_qp import load_hand
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.onboarding.edit import open_description
from handmap_qp.apps.onboarding.write import write_hand
from handmap_qp.client import Command
from handmap_qp.errors import HandError, InvalidInputError
from handmap_qp.hands import Names

HAND = "allegro_right"
RATE = 100.0


def simulated(seed: int = 3) -> Simulated:
    return Simulated(f"{HAND}:{seed}", load_hand(HAND).joint_names)


def ritual_of(motors: Simulated) -> Ritual:
    hand = load_hand(HAND, mount="fixed")
    return Ritual(motors, hand, motors.effort, (k / RATE for k in count()))


@pytest.fixture(scope="module")
def found() -> tuple[Simulated, Ritual, Tuning]:
    """Return a simulated hand, the ritual, and what was found."""
    motors = simulated()
    ritual = ritual_of(motors)
    return motors, ritual, ritual.run()


def path(*ways: tuple[float, float]) -> np.ndarray:
    """Return a motion on straight ways, each an end [rad] and a speed [rad/s]."""
    rows = [np.zeros(40)]
    for end, speed in ways:
        begin = rows[-1][-1]
        n = max(2, round(abs(end - begin) / speed * RATE))
        rows.append(np.linspace(begin, end, n + 1)[1:])
    return np.concatenate([*rows, np.full(40, rows[-1][-1])])


def played(told: np.ndarray, joint: Joint) -> tuple[np.ndarray, np.ndarray]:
    """Return where a joint goes, and its torque: a tendon with play, and friction."""
    time = np.arange(len(told)) / RATE
    goals = joint.gain * np.interp(time - joint.delay, time, told) + joint.zero
    q, rows, half = goals[0], [], 0.5 * joint.backlash
    for goal in goals:
        q = np.clip(q, goal - joint.band, goal + joint.band)
        pull = goal - q
        slack = np.clip(pull, -half, half)
        rows.append((q, (pull - slack) / joint.stretch))
    angles, torques = np.array(rows).T
    return angles, torques


@pytest.mark.parametrize("seed", range(4))
def test_a_joint_without_noise_is_found_to_half_a_percent(seed: int) -> None:
    random = np.random.default_rng(seed)
    least = [0.8, -0.1, 0.02, 0.02, 0.1, 0.03]
    most = [1.1, 0.1, 0.12, 0.08, 0.4, 0.08]
    true = random.uniform(least, most)
    # A delay between two of those that are tried would leave a rest.
    true[2] = true[2].round(3)
    joint = Joint(*true.tolist(), range=(-2.0, 2.0))
    slow = [(0.15, 0.5), (-0.15, 0.04), (0.15, 0.04)]
    fast = [(0.15, 2.0), (-0.15, 2.0), (0.15, 2.0), (-0.15, 2.0)]
    told = path(*slow, *fast, (1.0, 0.8), (0.0, 0.8))
    q, torque = played(told, joint)
    columns = (values[:, None] for values in (told, q, torque))
    log = Log(np.arange(len(told)) / RATE, *columns)
    np.testing.assert_allclose(fit_joint(log, 0, 1.0, slice(30, None)), true, rtol=5e-3)


def test_all_parameters_of_a_hand_are_found(
    found: tuple[Simulated, Ritual, Tuning],
) -> None:
    motors, ritual, tuning = found
    joints = [tuning.joints[name] for name in motors.joint_names]
    # At least .3 degrees or 5 ms; stretch by the torque that is used.
    floors = {"gain": 0.0, "zero": 5e-3, "delay": 5e-3, "backlash": 5e-3}
    for name, floor in (floors | {"stretch": 5e-3 / 0.3, "friction": 0.0}).items():
        true = getattr(motors, name)
        error = np.abs([getattr(joint, name) for joint in joints] - true)
        assert (error <= np.maximum(0.1 * true, floor)).mean() > 0.9, name
    assert len(ritual.log.time) / RATE < 120.0


def test_the_ritual_keeps_all_limits_and_touches_with_tips_alone(
    found: tuple[Simulated, Ritual, Tuning],
) -> None:
    motors, ritual, _ = found
    log = ritual.log
    low, high = motors.range
    assert ((low <= log.told) & (log.told <= high)).all()
    # A count of the encoder.
    assert ((low - 0.0016 < log.q) & (log.q < high + 0.0016)).all()
    true = log.q[::20] + motors.encoder
    assert GapMeter(load_hand(HAND, mount="fixed")).nearest(true).min() > -0.02


def test_encoders_are_right_where_tips_meet(
    found: tuple[Simulated, Ritual, Tuning],
) -> None:
    motors, ritual, tuning = found
    meter = GapMeter(hand := load_hand(HAND, mount="fixed"))
    met = []
    for finger, _, near, last in ritual._pinch_ways(tuning):
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


JOINT = Joint(0.85, 0.03, 0.0, 0.05, 0.3, 0.06, (-0.8, 0.9))
STIFF = Joint(1.1, -0.02, 0.0, 0.03, 0.1, 0.04, (-0.7, 1.5))
PAIR = Tuning({"b": JOINT, "a": STIFF})


class Played:
    """Motors whose joints have play, gain and zero, and remember what they were told."""

    joint_names: Names = ("b", "a")
    range = np.array([[-1.0, -1.0], [1.0, 2.0]])
    rate, speed, effort = RATE, 5.0, 0.4

    def __init__(self, *joints: Joint) -> None:
        self.gain = np.array([joint.gain for joint in joints])
        self.zero = np.array([joint.zero for joint in joints])
        self.band = np.array([joint.band for joint in joints])
        self.q = np.zeros(2)
        self.written: list[np.ndarray] = []

    def connect(self) -> None: ...

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        return self.q, np.zeros(2), Health(np.full(2, 30.0), ())

    def write(self, q: np.ndarray, effort: float) -> None:
        goal = self.gain * q + self.zero
        self.q = np.clip(self.q, goal - self.band, goal + self.band)
        self.written.append(q)

    def stop(self) -> None: ...


@pytest.mark.parametrize("seed", range(2))
def test_joints_go_where_they_are_told_inside_the_dead_band(seed: int) -> None:
    motors = Played(JOINT, STIFF)
    driver = Compensated(motors, PAIR)
    random = np.random.default_rng(seed)
    time = np.arange(0.0, 10.0, 1.0 / RATE)
    waves = random.uniform(0.2, 1.5, (2, 3)), random.uniform(0.0, 6.0, (2, 3))
    goals = 0.25 * np.sin(time[:, None, None] * waves[0] + waves[1]).sum(axis=2)
    errors = []
    for goal in goals:
        driver.write(goal, 0.1)
        q, *_ = driver.read()
        errors.append(np.abs(q - goal))
    # Until it has moved once, it is not known on which side of the play a joint is.
    late = np.array(errors)[100:]
    assert late.max() < STILL + 2e-3
    assert np.median(late) < 1e-9
    written = np.array(motors.written)
    assert (np.abs(np.diff(written, axis=0)) <= motors.speed / RATE + 1e-12).all()


def test_a_hand_that_is_still_gets_commands_that_are_still() -> None:
    motors = Played(JOINT, STIFF)
    driver = Compensated(motors, PAIR)
    random = np.random.default_rng(0)
    for goal in np.linspace(0.0, 0.5, 100):
        driver.write(np.full(2, goal), 0.1)
    before = len(motors.written)
    for _ in range(300):
        driver.write(0.5 + random.uniform(-0.4, 0.4, 2) * STILL, 0.1)
    noise = np.ptp(motors.written[before:], axis=0)
    # It is neither amplified beyond the gain, nor does it take the play from side to side.
    assert (noise <= 0.8 * STILL / np.array([JOINT.gain, STIFF.gain]) + 1e-12).all()
    for _ in range(10):
        driver.write(np.full(2, 0.5), 0.1)
    np.testing.assert_array_equal(np.ptp(motors.written[-9:], axis=0), 0.0)


@pytest.mark.parametrize("seed", range(2))
def test_no_command_leaves_the_limits(seed: int) -> None:
    motors = Played(JOINT, STIFF)
    driver = Compensated(motors, PAIR)
    random = np.random.default_rng(seed)
    for goal in random.uniform(-4.0, 4.0, (300, 2)).repeat(30, axis=0):
        driver.write(goal, 0.1)
        low, high = np.array([JOINT.range, STIFF.range]).T
        assert (low - 1e-9 <= motors.q).all()
        assert (motors.q <= high + 1e-9).all()
    written = np.array(motors.written)
    assert (written >= motors.range[0]).all()
    assert (written <= motors.range[1]).all()


def test_joints_wait_for_the_slowest_one() -> None:
    plain = Joint(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, (-1.0, 1.0))
    late = msgspec.structs.replace(plain, delay=0.055)
    motors = Played(plain, late)
    driver = Compensated(motors, Tuning({"b": plain, "a": late}))
    for k in range(100):
        driver.write(np.full(2, 0.01 * k), 0.1)
    # 55 ms at 1 rad/s; the slow one is told at once.
    np.testing.assert_allclose(motors.written[-1], [0.99 - 0.055, 0.99])
    driver.stop()
    driver.write(np.zeros(2), 0.1)
    np.testing.assert_array_equal(motors.written[-1], 0.0)


def test_the_loop_brings_joints_where_the_session_wants_them() -> None:
    motors = Played(JOINT, STIFF)
    command = Command(  # Of a session whose joints are in another order.
        **{"seq": 1, "name": "lab", "time": 0.0, "server_time": 0.0, "wrist": None},
        **{"joint_names": ("a", "b"), "q": (0.5, -0.3), "status": "converged"},
    )
    with patch("handmap_drive.drive.monotonic", return_value=0.0):
        loop = Loop(Compensated(motors, PAIR), command, 0.1, 60.0)
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


def spoil(fault: str, motors: Simulated) -> None:
    """Give the second joint a fault."""
    match fault:
        case "dead":
            motors.is_dead[1] = True
        case "frozen":
            motors.is_frozen[1] = True
        case "blocked":
            motors.friction[1] = 1.0
        case "swapped":
            motors.motor[[1, 5]] = 5, 1
        case "reversed":
            motors.gain[1] *= -1.0
            motors.zero[1] += 0.6
        case "other":
            motors.gain[1] = 0.4
        case "mute":
            read = motors.read
            motors.read = lambda: (
                (seen := read())[0],
                np.where(np.arange(16) == 1, 0.0, seen[1]),
                seen[2],
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
        ("other", r"joint_1.0: it moves 0.4 times as far as it is told"),
        ("mute", "joint_1.0: its torque is not measured"),
        ("jam", r"joint_1.0: it stops at 0.80. rad on its way to 1.61"),
    ],
)
def test_each_fault_is_named(fault: str, text: str) -> None:
    motors = simulated()
    spoil(fault, motors)
    with pytest.raises(DriverError, match=text):
        ritual_of(motors).run()


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


def test_the_hand_is_written_and_read_again(
    tmp_path: Path,
    found: tuple[Simulated, Ritual, Tuning],
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, picture = tmp_path / "mine.yaml", tmp_path / "mine.png"
    with (
        patch.object(tune, "turns", at_once),
        patch.object(Ritual, "run", lambda _: found[2]),
        patch.object(Ritual, "log", found[1].log),
    ):
        command(out, picture=picture, json=True).run()
    assert json.loads(capsys.readouterr().out.splitlines()[0])["joints"]
    assert picture.stat().st_size > 10_000
    assert read_tuning(out) == found[2]
    hand = load_hand(out)
    ranges = np.array([found[2].joints[name].range for name in hand.joint_names]).T
    np.testing.assert_allclose(hand.limits, ranges)
    assert hand.name == "mine"
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
    with pytest.raises(HandError, match=r"tuning: .*joints.*: run `handmap tune`"):
        read_tuning(file)
