"""The library in C and C++: installed away from the checkout, it follows as Python does."""

from __future__ import annotations

import csv
import ctypes
import math
import shutil
import subprocess
import threading
import zlib
from collections.abc import Callable
from copy import deepcopy
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from library_in_c import (
    BUSY,
    INVALID_HAND,
    INVALID_INPUT,
    ROOT,
    Command,
    Options,
    Sample,
    built_examples,
    loaded,
    run,
)
from run_cases import FAULTS, mapper_of, recording_with

from handmap_core.human.recording import Recording
from handmap_core.stream.smoothing import Smoothing
from handmap_qp import Follower, HandMapper, HumanSample, load_hand
from handmap_qp.apps.saving import saved_bytes
from handmap_qp.mapping import MapStep
from handmap_qp.se3 import Array
from handmap_qp.trackers import read_recording, write_recordings

# A compiler's work, once for the module.
pytestmark = pytest.mark.slow
DT = 1.0 / 60.0
_Numbers = ctypes.POINTER(ctypes.c_double)


@pytest.fixture(scope="module")
def programs(prefix: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built_examples(prefix, tmp_path_factory.mktemp("examples"))


@pytest.fixture(scope="module")
def library(prefix: Path) -> ctypes.CDLL:
    return loaded(prefix)


class Follows:
    """A hand of the library, with the calls of this test."""

    def __init__(
        self, library: ctypes.CDLL, saved: bytes, options: Options | None = None
    ) -> None:
        self.library = library
        self.hand = ctypes.c_void_p()
        given = None if options is None else ctypes.byref(options)
        done = library.handmap_load(saved, len(saved), given, ctypes.byref(self.hand))
        assert done == 0, library.handmap_last_error()
        self.command = Command()

    def __del__(self) -> None:
        self.library.handmap_free(self.hand)

    def call(self, name: str, *arguments: Any) -> int:
        """Call a function that writes the command; return its result."""
        function = getattr(self.library, f"handmap_{name}")
        return function(self.hand, *arguments, ctypes.byref(self.command))

    def follow(self, sample: HumanSample, dt: float = math.nan) -> Array:
        """Follow a sample; return the joint positions."""
        given, _kept = sample_of(self.library, sample, dt)
        assert self.call("follow", ctypes.byref(given)) == 0, self.problem
        return self.q

    @property
    def q(self) -> Array:
        """Joint positions of the last command."""
        return np.array(self.command.q[: self.command.joints])

    @property
    def status(self) -> str:
        """How the QP of the last command ended."""
        return self.library.handmap_status_name(self.command.status).decode()

    @property
    def problem(self) -> str:
        """What went wrong last."""
        return self.library.handmap_last_error().decode()


def numbers(array: Array) -> Any:
    """Return an array for C."""
    return np.ascontiguousarray(array, dtype=float).ctypes.data_as(_Numbers)


def sample_of(
    library: ctypes.CDLL, sample: HumanSample, dt: float = math.nan
) -> tuple[Sample, list[Array]]:
    """Return a sample for C, and what must stay as long as it is used."""
    kept = [np.ascontiguousarray(sample.landmarks, dtype=float)]
    given = library.handmap_new_sample(sample.time, numbers(kept[0]))
    if sample.wrist is not None:
        kept.append(np.ascontiguousarray(sample.wrist, dtype=float))
        given.wrist = numbers(kept[1])
    given.valid = sample.valid
    given.confidence = sample.confidence
    given.dt = dt
    return given, kept


def agree(follows: Follows, step: MapStep) -> None:
    """Check that a command of C is that of a step of Python."""
    command = follows.command
    np.testing.assert_allclose(follows.q, step.command.q, atol=1e-9)
    np.testing.assert_allclose(
        np.reshape(command.wrist, (4, 4)), step.command.wrist, atol=1e-9
    )
    assert command.rule.decode() == (step.verdict.rule if step.verdict else "")
    assert follows.status == step.stages.ik.status
    assert bool(command.is_held) == step.is_held
    assert bool(command.is_gliding) == step.is_gliding


# -- it follows as Python does


@pytest.mark.parametrize("fault", FAULTS)
def test_it_follows_as_python_does(
    fault: str, library: ctypes.CDLL, mapper: HandMapper, saved: bytes
) -> None:
    follows = Follows(library, saved)
    follower = Follower(deepcopy(mapper))
    recording = recording_with(fault)
    for i in range(len(recording)):
        sample = recording.sample(i)
        follows.follow(sample)
        agree(follows, follower.map_sample(sample))


@pytest.mark.parametrize(
    ("robot", "preset"), [("panda_gripper", "picking"), ("g1_arm_left", "")]
)
def test_other_hands_follow_alike(
    robot: str, preset: str, library: ctypes.CDLL
) -> None:
    hand = load_hand(robot)
    human = load_hand(
        "human_left" if hand.side == "left" else "human", points="landmarks"
    )
    mapper = HandMapper(human, hand, preset or "teleoperation")
    follows = Follows(library, saved_bytes(mapper))
    follower = Follower(mapper)
    for i in range(60):
        angles = human.rest + 0.5 * (1.0 - math.cos(0.1 * i)) * (
            0.6 * (human.upper_limits - human.rest)
        )
        sample = HumanSample(i / 60.0, hand.side, human.points(angles))
        follows.follow(sample)
        agree(follows, follower.map_sample(sample))


@pytest.mark.parametrize("rejoin", ["glide", "clutch"])
def test_options_are_those_of_python(
    rejoin: Any, library: ctypes.CDLL, mapper: HandMapper, saved: bytes
) -> None:
    defaults = library.handmap_default_options()
    assert Smoothing(defaults.acceleration, defaults.speed_gain) == Smoothing()
    follows = Follows(library, saved, Options(int(rejoin == "clutch"), 1, 2.0, 3.0))
    follower = Follower(deepcopy(mapper), rejoin=rejoin, smoothing=Smoothing(2.0, 3.0))
    recording = recording_with(FAULTS[2])
    for i in range(len(recording)):
        follows.follow(recording.sample(i))
        agree(follows, follower.map_sample(recording.sample(i)))
    plain = Follows(library, saved, Options(0, 0, 0.0, 0.0))
    follower = Follower(deepcopy(mapper), smoothing=None)
    for i in range(20):
        plain.follow(recording.sample(i))
        agree(plain, follower.map_sample(recording.sample(i)))


def test_engaging_and_holding_are_those_of_python(
    library: ctypes.CDLL, mapper: HandMapper, saved: bytes
) -> None:
    follows = Follows(library, saved)
    follower = Follower(deepcopy(mapper))
    recording = recording_with("")
    for i in range(30):
        follows.follow(recording.sample(i))
        agree(follows, follower.map_sample(recording.sample(i)))
    for _ in range(3):
        assert follows.call("hold", DT) == 0
        held = follower.mapper.hold(DT)
        np.testing.assert_allclose(follows.q, held.command.q, atol=1e-12)
    assert library.handmap_engage(follows.hand) == 0
    follower.mapper.engage()
    for i in range(40, 60):
        follows.follow(recording.sample(i), DT)
        agree(follows, follower.map_sample(recording.sample(i), dt=DT))


def test_landmarks_and_joint_angles_are_mapped_as_they_are(
    library: ctypes.CDLL, mapper: HandMapper, saved: bytes
) -> None:
    follows = Follows(library, saved)
    other = deepcopy(mapper)
    human = other.human
    wrist = np.eye(4)
    wrist[:3, 3] = 0.1, 0.2, 0.3
    for share in (0.0, 0.2, 0.4):
        q = human.rest + share * (human.upper_limits - human.rest)
        assert follows.call("map_joints", numbers(q), numbers(wrist), DT) == 0
        step = other.map_step(q, wrist, dt=DT)
        np.testing.assert_allclose(follows.q, step.command.q, atol=1e-9)
        points = human.points(q, wrist)
        assert follows.call("map_landmarks", numbers(points), None, DT) == 0
        step = other.map_landmarks(points, dt=DT)
        np.testing.assert_allclose(follows.q, step.command.q, atol=1e-9)


def test_a_wrist_in_floats_is_made_a_rotation(
    library: ctypes.CDLL, mapper: HandMapper, saved: bytes
) -> None:
    follows = Follows(library, saved)
    follower = Follower(deepcopy(mapper))
    recording = recording_with("quaternion")
    for i in range(40):
        sample = recording.sample(i)
        assert sample.wrist is not None
        loose = HumanSample(
            sample.time,
            sample.side,
            sample.landmarks,
            sample.wrist.astype(np.float32).astype(float),
        )
        follows.follow(loose)
        agree(follows, follower.map_sample(loose))


def test_links_and_landmarks_are_where_python_has_them(
    library: ctypes.CDLL, mapper: HandMapper, saved: bytes
) -> None:
    follows = Follows(library, saved)
    recording = recording_with("")
    for i in range(20):
        follows.follow(recording.sample(i))
    count = library.handmap_link_count(follows.hand)
    names = [library.handmap_link_name(follows.hand, i).decode() for i in range(count)]
    poses = np.zeros((count, 4, 4))
    assert library.handmap_link_poses(follows.hand, numbers(poses)) == 0
    robot = mapper.robot
    wrist = np.reshape(follows.command.wrist, (4, 4))
    expected = robot.link_poses(names, follows.q, wrist)
    np.testing.assert_allclose(poses, expected, atol=1e-9)
    human = mapper.human
    q = human.rest + 0.3 * (human.upper_limits - human.rest)
    landmarks = np.zeros((21, 3))
    done = library.handmap_human_landmarks(
        follows.hand, numbers(q), numbers(wrist), numbers(landmarks)
    )
    assert done == 0
    np.testing.assert_allclose(landmarks, human.points(q, wrist), atol=1e-9)
    limits = np.zeros((3, len(robot.joint_names)))
    assert library.handmap_joint_limits(follows.hand, *map(numbers, limits)) == 0
    np.testing.assert_array_equal(limits[:2], robot.limits)
    np.testing.assert_array_equal(limits[2], robot.velocity_limits)
    assert library.handmap_joint_limits(follows.hand, None, None, None) == (
        INVALID_INPUT
    )


# -- stopping


def test_a_stop_brakes_within_the_limits_and_holds_until_engaged(
    library: ctypes.CDLL, mapper: HandMapper, saved: bytes
) -> None:
    follows = Follows(library, saved)
    recording = recording_with("")
    before = at = np.zeros(16)
    for i in range(45):
        before, at = at, follows.follow(recording.sample(i), DT)
    assert follows.call("stop", DT) == 0
    stopped = follows.q
    # The stop that stays possible behind every command: no joint goes farther than it went before.
    assert (np.abs(stopped - at) <= np.abs(at - before) + 1e-9).all()
    for i in range(45, 100):
        q = follows.follow(recording.sample(i), DT)
        assert follows.command.is_held
    for i in range(100, 110):
        np.testing.assert_array_equal(follows.follow(recording.sample(i), DT), q)
    np.testing.assert_array_equal(follows.command.velocity[:16], 0.0)
    assert library.handmap_engage(follows.hand) == 0
    for i in range(110, 140):
        follows.follow(recording.sample(i), DT)
    assert not follows.command.is_held
    assert not np.array_equal(follows.q, q)
    speed = np.abs(follows.command.velocity[:16])
    assert (speed <= mapper.robot.velocity_limits + 1e-9).all()


# -- wrong input


def test_wrong_samples_leave_the_hand_where_it_is(
    library: ctypes.CDLL, saved: bytes
) -> None:
    follows, judge = Follows(library, saved), Follows(library, saved)
    recording = recording_with("")
    landmarks = recording.landmarks[0]
    hole = landmarks.copy()
    hole[3, 1] = np.nan
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    q = np.zeros(20)
    beyond = q.copy()
    beyond[4] = 9.0
    eye = np.eye(4)
    wrong: list[tuple[str, str, tuple[Any, ...]]] = [
        ("landmarks", "map_landmarks", (numbers(hole), None, DT)),
        ("landmarks: expected one, got NULL", "map_landmarks", (None, None, DT)),
        ("dt", "map_landmarks", (numbers(landmarks), None, 0.0)),
        ("dt", "map_landmarks", (numbers(landmarks), None, math.nan)),
        ("wrist_pose", "map_landmarks", (numbers(landmarks), numbers(mirror), DT)),
        ("wrist_pose", "map_joints", (numbers(q), numbers(2.0 * eye), DT)),
        ("outside its limits", "map_joints", (numbers(beyond), numbers(eye), DT)),
        ("outside its limits", "map_joints", (numbers(q + np.nan), numbers(eye), DT)),
        ("dt", "hold", (-1.0,)),
        ("sample: expected one", "follow", (None,)),
        ("dt", "stop", (math.inf,)),
    ]
    for i in range(20):
        follows.follow(recording.sample(i))
        judge.follow(recording.sample(i))
        for said, name, arguments in wrong:
            assert follows.call(name, *arguments) == INVALID_INPUT, name
            assert said in follows.problem
        given, _kept = sample_of(library, recording.sample(i))
        given.landmarks = numbers(hole)
        assert follows.call("follow", ctypes.byref(given)) == INVALID_INPUT
        given.landmarks = None
        assert follows.call("follow", ctypes.byref(given)) == INVALID_INPUT
        np.testing.assert_array_equal(follows.q, judge.q)
    assert library.handmap_engage(None) == INVALID_INPUT
    assert library.handmap_hold(follows.hand, DT, None) == INVALID_INPUT


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda content: b"", "expected a saved hand"),
        (lambda content: content[:-100], "expected a saved hand"),
        (lambda content: b"\x91" * 100_000, "expected a saved hand"),
        (lambda content: content[:-900] + b"?" + content[-899:], "damaged"),
        (
            lambda content: content.replace(b"0.2.0", b"0.1.9", 1),
            "of version 0.1.9, expected 0.2.0",
        ),
        (
            lambda content: content.replace(b"handmap hand", b"handmap foot", 1),
            "expected a saved hand",
        ),
    ],
    ids=["empty", "torn", "nested", "damaged", "version", "kind"],
)
def test_bytes_of_something_else_are_refused(
    change: Callable[[bytes], bytes], said: str, library: ctypes.CDLL, saved: bytes
) -> None:
    wrong = change(saved)
    hand = ctypes.c_void_p()
    done = library.handmap_load(wrong, len(wrong), None, ctypes.byref(hand))
    assert done == INVALID_HAND
    assert said in library.handmap_last_error().decode()
    assert not hand


def test_a_hand_that_only_python_leads_is_refused(library: ctypes.CDLL) -> None:
    content = saved_bytes(mapper_of("three_finger", "paper"))
    hand = ctypes.c_void_p()
    assert library.handmap_load(content, len(content), None, ctypes.byref(hand)) == (
        INVALID_HAND
    )
    assert b"only Python follows with it" in library.handmap_last_error()


@pytest.mark.parametrize(
    "options",
    [Options(7, 1, 1.0, 1.0), Options(0, 1, -1.0, 1.0), Options(0, 1, 1.0, math.nan)],
)
def test_wrong_options_are_refused(
    options: Options, library: ctypes.CDLL, saved: bytes
) -> None:
    hand = ctypes.c_void_p()
    done = library.handmap_load(
        saved, len(saved), ctypes.byref(options), ctypes.byref(hand)
    )
    assert done == INVALID_INPUT


def test_random_damage_never_ends_the_process(
    library: ctypes.CDLL, saved: bytes
) -> None:
    """Damage behind the checksum: the fields of a model, which is made whole again."""
    head = msgspec.msgpack.decode(saved)
    random = np.random.default_rng(17104)
    results = set()
    for _ in range(60):
        part = bytearray(head["core"])
        for place in random.integers(0, len(part), size=random.integers(1, 4)):
            part[place] = random.integers(256)
        changed = head | {"core": bytes(part), "checksum": checksum(head["body"], part)}
        content = msgspec.msgpack.encode(changed)
        hand = ctypes.c_void_p()
        done = library.handmap_load(content, len(content), None, ctypes.byref(hand))
        results.add(done)
        if done == 0:
            library.handmap_free(hand)
    assert results <= {0, INVALID_HAND}
    assert INVALID_HAND in results


def checksum(body: bytes, part: bytes | bytearray) -> int:
    """Return the checksum of a file."""
    return zlib.crc32(part, zlib.crc32(body))


def test_one_thread_at_a_time_works_on_a_hand(
    library: ctypes.CDLL, saved: bytes
) -> None:
    follows = Follows(library, saved)
    recording = recording_with("")
    results: list[int] = []

    def work() -> None:
        command = Command()
        for i in range(len(recording)):
            given, _kept = sample_of(library, recording.sample(i))
            results.append(
                library.handmap_follow(
                    follows.hand, ctypes.byref(given), ctypes.byref(command)
                )
            )

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(results) <= {0, BUSY}
    assert results.count(0) >= len(recording)


# -- the examples, and the headers


@pytest.fixture
def samples(tmp_path: Path) -> Path:
    """Return the demo's recording of both hands, as a table."""
    file = tmp_path / "demo.csv"
    write_recordings([*both_hands()], file)
    return file


def both_hands() -> list[Recording]:
    """Return the left and the right hand of the demo."""
    return [read_recording("demo", side) for side in ("left", "right")]


def test_the_first_example_prints_the_commands_of_python(
    programs: Path, samples: Path, mapper: HandMapper, saved: bytes, tmp_path: Path
) -> None:
    hand = tmp_path / "allegro.hand"
    hand.write_bytes(saved)
    printed = run(programs / "01_loop", hand, samples)
    header, *rows = csv.reader(printed.splitlines())
    assert header[3:] == [*mapper.robot.joint_names]
    follower = Follower(deepcopy(mapper))
    recording = both_hands()[1]
    assert len(rows) == len(recording)
    for i, (time, rule, held, *q) in enumerate(rows):
        step = follower.map_sample(recording.sample(i))
        assert step.verdict
        assert (rule, bool(int(held))) == (step.verdict.rule, step.is_held)
        assert float(time) == pytest.approx(follower.mapper.moving_robot.time)
        np.testing.assert_allclose(np.array(q, float), step.command.q, atol=1e-9)


def test_the_second_example_leads_both_hands_and_stops_one(
    programs: Path, samples: Path, tmp_path: Path
) -> None:
    files = []
    for side in ("left", "right"):
        human = load_hand(
            "human_left" if side == "left" else "human", points="landmarks"
        )
        file = tmp_path / f"{side}.hand"
        file.write_bytes(saved_bytes(HandMapper(human, load_hand(f"allegro_{side}"))))
        files.append(file)
    left, right = run(programs / "02_two_hands", *files, samples).splitlines()
    count = len(both_hands()[0])
    assert left.startswith(f"allegro_left: {count} commands, ")
    held = int(left.split(" commands, ")[1].split()[0])
    assert held >= count - count // 2
    assert right.startswith(f"allegro_right: {len(both_hands()[1])} commands, ")


def test_the_third_example_runs_at_1_khz_and_counts(
    programs: Path, samples: Path, saved: bytes, tmp_path: Path
) -> None:
    hand = tmp_path / "allegro.hand"
    hand.write_bytes(saved)
    printed = run(programs / "03_realtime", hand, samples, "0.3")
    line = next(each for each in printed.splitlines() if "at 1 kHz" in each)
    count = int(line.split(": ")[1].split()[0])
    assert 1 <= count <= 301
    counts = [int(each.split()[-1]) for each in printed.splitlines() if "below" in each]
    assert sum(counts) == count


@pytest.mark.parametrize(
    ("program", "arguments", "code"),
    [
        ("01_loop", (), 2),
        ("01_loop", ("missing.hand", "missing.csv"), 1),
        ("02_two_hands", ("a",), 2),
        ("03_realtime", ("missing.hand", "missing.csv", "1"), 1),
    ],
)
def test_examples_say_what_is_wrong(
    program: str, arguments: tuple[str, ...], code: int, programs: Path
) -> None:
    done = subprocess.run(
        [programs / program, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == code
    assert done.stderr.startswith(
        ("usage:", f"{program}: missing.hand: cannot be read")
    )


def test_the_installed_copy_needs_nothing_of_python(programs: Path) -> None:
    if shutil.which("ldd") is None:
        pytest.skip("needs ldd")
    needed = run("ldd", programs / "01_loop")
    assert "libhandmap" in needed
    assert "python" not in needed.lower()


def test_the_header_is_c(prefix: Path, tmp_path: Path) -> None:
    source = tmp_path / "uses.c"
    source.write_text(
        '#include "handmap/handmap.h"\n'
        "int main(void) { return handmap_version()[0] == 0; }\n"
    )
    options = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror"]
    compiler = shutil.which("gcc") or "g++"
    run(
        compiler,
        *options,
        f"-I{prefix / 'include'}",
        "-c",
        source,
        "-o",
        tmp_path / "uses.o",
    )


def test_every_function_is_told(prefix: Path) -> None:
    """What the library exports is what its header has, and nothing else."""
    (file,) = prefix.glob("lib*/libhandmap.so")
    if shutil.which("nm") is None:
        pytest.skip("needs nm")
    symbols = run("nm", "-D", "--defined-only", file).split()
    exported = {each for each in symbols if each.startswith("handmap_")}
    header = (ROOT / "core" / "include" / "handmap" / "handmap.h").read_text()
    declared = {
        word.split("(")[0].lstrip("*")
        for line in header.splitlines()
        if line.startswith("HANDMAP_API")
        for word in line.split()
        if word.lstrip("*").startswith("handmap_") and "(" in word
    }
    assert exported == declared


def test_the_version_is_that_of_the_package(library: ctypes.CDLL) -> None:
    assert library.handmap_version().decode() == version("handmap-core")
