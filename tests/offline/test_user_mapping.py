"""Mappings of a user: files of Python, joints of any program, and one line for every mistake."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from comparison_cases import write_closing

from handmap_qp import cli
from handmap_qp.apps.offline.comparison import Take, compare_methods, prepare_take
from handmap_qp.apps.offline.user_file import UserCodeError, read_user_mapping
from handmap_qp.apps.offline.user_mapping import user_method
from handmap_qp.apps.offline.user_trajectory import trajectory_method
from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.hands import Hand, load_hand
from handmap_qp.trackers import read_recording

# Whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[2] / "examples" / "05_own_method.py"

MANY = """
from dataclasses import dataclass
import numpy as np
import handmap_qp as hm

@dataclass
class Rest(hm.CustomMethod):
    def targets(self, sample):
        return self.place_joints(sample, self.robot.rest)

class Empty(hm.CustomMethod):
    pass

class Wants(Rest):
    def __init__(self, share):
        self.share = share

class Breaks(hm.CustomMethod):
    def targets(self, sample):
        return sample.points[99]

class Nowhere(hm.CustomMethod):
    def targets(self, sample):
        return self.place_joints(sample, np.full(8, np.nan))

def few(landmarks): return np.zeros(4)
def nan(landmarks): return np.full(8, np.nan)
def breaks(landmarks): return landmarks[25]
def count(robot):
    calls = 0
    def answer(landmarks):
        nonlocal calls
        calls += 1
        return np.full(8, 1e-3 * calls)
    return answer
def made(human, robot): return count(robot)
def makes_a_number(human, robot): return 3
def wants_three(a, b, c): return 1
number = 4
"""


def line_of(code: str) -> int:
    """Return the line of the file that has some code, from 1."""
    return next(i for i, line in enumerate(MANY.split("\n"), 1) if code in line)


@pytest.fixture(scope="module")
def robot() -> Hand:
    return load_hand("three_finger")


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Take:
    return prepare_take(read_recording(write_closing(tmp_path_factory.mktemp("take"))))


@pytest.fixture
def many(tmp_path: Path) -> str:
    file = tmp_path / "many.py"
    file.write_text(MANY, encoding="utf-8")
    return str(file)


def test_joints_of_a_function_are_taken_as_they_are(
    many: str, take: Take, robot: Hand
) -> None:
    method = user_method(f"{many}:made")
    assert method.name == "many.py:made"
    motion = method.map_take(take, robot)
    valid = take.recording.valid
    counted = np.cumsum(valid)
    # A factory starts again; samples that were not seen repeat the last joints.
    np.testing.assert_allclose(motion.q, 1e-3 * counted[:, None] * np.ones(8))
    assert not motion.moves_wrist
    limited = user_method(f"{many}:made+limits").map_take(take, robot)
    low, high = robot.limits
    assert ((limited.q >= low) & (limited.q <= high)).all()


def test_a_method_is_followed_by_the_qp(many: str, take: Take, robot: Hand) -> None:
    progress: list[int] = []
    method = user_method(f"{many}:Rest")
    assert method.map_slowly
    motion = method.map_slowly(take, robot, progress.append)
    assert progress == list(range(1, len(take.recording) + 1))
    assert motion.moves_wrist
    np.testing.assert_allclose(motion.q[-1], robot.rest, atol=1e-2)
    smooth = user_method(f"{many}:Rest+smooth").map_take(take, robot)
    assert len(smooth.q) == len(motion.q)


def test_progress_names_the_samples(many: str, take: Take, robot: Hand) -> None:
    said: list[str] = []
    method = user_method(f"{many}:made")
    compare_methods([take], robot, [method], lambda _, text: said.append(text))
    total = len(take.recording)
    assert any(text.endswith(f"{total} of {total} samples") for text in said)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Empty", "Empty does not define targets"),
        ("Wants", "Wants.__init__.* missing 1 required"),
        ("Breaks", f"Breaks: line {line_of('points[99]')}: IndexError"),
        ("Nowhere", "no finite targets in 2 of 2 samples"),
        ("few", r"expected 8 joint positions .* shape \(4,\)"),
        ("nan", "not finite in 2 of 2 samples, the first is sample 0"),
        ("breaks", f"breaks: line {line_of('landmarks[25]')}: IndexError"),
        ("makes_a_number", "made int, expected a function"),
        ("wants_three", "got wants_three with 3 arguments"),
        ("number", "got number = 4"),
        ("unknown", "does not define unknown"),
        ("mad", "did you mean made"),
        ("made+smooth", "a function of joints"),
        ("Rest+limits", "which keeps the limits"),
    ],
)
def test_mistakes_are_found_before_any_mapping(
    name: str, said: str, many: str, take: Take, robot: Hand
) -> None:
    with pytest.raises((UserCodeError, InvalidInputError), match=said) as caught:
        compare_methods([take], robot, [user_method(f"{many}:{name}")])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import no_such_package", "line 1: ModuleNotFoundError"),
        ("x = 1\ndef f(landmarks)\n", "line 2: SyntaxError"),
        ("1 / 0", "line 1: ZeroDivisionError"),
        ("raise SystemExit(1)", "below `if __name__ == '__main__':`"),
        ("x = 1", "defines no mapping"),
        ("def a(p): ...\ndef b(p): ...", r"several mappings: a, b: name one, as .*:a$"),
    ],
)
def test_files_that_cannot_be_used_are_one_line(
    text: str, said: str, tmp_path: Path
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(HandmapError, match=said):
        read_user_mapping(str(file))


def test_files_that_do_not_exist_are_named() -> None:
    with pytest.raises(InvalidInputError, match=r"absent\.py"):
        read_user_mapping("absent.py:f")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("def mine(p): ...\ndef helper(a, b, c): ...\ndef _private(p): ...", "mine"),
        (MANY.split("class Empty")[0] + "\nfixed = Rest()\ndef f(p): ...", "fixed"),
        (MANY.split("class Empty")[0] + "\ndef f(p): ...", "Rest"),
        ("from math import sqrt\ndef mine(landmarks): ...", "mine"),
    ],
)
def test_a_file_with_one_mapping_needs_no_name(
    text: str, name: str, tmp_path: Path
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text, encoding="utf-8")
    found = read_user_mapping(str(file)).defined
    assert (getattr(found, "__name__", None) or "fixed") == name


def trajectory(folder: Path, take: Take, hand: Hand, **changes: Any) -> Path:
    """Write joints with columns from last to first; None leaves an array out."""
    rng = np.random.default_rng(0)
    names = hand.joint_names[::-1]
    q = rng.uniform(*hand.limits, (len(take.recording), len(names)))[:, ::-1]
    arrays: dict[str, Any] = {
        "time": take.recording.time,
        "q": q,
        "joint_names": names,
    } | changes
    file = folder / "closing.npz"
    np.savez(file, **{k: v for k, v in arrays.items() if v is not None})
    return file


def test_columns_of_a_trajectory_are_found_by_name(
    tmp_path: Path, take: Take, robot: Hand
) -> None:
    file = trajectory(tmp_path, take, robot)
    with np.load(file) as arrays:
        q = arrays["q"][:, ::-1]
    for path in (file, tmp_path):
        motion = trajectory_method(path).map_take(take, robot)
        np.testing.assert_array_equal(motion.q, q)
    # Where the hand is not seen, a program may have no answer.
    unseen = ~take.recording.valid
    assert unseen.any()
    given = np.where(unseen[:, None], np.nan, q[:, ::-1])
    file = trajectory(tmp_path, take, robot, q=given)
    motion = trajectory_method(file).map_take(take, robot)
    np.testing.assert_array_equal(motion.q[~unseen], q[~unseen])
    assert np.isfinite(motion.q).all()


def bad(take: Take, robot: Hand) -> dict[str, tuple[dict[str, Any], str]]:
    """Return changes of a good trajectory, and what is said of them."""
    time = take.recording.time
    count = len(time)
    q = np.zeros((count, 8))
    late = time.copy()
    late[30:] += 0.01
    lost = q.copy()
    lost[5] = np.nan
    return {
        "keys": ({"time": None, "joint_names": None}, "no time, joint_names, only q"),
        "count": ({"time": time[:9], "q": q[:9]}, f"has 9 samples.* has {count}"),
        "late": ({"time": late}, rf"in {count - 30} of {count} samples: sample 30"),
        "off": ({"time": time + 0.5}, r"\+0.5000 s off that of closing in every"),
        "nan": ({"q": lost}, "not finite in 1 of .* the first is 5"),
        "degrees": ({"q": q + 90.0}, "np.radians"),
        "shape": ({"q": q[:, :4]}, r"shape \(\d+, 4\)"),
        "text": ({"q": q.astype(str)}, "expected numbers"),
        "twice": ({"joint_names": ["a"] * 8}, "a name twice"),
        "names": (
            {"joint_names": [f"x_{n}" for n in robot.joint_names]},
            "is not of three_finger: joint_names lacks",
        ),
        "robot": (
            {"joint_names": list("abcdefgh"), "robot": "leap_right"},
            "of leap_right: --robot leap_right",
        ),
        "wrist": ({"wrist": np.zeros((3, 4, 4))}, "leave wrist out"),
    }


@pytest.mark.parametrize(
    "case",
    [
        "keys",
        "count",
        "late",
        "off",
        "nan",
        "degrees",
        "shape",
        "text",
        "twice",
        "names",
        "robot",
        "wrist",
    ],
)
def test_a_trajectory_of_something_else_says_so(
    case: str, tmp_path: Path, take: Take, robot: Hand
) -> None:
    changes, said = bad(take, robot)[case]
    method = trajectory_method(trajectory(tmp_path, take, robot, **changes))
    with pytest.raises(InvalidInputError, match=said) as caught:
        compare_methods([take], robot, [method])
    assert caught.value.argument == "--trajectory"
    assert "\n" not in str(caught.value)


def test_what_is_not_a_file_of_arrays_says_so(
    tmp_path: Path, take: Take, robot: Hand
) -> None:
    (tmp_path / "closing.npz").write_text("text", encoding="utf-8")
    with pytest.raises(InvalidInputError, match="is not an"):
        trajectory_method(tmp_path / "closing.npz").map_take(take, robot)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InvalidInputError, match="for the recording closing"):
        trajectory_method(tmp_path / "empty").map_take(take, robot)
    with pytest.raises(InvalidInputError, match="exists"):
        trajectory_method(tmp_path / "absent.npz")


def compared(
    capsys: pytest.CaptureFixture[str], recording: str, *words: str
) -> dict[str, dict[str, float]]:
    """Run `handmap compare`, and return its values by method, but for the time of a step."""
    given = ["compare", recording, "--robot", "allegro_right", "--json"]
    assert cli.main([*given, *words]) == 0
    overall = json.loads(capsys.readouterr().out)["overall"]
    for values in overall.values():
        del values["step_time_ms"]
    return overall


def test_a_motion_is_measured_alike_however_it_is_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The example's function, its joints as a trajectory, and a folder with them."""
    file = write_closing(tmp_path, "one", seconds=2.4)
    take = prepare_take(read_recording(file))
    allegro = load_hand("allegro_right")
    name = f"{EXAMPLE}:allegro_joints"
    motion = user_method(name).map_take(take, allegro)
    joints = tmp_path / "joints"
    joints.mkdir()
    for out in (tmp_path / "q.npz", joints / "one.npz"):
        np.savez(
            out, time=motion.time, q=motion.q, joint_names=np.array(allegro.joint_names)
        )
    words = ["--methods", "paper", name, "--trajectory", str(tmp_path / "q.npz")]
    found = compared(capsys, str(file), *words, str(joints))
    assert list(found) == ["paper", "05_own_method.py:allegro_joints", "q", "joints"]
    assert found["q"] == found["joints"] == found["05_own_method.py:allegro_joints"]
    assert found["q"] != found["paper"]


def test_a_trajectory_of_retarget_is_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(write_closing(tmp_path, "one", seconds=2.4))
    out = str(tmp_path / "q.npz")
    words = [file, "--robot", "allegro_right"]
    assert cli.main(["retarget", *words, "--preset", "paper", "--out", out]) == 0
    capsys.readouterr()
    found = compared(capsys, file, "--methods", "paper", "--trajectory", out)
    for key in ("finger_direction_deg", "tip_error_mm", "outside_limits"):
        assert found["q"][key] == pytest.approx(found["paper"][key], rel=0.1, abs=0.01)


@pytest.mark.parametrize("command", ["compare", "score"])
def test_the_help_teaches_it(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    page = " ".join(capsys.readouterr().out.split())
    for word in ("FILE.py:NAME", "--trajectory", "joint_names", "CustomMethod"):
        assert word in page
    assert "(21, 3) [m]" in page
