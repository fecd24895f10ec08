"""Comparisons: each method on the same samples, and a message if a method fails."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from comparison_cases import write_closing
from scipy.spatial.transform import Rotation

from handmap_qp.apps.offline import comparison
from handmap_qp.apps.offline.comparison import (
    ComparedMethod,
    OutsideError,
    Take,
    compare_methods,
    is_peer,
    outside_methods,
    own_method,
    own_methods,
    peers_program,
    prepare_take,
    with_limited,
)
from handmap_qp.apps.offline.hand_trace import TIP
from handmap_qp.apps.offline.limited import clip_motion
from handmap_qp.apps.offline.trajectory import RobotMotion, held_samples
from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.hands import Side
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.mapping.presets import PRESETS
from handmap_qp.se3 import inverse_pose, rotation_from_rpy
from handmap_qp.trackers.formats import read_recording

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow


def still(name: str = "still", *, moves_wrist: bool = False) -> ComparedMethod:
    """Hold one posture, with the wrist at the origin or on the human's palm."""

    def map_take(take: Take, robot: Hand) -> RobotMotion:
        count = len(take.recording)
        wrist = take.trace.palm @ inverse_pose(robot.wrist_to_palm)
        if moves_wrist:
            wrist = np.tile(np.eye(4), (count, 1, 1))
        return RobotMotion(
            robot,
            take.recording.time,
            q=np.tile(robot.rest, (count, 1)),
            wrist=wrist,
            step_cpu=np.full(count, 2e-3),
            moves_wrist=moves_wrist,
        )

    return ComparedMethod(name, map_take)


def _fail(take: Take, robot: Hand) -> RobotMotion:
    raise HandmapError(f"cannot map\n{take.name}")


FAILING = ComparedMethod("failing", _fail)


@pytest.fixture(scope="module")
def robot() -> Hand:
    return load_hand("three_finger")


def take_of(
    folder: Path, name: str = "closing", side: Side = "right", onto: Side = "right"
) -> Take:
    file = write_closing(folder, name, side)
    recording = read_recording(file)
    return prepare_take(recording, onto)


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Take:
    return take_of(tmp_path_factory.mktemp("take"))


def test_take_holds_what_was_not_seen(take: Take) -> None:
    assert (take.name, take.is_mirrored, take.has_wrist) == ("closing", False, True)
    index = np.arange(len(take.recording))
    index[40:43] = 39
    np.testing.assert_array_equal(held_samples(take.recording.valid), index)
    np.testing.assert_array_equal(take.wrist[40:43], take.wrist[[39, 39, 39]])
    assert np.isfinite(take.trace.points).all()
    np.testing.assert_array_equal(
        held_samples(np.array([False, True, False])), [1, 1, 1]
    )


def test_mirrored_take_is_that_of_the_other_hand(take: Take, tmp_path: Path) -> None:
    left = take_of(tmp_path, side="left")
    assert left.is_mirrored
    assert left.recording.side == "right"
    tips, expected = (one.trace.local[:, :, TIP] for one in (left, take))
    np.testing.assert_allclose(tips, expected, atol=1e-6)
    # The wrist pose of the tracker is mirrored with the landmarks.
    fitted = prepare_take(replace(left.recording, wrist=None))
    assert not fitted.has_wrist
    np.testing.assert_allclose(left.wrist, fitted.wrist, atol=1e-6)


def test_palm_of_the_tracker_is_used(take: Take, tmp_path: Path) -> None:
    recording = read_recording(write_closing(tmp_path))
    fitted = prepare_take(replace(recording, wrist=None))
    assert not fitted.has_wrist
    # The landmarks are exact, so both ways find the same palm.
    np.testing.assert_allclose(fitted.wrist, take.wrist, atol=1e-6)


def test_own_methods_get_the_palm_of_the_take(take: Take, robot: Hand) -> None:
    turned = take.wrist.copy()
    turned[30:, :3, :3] = turned[30:, :3, :3] @ rotation_from_rpy([0.0, 0.2, 0.0])
    motions = [
        own_method("fingertip-vectors").map_take(given, robot)
        for given in (take, replace(take, wrist=turned))
    ]
    wrists = [motion.wrist for motion in motions]
    np.testing.assert_array_equal(wrists[0][:30], wrists[1][:30])
    between = wrists[0][-1, :3, :3].T @ wrists[1][-1, :3, :3]
    assert np.degrees(Rotation.from_matrix(between).magnitude()) == pytest.approx(
        11.5, abs=1.0
    )


def test_recording_without_samples_that_count_is_rejected(tmp_path: Path) -> None:
    recording = read_recording(write_closing(tmp_path))
    short = type(recording)(
        "short",
        recording.time[:10],
        recording.landmarks[:10],
        recording.valid[:10],
        recording.side,
    )
    with pytest.raises(
        InvalidInputError, match="short: expected valid samples after the first"
    ):
        prepare_take(short)


def test_methods_are_measured_on_the_same_samples(take: Take, robot: Hand) -> None:
    seen: list[tuple[int, str]] = []
    methods = [own_method("paper"), still(), still("moving", moves_wrist=True)]
    result = compare_methods([take], robot, methods, lambda *args: seen.append(args))
    assert [count for count, _ in seen] == [0, 1, 2, 3]
    assert seen[1][1] == "still on closing (1 of 3)"
    assert result.methods == ("paper", "still", "moving")
    values = result.of_method("still")[0].values
    assert values["extension_correlation"] == 0.0
    assert values["step_time_ms"] == pytest.approx(2.0)
    # A method that does not move the wrist has no palm error, and a note says so.
    assert np.isnan(values["palm_deg"])
    assert np.isnan(values["palm_mm"])
    (note,) = result.notes()
    assert note.startswith("still: the wrist is not moved")
    # A wrist fixed at the origin has the whole motion of the human as error.
    assert result.overall["moving"]["palm_deg"] > 5.0
    assert result.overall["moving"]["palm_mm"] > 50.0
    assert result.overall["paper"]["speed_ratio"] <= 1.0 + 1e-6
    assert result.overall["paper"]["outside_limits"] == 0.0


def test_method_that_fails_says_so(take: Take, robot: Hand) -> None:
    result = compare_methods([take], robot, [FAILING, still(moves_wrist=True)])
    (run,) = result.of_method("failing")
    assert run.problem == "cannot map closing"
    assert run.motion is None
    assert all(np.isnan(value) for value in result.overall["failing"].values())
    assert result.notes() == ["failing: cannot map closing"]


@pytest.mark.slow
def test_failures_on_some_recordings_are_named(
    take: Take, robot: Hand, tmp_path: Path
) -> None:
    other = take_of(tmp_path, "other")
    result = compare_methods([take, other], robot, [FAILING])
    assert result.notes() == [
        "failing on closing: cannot map closing",
        "failing on other: cannot map other",
    ]


@pytest.mark.slow
def test_overall_is_the_mean_over_recordings(
    take: Take, robot: Hand, tmp_path: Path
) -> None:
    file = write_closing(tmp_path, "longer", seconds=1.8)
    result = compare_methods(
        [take, prepare_take(read_recording(file))], robot, [still()]
    )
    values = [run.values["tip_error_mm"] for run in result.of_method("still")]
    assert values[0] != values[1]
    assert result.overall["still"]["tip_error_mm"] == pytest.approx(np.mean(values))


def test_bad_comparisons_are_rejected(take: Take, robot: Hand, tmp_path: Path) -> None:
    left = take_of(tmp_path, "left", side="left", onto="left")
    for takes, methods, argument in (
        ([], [still()], "takes"),
        ([take, take], [still()], "takes"),
        ([left], [still()], "takes"),
        ([take], [], "methods"),
        ([take], [still(), still()], "methods"),
    ):
        with pytest.raises(InvalidInputError) as caught:
            compare_methods(takes, robot, methods)
        assert caught.value.argument == argument


def test_robot_without_named_fingers_is_rejected(take: Take, robot: Hand) -> None:
    points = tuple(
        msgspec.structs.replace(point, finger=None) for point in robot.spec.points
    )
    nameless = Hand(msgspec.structs.replace(robot.spec, points=points))
    with pytest.raises(
        InvalidInputError, match="no finger with a human name"
    ) as caught:
        compare_methods([take], nameless, [still()])
    assert caught.value.argument == "robot"


def test_own_methods_are_presets_and_methods_by_name() -> None:
    assert set(own_methods()) == set(PRESETS) - {"fixed_wrist"}
    assert own_method("paper+smooth").name == "paper+smooth"
    for name in ("homogeneous", "paper+", "+smooth", ""):
        with pytest.raises(InvalidInputError) as caught:
            own_method(name)
        assert caught.value.argument == "--methods"


def test_filter_smooths_and_lags(take: Take, robot: Hand) -> None:
    raw, smooth = (
        own_method(name).map_take(take, robot)
        for name in ("teleoperation", "teleoperation+smooth")
    )
    assert not np.allclose(raw.q, smooth.q, atol=1e-3)
    np.testing.assert_allclose(raw.q[-1], smooth.q[-1], atol=0.3)


PROGRAM = """
import json, sys
import numpy as np
if sys.argv[1] == "list":
    if sys.argv[2] == "unknown":
        sys.exit("first line\\nthis robot is not known")
    others = [{"name": name} for name in ("bare", "broken")]
    print(json.dumps([{"name": "theirs", "about": "theirs 1.0"}, *others]))
else:
    _, _, method, hand, given, made = sys.argv
    with np.load(given) as arrays:
        count = len(arrays["time"])
        assert str(arrays["handedness"]) == "right" and arrays["landmarks"].shape == (count, 21, 3)
    if method == "broken":
        np.savez(made, q=np.zeros((count, 3)), step_time=np.zeros(count))
    else:
        wrist = {"wrist": np.tile(np.eye(4), (count, 1, 1))} if method == "theirs" else {}
        np.savez(made, q=np.full((count, 8), 0.1), step_time=np.full(count, 1e-3), **wrist)
"""


def test_outside_program_is_asked_and_run(
    take: Take, robot: Hand, tmp_path: Path
) -> None:
    (tmp_path / "compare.py").write_text(PROGRAM, encoding="utf-8")
    assert len(robot.joint_names) == 8
    theirs, bare, broken = outside_methods(tmp_path, "three_finger").values()
    motion = theirs.map_take(take, robot)
    assert motion.q.shape == (len(take.recording), 8)
    assert motion.moves_wrist
    assert motion.about == "theirs 1.0"
    # Without a wrist of its own, the palm is the human's.
    found = bare.map_take(take, robot)
    assert not found.moves_wrist
    palm = found.wrist @ robot.wrist_to_palm
    np.testing.assert_allclose(palm, take.trace.palm, atol=1e-12)
    with pytest.raises(OutsideError, match=r"broken: bad result: .*q: expected"):
        broken.map_take(take, robot)


def test_outside_program_that_fails_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(OutsideError, match=r"no compare\.py in") as caught:
        outside_methods(tmp_path, "three_finger")
    assert "\n" not in str(caught.value)
    (tmp_path / "compare.py").write_text(PROGRAM, encoding="utf-8")
    with pytest.raises(OutsideError) as caught:
        outside_methods(tmp_path, "unknown")
    assert str(caught.value) == "this robot is not known"
    (tmp_path / "compare.py").write_text("print('no JSON')", encoding="utf-8")
    with pytest.raises(OutsideError, match="expected a JSON list of methods"):
        outside_methods(tmp_path, "three_finger")


def jumping(robot: Hand, time: np.ndarray) -> RobotMotion:
    """Return a motion that jumps between and beyond the limits of position."""
    rng = np.random.default_rng(0)
    low, high = robot.limits
    q = rng.uniform(low - 1.0, high + 1.0, (len(time), len(low)))
    wrist = np.tile(np.eye(4), (len(time), 1, 1))
    return RobotMotion(robot, time, q, wrist, np.zeros(len(time)), "jumps")


def test_clipped_motions_keep_all_limits_by_their_time_stamps(robot: Hand) -> None:
    time = np.cumsum(np.random.default_rng(1).uniform(1e-3, 0.2, 200))
    jumps = jumping(robot, time)
    clipped = clip_motion(jumps)
    low, high = robot.limits
    assert ((low <= clipped.q) & (clipped.q <= high)).all()
    assert (np.abs(clipped.speeds) <= robot.velocity_limits * (1.0 + 1e-9)).all()
    assert (np.abs(clipped.speeds) > 0.999 * robot.velocity_limits).any()
    np.testing.assert_array_equal(clipped.q[0], np.clip(jumps.q[0], low, high))
    assert clipped.about == "jumps, clipped by the joints' limits"
    # What keeps them already stays as it is.
    np.testing.assert_allclose(clip_motion(clipped).q, clipped.q, rtol=0.0, atol=1e-12)


def test_a_clipped_joint_comes_to_its_target_at_its_speed(robot: Hand) -> None:
    time = np.arange(400) / 60.0
    low, high = robot.limits
    q = np.vstack([low, np.tile(high + 1.0, (len(time) - 1, 1))])
    motion = replace(jumping(robot, time), q=q)
    clipped = clip_motion(motion).q
    expected = np.minimum(high, low + np.outer(time, robot.velocity_limits))
    np.testing.assert_allclose(clipped, expected, atol=1e-9)


def test_peers_are_run_once_for_both_forms(take: Take, robot: Hand) -> None:
    calls = []

    def jump(given: Take, hand: Hand) -> RobotMotion:
        calls.append(given)
        return jumping(hand, given.recording.time)

    methods = with_limited({"theirs": ComparedMethod("theirs", jump)})
    assert [*methods] == [method.name for method in methods.values()]
    assert [*methods] == ["theirs", "theirs+limits"]
    result = compare_methods([take], robot, [*methods.values()])
    assert calls == [take]
    free, limited = (result.overall[name] for name in methods)
    assert free["speed_ratio"] > 1.1
    assert free["outside_limits"] > 0.0
    assert limited["speed_ratio"] == pytest.approx(1.0)
    assert limited["outside_limits"] == 0.0


PEERS = Path(__file__).resolve().parents[2] / "benchmarks" / "peers"


def test_the_peers_program_is_found_without_being_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of the checkout, or of an installed package."""
    assert peers_program() == PEERS
    assert is_peer("dexi-dexpilot")
    assert not any(map(is_peer, own_methods()))
    package = tmp_path / "handmap_qp"
    file = package / "apps" / "offline" / "comparison.py"
    monkeypatch.setattr(comparison, "__file__", str(file))
    assert peers_program() == package / "outside" / "peers"


@pytest.mark.slow
def test_peers_that_are_not_built_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HANDMAP_PEERS", str(tmp_path))
    with pytest.raises(OutsideError, match=r"^--peers: .*not built.*run make peers$"):
        outside_methods(PEERS, "allegro_right")


@pytest.mark.slow
def test_peers_run(take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [str(PEERS.parent), *sys.path])
    from peers import build

    if missing := build.missing_peers():
        pytest.skip(
            f"{', '.join(missing)} not built in {build.peers_folder()}: make peers"
        )
    robot = load_hand("allegro_right")
    methods = outside_methods(PEERS, "allegro_right")
    assert {"dex-vector", "dexi-dexpilot"} <= methods.keys()
    chosen = [methods["dexi-vector-unfiltered"], methods["dexi-position"]]
    result = compare_methods([take], robot, chosen)
    values = result.overall["dexi-vector-unfiltered"]
    assert values["extension_correlation"] > 0.5
    assert np.isnan(values["palm_deg"])
    # The position method moves a free root.
    assert np.isfinite(result.overall["dexi-position"]["palm_deg"])
    assert json.dumps(result.notes()).count("dexi-position") == 0
