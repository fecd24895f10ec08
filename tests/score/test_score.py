"""The score: the reader reads hands as people do, columns are compare's, pages hold everything."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, find_chromium
from handmap_score import cli
from handmap_score.gestures import (
    JOINT_NOISE,
    SOURCES,
    TRACKER_NOISE,
    people,
    perform,
    read_gestures,
)
from handmap_score.pages import votes_page
from handmap_score.reader import Reader, constant_thumb_error, signs
from handmap_score.scoring import (
    LEVEL,
    HandScore,
    Ranking,
    parts_of,
    rank,
    score_hand,
    score_of,
)
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import norm, ttest_rel

from handmap_qp.apps.offline import fidelity
from handmap_qp.apps.offline.compare import Compare, methods_of
from handmap_qp.apps.offline.comparison import (
    ComparedMethod,
    OutsideError,
    Take,
    compare_methods,
    is_peer,
    own_method,
)
from handmap_qp.apps.offline.fidelity import ByFinger, sample_workspace
from handmap_qp.apps.offline.hand_trace import HandTrace, trace_robot
from handmap_qp.apps.offline.trajectory import RobotMotion
from handmap_qp.errors import InvalidInputError, MissingPackageError
from handmap_qp.hands import FINGERS, THUMB, Hand, find_fingers, load_hand
from handmap_qp.human import finger_chains
from handmap_qp.mapping import FistTime, slow_note
from handmap_qp.trackers import check_recording

# Whole hands, pictures and a browser: not for the fast suite.
pytestmark = pytest.mark.slow
HANDY, XRBLOCKS = SOURCES
RATE = 30.0


def follow(take: Take, robot: Hand) -> RobotMotion:
    """Give a human-like hand the person's own pose."""
    count = len(take.recording)
    robot = take.human
    return RobotMotion(
        robot, take.recording.time, take.q, take.wrist, np.full(count, 1e-3)
    )


def stand(take: Take, robot: Hand) -> RobotMotion:
    """Stand still."""
    count = len(take.recording)
    q = np.tile(robot.rest, (count, 1))
    return RobotMotion(robot, take.recording.time, q, take.wrist, np.full(count, 1e-3))


def refuse(take: Take, robot: Hand) -> RobotMotion:
    """Follow in the first seed alone."""
    if take.name.endswith("4"):
        raise OutsideError("not today")
    return follow(take, robot)


METHODS = [
    ComparedMethod("follow", follow),
    ComparedMethod("stand", stand),
    ComparedMethod("refuse", refuse),
]


@pytest.fixture(scope="module")
def human() -> Hand:
    return load_hand("human")


@pytest.fixture(scope="module", autouse=True)
def few_reached() -> Iterator[None]:
    """Sample few points of what fingers can reach.

    It does not count in a score, and every take has a hand of its own.
    """

    def few(hand: Hand) -> ByFinger:
        return sample_workspace(hand, count=500)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fidelity, "sample_workspace", few)
        yield


@pytest.fixture(scope="module")
def scored(human: Hand, few_reached: None) -> HandScore:
    return score_hand(human, METHODS, [], (3, 4), RATE)


@pytest.mark.parametrize(
    ("source", "side"),
    # Other tests look at the same right hands.
    [
        (HANDY, "right"),
        (XRBLOCKS, "right"),
        (HANDY, "left"),
        pytest.param(XRBLOCKS, "left", marks=pytest.mark.full),
    ],
)
def test_performances_are_hands_that_the_input_check_accepts(source, side) -> None:
    _, take, shown, samples = perform(source, 3, RATE, side)
    assert take.recording.side == side
    check_recording(take.recording, name=source.name)
    assert sorted(shown) == sorted(read_gestures(source).names)
    # Every gesture is held where it is read, and as long as every other.
    points = take.recording.landmarks
    for last in samples:
        assert np.ptp(points[last - 11 : last + 1], axis=0).max() < 8.0 * TRACKER_NOISE
    # Bones keep their lengths but for noise, and for poses of two hands with different ones.
    bones = np.diff([finger_chains(each) for each in take.recording.landmarks], axis=2)
    spread = np.linalg.norm(bones, axis=3).std(axis=0)
    assert spread.max() < 0.003


def test_landmarks_at_a_pose_are_the_sources_own() -> None:
    gestures = read_gestures(HANDY)
    with np.load(Path(cli.__file__).parent / "poses" / "handy.npz") as arrays:
        own = arrays["landmarks"].astype(float)
    seen = gestures.seen(gestures.poses, np.random.default_rng(0))

    def distances(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points[:, :, None] - points[:, None], axis=3)

    assert np.abs(distances(seen) - distances(own)).max() < 10.0 * TRACKER_NOISE


def test_seed_decides_everything() -> None:
    first = perform(XRBLOCKS, 3, RATE, "right")
    again = perform.__wrapped__(XRBLOCKS, 3, RATE, "right")
    other = perform(XRBLOCKS, 4, RATE, "right")
    np.testing.assert_array_equal(
        first.take.recording.landmarks, again.take.recording.landmarks
    )
    assert first.shown != other.shown


def test_noise_of_joints_is_spread_evenly() -> None:
    gestures = read_gestures(HANDY)
    every = np.arange(len(gestures.names))
    noise = gestures.show(every, np.random.default_rng(0)) - gestures.poses
    ranges = np.floor(len(every) * norm.cdf(noise[:, :20] / JOINT_NOISE))
    np.testing.assert_array_equal(np.sort(ranges, axis=0), every[:, None].repeat(20, 1))
    assert not noise[:, 20:].any()


def test_perfect_robot_is_read_and_a_still_one_is_not(
    human: Hand, scored: HandScore
) -> None:
    first, second = scored.mappings
    assert [first.method, second.method] == ["follow", "stand"]
    # People themselves are not read without fail: bones and palms are measured in each motion.
    assert min(first.values["people"], first.values["read"]) > 0.98
    assert sum(first.confused.values()) <= 2
    # Its score is not 100: the model's fingers are thick, and overlap in fists.
    assert first.score > 70.0
    assert second.values["read"] < 0.1
    assert second.score < 15.0
    shown, often = next(iter(second.confused.items()))
    assert shown.split(" for ")[0] in read_gestures(HANDY).names
    assert often <= 2
    assert scored.notes == [
        f"refuse on {source.name}, seed 4: not today" for source in SOURCES
    ]
    assert scored.ranking == rank(np.array([first.scores, second.scores]))
    # Without one of two seeds, nothing is told apart.
    assert (scored.ranking.apart, scored.ranking.agreeing) == (0, 0)
    # The pictures' joints are those of the mappings in their order.
    for row in scored.sheet:
        np.testing.assert_array_equal(row.q[1], human.rest)


def test_shuffled_labels_fall_to_chance() -> None:
    rng = np.random.default_rng(0)
    _, take, shown, samples = perform(HANDY, 3, RATE, "right")
    reader = Reader(HANDY, "right", FINGERS)
    right = []
    for _ in range(100):
        shuffled = take.trace.part(rng.permutation(samples), FINGERS)
        right.append(np.equal(reader.read(shuffled, shown), shown).mean())
    assert np.mean(right) == pytest.approx(reader.same.mean(), abs=0.01)
    assert reader.same.mean() < 0.03


def with_turned_thumb(hand: HandTrace, degrees: float, axis: int) -> HandTrace:
    """Return a hand whose thumb is turned about an axis of its palm, in its CMC joint."""
    thumb = hand.names.index(THUMB)
    points = hand.local.copy()
    turn = Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis])
    knuckle = points[:, thumb, :1]
    own = points[:, thumb] - knuckle
    points[:, thumb] = knuckle + turn.apply(own.reshape(-1, 3)).reshape(own.shape)
    at_origin = np.tile(np.eye(4), (len(points), 1, 1))
    return hand._replace(points=points, palm=at_origin)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_thumb_that_is_wrong_in_every_gesture_is_not_overlooked(axis: int) -> None:
    right = wrong = count = 0
    for source in SOURCES:
        _, take, shown, samples = perform(source, 3, RATE, "right")
        person = take.trace.part(samples, FINGERS)
        reader = Reader(source, "right", FINGERS)
        off = with_turned_thumb(person, 50.0, axis)
        right += np.equal(reader.read(person, shown), shown).sum()
        wrong += np.equal(reader.read(off, shown), shown).sum()
        count += len(shown)
        assert constant_thumb_error(person, person) == 0.0
        assert 20.0 < constant_thumb_error(person, off) <= 50.0
    assert right > 0.98 * count
    assert wrong < 0.87 * count


def test_a_gesture_is_read_by_itself() -> None:
    _, take, shown, samples = perform(HANDY, 3, RATE, "right")
    reader = Reader(HANDY, "right", FINGERS)
    # Some are wrong, so that what is read is more than what is shown.
    hand = with_turned_thumb(take.trace.part(samples, FINGERS), 50.0, 2)
    alone = [
        reader.read(hand.part(np.array([i]), FINGERS), shown[i : i + 1])[0]
        for i in range(len(shown))
    ]
    assert reader.read(hand, shown) == alone


def test_constant_errors_of_thumbs_are_those_of_all_gestures() -> None:
    _, take, _, samples = perform(HANDY, 3, RATE, "right")
    person = take.trace.part(samples, FINGERS)
    # Half of them to either side: nothing is left in common.
    half = np.arange(len(samples)) < len(samples) // 2
    there, back = (with_turned_thumb(person, angle, 0) for angle in (20.0, -20.0))
    both = there._replace(
        points=np.where(half[:, None, None, None], there.points, back.points)
    )
    assert constant_thumb_error(person, there) > 15.0
    assert constant_thumb_error(person, both) < 5.0
    assert np.isnan(constant_thumb_error(person.part(half, FINGERS[1:]), person))


def test_other_bases_of_fingers_alone_do_not_make_a_hand_misread() -> None:
    """Nearest postures of hands of other proportions are read, without what they have in common."""
    robot = load_hand("allegro_right")
    fingers = tuple(find_fingers(robot))
    reader = Reader(XRBLOCKS, "right", fingers)
    shown = read_gestures(XRBLOCKS).names
    low, high = robot.limits

    def seen(share: np.ndarray) -> np.ndarray:
        return signs(trace_robot(robot, low + np.atleast_2d(share) * (high - low)))

    def jacobian(share: np.ndarray) -> np.ndarray:
        step = np.where(share > 0.5, -1e-4, 1e-4)
        rows = seen(np.vstack([share, share + np.diag(step)]))
        return ((rows[1:] - rows[0]) / step[:, None]).T

    start = (robot.rest - low) / (high - low)
    person = people(XRBLOCKS, "right")
    means = signs(person.part(np.arange(len(person.points)), fingers))
    means = means.reshape(-1, len(shown), means.shape[1]).mean(axis=0)
    nearest = [
        least_squares(
            lambda share, mean=mean: seen(share)[0] - mean,
            start.clip(0.02, 0.98),
            jacobian,
            bounds=(0.0, 1.0),
            xtol=1e-2,
            ftol=1e-2,
        ).x
        for mean in means
    ]
    shows = trace_robot(robot, low + np.array(nearest) * (high - low))
    assert np.equal(reader.read(shows, shown), shown).mean() > 0.9


def test_fewer_fingers_tell_fewer_gestures_apart() -> None:
    names = read_gestures(HANDY).names
    reads = [Reader(HANDY, "right", FINGERS[:count]).same for count in (5, 3)]
    a, b = names.index("devil / bull"), names.index("asl 1 / point")
    assert [same[a, b] for same in reads] == [False, True]
    assert reads[0].sum() < reads[1].sum()


def test_hand_without_a_thumb_is_read_too() -> None:
    _, take, shown, samples = perform(HANDY, 3, RATE, "right")
    hand = take.trace.part(samples, FINGERS[1:])
    assert Reader(HANDY, "right", hand.names).read(hand, shown) == [*shown]


def test_places_are_shared_unless_seeds_tell_mappings_apart() -> None:
    rng = np.random.default_rng(0)
    means = np.array([90.0, 89.9, 60.0, 20.1, 20.0])[:, None]
    scores = means + rng.normal(0.0, 1.0, (5, 6))
    # Without any of six seeds, eight pairs are apart.
    assert rank(scores) == Ranking([1, 1, 3, 4, 4], 48, 48)
    # Places are those of the mappings as they are given.
    assert rank(scores[[4, 2, 0, 3, 1]]) == Ranking([4, 3, 1, 4, 1], 48, 48)
    # What seeds have in common tells nothing: mappings are paired.
    hard = 30.0 * rng.normal(size=6)
    assert rank(np.array([hard, hard - rng.uniform(1.0, 2.0, 6)])).places == [1, 2]
    # The test is scipy's.
    for gap in np.linspace(0.0, 3.0, 50):
        pair = np.array([rng.normal(gap, 1.0, 5), rng.normal(0.0, 1.0, 5)])
        is_better = ttest_rel(*pair, alternative="greater").pvalue < LEVEL
        assert rank(pair).places == [1, 1 + is_better]
    # A seed does not agree with itself: without it, the other one tells nothing apart.
    assert rank(np.array([[2.0, 2.0], [1.0, 1.0]])) == Ranking([1, 2], 0, 0)
    # A seed that turns round what the others say does not agree, in one of three pairs.
    turned = np.array([[10.0], [0.0], [-50.0]]).repeat(20, axis=1)
    turned[:2, 0] = 0.0, 1.0
    assert rank(turned) == Ranking([1, 2, 3], 60, 59)
    assert rank(means) == Ranking([1] * 5, 0, 0)


def test_columns_are_those_of_compare(human: Hand) -> None:
    methods = [own_method("teleoperation")]
    robot = load_hand("three_finger")
    (row,) = score_hand(robot, methods, [], (3,), RATE).mappings
    takes = [perform(source, 3, RATE, "right").take for source in SOURCES]
    columns = compare_methods(takes, robot, methods).overall["teleoperation"]
    del columns["step_time_ms"]
    for key, value in columns.items():
        np.testing.assert_equal(row.values[key], value, err_msg=key)
    assert row.score == pytest.approx(score_of(parts_of(row.values)))


def test_score_is_that_of_the_formula() -> None:
    good = {
        "finger_direction_deg": 0.0,
        "pinch_closed": 1.0,
        "pinch_false": 0.0,
        "read": 0.9,
        "people": 0.9,
        "chance": 0.1,
        "self_penetration": 0.0,
        "jerk_ratio": 0.5,
        "speed_ratio": 1.0,
        "outside_limits": 0.0,
        "latency_ms": 0.0,
    }

    def score(**changes: float) -> float:
        return score_of(parts_of(good | changes))

    assert score() == pytest.approx(100.0)
    assert score(finger_direction_deg=22.5) == pytest.approx(100.0 * 2.5 / 3.0)
    assert score(pinch_false=0.05) == pytest.approx(100.0 * 2.5 / 3.0)
    assert score(read=0.1) == pytest.approx(score(read=0.0)) == pytest.approx(200 / 3)
    assert score(self_penetration=0.5) == pytest.approx(100.0 * 2.5 / 3.0)
    assert score(jerk_ratio=2.0) == score(speed_ratio=2.0) == pytest.approx(250 / 3)
    assert score(latency_ms=-75.0) == pytest.approx(100.0 * 2.5 / 3.0)
    # Without pinches, the two other parts count; without motion there is no lag to praise.
    assert score(pinch_closed=np.nan, finger_direction_deg=45.0) == pytest.approx(50.0)
    assert score(latency_ms=np.nan) == pytest.approx(200.0 / 3.0)


SLOW = FistTime(1.4, "f1_distal", np.full(8, 1.4), is_assumed=False)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, few_reached: None) -> Path:
    """Run the command on a small hand, with pictures of a few pixels."""
    folder = tmp_path_factory.mktemp("score") / "new"

    def small(columns, rows, *, side) -> np.ndarray:
        return np.full((len(rows), 1 + len(columns), 2, 4, 4, 3), 0.5)

    command = cli.Score(
        out=folder,
        hands=("three_finger",),
        methods=("paper", "finger-vectors"),
        seeds=(3,),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("handmap_score.pages.pose_pictures", small)
        patch.setattr(cli, "fist_time", lambda *_: SLOW)
        command.run()
    return folder


def test_page_has_gestures_with_source_and_licence(written: Path) -> None:
    results = json.loads((written / "score.json").read_text())
    (hand,) = results["hands"].values()
    page = (written / "score.html").read_text()
    for source in SOURCES:
        assert f'"poses: {source.name}":"{source.licence}, ' in page
        assert f'"source":"{source.name}, {source.licence}"' in page
    assert "http" not in page.replace("https://github.com", "")
    # Pictures of every third gesture.
    assert page.count('"UklGR') == 24 * 2
    assert results["about"]["seeds"] == [3]
    methods = [row["method"] for row in hand["mappings"]]
    assert {*methods} == {"paper", "finger-vectors"}
    # A hand that is slower than people is known as one.
    assert results["about"]["speed: three_finger"] == slow_note(SLOW)
    assert "This hand needs 1.4 s for a fist" in page
    # Peers that did not run say how to.
    assert "handmap-qp[peers]" in results["about"]["peers"]
    assert [row["mapping"] for row in results["overview"]] == methods


@pytest.mark.skipif(find_chromium() is None, reason="no Chromium")
def test_pages_in_a_browser(written: Path) -> None:
    program = find_chromium()
    assert program
    with Browser(program) as browser:
        browser.open(f"file://{written}/score.html")
        browser.wait_for("document.querySelectorAll('#gestures tr').length == 25")
        text = browser.evaluate("document.body.innerText")
        assert "asl " in text
        assert "of 0 pairs that the others place apart, 0 do not turn round" in text
        assert browser.evaluate("document.images[0].decode().then(() => 1)") == 1
        assert browser.evaluate("document.images.length") == 24 * 2
        assert "Stewart Smith" in text
        browser.open(f"file://{written}/votes.html")
        browser.wait_for("document.getElementById('progress')?.textContent")
        # Nothing says which mapping is which.
        shown = browser.evaluate("document.body.innerText")
        assert "paper" not in shown
        better = [
            0 if a > b else 1 for a, b in browser.evaluate("PAIRS.map(p => p.scores)")
        ]
        keys = {0: ("ArrowLeft", 37), 1: ("ArrowRight", 39)}
        browser.evaluate(f"document.querySelectorAll('.picture')[{better[0]}].click()")
        browser.press(*keys[better[1]])
        browser.press(*keys[1 - better[2]])
        browser.press("ArrowDown", 40)
        assert "2 of 3 votes agree" in browser.evaluate("document.body.innerText")
        # Votes outlive the page. When a busy browser hands them on is its own affair.
        stored = browser.evaluate("JSON.stringify({...localStorage})")
        browser.call(
            "Page.addScriptToEvaluateOnNewDocument",
            source=f"Object.assign(localStorage, {stored})",
        )
        browser.open(f"file://{written}/votes.html?again")
        browser.wait_for("location.search == '?again'")
        browser.wait_for("document.getElementById('progress')?.textContent")
        assert "4 of 6 pairs" in browser.evaluate("document.body.innerText")
        rows = browser.evaluate("rows()")
        assert [row["agrees"] for row in rows] == [True, True, False, ""]
        assert browser.evaluate("csv(rows()).split('\\n').length") == 5
        assert browser.errors == []


def test_votes_show_the_mappings_that_they_name(
    scored: HandScore, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = {}

    def remember(columns, rows, *, side) -> np.ndarray:
        drawn.update((row.label, row.q) for row in rows)
        return np.full((len(rows), 3, 2, 4, 4, 3), 0.5)

    monkeypatch.setattr("handmap_score.pages.pose_pictures", remember)
    page = votes_page([scored], 5)
    asked = json.loads(page.partition("PAIRS = ")[2].partition(";\n")[0])
    assert len(asked) == 5
    methods = [mapping.method for mapping in scored.mappings]
    ends = {row.label: row.q for row in scored.sheet}
    for pair in asked:
        own = [methods.index(method) for method in pair["mappings"]]
        assert pair["scores"] == [scored.mappings[i].score for i in own]
        shown = [ends[pair["gesture"]][i] for i in own]
        np.testing.assert_array_equal(drawn[pair["gesture"]], shown)


def refused(command: cli.Score, argument: str) -> None:
    with pytest.raises(InvalidInputError) as error:
        command.run()
    assert error.value.argument == argument


def test_wrong_words_are_refused_before_any_work(tmp_path: Path) -> None:
    one = cli.Score(out=tmp_path, hands=("three_finger",))
    refused(replace(one, seeds=(1, 1)), "--seeds")
    refused(replace(one, seeds=(-1,)), "--seeds")
    refused(replace(one, methods=("nothing",)), "--methods")
    refused(replace(one, hands=("three_finger", "three_finger")), "--hands")
    (tmp_path / "file").touch()
    refused(replace(one, out=tmp_path / "file" / "new"), "--out")


def test_hands_whose_fingers_have_no_names_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cli, "find_fingers", lambda robot: {})
    refused(cli.Score(hands=("three_finger",)), "--hands")


def test_shapes_are_of_one_hand_and_not_of_tasks() -> None:
    urdf = Path("other.urdf")
    refused(cli.Score(hands=("three_finger", "human"), shapes=urdf), "--shapes")
    refused(cli.Score(hands=("three_finger",), shapes=urdf), "--shapes")
    refused(cli.Score(tasks=("pick",), shapes=urdf), "--shapes")


def test_mappings_go_on_without_peers_that_cannot_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def without_peers(request: Compare) -> list[ComparedMethod]:
        if request.peers or any(map(is_peer, request.methods)):
            raise OutsideError("not built")
        return methods_of(request)

    monkeypatch.setattr(cli, "methods_of", without_peers)
    # The name of a peer asks for it, with and without --peers.
    for peers in (True, False):
        about: dict[str, Any] = {}
        named = Compare((), "three_finger", ("paper", "dex-vector"), peers=peers)
        (method,) = cli.mappings_of(named, about)
        assert method.name == "paper"
        assert about == {"peers on three_finger": "left out: not built"}
        with pytest.raises(OutsideError):
            cli.mappings_of(replace(named, methods=("dex-vector",)), about)


def test_hands_that_are_not_installed_are_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def load(name: str) -> Hand:
        raise MissingPackageError("a-hand")

    monkeypatch.setattr(cli, "load_hand", load)
    refused(cli.Score(), "--hands")


FUNCTION = """
import numpy as np
def joints(landmarks):
    return np.full(16, landmarks[8, 0] - landmarks[0, 0])
"""


def test_a_function_needs_the_hand_that_it_is_for(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(FUNCTION, encoding="utf-8")
    refused(cli.Score(files=(str(file),)), "--hands")
    refused(cli.Score(methods=(f"{file}:joints",)), "--hands")
    refused(cli.Score(trajectory=(tmp_path,)), "--hands")
    refused(cli.Score(trajectory=(file,)), "--trajectory")
    refused(cli.Score(files=("teleoperation",)), "FILE.py")
    refused(cli.Score(files=(str(tmp_path / "absent.py"),)), "FILE.py")
    refused(cli.Score(tasks=("pick",), gestures=tmp_path), "--gestures")
    refused(cli.Score(tasks=("pick",), trajectory=(tmp_path,)), "--trajectory")


def test_joints_of_any_program_score_as_the_function_that_made_them(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(FUNCTION, encoding="utf-8")
    shown, joints = tmp_path / "shown", tmp_path / "joints"
    monkeypatch.setattr(cli, "score_page", lambda *_: "")
    monkeypatch.setattr(cli, "votes_page", lambda *_: "")
    given = cli.Score(
        out=tmp_path / "out", hands=("allegro_right",), seeds=(3,), methods=("paper",)
    )
    replace(given, gestures=shown).run()
    printed = capsys.readouterr().out
    assert (
        "handmap score --trajectory FOLDER --hands allegro_right --seeds 3" in printed
    )
    files = sorted(shown.iterdir())
    names = ["demo_right.npz", "handy_seed_3.npz", "xrblocks_seed_3.npz"]
    assert [each.name for each in files] == names
    joints.mkdir()
    for each in files:
        with np.load(each) as arrays:
            points = arrays["landmarks"]
            q = np.repeat((points[:, 8, 0] - points[:, 0, 0])[:, None], 16, axis=1)
            np.savez(
                joints / each.name,
                time=arrays["time"],
                q=q,
                joint_names=load_hand("allegro_right").joint_names,
            )
    replace(given, files=(str(file),), trajectory=(joints,)).run()
    assert "give three by --seeds" in capsys.readouterr().err
    results = json.loads((tmp_path / "out" / "score.json").read_text("utf-8"))
    scores = {row["mapping"]: row["score"] for row in results["overview"]}
    assert scores["mine.py"] == scores["joints"]
    assert {*scores} == {"paper", "mine.py", "joints"}
    # Without a file, one of the names is that of the first recording.
    (joints / names[1]).unlink()
    with pytest.raises(InvalidInputError, match="for the recording handy, seed 3"):
        replace(given, trajectory=(joints,)).run()
