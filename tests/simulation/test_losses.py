"""Why objects are lost, fists, torques, which way is up, and where the person's pads meet."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from picks import kept, made_pick

from handmap_core.human.recording import Recording
from handmap_qp import InvalidInputError, cli, load_hand
from handmap_qp.apps.offline.comparison import Take, prepare_take
from handmap_qp.apps.offline.trajectory import RobotMotion
from handmap_qp.apps.simulation.commands import (
    PinchWindow,
    chosen_methods,
    find_pinch,
    map_take,
    read_pick,
)
from handmap_qp.apps.simulation.losses import Loss, Touch, loss_in_try, tries
from handmap_qp.apps.simulation.pad_motion import PersonPads
from handmap_qp.apps.simulation.physics import Physics, choose_gravity
from handmap_qp.apps.simulation.pinch import (
    CUBE,
    PinchOutcome,
    PinchScene,
    PinchTrial,
)
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.apps.simulation.tried import REFUSED
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import urdf_directory
from handmap_qp.hands.torques import torque_limits
from handmap_qp.mapping.objects import Sphere
from handmap_qp.trackers import read_recording
from handmap_qp.trackers.formats.archive import read_archive

RATE = 60.0


def course_of(
    *parts: tuple[float, float, float, float], beside: float = 0.0
) -> list[Touch]:
    """Touches of parts of a course: seconds, forces of thumb and others, end of `moved`."""
    course: list[Touch] = []
    moved = 0.0
    for seconds, thumb, others, end in parts:
        first = len(course)
        for i, place in enumerate(np.linspace(moved, end, round(seconds * RATE))):
            time = (first + i) / RATE
            course.append(Touch(time, thumb, others, beside, float(place), 0.0))
        moved = end
    return course


@pytest.mark.parametrize(
    ("course", "loss"),
    [
        (course_of((0.5, 0.0, 0.0, 0.0)), Loss.UNTOUCHED),
        ([], Loss.UNTOUCHED),
        (course_of((0.2, 1.0, 0.0, 0.02), (0.5, 1.0, 1.0, 0.02)), Loss.PUSHED_BY_THUMB),
        (
            course_of((0.2, 0.0, 1.0, 0.02), (0.5, 1.0, 1.0, 0.02)),
            Loss.PUSHED_BY_FINGER,
        ),
        (course_of((0.2, 1.0, 0.0, 0.001)), Loss.NO_FINGER),
        (course_of((0.2, 1.0, 0.0, 0.02)), Loss.PUSHED_BY_THUMB),
        (course_of((0.2, 0.0, 1.0, 0.001)), Loss.ONE_SIDE),
        (course_of((0.1, 1.0, 1.0, 0.0)), Loss.SQUEEZED_OUT),
        # A try of one instant, with and without a press.
        (course_of((1.0 / RATE, 1.0, 1.0, 0.0)), Loss.SQUEEZED_OUT),
        (course_of((1.0 / RATE, 0.1, 0.1, 0.0)), Loss.SQUEEZED_OUT),
        (course_of((0.5, 1.0, 1.0, 0.0), beside=0.02), Loss.BESIDE),
        (course_of((0.5, 1.0, 1.0, 0.0)), None),
    ],
)
def test_each_way_to_miss_an_object_has_its_name(
    course: list[Touch], loss: Loss | None
) -> None:
    assert loss_in_try(course) == loss


def test_a_break_of_touch_ends_a_try() -> None:
    """Contacts flicker: a break of 0.05 s does not."""
    short, long = (
        course_of((0.2, 1.0, 0.0, 0.0), (seconds, 0.0, 0.0, 0.0), (0.2, 0.0, 1.0, 0.0))
        for seconds in (0.05, 0.3)
    )
    assert [len(tries(course)) for course in (short, long)] == [1, 2]


@pytest.fixture(scope="module")
def gripper() -> PinchScene:
    """Jaws that close within a fifth of a second, and rise."""
    time = np.arange(61) / 50.0
    q = np.interp(time, [0.0, 0.2], [0.04, 0.0])[:, None]
    wrist = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (61, 1, 1))
    wrist[:, 2, 3] = np.interp(time, [0.4, 1.0], [0.0, 0.1])
    hand = load_hand("panda_gripper")
    commands = RobotMotion(hand, time, q, wrist, np.zeros(61))
    physics = Physics()
    return PinchScene(commands, PinchWindow(0, 10, 60), physics)


@pytest.mark.parametrize(
    ("trial", "losses"),
    [
        (PinchTrial(), {None}),
        (PinchTrial(offset=(0.0, 0.0, -0.06)), {Loss.UNTOUCHED}),
        (PinchTrial(friction=0.01, mass=0.2), {Loss.SLIPPED, Loss.SQUEEZED_OUT}),
        (PinchTrial(Sphere(0.008), offset=(0.03, 0.0, 0.0)), {Loss.UNTOUCHED}),
    ],
    ids=["held", "below", "slippery", "beside"],
)
def test_a_simulated_object_is_lost_for_what_was_done_to_it(
    gripper: PinchScene, trial: PinchTrial, losses: set[Loss | None]
) -> None:
    outcome = gripper.run(trial)
    assert outcome.loss in losses
    assert outcome.is_held == (outcome.loss is None)
    columns = outcome.columns
    assert str(columns["loss"]) == (outcome.loss or "")
    touched = columns["thumb_force"] + columns["other_force"]
    np.testing.assert_allclose(touched, columns["normal_force"], atol=1e-9)


def test_what_is_gripped_only_at_the_end_is_not_called_lost(
    gripper: PinchScene,
) -> None:
    whole = gripper.run(PinchTrial())
    time = gripper.commands.time
    freed = np.searchsorted(time, time[gripper.window.end] - whole.pinch_time)
    for later in (-0.05, 0.1):
        end = int(np.searchsorted(time, time[freed] + later))
        scene = PinchScene(
            gripper.commands, gripper.window._replace(end=end), gripper.physics
        )
        assert scene.run(PinchTrial()).loss == Loss.TOO_LATE


def test_a_fist_is_no_pick(recordings: Path) -> None:
    """A person's fist, on video: thumb and index landmarks are as near as in a pinch."""
    video = read_recording(recordings / "rgb_mediapipe_right.npz")
    for instant in (8.47, 20.2):
        fist = kept(video, instant, (0.0, 1.0, 0.0))
        with pytest.raises(InvalidInputError, match="got a fist") as caught:
            find_pinch(fist)
        assert caught.value.argument == fist.name
        assert find_pinch(fist, takes_fists=True).closed > 0


def test_pinches_of_people_and_of_the_package_are_picks(recordings: Path) -> None:
    files = [*("demo", "pinch"), *recordings.glob("leap_[ph]*_right.npz")]
    assert len(files) == 4
    for file in files:
        window = find_pinch(read_recording(file, "right"))
        assert window.start < window.closed < window.end


def test_a_pick_is_found_beside_a_longer_closing_that_is_none() -> None:
    """The longest closing that is a pick counts, not the longest closing."""
    pick = made_pick(seed=5)
    open_hand = pick.landmarks[:1].repeat(240, axis=0)
    # No finger can do this: the tip of the index finger alone goes to the thumb's.
    open_hand[30:230, 8] = open_hand[30:230, 4] + np.array([0.01, 0.0, 0.0])
    both = Recording(
        "both",
        np.arange(240 + len(pick)) / 60.0,
        np.concatenate([open_hand, pick.landmarks]),
        np.ones(240 + len(pick), dtype=bool),
        "right",
    )
    assert find_pinch(both, takes_fists=True).closed == 30
    assert find_pinch(both).closed > 240


def test_torques_are_the_makers_and_say_where_they_are_from() -> None:
    allegro = torque_limits(load_hand("allegro_right"))
    np.testing.assert_array_equal(allegro.values, 0.7)
    assert "maker of allegro" in allegro.source
    ability = torque_limits(load_hand("ability_right"))
    assert ability.values.max() == 6.0
    assert ability.source == "1.2 to 6 N m, by the URDF"
    # The URDF of Romeo says 0, that of SVH 1000.
    for name, count in (("romeo_left", "1 of 1"), ("svh_right", "9 of 9")):
        limits = torque_limits(load_hand(name))
        np.testing.assert_array_equal(limits.values, 1.0)
        assert f"assumed for {count} joints" in limits.source
    arm = load_hand("ur5_allegro")
    fingers = torque_limits(arm).values[~arm.moves_wrist]
    np.testing.assert_array_equal(fingers, 0.7)
    assert torque_limits(load_hand("panda_gripper")).source == "100 N, by the URDF"
    # A limit of 10 N m is a placeholder, and one below is the maker's.
    for effort, limit in ((9.99, 9.99), (10.0, 1.0)):
        hand = load_hand("romeo_left")
        hand.model.effortLimit[:] = effort
        np.testing.assert_array_equal(torque_limits(hand).values, limit)
    # An arm's own limit is nobody's placeholder.
    hand = load_hand("tiago_arm")
    hand.model.effortLimit[:] = 1000.0
    values = torque_limits(hand).values
    np.testing.assert_array_equal(values[hand.moves_wrist], 1000.0)
    np.testing.assert_array_equal(values[~hand.moves_wrist], 1.0)
    asked = torque_limits(load_hand("allegro_right"), 1e3)
    np.testing.assert_array_equal(asked.values, 15.0)


@pytest.mark.parametrize(
    ("asked", "upright", "gravity", "text"),
    [
        (None, "+z up, +y forward", (0.0, 0.0, -9.81), "+z, of the recording"),
        (None, "-y up, +z forward", (0.0, 9.81, 0.0), "-y, of the recording"),
        (None, "", (0.0, -9.81, 0.0), "+y, assumed"),
        ("x", "+z up, +y forward", (-9.81, 0.0, 0.0), "+x, as asked for"),
        ("-z", "", (0.0, 0.0, 9.81), "-z, as asked for"),
    ],
)
def test_gravity_points_against_what_is_up(
    asked: str | None, upright: str, gravity: tuple[float, float, float], text: str
) -> None:
    found, says = choose_gravity(asked, upright, "of the recording")
    assert found == gravity
    assert says.startswith(text)


def test_a_person_who_is_the_robot_meets_the_object_at_the_persons_place() -> None:
    """Joints of the person on the person's own hand: what is left is the lag of motors."""
    take, window = _take(load_hand("human"))
    own = take.human
    commands = RobotMotion(
        own, take.recording.time, take.q, take.wrist, np.zeros(len(take.q))
    )
    person = PersonPads(take, window, own)
    scene = PinchScene(commands, window, Physics(gravity=(0.0, -9.81, 0.0)))
    assert np.linalg.norm(person.offset(scene.closing, 0.03)) < 4e-3
    # A place on a larger hand is farther from the palm, by the ratio of sizes.
    larger = PersonPads(take, window, load_hand("allegro_right"))
    palm = take.trace.palm[window.opened : window.end + 1, :3, 3]
    reaches = [
        np.linalg.norm(one.motion.places[:, 0] - palm, axis=1)
        for one in (person, larger)
    ]
    ratios = reaches[1] / reaches[0]
    np.testing.assert_allclose(ratios, ratios[0])
    assert ratios[0] > 1.2


def _take(robot: Hand) -> tuple[Take, PinchWindow]:
    recording = made_pick(closing=0.8)
    return prepare_take(recording, robot.side), find_pinch(recording)


def test_an_object_stands_where_it_is_asked_to(gripper: PinchScene) -> None:
    motion = gripper.closing
    shifted = motion._replace(places=motion.places + np.array([0.004, 0.0, 0.0]))
    elsewhere = replace(gripper, placing=shifted).run(PinchTrial())
    here = gripper.run(PinchTrial())
    starts = [one.episode.at.object_pose[0, :3, 3] for one in (here, elsewhere)]
    np.testing.assert_allclose(starts[1] - starts[0], (0.004, 0.0, 0.0), atol=1e-3)


def test_where_15_mm_cannot_be_had_the_hand_starts_where_it_is_clearest(
    gripper: PinchScene,
) -> None:
    late = replace(gripper, window=PinchWindow(6, 10, 60, opened=4))
    with pytest.raises(InvalidInputError, match="15 mm"):
        late.run(PinchTrial())
    outcome = replace(late, least_clear=0.002).run(PinchTrial())
    assert len(outcome.episode.at.time) == 60 - 4
    assert outcome.is_held


def test_the_command_says_what_it_assumed_and_why_objects_were_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["simulate", "pinch", "--robot", "allegro_right", "--json"]
    out = tmp_path / "lost.npz"
    assert cli.main([*words, "--friction", "0.05", "--out", str(out)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["assumed"]["up"].startswith("+z, of the recording")
    assert "0.7 N m" in found["assumed"]["torque"]
    row, gripping = found["rows"]
    assert gripping["mapping"] == f"{row['mapping']}+grip"
    assert row["held"] == "no"
    assert row["why not"] in set(Loss)
    assert str(read_archive(out)["loss"]) == row["why not"]
    pads, _ = found["pads"]
    assert 0.0 < pads["off mm"] < 100.0


@pytest.mark.parametrize("robot", ["three_finger", "leap_right", "allegro_right"])
def test_demo_is_held(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The first simulation of a new user, by the default hand and others."""
    assert cli.main(["simulate", "demo", "--robot", robot, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    # Its world has z up: with another one, the object leaves its stand.
    assert "+z" in told["assumed"]["up"]
    assert [row["held"] for row in told["rows"]] == ["yes", "yes"]
    passed = told["assumed"].get("finger in the way", "")
    assert passed.startswith("middle")


def test_a_finger_in_the_way_touches_the_object_once_it_has_left() -> None:
    """The person of `demo` points, then pinches: a curled finger is where the object comes."""
    hand = load_hand("three_finger")
    take, window = read_pick(hand, [Path("demo")])
    (commands,) = map_take(chosen_methods((), None, hand.name), take, hand)
    scene = PinchScene(commands, window, Physics(gravity=(0.0, 0.0, -9.81)))
    outcome = scene.run(PinchTrial())
    assert outcome.in_the_way == ("middle",)
    # It passes while it is in the object, without a force, and is nowhere in it afterwards.
    simulator = Simulator(hand, CUBE, scene.physics)
    middle = scene.pads.others["middle"]
    at = outcome.episode.at
    gaps = []
    for q, wrist, pose in zip(at.q, at.wrist, at.object_pose, strict=True):
        simulator.reset(hand.configuration_vector(q, wrist), pose)
        gaps.append(simulator.clearance(middle))
    left = int(np.argmax(np.array(gaps) > 0.0))
    assert gaps[0] < 0.0 < gaps[left]
    assert at.normal_force[:left].max() == 0.0
    assert min(gaps[left:]) > -1e-3


def test_links_that_pass_do_not_touch(gripper: PinchScene) -> None:
    simulator = Simulator(gripper.commands.robot, CUBE, gripper.physics)
    pose = np.eye(4)
    simulator.reset(gripper.commands.at(gripper.window.end), pose)
    pose[:3, 3] = gripper.pads.pair.middle(gripper.pads.places(simulator))
    for passing, touches in (((), True), (simulator.links, False), ((), True)):
        simulator.reset(gripper.commands.at(gripper.window.end), pose)
        simulator.set_passing(passing)
        simulator.follow(simulator.target, gripper.physics.time_step)
        assert bool(simulator.pressing()) == touches


def test_palms_and_fingers_that_stay_in_the_way_are_refused() -> None:
    """Only fingers that leave the object's place before the pads meet it may be there."""
    hand = load_hand("three_finger")
    take, window = read_pick(hand, [Path("demo")])
    (commands,) = map_take(chosen_methods((), None, hand.name), take, hand)
    scene = PinchScene(
        commands, window, Physics(gravity=(0.0, 0.0, -9.81)), None, 0.005
    )
    with pytest.raises(InvalidInputError, match="the nearest link at -"):
        scene.run(PinchTrial(Sphere(0.08)))


@pytest.mark.parametrize("robot", ["g1", "ur5_allegro"])
def test_the_persons_place_is_for_palms_that_go_where_the_persons_is(
    robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["simulate", "pinch", "--robot", robot, "--place", "person"]
    assert cli.main(words) == 2
    assert "--place: expected a hand without an arm" in capsys.readouterr().err


@pytest.mark.parametrize("trials", [(), ("--trials", "2")], ids=["one", "trials"])
def test_a_mapping_that_cannot_start_is_a_row_beside_others(
    trials: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It does not hide what the others hold; if none can start, that is the error."""
    run = PinchScene.run
    refused = {"teleoperation"}
    names = iter(())

    def refuse(scene: PinchScene, trial: PinchTrial) -> PinchOutcome:
        if next(names) in refused:
            raise InvalidInputError("in the hand", argument="robot")
        return run(scene, trial)

    monkeypatch.setattr(PinchScene, "run", refuse)
    count = 2 if trials else 1
    methods = ("teleoperation", "fingertip-vectors")
    words = ["simulate", "pinch", "--json", *trials]
    words += ["--methods", *methods]
    names = iter([name for name in methods for _ in range(count)])
    assert cli.main(words) == 0
    found = json.loads(capsys.readouterr().out)
    first, second = found["rows"]
    if trials:
        assert (first["refused"], first["trials"], first["held %"]) == (2, 0, "-")
        assert second["trials"] == 2
        assert found["losses"]["teleoperation"] == {REFUSED: 2}
        assert found["trials"][0]["refused"] == {"teleoperation": "robot: in the hand"}
    else:
        assert first["held"] == "refused"
        assert first["why not"] == "robot: in the hand"
        assert second["held"] in ("yes", "no")
    refused.add("fingertip-vectors")
    names = iter([name for name in methods for _ in range(count)])
    assert cli.main(words) == 2
    assert "robot: in the hand" in capsys.readouterr().err


def test_folders_of_a_user_do_not_tell_the_maker(tmp_path: Path) -> None:
    folder = tmp_path / "leap_of_faith"
    shutil.copytree(urdf_directory() / "three_finger", folder)
    file = folder / "hand.yaml"
    own = load_hand("three_finger")
    urdf = f"urdf: {folder / own.spec.urdf}"
    file.write_text(file.read_text().replace(f"urdf: {own.spec.urdf}", urdf))
    assert torque_limits(load_hand(file)).source == torque_limits(own).source
