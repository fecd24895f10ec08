"""Pinches, trials, films and the command."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from picks import HOUSEHOLD, made_pick, picks
from scipy.spatial.transform import Rotation
from simulation_cases import CUBE

from handmap_core.human.recording import Recording
from handmap_qp import HandError, InvalidInputError, InvalidOptionsError, cli, load_hand
from handmap_qp.apps.offline.trajectory import RobotMotion
from handmap_qp.apps.simulation.commands import PinchWindow, find_pinch, read_pick
from handmap_qp.apps.simulation.pads import Pads, largest_slide
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.pictures import film, picture, write_page
from handmap_qp.apps.simulation.pinch import (
    PinchOutcome,
    PinchScene,
    PinchTrial,
    random_trials,
)
from handmap_qp.apps.simulation.pinch_rows import describe_trial, success_rate
from handmap_qp.apps.simulation.simulator import Episode, Instant, Simulator
from handmap_qp.hands import Side
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.pads import find_pads
from handmap_qp.hands.spec import PadSpec
from handmap_qp.mapping.objects import (
    Box,
    Cylinder,
    MeshShape,
    Sphere,
    parse_object,
    surface,
)
from handmap_qp.trackers.formats import write_recordings
from handmap_qp.trackers.formats.archive import read_archive

WINDOW = PinchWindow(0, 10, 60)


@pytest.fixture(scope="module")
def pinching() -> PinchScene:
    """A gripper that closes within a fifth of a second, and then rises."""
    hand = load_hand("panda_gripper")
    time = np.arange(61) / 50.0
    q = np.interp(time, [0.0, 0.2], [0.04, 0.0])[:, None]
    wrist = np.tile(np.eye(4), (61, 1, 1))
    wrist[:, :3, :3] = np.diag([1.0, -1.0, -1.0])
    wrist[:, 2, 3] = np.interp(time, [0.4, 1.0], [0.0, 0.1])
    commands = RobotMotion(hand, time, q, wrist, np.zeros(61))
    return PinchScene(commands, WINDOW, Physics())


@pytest.fixture(scope="module")
def lifted(pinching: PinchScene) -> PinchOutcome:
    return pinching.run(PinchTrial())


def test_a_closing_gripper_lifts_the_object(lifted: PinchOutcome) -> None:
    outcome, poses = lifted, lifted.episode.at.object_pose[:, :3, 3]
    assert outcome.is_held
    assert poses[-1, 2] - poses[0, 2] == pytest.approx(0.1, abs=0.005)
    assert outcome.held_time == pytest.approx(outcome.pinch_time)


def test_the_object_stands_where_the_robots_own_pads_meet(pinching: PinchScene) -> None:
    """The pads lag behind their commands, so these have gone further by then."""
    met = pinching.meeting(0.03)
    assert pinching.pads.pair.gap(met.places) == pytest.approx(0.03, abs=1e-4)
    soft = pinching.physics.replaced(sliding_stiffness=200.0)
    later = PinchScene(pinching.commands, WINDOW, soft).meeting(0.03)
    assert later.time > met.time + 0.01
    # Wider objects are met earlier.
    assert pinching.meeting(0.05).time < met.time
    # What is nearer than the pads can come is met at their nearest.
    never = pinching.meeting(-1.0)
    assert pinching.pads.pair.gap(never.places) < 0.005


def test_the_middle_is_as_far_from_the_surfaces_of_both_pads() -> None:
    """A description may give the thumb a larger pad than the hand's shapes have."""
    spec = load_hand("three_finger").spec
    pad = PadSpec(radius=0.012)
    points = tuple(
        msgspec.structs.replace(point, pad=pad) if point.finger == "thumb" else point
        for point in spec.points
        if point.name in spec.sets["fingertips"]
    )
    sets = {"fingertips": spec.sets["fingertips"]}
    hand = load_hand(msgspec.structs.replace(spec, points=points, sets=sets))
    pads = Pads(hand)
    thumb, finger = (find_pads(hand)[name] for name in ("thumb", "index"))
    assert thumb.radius > finger.radius + 1e-3
    simulator = Simulator(hand, CUBE)
    simulator.reset(
        simulator.hand.configuration_vector(hand.rest, np.eye(4)), np.eye(4)
    )
    places = pads.places(simulator)
    middle = pads.pair.middle(places)
    to_thumb, to_finger = np.linalg.norm(places - middle, axis=1)
    half = pads.pair.gap(places) / 2.0
    assert to_thumb - thumb.radius == pytest.approx(half)
    assert to_finger - finger.radius == pytest.approx(half)


def test_the_stand_lets_go_when_both_pads_have_pressed(lifted: PinchOutcome) -> None:
    """Not at the first touch, nor when the pads should have met the object a while ago."""
    at = lifted.episode.at
    pressed = np.flatnonzero(at.links_touching >= 2)[0]
    gripped = at.time[pressed] + 0.2
    assert lifted.pinch_time == pytest.approx(at.time[-1] - gripped, abs=0.03)


def test_the_stand_lets_go_at_last_where_no_grip_comes(pinching: PinchScene) -> None:
    """A second after the pads should have met the object."""
    below = PinchTrial(offset=(0.0, 0.0, -0.06))
    met = pinching.meeting(surface(below.shape).extents[0])
    at = pinching.run(below).episode.at
    falls = np.flatnonzero(at.object_pose[0, 2, 3] - at.object_pose[:, 2, 3] > 1e-4)
    assert at.time[falls[0]] == pytest.approx(met.time + 1.0, abs=0.05)
    # A grip that ends before has had no object to lose.
    short = PinchScene(pinching.commands, PinchWindow(0, 10, 40), pinching.physics)
    outcome = short.run(below)
    assert (outcome.is_held, outcome.held_time, outcome.slip) == (False, 0.0, 0.0)


def test_an_object_that_goes_with_its_pads_does_not_slide_on_them() -> None:
    """Pads that turn by a right angle, and a wrist that does not: 3 mm along, then 4 mm across."""
    away = np.array([[0.0, 0.003, 0.0], [-0.003, 0.0, 0.0], [-0.003, 0.0, 0.004]])
    lines = 0.04 * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    assert largest_slide(away[:2], lines[:2]) == pytest.approx(0.0, abs=1e-12)
    assert largest_slide(away, lines) == pytest.approx(0.004)
    # Pads at one place, and the first instant alone, have no turn.
    assert largest_slide(away[:1], lines[:1]) == 0.0
    assert largest_slide(away[:2], 0.0 * lines[:2]) == pytest.approx(0.003 * 2**0.5)


def test_jaws_that_only_close_slide_as_far_as_their_object_slips(
    pinching: PinchScene, lifted: PinchOutcome
) -> None:
    """Jaws neither turn nor move against their wrist: both displacements are one."""
    assert lifted.slide == pytest.approx(lifted.slip, abs=1e-3)
    lost = pinching.run(PinchTrial(friction=0.01, mass=0.2))
    assert lost.slide > 0.01
    assert lost.slide == pytest.approx(lost.slip, abs=5e-3)


def test_what_was_carried_for_no_time_was_not_held(pinching: PinchScene) -> None:
    whole = pinching.run(PinchTrial())
    assert whole.is_held
    time = pinching.commands.time
    freed = np.searchsorted(time, time[pinching.window.end] - whole.pinch_time)
    for later, is_held in ((0.1, False), (0.3, True)):
        end = int(np.searchsorted(time, time[freed] + later))
        window = pinching.window._replace(end=end)
        scene = PinchScene(pinching.commands, window, pinching.physics)
        assert scene.run(PinchTrial()).is_held == is_held


def test_a_trial_starts_where_the_open_hand_is_last_clear_of_the_object(
    pinching: PinchScene,
) -> None:
    """The pads by 15 mm, all else at all; not at the last sample that may be the first."""
    window = PinchWindow(8, 10, 60)
    scene = PinchScene(pinching.commands, window, pinching.physics)
    episode = scene.run(PinchTrial()).episode
    place = episode.at.object_pose[0]
    simulator = Simulator(pinching.commands.robot, episode.shape, pinching.physics)
    gaps = []
    for i in range(9):
        simulator.reset(pinching.commands.at(i), place)
        gaps.append(simulator.clearance(scene.pads.bodies))
    start = 60 - len(episode.at.time)
    assert gaps[start] >= 0.015 > gaps[start + 1]
    assert start < window.start


def test_an_object_in_the_hand_at_the_start_is_refused_by_name(
    pinching: PinchScene,
) -> None:
    closed = PinchScene(
        pinching.commands, PinchWindow(12, 14, 60, opened=11), pinching.physics
    )
    with pytest.raises(InvalidInputError, match=r"panda_gripper.* 15 mm") as caught:
        closed.run(PinchTrial(offset=(0.0, 0.0, 0.01)))
    assert caught.value.argument == "panda_gripper"
    # Half of the width inside each pad: the gap is shut.
    assert re.search(r"pads at -\d+ mm, the nearest link at -\d+ mm", str(caught.value))
    # Pads that are clear do not make up for another link in the object.
    tall = PinchTrial(shape=Box((0.02, 0.02, 0.3)))
    with pytest.raises(InvalidInputError, match=r"pads at .* link at -\d+ mm"):
        pinching.run(tall)


@pytest.mark.parametrize(
    "trial",
    [
        PinchTrial(friction=0.01, mass=0.2),
        PinchTrial(offset=(0.0, 0.0, -0.06)),
        PinchTrial(shape=Sphere(0.008), offset=(0.03, 0.0, 0.0)),
    ],
    ids=["slippery", "below", "beside"],
)
def test_what_is_not_gripped_falls(pinching: PinchScene, trial: PinchTrial) -> None:
    outcome = pinching.run(trial)
    assert not outcome.is_held
    assert outcome.held_time < outcome.pinch_time


def test_trials_repeat_with_their_seed(pinching: PinchScene) -> None:
    one, same, other = (random_trials(20, seed) for seed in (3, 3, 4))
    for a, b in zip(one, same, strict=True):
        assert (a.offset, a.yaw, a.mass, a.friction) == (
            b.offset,
            b.yaw,
            b.mass,
            b.friction,
        )
        assert type(a.shape) is type(b.shape)
    assert [t.mass for t in one] != [t.mass for t in other]
    assert all(0.02 <= surface(trial.shape).extents[0] <= 0.045 for trial in one)
    assert {trial.mass for trial in random_trials(5, 0, "nominal")} == {0.05}
    results = [pinching.run(one[0]._replace(shape=Sphere(0.012))) for _ in range(2)]
    first, second = (result.episode.at.object_pose for result in results)
    np.testing.assert_array_equal(first, second)


def test_intervals_hold_the_rate_and_shrink_with_trials() -> None:
    for held, count in ((0, 10), (5, 10), (10, 10), (190, 200)):
        rate, low, high = success_rate(held, count)
        assert 0.0 <= low <= rate + 1e-12
        assert rate <= high + 1e-12 <= 1.0 + 1e-9
    assert np.ptp(success_rate(100, 200)[1:]) < np.ptp(success_rate(10, 20)[1:])
    # Wilson's interval of 8 of 10, as in Newcombe 1998 for other counts: (p + z^2/2n +- ...) / ...
    np.testing.assert_allclose(success_rate(8, 10)[1:], (0.4902, 0.9433), atol=1e-4)


def test_a_pinch_is_found_in_landmarks() -> None:
    time = np.arange(200) / 100.0
    landmarks = np.tile(load_landmarks(), (200, 1, 1))
    landmarks[:, 8] = landmarks[:, 4] + np.array([0.08, 0.0, 0.0])
    landmarks[50:150, 8] = landmarks[50:150, 4] + np.array([0.01, 0.0, 0.0])
    recording = Recording("made", time, landmarks, np.ones(200, dtype=bool), "right")
    window = find_pinch(recording, takes_fists=True)
    assert window == PinchWindow(49, 50, 149, "right", opened=0)
    landmarks[:, 8] = landmarks[:, 4] + np.array([0.08, 0.0, 0.0])
    with pytest.raises(
        InvalidInputError, match=r"open: expected a pinch .* got 0\.00 s"
    ):
        find_pinch(
            Recording("open", time, landmarks, np.ones(200, dtype=bool), "right"),
            takes_fists=True,
        )


def slow_pinch(gap: Any, turn: Any = 0.0) -> Recording:
    """A hand of a gap [m] that turns by an angle [rad], both over 3 s, at 100 Hz."""
    time = np.arange(300) / 100.0
    landmarks = np.tile(load_landmarks(), (300, 1, 1))
    landmarks[:, 8] = landmarks[:, 4]
    landmarks[:, 8, 0] += gap(time)
    turns = Rotation.from_rotvec(np.outer(time * turn, [0.0, 0.0, 1.0])).as_matrix()
    landmarks = np.einsum("tij,tpj->tpi", turns, landmarks)
    return Recording("mine", time, landmarks, np.ones(300, dtype=bool), "right")


def closing_at(*knots: float) -> Any:
    """A gap of 100 mm that becomes 10 mm between two instants."""
    return lambda time: np.interp(time, knots, [0.1, 0.01])


def test_a_hand_that_is_not_open_shortly_before_is_no_pick() -> None:
    """From 65 to 22 mm it takes 43 / 90 of the time in which it closes."""
    window = find_pinch(slow_pinch(closing_at(0.1, 2.1)), takes_fists=True)
    assert window.closed == pytest.approx(10 + 200 * 78 / 90, abs=1)
    assert window.start == pytest.approx(10 + 200 * 35 / 90, abs=1)
    # Open since the beginning, and at most a second before.
    assert window.opened == 0
    late = find_pinch(slow_pinch(closing_at(1.0, 2.0)), takes_fists=True)
    assert 99 <= late.start - late.opened <= 100
    with pytest.raises(InvalidInputError, match="at most 59 mm") as caught:
        find_pinch(slow_pinch(closing_at(0.1, 2.5)), takes_fists=True)
    assert caught.value.argument == "mine"
    assert "open by 65 mm" in caught.value.expected


def test_a_wrist_that_turns_while_the_hand_closes_makes_no_pick() -> None:
    """From 65 mm to 22 mm within 43 / 90 s."""
    closing = closing_at(0.5, 1.5)
    still = np.radians(20.0) * 90 / 43
    assert find_pinch(slow_pinch(closing, still), takes_fists=True).closed == 137
    with pytest.raises(InvalidInputError, match="got 31 degrees") as caught:
        find_pinch(slow_pinch(closing, 1.5 * still), takes_fists=True)
    assert "mine: expected a palm that turns by less than 25" in str(caught.value)


def test_the_hand_that_pinches_longest_is_found_in_samples_of_the_longest() -> None:
    time = np.arange(200) / 100.0
    still = Recording(
        "still", time, np.tile(load_landmarks(), (200, 1, 1)), np.ones(200), "left"
    )
    slow = np.tile(load_landmarks(), (100, 1, 1))
    slow[:, 8] = slow[:, 4] + np.array([0.08, 0.0, 0.0])
    slow[25:75, 8] = slow[25:75, 4] + np.array([0.01, 0.0, 0.0])
    pinching = Recording("pinching", time[::2], slow, np.ones(100), "right")
    window = find_pinch(still, pinching, takes_fists=True)
    assert window == PinchWindow(48, 50, 148, "right", opened=0)
    assert find_pinch(pinching, takes_fists=True) == PinchWindow(
        24, 25, 74, "right", opened=0
    )


def test_a_robot_with_both_hands_holds_the_object_in_the_one_that_pinches(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left = made_pick("left")
    open_hand = left.landmarks[:1].repeat(len(left), axis=0)
    # At half the rate of the other.
    still = replace(left, landmarks=open_hand).part(slice(0, None, 2))
    files = [str(tmp_path / f"{side}.npz") for side in ("left", "right")]
    for file, hand in zip(files, (still, made_pick()), strict=True):
        write_recordings([hand], file)
    out = tmp_path / "simulated.npz"
    page = tmp_path / "simulated.html"
    words = ["simulate", *files, "--robot", "ur5_pair", "--json"]
    words += ["--out", str(out)]
    assert cli.main([*words, "--html", str(page)]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["held"] == "yes"
    simulated = read_archive(out)
    assert len(simulated["joint_names"]) == 2 * (6 + 16)
    # Gravity is along z, in the robot's world: the stand of the object keeps its height.
    assert np.ptp(simulated["object_pose"][:, 2, 3]) < 0.1
    assert page.stat().st_size > 1e6
    assert cli.main(["simulate", *files, "--robot", "allegro_right"]) == 2
    assert "expected one recording of a hand" in capsys.readouterr().err


@pytest.mark.parametrize("side", ["left", "right"])
def test_of_a_file_with_both_hands_that_of_the_robot_is_read(
    side: Side, tmp_path: Path
) -> None:
    both = tmp_path / "both.npz"
    write_recordings([made_pick("left"), made_pick("right")], both)
    take, _ = read_pick(load_hand(f"g1_{side}"), [both])
    assert take.recording.side == side


def load_landmarks() -> np.ndarray:
    """Landmarks of the resting human hand."""
    human = load_hand("human", points="landmarks")
    return human.points(human.rest, np.eye(4))


@pytest.fixture(scope="module")
def episode(lifted: PinchOutcome) -> Episode:
    return lifted.episode


@pytest.mark.slow
def test_pictures_and_films_show_the_object(episode: Episode, tmp_path: Path) -> None:
    from PIL import Image

    picture(episode, tmp_path / "strip.png", count=2)
    strip = np.asarray(Image.open(tmp_path / "strip.png").convert("RGB")).astype(int)
    assert strip.shape == (360, 960, 3)
    is_orange = (strip[..., 0] > strip[..., 2] + 60) & (strip[..., 1] > strip[..., 2])
    left, right = np.split(is_orange, 2, axis=1)
    assert min(left.sum(), right.sum()) > 300
    # Upwards is towards the first row.
    assert np.argwhere(left)[:, 0].mean() - np.argwhere(right)[:, 0].mean() > 20
    film(episode, tmp_path / "film.gif", rate=2.0)
    duration = episode.at.time[-1] - episode.at.time[0]
    with Image.open(tmp_path / "film.gif") as frames:
        assert getattr(frames, "n_frames", 1) == int(np.ceil(2.0 * duration))


@pytest.mark.slow
def test_a_page_plays_both_hands_without_a_network(
    episode: Episode, tmp_path: Path
) -> None:
    page = tmp_path / "run.html"
    later = episode._replace(at=Instant(*(column[5:] for column in episode.at)))
    write_page(page, {"robot": episode, "later": later}, "a <run>")
    text = page.read_text(encoding="utf-8")
    assert "<title>a &lt;run&gt;" in text
    assert "__VISER_EMBED_DATA__" in text
    assert 'src="http' not in text
    duration = episode.at.time[-1] - episode.at.time[0]
    assert f"{duration:.1f} s, {len(episode.at.time)} samples" in text


@pytest.mark.parametrize(
    ("text", "shape"),
    [
        ("box:0.05", CUBE),
        ("box:0.01x0.02x0.03", Box((0.01, 0.02, 0.03))),
        ("sphere:0.04", Sphere(0.02)),
        ("cylinder:0.04x0.1", Cylinder(0.02, 0.1)),
    ],
)
def test_objects_are_read_from_words(text: str, shape: Any) -> None:
    assert parse_object(text) == shape


def test_a_mesh_is_its_convex_hull_about_its_centre(tmp_path: Path) -> None:
    import trimesh

    file = tmp_path / "cube.stl"
    solid = trimesh.creation.box((0.02, 0.02, 0.06))
    solid.apply_translation((1.0, 2.0, 3.0))
    solid.export(file)
    shape = parse_object(str(file), is_centred=True)
    assert isinstance(shape, MeshShape)
    np.testing.assert_allclose(
        np.ptp(shape.points, axis=0), (0.02, 0.02, 0.06), atol=1e-6
    )
    np.testing.assert_allclose(shape.points.mean(axis=0), 0.0, atol=1e-6)
    tracked = parse_object(str(file))
    assert isinstance(tracked, MeshShape)
    np.testing.assert_allclose(tracked.points.mean(axis=0), (1.0, 2.0, 3.0), atol=1e-6)


@pytest.mark.parametrize(
    "text", ["", "box", "box:", "box:1..2", "sphere:1x2", "gone.stl"]
)
def test_other_words_are_no_objects(text: str) -> None:
    with pytest.raises(InvalidInputError):
        parse_object(text)


@pytest.mark.parametrize(
    ("text", "option"), [("box:-1", "size"), ("box:0", "size"), ("sphere:0", "radius")]
)
def test_a_size_is_positive(text: str, option: str) -> None:
    with pytest.raises(InvalidOptionsError, match=f"{option}: .*> 0"):
        parse_object(text)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ["demo::right", "--trials", "5", "--mass", "0.2"],
            "--trials: draws object, mass",
        ),
        (["demo::right", "--trials", "5", "--out", "a.npz"], "--trials"),
        (["demo::right", "--out", "a.txt"], "--out"),
        (["demo::right", "--html", "a.txt"], "--html"),
        (["gone.npz"], "gone.npz"),
        (["demo::right", "--object", "brick"], "--object"),
        (["demo::right", "--robot", "gone"], "gone"),
        (["demo::right", "--friction", "-1"], "friction"),
    ],
)
def test_wrong_arguments_are_one_line(
    words: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["simulate", *words]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len([line for line in lines if line.startswith("handmap:")]) == 1
    assert says in lines[-1]


@pytest.mark.slow
def test_the_command_counts_every_trial_and_writes_a_simulation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "pinch.npz"
    file = tmp_path / "made.npz"
    write_recordings([made_pick()], file)
    words = ["simulate", str(file), "--robot", "allegro_right", "--json"]
    words += ["--methods", "fingertip-vectors"]
    assert cli.main([*words, "--trials", "2"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["trials"] for row in found["rows"]] == [2]
    assert [row["refused"] for row in found["rows"]] == [0]
    assert found["trials"][0]["tried"] == ["fingertip-vectors"]
    drawn = [describe_trial(trial) for trial in random_trials(2, 0)]
    assert [
        {
            k: v
            for k, v in trial.items()
            if k not in ("held", "tried", "lost", "refused")
        }
        for trial in found["trials"]
    ] == drawn
    assert cli.main([*words, "--out", str(out), "--torque", "0.2"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["torque N m"] <= 0.2
    columns = np.load(out)
    assert set(columns) >= {
        "time",
        "q",
        "command",
        "wrist",
        "object_pose",
        "normal_force",
        "torque",
    }
    assert np.abs(columns["torque"]).max() == pytest.approx(0.2)
    assert str(columns["robot"]) == "allegro_right"
    assert columns["q"].shape == (len(columns["time"]), len(columns["joint_names"]))


@pytest.mark.slow
def test_the_command_holds_what_it_meets(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "made.npz"
    write_recordings([made_pick()], file)
    words = ["simulate", str(file), "--robot", "allegro_right", "--json"]
    assert cli.main(words) == 0
    by_default = json.loads(capsys.readouterr().out)["rows"]
    slips = {}
    known = {}
    # A robot that is simulated has encoders: it grips by default.
    assert by_default[-1]["mapping"] == f"{by_default[0]['mapping']}+grip"
    slips["grip"] = by_default[-1]
    for grip in ("grip+place", "grip+place5"):
        assert cli.main([*words, "--grip", grip]) == 0
        found = json.loads(capsys.readouterr().out)
        plain, own = found["rows"]
        known[grip] = found["assumed"].get("known place", "")
        assert own["mapping"] == f"{plain['mapping']}+{grip}"
        slips[grip] = own
    assert cli.main([*words, "--grip", "off"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == by_default[:1]
    # Where the object is known, it is not pushed away before it is held.
    assert slips["grip+place"]["held"] == "yes"
    assert slips["grip+place"]["slip mm"] < 5.0
    assert slips["grip"] != slips["grip+place"]
    # A place with an error is another one, and the command says how wrong it may be.
    assert slips["grip+place5"] != slips["grip+place"]
    assert not known["grip+place"]
    assert known["grip+place5"].startswith("off by 5 mm along each axis")
    assert cli.main([*words, "--grip", "place5"]) == 2
    assert "expected grip, grip+place, grip+place5" in capsys.readouterr().err
    both = ["simulate", str(file), str(file), "--grip", "grip"]
    assert cli.main([*both, "--robot", "allegro_right"]) == 2
    assert "expected one recording of a hand" in capsys.readouterr().err


def test_the_json_says_which_mapping_held_which_object(
    lifted: PinchOutcome,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    heavy = [trial.mass > 0.05 for trial in random_trials(6, 0)]
    assert any(heavy)
    assert not all(heavy)

    def run(_: PinchScene, trial: PinchTrial) -> PinchOutcome:
        if trial.mass > 0.09:
            raise InvalidInputError("in the hand", argument="robot")
        return lifted._replace(is_held=trial.mass > 0.05)

    monkeypatch.setattr(PinchScene, "run", run)
    refused = [trial.mass > 0.09 for trial in random_trials(6, 0)]
    held = [a and not b for a, b in zip(heavy, refused, strict=True)]
    assert any(held)
    assert any(refused)
    words = ["simulate", "demo::right", "--robot", "panda_gripper", "--json"]
    words += ["--methods", "fingertip-vectors"]
    assert cli.main([*words, "--trials", "6"]) == 0
    found = json.loads(capsys.readouterr().out)
    name = ["fingertip-vectors"]
    assert [trial["held"] for trial in found["trials"]] == [name * yes for yes in held]
    tried = [name * (not no) for no in refused]
    assert [trial["tried"] for trial in found["trials"]] == tried
    (row,) = found["rows"]
    assert row["refused"] == sum(refused)
    assert row["trials"] == 6 - sum(refused)
    assert row["held %"] == round(100.0 * sum(held) / row["trials"], 1)
    assert row["torque N m"] == pytest.approx(lifted.torque, abs=0.006)
    # One object that is refused, and no other.
    words += ["--trials", "1", "--objects", "nominal", "--mass", "0.2"]
    assert cli.main(words) == 2
    assert "robot: in the hand" in capsys.readouterr().err


def test_a_hand_without_shapes_cannot_touch() -> None:
    hand = load_hand("three_finger")
    text = re.sub(r"<collision[ >].*?</collision>", "", hand.urdf_text, flags=re.DOTALL)
    text = re.sub(
        r"<collision_checking>.*?</collision_checking>", "", text, flags=re.DOTALL
    )
    with pytest.raises(HandError, match="no collision shapes"):
        Simulator(Hand(hand.spec, urdf_text=text), CUBE)


@pytest.mark.slow
def test_a_dozen_recordings_are_picks_and_the_household_can_be_simulated(
    pinching: PinchScene, recordings: Path
) -> None:
    made = list(picks(sorted(recordings.glob("*.npz"))))
    assert len({recording.name for recording in made}) == 12
    for recording in made:
        window = find_pinch(recording, takes_fists=True)
        assert window.opened <= window.start < window.closed < window.end
    assert len(HOUSEHOLD) == 12
    for trial in HOUSEHOLD.values():
        assert 0.005 < surface(trial.shape).extents[0] < 0.2
        simulator = Simulator(
            pinching.commands.robot, trial.shape, Physics(mass=trial.mass)
        )
        # The frame's origin is inside, where the pads come together.
        reach = simulator.model.geom("/object").rbound
        assert 0.0 < reach < 0.2
