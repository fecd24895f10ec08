"""Tasks in closed loop: counts are exact, the judge is sound, and statistics are what they say."""

from __future__ import annotations

import io
import json
import math
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest
from handmap_score.cli import Score
from handmap_score.tasks import adroit, benches, experts, judge
from handmap_score.tasks.attempt import Attempt, attempt, count_drops, count_runs
from handmap_score.tasks.benches import (
    Blocks,
    Cell,
    CellResult,
    Outcome,
    jobs_of,
    run_cells,
)
from handmap_score.tasks.catalogue import CATALOGUE, Entry
from handmap_score.tasks.cli import TasksRequest, score_tasks
from handmap_score.tasks.experts import Filter, Style
from handmap_score.tasks.film import FilmError, FilmJob, draw_films
from handmap_score.tasks.journal import FILE, Kept, Line
from handmap_score.tasks.mapping import (
    Replayed,
    Straight,
    Unmapped,
    check_mapping,
    make_mapping,
)
from handmap_score.tasks.operator import HumanHand, Joints, Operator
from handmap_score.tasks.page import tasks_page
from handmap_score.tasks.report import (
    Check,
    checks_of,
    groups_of,
    object_rows,
    pair_rows,
    rows_of_results,
)
from handmap_score.tasks.shares import (
    contradictions,
    drawn,
    mcnemar,
    order_of,
    wilson,
)
from handmap_score.tasks.task import Record, Scene, Signals, Task
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageSequence
from scipy.stats import binomtest

from handmap_qp import read_recording
from handmap_qp.apps.offline.user_file import UserCodeError
from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.hands import Hand, load_hand
from handmap_qp.human import Recording

STEP = 0.01
LIMIT = 50
HOLD = 5
TOUCH = 0.25
"""Position from which the toy's hand touches its object."""
GOAL = 0.5
"""Position from which the toy's goal holds."""
SLIDER = """
<mujoco>
  <worldbody>
    <body name="finger"><joint name="slider" type="slide"/><geom size=".1"/></body>
  </worldbody>
</mujoco>
"""


class Toy:
    """A task without physics: the first joint of the robot goes where it is commanded."""

    name = "toy"
    time_step = STEP
    time_limit = LIMIT * STEP
    hold = HOLD

    def __init__(self, hand: str = "human") -> None:
        self.robot: Hand = load_hand(hand)
        self.other: Hand | None = None
        self.model = mujoco.MjModel.from_xml_string(SLIDER)
        self.data = mujoco.MjData(self.model)
        self.joint = self.robot.joint_names[0]
        self.resets: list[int] = []

    def reset(self, seed: int) -> Scene:
        self.resets.append(seed)
        self.steps = 0
        self.data.qpos[0] = 0.0
        return self.scene()

    def step(self, hand: HumanHand, command: Joints) -> Scene:
        self.steps += 1
        self.data.qpos[0] = command.get(self.joint, self.data.qpos[0])
        return self.scene()

    def cause(self, course: Sequence[Signals]) -> str:
        touched = any(one.touching for one in course)
        return "touched" if touched else "never reached"

    def scene(self) -> Scene:
        place = float(self.data.qpos[0])
        signals = Signals(
            is_reached=place >= GOAL,
            touching=frozenset({"index"} if place >= TOUCH else ()),
            is_gripped=place >= TOUCH,
            force=10.0 * max(0.0, place - TOUCH),
            moved=0.0,
        )
        return Scene(self.steps * STEP, np.array([place]), {}, {}, signals)


class Pusher:
    """An operator that moves its joint by the same way each step, and sees what comes of it."""

    name = "pusher"
    has_finished = False

    def __init__(self, way: float = 0.05) -> None:
        self.way = way
        self.joint = load_hand("human").joint_names[0]
        self.seen: list[float] = []

    def calibrate(self, seed: int) -> Recording:
        return read_recording("demo", "right")

    def reset(self, seed: int) -> None:
        self.seen = []

    def see(self, scene: Scene) -> HumanHand:
        place = float(scene.observation[0])
        self.seen.append(place)
        return HumanHand(np.zeros((21, 3)), np.eye(4), {self.joint: place + self.way})


def recount_toy(record: Record) -> bool:
    """Judge the toy again: the goal held in the last states."""
    return bool((record.qpos[-HOLD:, 0] >= GOAL).all())


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Entry:
    """Put the toy into the catalogue."""
    entry = Entry(
        make=lambda hand, objects: Toy(hand),
        hands=("human",),
        describe=None,
        operators={
            "pusher": lambda robot: Pusher(),
            "slow pusher": lambda robot: Pusher(0.04),
        },
        usual=("pusher",),
        recount=lambda: recount_toy,
        own_hands=("human",),
    )
    monkeypatch.setitem(CATALOGUE, "toy", entry)
    benches._task.cache_clear()
    benches._operator.cache_clear()
    return entry


# Shares.


@pytest.mark.parametrize(
    ("successes", "attempts", "low", "high"),
    [(0, 20, 0.0, 0.1611), (20, 20, 0.8389, 1.0), (17, 20, 0.6396, 0.9476)],
)
def test_wilson_is_that_of_the_tables(
    successes: int, attempts: int, low: float, high: float
) -> None:
    share = wilson(successes, attempts)
    assert (share.low, share.high) == pytest.approx((low, high), abs=1e-4)


@given(st.integers(1, 300).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_agrees_with_scipy_and_is_symmetric(numbers: tuple[int, int]) -> None:
    successes, attempts = numbers
    share = wilson(successes, attempts)
    known = binomtest(successes, attempts).proportion_ci(0.95, "wilson")
    assert (share.low, share.high) == pytest.approx((known.low, known.high), abs=1e-9)
    mirrored = wilson(attempts - successes, attempts)
    assert share.low == pytest.approx(1.0 - mirrored.high)
    assert share.low <= share.mean <= share.high


@pytest.mark.parametrize("numbers", [(0, 0), (-1, 5), (6, 5)])
def test_wilson_rejects_other_numbers(numbers: tuple[int, int]) -> None:
    with pytest.raises(InvalidInputError):
        wilson(*numbers)


def test_pairs_count_scenes_in_which_one_alone_succeeds() -> None:
    first = np.array([True] * 12 + [False] * 8)
    second = np.array([True] * 4 + [False] * 15 + [True])
    pair = mcnemar("a", "b", first, second)
    assert (pair.first_only, pair.second_only) == (8, 1)
    assert pair.p == pytest.approx(2 * (1 + 9) / 2**9)
    assert pair.is_apart
    assert mcnemar("a", "a", first, first).p == 1.0


def test_an_order_is_stable_if_no_block_turns_it_round() -> None:
    good = np.ones((3, 10), dtype=bool)
    bad = np.zeros((3, 10), dtype=bool)
    order = order_of({"bad": bad, "good": good})
    assert order.names == ("good", "bad")
    assert order.is_stable


def test_reversals_are_counted_by_block() -> None:
    first = np.ones((5, 8), dtype=bool)
    second = np.zeros((5, 8), dtype=bool)
    first[4], second[4] = False, True
    order = order_of({"first": first, "second": second})
    ((pair, count),) = order.reversed
    assert (pair.first, pair.second, count) == ("first", "second", 1)
    assert not order.is_stable


def test_one_block_or_equal_mappings_show_no_stable_order() -> None:
    wins = np.ones((1, 20), dtype=bool)
    assert not order_of({"a": wins, "b": ~wins}).is_stable
    assert not order_of(
        {"a": np.ones((5, 4), bool), "b": np.ones((5, 4), bool)}
    ).is_stable


def test_operators_contradict_each_other_in_opposite_orders() -> None:
    good = np.ones((2, 10), dtype=bool)
    one = order_of({"a": good, "b": ~good})
    other = order_of({"a": ~good, "b": good})
    assert contradictions(one, other) == [("a", "b")]
    assert contradictions(one, one) == []


@pytest.mark.parametrize(
    ("count", "number"), [(0, 0), (1, 1), (20, 1), (60, 3), (61, 4)]
)
def test_at_least_a_share_is_drawn(count: int, number: int) -> None:
    chosen = drawn(count, 0.05, seed=3)
    assert len({*chosen.tolist()}) == number
    assert (chosen == drawn(count, 0.05, seed=3)).all()


# One attempt.


@pytest.mark.parametrize(
    ("flags", "runs"),
    [("", 0), ("...", 0), ("xxx", 1), ("x..x", 1), ("x...x", 2), ("..x.x.x..", 1)],
)
def test_runs_that_flicker_are_one(flags: str, runs: int) -> None:
    assert count_runs([flag == "x" for flag in flags], pause=3) == runs


@pytest.mark.parametrize(
    ("grips", "is_lost", "is_success", "drops"),
    [
        (0, True, False, 0),
        (1, False, False, 0),
        (1, True, False, 1),
        (2, True, True, 1),
    ],
)
def test_grips_that_end_are_drops(
    grips: int, is_lost: bool, is_success: bool, drops: int
) -> None:
    assert count_drops(grips, is_lost=is_lost, is_success=is_success) == drops


def test_the_loop_is_closed_and_ends_when_the_goal_has_held() -> None:
    # A power of two, so that sums are exact.
    way = 0.0625
    task, operator = Toy(), Pusher(way)
    done = attempt(task, operator, Unmapped(), 7)
    # Eight steps to the goal, which then has to hold in five, the first of them included.
    assert done.is_success
    assert done.steps == 8 + HOLD - 1
    assert done.time == pytest.approx(done.steps * STEP)
    assert operator.seen == pytest.approx([way * i for i in range(done.steps)])
    assert task.resets == [7]
    assert (done.tries, done.drops, done.cause) == (1, 0, "")
    assert done.force == pytest.approx(10.0 * (way * done.steps - TOUCH))
    assert done.record is not None
    assert done.record.qpos.shape == (done.steps + 1, 1)
    assert recount_toy(done.record)


def test_an_attempt_ends_at_the_time_limit() -> None:
    done = attempt(Toy(), Pusher(), Straight(load_hand("human")), 0)
    assert (done.is_success, done.steps, done.cause) == (False, LIMIT, "never reached")


def test_an_attempt_ends_a_while_after_the_operator_has_finished() -> None:
    task, operator = Toy(), Pusher()
    task.time_limit = 1e3
    operator.has_finished = True
    done = attempt(task, operator, Straight(task.robot), 0)
    assert done.time == pytest.approx(2.0, abs=2.0 * STEP)
    # The goal is reached meanwhile.
    assert attempt(task, operator, Unmapped(), 0).is_success


# Mappings.


def test_an_open_hand_stays_as_it_was_at_first() -> None:
    hands = [
        HumanHand(np.zeros((21, 3)), np.eye(4), {"joint": value})
        for value in (0.1, 0.7)
    ]
    mapping = make_mapping("open", Pusher(), load_hand("human"), 0)
    for first in hands:
        mapping.reset()
        assert mapping.map(first, 0.1) == first.joints
        assert [mapping.map(hand, 0.1) for hand in hands] == [first.joints] * 2


def test_the_identity_wins_what_unmapped_wins(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "class Identity:\n"
        "    def __init__(self, human, robot): pass\n"
        "    def reset(self): pass\n"
        "    def map(self, hand, dt): return dict(hand.joints)\n"
    )
    task, operator = Toy(), Pusher()
    identity = make_mapping(f"{file}:Identity", operator, task.robot, 0)
    mine = attempt(task, operator, identity, 0)
    own = attempt(task, operator, Unmapped(), 0)
    assert mine[:-1] == own[:-1]


def test_a_method_of_a_user_maps_landmarks(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "from handmap_qp.mapping import preset_choice\n"
        "METHOD = preset_choice('finger-vectors').method\n"
        "NUMBER = 3\n"
    )
    robot, operator = load_hand("human"), Pusher()
    landmarks = operator.calibrate(0).landmarks[0]
    mapping = make_mapping(f"{file}:METHOD", operator, robot, 0)
    command = mapping.map(HumanHand(landmarks, np.eye(4)), 0.02)
    assert {*command} == {*robot.joint_names}
    with pytest.raises(InvalidInputError, match="NUMBER"):
        make_mapping(f"{file}:NUMBER", operator, robot, 0)
    with pytest.raises(InvalidInputError, match="does not define NOTHING"):
        make_mapping(f"{file}:NOTHING", operator, robot, 0)


def test_a_function_and_a_method_of_ones_own_are_mappings(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "import handmap_qp as hm\n"
        "def joints(landmarks): return [landmarks[0, 0]] * 20\n"
        "def made(human, robot): return lambda landmarks: robot.rest\n"
        "class Rest(hm.CustomMethod):\n"
        "    human_points = 'fingertips'\n"
        "    def targets(self, sample):\n"
        "        assert len(sample.points) == 5\n"
        "        return self.place_joints(sample, self.robot.rest)\n"
        "def wrong(landmarks): return 1\n"
    )
    robot, operator = load_hand("human"), Pusher()
    hand = HumanHand(operator.calibrate(0).landmarks[0], np.eye(4))

    def command(name: str) -> list[float]:
        mapping = make_mapping(f"{file}:{name}", operator, robot, 0)
        mapping.reset()
        found = mapping.map(hand, 0.02)
        return [found[joint] for joint in robot.joint_names]

    assert command("joints") == [hand.landmarks[0, 0]] * 20
    for name in ("made", "Rest"):
        assert command(name) == pytest.approx(robot.rest.tolist(), abs=1e-2)
    with pytest.raises(UserCodeError, match="wrong: joints: expected 20"):
        command("wrong")


@pytest.mark.parametrize(
    ("returned", "problem"),
    [("1 / 0", "ZeroDivisionError"), ("{'joint': float('nan')}", "joint is nan")],
)
def test_a_mapping_of_a_user_fails_alone(
    returned: str, problem: str, toy: Entry, tmp_path: Path
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "class Broken:\n"
        "    def __init__(self, human, robot): pass\n"
        "    def reset(self): pass\n"
        f"    def map(self, hand, dt): return {returned}\n"
    )
    names = f"{file}:Broken", "unmapped"
    cells = [Cell("toy", "human", "pusher", name) for name in names]
    broken, unmapped = run_cells(cells, Blocks((0,), 2), 1, lambda *_: None)
    assert problem in broken.problem
    assert unmapped.wins.all()


def test_a_mapper_forgets_the_attempt_before() -> None:
    operator = Pusher()
    hands = [
        HumanHand(one, np.eye(4)) for one in operator.calibrate(0).landmarks[:60:6]
    ]
    mapping = make_mapping("teleoperation", operator, load_hand("human"), 0)
    first = [dict(mapping.map(hand, 0.1)) for hand in hands]
    mapping.reset()
    assert [dict(mapping.map(hand, 0.1)) for hand in hands] == first


def test_a_trajectory_plays_whatever_is_seen(tmp_path: Path) -> None:
    file = tmp_path / "motion.npz"
    time = np.array([2.0, 2.1, 2.2])
    q = np.array([[0.0], [1.0], [0.0]])
    np.savez(file, time=time, q=q, joint_names=np.array(["joint"]))
    mapping = make_mapping(str(file), Pusher(), load_hand("human"), 0)
    assert isinstance(mapping, Replayed)
    hand = HumanHand(np.zeros((21, 3)), np.eye(4))
    for _ in range(2):
        mapping.reset()
        played = [mapping.map(hand, 0.05)["joint"] for _ in range(6)]
        assert played == pytest.approx([0.0, 0.5, 1.0, 0.5, 0.0, 0.0])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("teleop", "did you mean teleoperation"),
        ("teleoperation+grib", r"did you mean teleoperation\+grip"),
        ("teleoperation+grip+places", "no mapping"),
        ("finger-vectors+grip", r"can grip \(teleoperation, picking\)"),
        ("nowhere.py:NAME", "a file that exists"),
        ("nowhere.npz", "a file that exists"),
    ],
)
def test_mappings_that_do_not_exist_are_rejected(name: str, text: str) -> None:
    with pytest.raises(InvalidInputError, match=text):
        check_mapping(name)


# A run.


def test_every_scene_is_tried_by_every_mapping(toy: Entry) -> None:
    blocks = Blocks((5, 50), 3)
    cells = [Cell("toy", "human", "pusher", name) for name in ("unmapped", "straight")]
    results = run_cells(cells, blocks, 1, lambda *_: None)
    for result in results:
        seeds = [one.seed for one in result.attempts]
        assert seeds == [5, 6, 7, 50, 51, 52]
        assert sum(block.recounted for block in result.blocks) >= 1
        assert not any(block.contradicted for block in result.blocks)
    unmapped, straight = results
    assert unmapped.wins.all()
    assert not straight.wins.any()
    assert straight.share.successes == 0


def test_records_are_kept_for_the_judge_and_the_film_alone() -> None:
    cell = Cell("toy", "human", "pusher", "unmapped")
    jobs = jobs_of(cell, Blocks((0, 100), 30))
    kept = frozenset().union(*(job.kept for job in jobs))
    assert 0 in kept
    assert 3 <= len(kept) <= 4
    assert all(job.kept <= {*job.seeds} for job in jobs)
    # The same scenes, whatever the mapping.
    others = jobs_of(cell._replace(method="straight"), Blocks((0, 100), 30))
    assert [job.kept for job in others] == [job.kept for job in jobs]


def test_a_mapping_that_cannot_be_used_is_named_with_its_reason(toy: Entry) -> None:
    cells = [Cell("toy", "human", "pusher", "no such mapping")]
    (result,) = run_cells(cells, Blocks((0,), 2), 1, lambda *_: None)
    assert "no mapping 'no such mapping'" in result.problem
    assert rows_of_results([result]) == []


@pytest.mark.parametrize(
    ("firsts", "attempts"), [((0, 2), 3), ((0,), 0), ((-1,), 1), ((), 1)]
)
def test_blocks_that_share_seeds_are_rejected(
    firsts: tuple[int, ...], attempts: int
) -> None:
    with pytest.raises(InvalidInputError):
        Blocks(firsts, attempts).check()


def made(success: bool, seed: int = 0) -> Attempt:
    """Return an attempt without a record."""
    cause = "" if success else "never <reached>"
    return Attempt(seed, success, 1.0, 1, 0, 2.0, cause, 10, None)


def result_of(method: str, wins: Sequence[bool], **about: int) -> CellResult:
    """Return a cell of one block, all of whose outcomes were recounted alike."""
    attempts = [made(win, seed) for seed, win in enumerate(wins)]
    cell = Cell("toy", "human", "pusher", method)
    recounted = about.get("recounted", len(attempts))
    return CellResult(cell, [Outcome(attempts, recounted=recounted)])


def unmet(results: Sequence[CellResult]) -> set[str]:
    """Return the conditions that are not met, but for the order over blocks."""
    checks = checks_of(results, CATALOGUE)
    return {
        check.what
        for check in checks
        if not check.is_met and "blocks" not in check.what
    }


def test_a_judge_is_unsound_where_nothing_or_everything_wins(
    toy: Entry, monkeypatch: pytest.MonkeyPatch
) -> None:
    all_win, none_win = [True] * 20, [False] * 20
    sound = [result_of("unmapped", all_win), result_of("straight", none_win)]
    assert unmet(sound) == set()
    gift = [sound[0], result_of("straight", [True, *none_win[1:]])]
    assert unmet(gift) == {"straight fingers succeed in none"}
    hard = [result_of("unmapped", [*all_win[2:], False, False]), sound[1]]
    assert unmet(hard) == {"unmapped succeeds in at least 95 %"}
    monkeypatch.setitem(CATALOGUE, "toy", toy._replace(own_control="open"))
    assert unmet([sound[0], result_of("open", [True, *none_win[1:]])]) == {
        "an open hand succeeds in none"
    }
    assert unmet([*gift, result_of("open", none_win)]) == set()
    unseen = [sound[0], result_of("straight", none_win, recounted=0)]
    assert unmet([sound[0]._replace(blocks=unseen[1].blocks), unseen[1]])


def test_what_was_not_tried_shows_nothing(
    toy: Entry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No success of no attempts is no proof, and nor is an agreement about none."""
    monkeypatch.setitem(CATALOGUE, "toy", toy)

    def failed(method: str) -> CellResult:
        cell = Cell("toy", "human", "pusher", method)
        return CellResult(cell, [Outcome((), problem="it cannot be used")])

    nothing = [failed("unmapped"), failed("straight")]
    assert unmet(nothing) == {
        "straight fingers succeed in none",
        "unmapped succeeds in at least 95 %",
        "a second judge recounts at least 5 % of the outcomes alike",
    }
    alone = [result_of("unmapped", [True] * 20), failed("straight")]
    assert unmet(alone) == {"straight fingers succeed in none"}


def test_an_outcome_that_the_second_judge_sees_otherwise_shows(
    toy: Entry, monkeypatch: pytest.MonkeyPatch
) -> None:
    liar = toy._replace(recount=lambda: lambda record: not recount_toy(record))
    monkeypatch.setitem(CATALOGUE, "toy", liar)
    cells = [Cell("toy", "human", "pusher", "unmapped")]
    results = run_cells(cells, Blocks((0,), 4), 1, lambda *_: None)
    assert results[0].blocks[0].contradicted
    assert "a second judge recounts at least 5 % of the outcomes alike" in unmet(
        results
    )


def test_shares_of_objects_add_up_to_those_of_their_cell() -> None:
    wins = [True, False, True, True, False, True, False]
    objects = ("egg", "pen", "can")
    rows = object_rows([result_of("unmapped", wins)], {"toy": objects})
    shares = {row["object"]: row["success"] for row in rows}
    # Seeds 0, 3 and 6 have the egg, 1 and 4 the pen, 2 and 5 the can.
    assert shares == {"egg": "2/3", "pen": "0/2", "can": "2/2"}
    assert rows[1]["causes of failure"] == "2 never <reached>"
    assert object_rows([result_of("unmapped", wins)], {"toy": ()}) == []
    few = object_rows([result_of("unmapped", wins[:1])], {"toy": objects})
    assert [row["object"] for row in few] == ["egg"]


def test_the_page_needs_no_other_file_and_no_text_breaks_it() -> None:
    results = [result_of("unmapped", [True, True]), result_of("<b>", [False, True])]
    checks = [Check("what", "where", False, "1 < 2")]
    page = tasks_page(
        rows_of_results(results),
        object_rows(results, {"toy": ("<egg>", "pen")}),
        pair_rows(groups_of(results)),
        checks,
        ["left out: a & b"],
        {"film": b"RIFF"},
        {"command": "handmap score --tasks"},
    )
    assert "1 never &lt;reached&gt;" in page
    assert "&lt;b&gt;" in page
    assert "&lt;egg&gt;" in page
    assert "<td><b>" not in page
    assert "http" not in page
    assert "1 of 1 conditions are not met: see below" in page


def test_the_command_writes_what_it_prints(
    toy: Entry, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    request = TasksRequest(
        tasks=("toy",),
        out=tmp_path / "out",
        hands=(),
        objects=(),
        operators=("pusher", "slow pusher"),
        methods=("finger-vectors",),
        blocks=Blocks((0, 10), 2),
        processes=1,
        films=False,
        resume=False,
        as_json=True,
    )
    score_tasks(request)
    printed = json.loads(capsys.readouterr().out)
    written = json.loads((tmp_path / "out" / "tasks.json").read_text("utf-8"))
    assert printed == written
    # Two operators, three mappings, two blocks of two.
    assert len(written["results"]) == 6
    assert len(written["attempts"]) == 24
    shares = {row["mapping"]: row["success"] for row in written["results"]}
    assert shares["unmapped"] == "4/4"
    assert shares["straight"] == "0/4"
    assert (tmp_path / "out" / "tasks.html").read_text("utf-8").startswith("<!doctype")


@pytest.mark.parametrize(
    ("score", "text"),
    [
        (Score(tasks=("dor",)), "did you mean door"),
        (Score(tasks=("door",), operators=("nobody",)), "nobody"),
        (Score(tasks=("door",), methods=("nothing",)), "nothing"),
        (Score(tasks=("door",), processes=0), "--processes"),
        (Score(attempts=3), "--attempts"),
        (Score(operators=("expert",)), "--operators"),
        (Score(films=False), "--no-films"),
    ],
)
def test_options_that_cannot_be_used_are_rejected(score: Score, text: str) -> None:
    with pytest.raises(InvalidInputError, match=text):
        score.run()


# Experts and their tasks.


def test_a_delay_comes_before_the_low_pass() -> None:
    filtered = Filter(Style(cutoff=5.0, delay=0.15))
    one = np.ones(1)
    values = [float(filtered(0.0 * one)[0])]
    values += [float(filtered(one)[0]) for _ in range(40)]
    assert values[:16] == [0.0] * 16
    decay = math.exp(-2.0 * math.pi * 5.0 * 0.01)
    expected = [1.0 - decay**i for i in range(1, 26)]
    assert values[16:] == pytest.approx(expected)


def test_an_expert_without_a_style_commands_what_its_policy_says() -> None:
    plain = Filter(Style())
    values = [np.array([float(i)]) for i in range(4)]
    assert [plain(value)[0] for value in values] == [0.0, 1.0, 2.0, 3.0]


def test_a_missing_package_or_file_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(experts.FOLDER, str(tmp_path))
    with pytest.raises(InvalidInputError, match="HANDMAP_OPERATORS"):
        experts.Policy(experts.weights_folder() / "door.npz")
    with pytest.raises(InvalidInputError, match="adroit-assumed"):
        adroit.describe_hand("leap_right", tmp_path)
    monkeypatch.setattr(adroit, "find_spec", lambda _: None)
    with pytest.raises(HandmapError, match="gymnasium-robotics is not installed"):
        adroit.scene_file("door")


def signals(
    touching: str = "", *, is_gripped: bool = False, moved: float = 0.0
) -> Signals:
    """Return signals of one step."""
    return Signals(False, frozenset(touching.split()), is_gripped, 0.0, moved)


@pytest.mark.parametrize(
    ("course", "cause"),
    [
        ([signals()], "never reached"),
        ([signals("thumb")], "touched by one part"),
        (
            [signals("thumb"), signals("thumb index", moved=0.02)],
            "pushed away by the thumb",
        ),
        (
            [signals("index"), signals("thumb index", moved=0.02)],
            "pushed away by a finger",
        ),
        ([signals("index"), signals("thumb index")], "touched, never gripped"),
        ([signals("index", is_gripped=True), signals()], "gripped, then lost"),
        ([signals("index", is_gripped=True)], "gripped, not at the target"),
    ],
)
def test_causes_of_a_lost_ball(course: list[Signals], cause: str) -> None:
    assert adroit.relocate_cause(course) == cause


@pytest.mark.parametrize(
    ("course", "cause"),
    [
        ([signals()], "never reached"),
        ([signals("index")], "touched by one part, not opened"),
        ([signals("thumb index", is_gripped=True)], "gripped, not opened"),
        ([signals("index", moved=0.5)], "opened, not wide enough"),
    ],
)
def test_causes_of_a_closed_door(course: list[Signals], cause: str) -> None:
    assert adroit.door_cause(course) == cause


needs_adroit = [
    pytest.mark.slow,
    pytest.mark.skipif(
        find_spec("gymnasium_robotics") is None,
        reason="needs gymnasium-robotics: pip install 'packages/score[tasks]'",
    ),
    pytest.mark.skipif(
        not (experts.weights_folder() / "door.npz").is_file(),
        reason=f"needs the operators' weights: set {experts.FOLDER}",
    ),
    # Of the packages, at their import.
    pytest.mark.filterwarnings("ignore"),
]
KINDS = [
    pytest.param(adroit.DOOR, judge.recount_door, marks=needs_adroit, id="door"),
    pytest.param(
        adroit.RELOCATE, judge.recount_relocate, marks=needs_adroit, id="relocate"
    ),
]
# What processes do is the same for both: the suite looks at one.
KINDS_ALONE = [
    pytest.param(adroit.DOOR, marks=needs_adroit, id="door"),
    pytest.param(
        adroit.RELOCATE, marks=[*needs_adroit, pytest.mark.full], id="relocate"
    ),
]
Recount = Callable[[Record, Path], bool]


@pytest.fixture(scope="module")
def adroit_hand(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Describe the hand."""
    return str(adroit.describe_hand(adroit.ADROIT, tmp_path_factory.mktemp("hand")))


@pytest.mark.parametrize(("kind", "recount"), KINDS)
def test_experts_win_unmapped_and_lose_with_straight_fingers(
    kind: str, recount: Recount, adroit_hand: str, tmp_path: Path
) -> None:
    task: Task = CATALOGUE[kind].make(adroit_hand, ())
    operator: Operator = experts.Expert(kind, "expert")
    file = tmp_path / "mine.py"
    file.write_text(
        "class Identity:\n"
        "    def __init__(self, human, robot): self.names = robot.joint_names\n"
        "    def reset(self): pass\n"
        "    def map(self, hand, dt): return {n: hand.joints[n] for n in self.names}\n"
    )
    identity = make_mapping(f"{file}:Identity", operator, task.robot, 0)
    scene = adroit.scene_file(kind)
    for seed in range(2):
        own = attempt(task, operator, Unmapped(), seed)
        again = attempt(task, operator, identity, seed)
        lost = attempt(task, operator, Straight(task.robot), seed)
        assert own.is_success
        assert own[:-1] == again[:-1]
        assert own.time == pytest.approx(0.01 * own.steps)
        assert (lost.is_success, lost.steps) == (False, adroit.STEPS)
        assert lost.cause
        assert own.record is not None
        assert lost.record is not None
        assert recount(own.record, scene)
        assert not recount(lost.record, scene)
        # Without the last states the goal has not held for long enough. Places that the maker
        # looks at are one physics step, a fifth of ours, older than the joints.
        short = own.record._replace(qpos=own.record.qpos[:-2])
        assert not recount(short, scene)


@pytest.mark.parametrize("kind", KINDS_ALONE)
def test_processes_change_no_outcome(kind: str, adroit_hand: str) -> None:
    cells = [
        Cell(kind, adroit_hand, "expert", name)
        for name in ("teleoperation", "straight")
    ]
    one, two = (
        run_cells(cells, Blocks((3, 7), 1), processes, lambda *_: None)
        for processes in (1, 2)
    )
    for alone, beside in zip(one, two, strict=True):
        assert [a[:-1] for a in alone.attempts] == [a[:-1] for a in beside.attempts]


@pytest.mark.parametrize(("kind", "recount"), KINDS[:1])
def test_a_film_shows_what_was_recorded(
    kind: str, recount: Recount, adroit_hand: str
) -> None:
    operator = experts.Expert(kind, "expert")
    done = attempt(CATALOGUE[kind].make(adroit_hand, ()), operator, Unmapped(), 0)
    assert done.record is not None
    try:
        (film,) = draw_films([FilmJob(kind, adroit_hand, done.record)], 1)
    except FilmError as error:
        pytest.skip(str(error))
    with Image.open(io.BytesIO(film)) as pictures:
        frames = [
            np.asarray(picture.convert("RGB"), dtype=float)
            for picture in ImageSequence.Iterator(pictures)
        ]
    assert len(frames) == 40
    assert np.abs(frames[0] - frames[-1]).mean() > 1.0


@pytest.mark.parametrize(("kind", "recount"), KINDS)
def test_landmarks_are_those_of_the_commanded_posture(
    kind: str, recount: Recount, adroit_hand: str
) -> None:
    operator = experts.Expert(kind, "expert")
    task = CATALOGUE[kind].make(adroit_hand, ())
    operator.reset(0)
    hand = operator.see(task.reset(0))
    assert {*task.robot.joint_names} < {*hand.joints}
    # The tips are beyond the sites that the maker puts into the tips' capsules.
    kinematics = experts.AdroitKinematics(kind)
    data = mujoco.MjData(kinematics.model)
    for name, value in hand.joints.items():
        bounded = np.clip(value, *kinematics.ranges[name])
        data.joint(name).qpos[0] = bounded
    mujoco.mj_forward(kinematics.model, data)
    sites = [
        data.site(f"S_{finger}tip").xpos for finger in ("th", "ff", "mf", "rf", "lf")
    ]
    gaps = np.linalg.norm(hand.landmarks[4::4] - sites, axis=1)
    assert (gaps < 0.01).all()
    assert hand.landmarks[0] == pytest.approx(hand.wrist[:3, 3])


@pytest.mark.parametrize(("kind", "recount"), KINDS)
def test_calibrations_differ_by_their_seeds_alone(kind: str, recount: Recount) -> None:
    operator = experts.Expert(kind, "expert")
    first, again, other = (operator.calibrate(seed) for seed in (1, 1, 2))
    assert (first.landmarks == again.landmarks).all()
    assert not (first.landmarks == other.landmarks).all()
    # Bones are the hand's own in all samples.
    bones = np.linalg.norm(np.diff(first.landmarks[:, 5:9], axis=1), axis=2)
    assert np.ptp(bones, axis=0) == pytest.approx(0.0, abs=1e-9)


# A run that is stopped.


def request_of(out: Path, *, resume: bool) -> TasksRequest:
    """Return a run of the toy."""
    return TasksRequest(
        tasks=("toy",),
        out=out,
        hands=(),
        objects=(),
        operators=(),
        methods=("finger-vectors",),
        blocks=Blocks((0, 10), 2),
        processes=1,
        films=False,
        resume=resume,
        as_json=True,
    )


class StopError(Exception):
    """Stops a run."""


def test_a_stopped_run_goes_on_where_it_was(
    toy: Entry,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    score_tasks(request_of(tmp_path / "whole", resume=False))
    whole = json.loads(capsys.readouterr().out)
    made: list[int] = []
    run_job = benches.run_job

    def counted(job: benches.Job) -> Outcome:
        if len(made) == 5:
            raise StopError
        made.append(job.seeds.start)
        return run_job(job)

    monkeypatch.setattr(benches, "run_job", counted)
    out = tmp_path / "parts"
    with pytest.raises(StopError):
        score_tasks(request_of(out, resume=False))
    # As a process that was killed leaves it.
    with (out / FILE).open("ab") as file:
        file.write(b'{"key": "toy')
    made.clear()
    monkeypatch.setattr(benches, "run_job", lambda job: made.append(1) or run_job(job))
    score_tasks(request_of(out, resume=True))
    # Three mappings, two blocks of two, of which five were there.
    assert len(made) == 12 - 5
    parts = json.loads(capsys.readouterr().out)
    assert parts["attempts"] == whole["attempts"]
    assert parts["soundness"] == whole["soundness"]
    made.clear()
    score_tasks(request_of(out, resume=True))
    assert not made


def test_a_run_without_resume_keeps_the_attempts_of_the_last_one(
    toy: Entry, tmp_path: Path
) -> None:
    score_tasks(request_of(tmp_path, resume=False))
    before = (tmp_path / FILE).read_bytes()
    score_tasks(request_of(tmp_path, resume=False))
    (old,) = tmp_path.glob("*.before.jsonl")
    assert old.read_bytes() == before


def test_attempts_of_other_versions_are_not_resumed(tmp_path: Path) -> None:
    file = tmp_path / FILE
    with Kept(file, "numpy 1", resume=False):
        pass
    changed = Kept(file, "numpy 2", resume=True)
    with pytest.raises(InvalidInputError, match="numpy 1"), changed:
        pass
    file.write_text("nothing\n")
    with pytest.raises(InvalidInputError, match="a journal"), changed:
        pass


KEEPING = """
import sys, time
from pathlib import Path
from handmap_score.tasks.journal import Kept
with Kept(Path(sys.argv[1]), "1", resume=True):
    print("open", flush=True)
    time.sleep(600.0)
"""
"""A program that has a journal open until it is killed."""


def test_a_journal_has_one_run_at_a_time_and_is_free_when_that_is_killed(
    tmp_path: Path,
) -> None:
    file = tmp_path / FILE
    others = [Kept(file, "1", resume=resume) for resume in (True, False)]
    program = [sys.executable, "-c", KEEPING, str(file)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == "open\n"
            before = file.read_bytes()
            for second in others:
                with pytest.raises(InvalidInputError) as refused, second:
                    pass
                assert str(refused.value) == (
                    f"--out: {file}: another handmap score writes to it"
                )
                assert [*tmp_path.iterdir()] == [file]
                assert file.read_bytes() == before
        finally:
            other.kill()
    for second in others:
        with second:
            assert len(second) == 0


def test_a_kept_attempt_is_the_same(tmp_path: Path) -> None:
    one = attempt(Toy(), Pusher(), Unmapped(), 3)
    line = Line.of("key", one, is_recounted=True, is_contradicted=False)
    with Kept(tmp_path / FILE, "1", resume=False) as kept:
        kept.add(line)
    with Kept(tmp_path / FILE, "1", resume=True) as resumed:
        again = resumed.get("key")
    assert again is not None
    assert again.attempt[:-1] == one[:-1]
    assert one.record is not None
    assert again.attempt.record is not None
    for first, second in zip(one.record, again.attempt.record, strict=True):
        assert np.array_equal(first, second)


def test_a_changed_file_of_a_user_is_another_mapping(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    cell = Cell("toy", "human", "pusher", f"{file}:Mine")
    (job,) = jobs_of(cell, Blocks((0,), 1))
    file.write_text("A = 1\n")
    first = job.key("human")
    file.write_text("A = 2\n")
    assert job.key("human") != first
    assert job.key("human") == job.key("human")
