"""Programs of others, live in a loop: each answer is used, and each failure has its reason."""

from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from handmap_score.tasks import outside
from handmap_score.tasks.cli import with_peers
from handmap_score.tasks.mapping import check_mapping
from handmap_score.tasks.operator import HumanHand, Joints
from handmap_score.tasks.outside import (
    LIMITS,
    OutsideMapping,
    WithinLimits,
    outside_mapping,
)
from handmap_score.tasks.person import own_hand

from handmap_qp.apps.offline.comparison import OutsideError
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands import Hand, load_hand
from handmap_qp.mapping import PRESETS

DT = 1.0 / 60.0
# It answers how many samples it has seen since it began, times a hundred, for each joint.
PROGRAM = """
import json, sys
if sys.argv[1] == "list":
    print(json.dumps([{"name": "dexi-count", "about": "counts"}]))
    sys.exit()
_, _, method, hand = sys.argv
if method == "dexi-broken":
    sys.exit("it is broken")
if method == "dexi-chatty":
    print("a word\\n" * 50_000, file=sys.stderr)
count = 0
print('"ready"', flush=True)
if method == "dexi-quitter":
    sys.stdin.close()
    sys.exit("it has left")
for line in sys.stdin:
    if method.startswith("dexi-says-"):
        print(method.removeprefix("dexi-says-"), flush=True)
        continue
    value = json.loads(line)
    count = 0 if value == "reset" else count + 1
    answer = [] if value == "reset" else [100.0 * count] * 16
    if count == 5:
        sys.exit("it is tired")
    print(json.dumps(answer), flush=True)
"""


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program of others in place of the peers'."""
    (tmp_path / "compare.py").write_text(PROGRAM)
    monkeypatch.setattr(outside, "peers_program", lambda: tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def robot() -> Hand:
    """A robot hand with 16 joints."""
    return load_hand("allegro_right")


def hand() -> HumanHand:
    """Any hand."""
    return HumanHand(np.zeros((21, 3)), np.eye(4))


def test_answers_are_joints_and_a_reset_forgets(program: Path, robot: Hand) -> None:
    mapping = OutsideMapping("dexi-count", robot)
    for _ in range(2):
        mapping.reset()
        for count in (1, 2, 3):
            joints = mapping.map(hand(), DT)
            assert joints == dict.fromkeys(robot.joint_names, 100.0 * count)


class Jump(OutsideMapping):
    """A mapping that jumps from one end of all ranges beyond the other."""

    def __init__(self, robot: Hand) -> None:
        self._ends = robot.limits
        self._names = robot.joint_names
        self.reset()

    def reset(self) -> None:
        self._count = 0

    def map(self, hand: HumanHand, dt: float) -> Joints:
        self._count += 1
        low, high = self._ends
        q = low if self._count == 1 else high + 1.0
        return dict(zip(self._names, q.tolist(), strict=True))


def test_limits_clip_position_and_speed(program: Path, robot: Hand) -> None:
    """Joints go from one end to the other at their speed limits, and no farther."""
    mapping = outside_mapping("dexi-count" + LIMITS, robot)
    assert [*mapping.map(hand(), DT).values()] == robot.limits[1].tolist()
    limited = WithinLimits(Jump(robot), robot)
    for _ in range(2):
        limited.reset()
        q = np.array([[*limited.map(hand(), DT).values()] for _ in range(60)])
        low, high = robot.limits
        assert np.array_equal(q[0], low)
        assert np.allclose(q[-1], high)
        expected = np.minimum(robot.velocity_limits * DT, high - low)
        assert np.allclose(np.diff(q, axis=0).max(axis=0), expected)


@pytest.mark.parametrize(
    ("act", "reason"),
    [
        (lambda robot: OutsideMapping("dexi-broken", robot), "it is broken"),
        (lambda robot: tired(OutsideMapping("dexi-count", robot)), "it is tired"),
        (lambda robot: one(OutsideMapping("dexi-count", own_hand())), "bad answer"),
    ],
)
def test_a_program_that_fails_says_why(
    act: Callable[[Hand], object], reason: str, program: Path, robot: Hand
) -> None:
    with pytest.raises(OutsideError, match=reason):
        act(robot)


@pytest.mark.parametrize(
    "answer", ["word", "3", '{"q": 1}', '["a"]', "[NaN]", "[1e999]"]
)
def test_an_answer_that_is_no_list_of_numbers_is_a_failure(
    answer: str, program: Path, robot: Hand
) -> None:
    mapping = OutsideMapping(f"dexi-says-{answer}", robot)
    with pytest.raises(OutsideError, match="bad answer"):
        one(mapping)
    with pytest.raises(OutsideError, match="bad answer"):
        mapping.reset()


def test_a_program_may_complain_as_much_as_it_likes(program: Path, robot: Hand) -> None:
    """Warnings that nobody reads do not fill its pipe: it would wait for ever."""
    mapping = OutsideMapping("dexi-chatty", robot)
    assert mapping.map(hand(), DT) == dict.fromkeys(robot.joint_names, 100.0)


def test_a_program_that_has_left_is_let_go(program: Path, robot: Hand) -> None:
    mapping = OutsideMapping("dexi-quitter", robot)
    process = mapping._process
    process.wait()
    with pytest.raises(OutsideError, match="it has left"):
        one(mapping)
    # A broken pipe in its end would be an unraisable error, which fails tests.
    del mapping
    gc.collect()
    assert process.stdin is not None
    assert process.stdin.closed


def one(mapping: OutsideMapping) -> None:
    """Ask once."""
    mapping.map(hand(), DT)


def tired(mapping: OutsideMapping) -> None:
    """Ask until the program ends."""
    for _ in range(6):
        mapping.map(hand(), DT)


def test_names_of_peers_are_checked_before_any_attempt(program: Path) -> None:
    check_mapping("dexi-count")
    check_mapping("dexi-count" + LIMITS)
    with pytest.raises(InvalidInputError, match="did you mean dexi-count"):
        check_mapping("dexi-cuont")


def test_all_peers_run_in_both_forms_beside_what_is_named(program: Path) -> None:
    named = with_peers(("teleoperation", "dexi-count"))
    assert named == ("teleoperation", "dexi-count", "dexi-count" + LIMITS)
    assert {*PRESETS} < {*with_peers(())}
