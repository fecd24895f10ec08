"""The view of a recording: mapping, drawing and controls."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import yaml

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from viewer_cases import (
    COUNT,
    GAP,
    closing_motion,
    closing_recording,
    make_replay,
    option_handles,
    plotted,
    press,
)

from handmap_qp import (
    HandMapper,
    InvalidInputError,
    InvalidOptionsError,
    MappingOptions,
    load_hand,
)
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.apps.viewer import figure
from handmap_qp.apps.viewer.controls import LEFT_OUT, SteeringControls
from handmap_qp.apps.viewer.figure import HandFigure, HumanFigure, state_text
from handmap_qp.apps.viewer.gauges import FIRST, InstantGauges, joints_by_finger
from handmap_qp.apps.viewer.replay import Replay, ReplayViewer
from handmap_qp.apps.viewer.sample import ViewSample
from handmap_qp.apps.viewer.scene import Display, HandScene
from handmap_qp.apps.viewer.serving import skip_wakeup_race
from handmap_qp.human import HumanMotion
from handmap_qp.mapping import fist_time, slow_note
from handmap_qp.mapping.presets import PRESETS, Choice, preset_choice
from handmap_qp.se3 import affine, rotation_from_quat_wxyz, transform_points

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

PAPER = preset_choice("paper")
QUARTER_TURN = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


@pytest.fixture
def viewer(server: Any) -> ReplayViewer:
    """A viewer paused at its first sample."""
    shown = ReplayViewer(server, make_replay())
    shown.play_bar.toggle()
    return shown


def pose_in_scene(server: Any, node: str) -> np.ndarray:
    """Return a node's pose in the scene from the poses of its ancestors."""
    pose, path = np.eye(4), ""
    for part in node.strip("/").split("/"):
        path += f"/{part}"
        handle = server.scene.get_handle_by_name(path)
        pose = pose @ affine(
            rotation_from_quat_wxyz(handle.wxyz), np.array(handle.position)
        )
    return pose


def in_scene(server: Any, node: str, points: np.ndarray) -> np.ndarray:
    return transform_points(pose_in_scene(server, node), points)


def seek(viewer: ReplayViewer, index: int) -> None:
    viewer.play_bar.slider.value = float(viewer.replay.time[index])
    viewer.tick(0.0)


# -- mapping


def replay_of(motion: HumanMotion, choice: Choice = PAPER) -> Replay:
    seen = closing_recording(), motion
    return Replay(motion.human, load_hand("three_finger"), choice, seen)


@pytest.mark.parametrize("preset", ["paper", "teleoperation", "joint-to-joint"])
def test_replay_gives_the_commands_of_map_recording(preset: str) -> None:
    replay, motion = make_replay(preset=preset), closing_motion()
    mapper = HandMapper(motion.human, load_hand("three_finger"), preset)
    expected = map_recording(mapper, closing_recording())
    np.testing.assert_allclose(
        [sample.robot_q for sample in replay.variant.samples], expected.q, atol=1e-12
    )
    targets = [
        sample.targets
        for sample in replay.variant.samples
        if sample.targets is not None
    ]
    np.testing.assert_allclose(targets, expected.targets, atol=1e-12)
    np.testing.assert_array_equal(
        [sample.is_seen for sample in replay.variant.samples], expected.valid
    )
    assert not expected.valid[~motion.valid].any()
    assert replay.variant.robot.reference_points == mapper.robot.reference_points


def test_every_preset_of_a_replay_is_aligned_as_the_first_one() -> None:
    motion = closing_motion()
    recording = replace(closing_recording(), upright="+y up, -z forward")
    robot = load_hand("ur5_allegro")
    for name in ("teleoperation", "object"):
        choice = preset_choice(name, motion.human)
        replay = Replay(motion.human, robot, choice, (recording, motion))
        assert replay.preset(name).method.values["alignment"] == "y-up"


def test_replay_shows_the_reference_until_the_hand_is_seen() -> None:
    valid = np.arange(COUNT) >= 7
    motion = replace(closing_motion(), valid=valid)
    recording = replace(closing_recording(), valid=valid)
    robot = load_hand("three_finger")
    replay = Replay(motion.human, robot, PAPER, (recording, motion))
    for sample in replay.variant.samples[:7]:
        np.testing.assert_allclose(
            sample.robot_q, replay.variant.samples[7].robot_q, atol=1e-12
        )
    assert [sample.is_seen for sample in replay.variant.samples] == valid.tolist()


def test_replay_refuses_a_motion_without_a_hand() -> None:
    motion = replace(closing_motion(), valid=np.zeros(COUNT, dtype=bool))
    with pytest.raises(InvalidInputError, match="no sample is valid"):
        replay_of(motion)


def test_options_that_cannot_be_used_leave_the_replay_as_it_was() -> None:
    replay = make_replay()
    before = replay.variant.samples
    with pytest.raises(InvalidOptionsError, match="abacus"):
        replay.remap(PAPER.with_changes({"ridge": 0.3, "solver": "abacus"}))
    assert replay.variant.samples is before
    assert replay.choice.method == MappingOptions()


# -- drawing


@pytest.mark.parametrize(
    ("robot", "alignment"), [("three_finger", "palm"), ("allegro_right", "world")]
)
def test_fingertips_of_the_drawn_hands_are_where_the_reference_points_are(
    server: Any, robot: str, alignment: str
) -> None:
    replay = make_replay(robot, alignment=alignment)
    sample = replay.variant.samples[-1]
    scene = HandScene(server, replay.human, replay.variants)
    scene.draw([sample])
    for side, hand, points in (
        ("human", replay.human, sample.humans[0].points),
        ("robot", replay.variant.robot, sample.robot_points),
    ):
        meshes = figure.link_meshes(hand)
        for i, point in enumerate(hand.reference_points):
            sphere = pose_in_scene(server, f"/{side}/points/{i}")[:3, 3]
            expected = in_scene(server, f"/{side}", np.asarray(points)[[i]])[0]
            np.testing.assert_allclose(sphere, expected, atol=1e-9)
            if point.link in meshes:
                drawn = in_scene(
                    server, f"/{side}/body/{point.link}", np.array([point.xyz])
                )[0]
                # The scene places the nodes of links, the hand the spheres.
                np.testing.assert_allclose(drawn, sphere, atol=1e-6)


@pytest.mark.parametrize("name", ["hey5", "tiago_arm"])
def test_links_are_drawn_where_the_model_has_them(server: Any, name: str) -> None:
    hand = load_hand(name)
    shown_hand = HandFigure(server, "hand", hand)
    wrist = affine(
        rotation_from_quat_wxyz((0.6, 0.0, 0.8, 0.0)), np.array([0.1, 0.2, 0.3])
    )
    q = np.random.default_rng(0).uniform(hand.lower_limits, hand.upper_limits)
    pose = wrist if hand.is_floating else None
    shown_hand.draw(
        ViewSample(
            time=0.0, robot_q=q, robot_wrist=wrist, robot_points=hand.points(q, pose)
        )
    )
    links = list(figure.link_meshes(hand))
    poses = hand.link_poses(links, q, pose)
    for link, pose in zip(links, poses, strict=True):
        np.testing.assert_allclose(
            pose_in_scene(server, f"/hand/body/{link}"), pose, atol=1e-5, err_msg=link
        )


def test_equal_palms_look_equal_in_both_worlds(server: Any) -> None:
    replay = make_replay(alignment="palm")
    first = replay.variant.samples[0]
    HandScene(server, replay.human, replay.variants).draw([first])
    for side, hand, wrist in (
        ("human", replay.human, first.humans[0].wrist),
        ("robot", replay.variant.robot, first.robot_wrist),
    ):
        palm = pose_in_scene(server, f"/{side}") @ wrist @ hand.wrist_to_palm
        np.testing.assert_allclose(palm[:3, :3], np.eye(3), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["teleoperation", "paper"])
def test_ellipsoid_is_what_the_deformation_makes_of_the_ball(
    server: Any, preset: str
) -> None:
    replay = make_replay(preset=preset)
    sample = replay.variant.samples[-1]
    scene = HandScene(server, replay.human, replay.variants)
    scene.draw([sample])
    handle = server.scene.get_handle_by_name("/human/ellipsoid")
    (human,) = sample.humans
    assert human.motion_deformation is not None
    linear = human.motion_deformation[:3, :3]
    axes = rotation_from_quat_wxyz(handle.wxyz) * np.array(handle.scale)
    # Two maps A deform a ball equally if their A A^T are equal.
    np.testing.assert_allclose(axes @ axes.T, linear @ linear.T, atol=1e-9)
    assert human.pivot is not None
    np.testing.assert_allclose(handle.position, human.pivot, atol=1e-12)
    assert not np.allclose(handle.scale, 1.0, atol=0.05), "the motion should deform"


def test_cube_has_the_corners_that_the_deformation_makes(server: Any) -> None:
    replay = make_replay(rigid_from="wrist")
    sample = replay.variant.samples[-1]
    scene = HandScene(server, replay.human, replay.variants)
    scene.draw([sample], Display(shape="cube"))
    cube = server.scene.get_handle_by_name("/human/cube")
    assert cube.visible
    assert not server.scene.get_handle_by_name("/human/ellipsoid").visible
    (human,) = sample.humans
    assert human.motion_deformation is not None
    linear = human.motion_deformation[:3, :3]
    corners = np.linalg.solve(linear, cube.points.reshape(-1, 3).T).T
    # Points are sent as 32-bit floats.
    np.testing.assert_allclose(np.abs(corners), np.abs(corners).max(), rtol=1e-4)
    assert len(np.unique(np.sign(corners), axis=0)) == 8


@pytest.mark.slow
@pytest.mark.parametrize("follow", ["hands", "world"])
def test_hands_stay_in_place_or_travel_as_asked(
    server: Any, follow: Literal["hands", "world"]
) -> None:
    replay = make_replay()
    scene = HandScene(server, replay.human, replay.variants)
    human, places = HumanFigure(server, "other", replay.human), []
    for sample in (replay.variant.samples[0], replay.variant.samples[-1]):
        scene.draw([sample], Display(follow))
        place = human.place_of(sample.humans[0])
        assert place is not None
        places.append(in_scene(server, "/human", place[0][None])[0])
    moved = float(np.linalg.norm(places[1] - places[0]))
    assert moved == pytest.approx(0.0, abs=1e-9) if follow == "hands" else moved > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("follow", ["hands", "world"])
def test_both_hands_are_in_view_on_a_portrait_screen(
    server: Any, follow: Literal["hands", "world"]
) -> None:
    replay = make_replay()
    scene = HandScene(server, replay.human, replay.variants)
    for sample in replay.variant.samples[::7]:
        scene.draw([sample], Display(follow))
        camera = server.initial_camera
        forward = (camera.look_at - camera.position) / np.linalg.norm(
            camera.look_at - camera.position
        )
        right = np.cross(forward, (0.0, 1.0, 0.0))
        for side, points in (
            ("human", sample.humans[0].points),
            ("robot", sample.robot_points),
        ):
            seen = in_scene(server, f"/{side}", np.asarray(points)) - camera.position
            depth = seen @ forward
            half_height = np.tan(0.5 * camera.fov)
            assert np.abs(
                seen @ right / depth
            ).max() < 0.75 * half_height * np.linalg.norm(right)
            assert np.abs(seen @ np.cross(right, forward) / depth).max() < half_height


def test_the_robots_name_says_that_the_hand_was_not_seen(viewer: ReplayViewer) -> None:
    assert state_text(viewer.sample) == ""
    pressed = replace(viewer.sample, held_by=("palm", "finger1_distal"))
    assert state_text(pressed) == "held by palm and finger1_distal"
    assert state_text(replace(pressed, status="released")) == "released"
    seek(viewer, GAP.start)
    label: Any = viewer.server.scene.get_handle_by_name("/robot_name")
    assert label.text.splitlines() == ["three_finger", "paper", "held: missing"]


# -- controls


@pytest.mark.parametrize("robot", ["svh_right", "three_finger"])
def test_a_slow_hand_has_a_line(server: Any, robot: str) -> None:
    viewer = ReplayViewer(server, make_replay(robot, "teleoperation"))
    note = slow_note(fist_time(load_hand("human"), load_hand(robot)))
    assert bool(note) == (robot == "svh_right")
    assert viewer.slow_text.content == note
    assert viewer.slow_text.visible == bool(note)


def test_a_slider_changes_the_robot_at_once(viewer: ReplayViewer) -> None:
    seek(viewer, COUNT - 1)
    before, drawn = (
        viewer.sample.robot_q,
        pose_in_scene(viewer.server, "/robot/points/0"),
    )
    option_handles(viewer.steering)["deformation_gain"].value = 0.0
    viewer.tick(0.0)
    assert viewer.replay.choice.method == MappingOptions(deformation_gain=0.0)
    assert np.abs(viewer.sample.robot_q - before).max() > 0.05
    assert (
        np.linalg.norm((pose_in_scene(viewer.server, "/robot/points/0") - drawn)[:3, 3])
        > 1e-3
    )


def test_saved_options_are_those_in_force(viewer: ReplayViewer) -> None:
    option_handles(viewer.steering)["deformation_gain"].value = 0.5
    viewer.tick(0.0)
    sent: list[bytes] = []
    client = SimpleNamespace(
        send_file_download=lambda name, content: sent.append(content)
    )
    viewer.send("options.yaml", client)
    assert yaml.safe_load(sent[0]) == {"preset": "paper", "deformation_gain": 0.5}


@pytest.mark.parametrize("preset", ["paper", "teleoperation"])
def test_every_control_reaches_its_option(server: Any, preset: str) -> None:
    options = preset_choice(preset)
    if preset == "paper":
        options = options.with_changes(
            {"pivot": "point", "pivot_point": (0.0, 0.0, 0.0)}
        )
    controls = SteeringControls(server, options, (preset,))
    assert controls.take_changes() == {}
    for name, handle in option_handles(controls).items():
        value = handle.value
        choices = getattr(handle, "options", ())
        if choices:
            handle.value = next(choice for choice in choices if choice != value)
        elif isinstance(value, bool):
            handle.value = not value
        elif isinstance(value, str):
            handle.value = "proxqp" if name == "solver" else "0.0, 0.5, 0.0"
        else:
            handle.value = (
                value + handle.step
                if value + handle.step <= handle.max
                else value - handle.step
            )
        changes = controls.take_changes()
        assert changes.keys() == {name}
        if name == "pivot":
            changes["pivot_point"] = None
        assert options.changes_to(options.with_changes(changes)) == changes
        controls.show_choice(options)
        assert handle.value == value
        assert controls.take_changes() == {}


def test_every_option_has_a_control_or_is_left_out_by_name(server: Any) -> None:
    controls = SteeringControls(server, PAPER, ("paper",))
    for preset in PRESETS:
        choice = preset_choice(preset)
        controls.show_choice(choice)
        options = {*choice.method.values, *choice.ik.values}
        assert option_handles(controls).keys() == options - {*LEFT_OUT}


@pytest.mark.slow
def test_options_beyond_a_slider_stay_as_they_were_given(server: Any) -> None:
    given = MappingOptions(
        ridge=7.0,
        stretch_max=np.inf,
        pivot="point",
        pivot_point=(0.0, 1.0, 0.0),
        alignment=QUARTER_TURN,
    )
    replay = make_replay()
    replay.remap(PAPER._replace(method=given))
    viewer = ReplayViewer(server, replay)
    option_handles(viewer.steering)["pivot"].value = "palm"
    option_handles(viewer.steering)["pivot_point"].value = ""
    viewer.tick(0.0)
    assert replay.choice.method == given.replaced(pivot="palm", pivot_point=None)
    option_handles(viewer.steering)["alignment"].value = "palm"
    viewer.tick(0.0)
    option_handles(viewer.steering)["alignment"].value = "as given"
    press(viewer.steering.reset)
    viewer.tick(0.0)
    assert replay.choice.method == given


def shown(server: Any, path: str) -> list[bool]:
    """Return the visibility of numbered nodes."""
    found: list[bool] = []
    while (node := server.scene.get_handle_by_name(f"{path}/{len(found)}")) is not None:
        found.append(node.visible)
    return found


@pytest.mark.slow
def test_a_preset_brings_its_options_its_points_and_its_mapping(
    viewer: ReplayViewer,
) -> None:
    seek(viewer, COUNT - 1)
    replay, steering = viewer.replay, viewer.steering
    assert steering.controls["preset"].handle.options == tuple(PRESETS)
    before = viewer.sample.robot_q
    few = len(replay.variant.robot.reference_points)
    assert shown(viewer.server, "/robot/points") == [True] * few
    option_handles(steering)["ridge"].value = 0.3
    viewer.tick(0.0)
    steering.controls["preset"].handle.value = "teleoperation"
    viewer.tick(0.0)
    assert replay.choice == preset_choice("teleoperation")
    assert np.abs(viewer.sample.robot_q - before).max() > 0.05
    many = len(replay.variant.robot.reference_points)
    assert many > few
    for part in ("points", "targets"):
        assert shown(viewer.server, f"/robot/{part}") == [True] * many
    handles = option_handles(steering)
    assert {"pinch_weight", "contact_gap", "rest_weight"} <= handles.keys()
    assert "pivot" not in handles
    assert handles["ridge"].value == 0.1
    assert all(handle.visible for handle in handles.values())
    ellipsoid = viewer.server.scene.get_handle_by_name("/human/ellipsoid")
    assert ellipsoid is not None
    assert ellipsoid.visible
    handles["extension_weight"].value = 0.0
    viewer.tick(0.0)
    assert replay.choice == preset_choice("teleoperation").with_changes(
        {"extension_weight": 0.0}
    )
    steering.controls["preset"].handle.value = "object"
    viewer.tick(0.0)
    assert replay.choice == preset_choice("object")
    assert shown(viewer.server, "/robot/points") == [True] * few + [False] * (
        many - few
    )
    assert "pinch_weight" not in option_handles(steering)
    assert option_handles(steering)["scale"].visible
    press(steering.reset)
    viewer.tick(0.0)
    assert replay.choice == PAPER
    assert steering.controls["preset"].handle.value == "paper"
    np.testing.assert_allclose(viewer.sample.robot_q, before, atol=1e-12)


@pytest.mark.slow
def test_the_measured_contact_gap_is_that_of_a_preset_chosen_later(server: Any) -> None:
    motion = closing_motion()
    replay = Replay(
        motion.human.with_contact_gap(0.018),
        load_hand("three_finger"),
        PAPER,
        (closing_recording(), motion),
    )
    viewer = ReplayViewer(server, replay)
    viewer.steering.controls["preset"].handle.value = "teleoperation"
    viewer.tick(0.0)
    assert replay.choice == preset_choice("teleoperation", replay.human)
    assert option_handles(viewer.steering)["contact_gap"].value == 0.018


def test_an_impossible_option_is_explained_and_changes_nothing(server: Any) -> None:
    replay = make_replay()
    replay.human = replay.human.with_points(("thumb_tip", "index_tip", "middle_tip"))
    replay.remap(PAPER)
    viewer = ReplayViewer(server, replay)
    samples = replay.variant.samples
    option_handles(viewer.steering)["ridge"].value = 0.0
    viewer.tick(0.0)
    assert replay.variant.samples is samples
    assert viewer.steering.message.visible
    assert "ridge: 0 needs 4" in viewer.steering.message.content
    option_handles(viewer.steering)["ridge"].value = 0.2
    viewer.tick(0.0)
    assert replay.choice.method == MappingOptions(ridge=0.2)
    assert not viewer.steering.message.visible


@pytest.mark.slow
def test_release_holds_the_robot_and_clutch_goes_on_from_there(
    viewer: ReplayViewer,
) -> None:
    seek(viewer, 30)
    press(viewer.steering.release)
    viewer.tick(0.0)
    assert viewer.steering.release.disabled
    seek(viewer, 45)
    press(viewer.steering.clutch)
    viewer.tick(0.0)
    samples = viewer.replay.variant.samples
    held = np.array([sample.robot_q for sample in samples[29:45]])
    np.testing.assert_allclose(held, np.tile(held[0], (16, 1)))
    assert {sample.status for sample in samples[30:45]} == {"released"}
    # No jump: at the clutch the motion is the identity, so targets equal the robot's points.
    assert samples[45].targets is not None
    np.testing.assert_allclose(samples[45].targets, samples[44].robot_points, atol=1e-9)
    assert viewer.steering.clutch.disabled
    press(viewer.steering.reset)
    viewer.tick(0.0)
    assert not viewer.replay.switches
    assert viewer.replay.variant.samples[40].status != "released"


def test_a_frame_dropped_by_visers_race_loses_no_request(
    viewer: ReplayViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail_to_wake() -> None:
        # As `asyncio.Event.set` fails if another thread starts to wait for it.
        waiters = deque([0])
        for _ in waiters:
            waiters.append(0)

    option_handles(viewer.steering)["ridge"].value = 0.3
    with monkeypatch.context() as once:
        once.setattr(viewer.server, "flush", fail_to_wake)
        with skip_wakeup_race():
            viewer.tick(0.0)
        assert viewer.replay.choice.method.values["ridge"] == 0.1
    viewer.tick(0.0)
    assert viewer.replay.choice.method.values["ridge"] == 0.3
    with pytest.raises(RuntimeError, match="another"), skip_wakeup_race():
        raise RuntimeError("another mistake")


@pytest.mark.slow
def test_time_runs_at_the_chosen_speed_and_starts_over(viewer: ReplayViewer) -> None:
    viewer.tick(0.5)
    assert viewer.index == 0, "paused"
    press(viewer.play_bar.button)
    viewer.tick(0.5)
    assert viewer.sample.time == pytest.approx(0.5, abs=1 / 30)
    viewer.play_bar.speed.value = "2"
    viewer.tick(0.5)
    assert viewer.sample.time == pytest.approx(1.5, abs=1 / 30)
    viewer.tick(0.5)
    assert viewer.index == 0


@pytest.mark.slow
def test_gauges_show_errors_timing_and_joints(viewer: ReplayViewer) -> None:
    seek(viewer, 40)
    samples = viewer.replay.variant.samples
    time, error = plotted(viewer.gauges.error.content, FIRST)
    expected = 1e3 * np.array([sample.point_error.mean() for sample in samples])
    is_known = np.isfinite(expected)
    # Labels of the axis have one digit.
    np.testing.assert_allclose(time, viewer.replay.time[is_known], atol=0.05)
    np.testing.assert_allclose(error, expected[is_known], atol=0.005 * error.max())
    mark = re.search(r"translate\(([\d.]+) 0\)", viewer.gauges.error.content)
    assert mark is not None
    assert float(mark[1]) == pytest.approx(228.0 * 40 / (COUNT - 1), abs=0.1)
    _, step = plotted(viewer.gauges.timing.content, FIRST)
    durations = 1e6 * np.array([sample.duration for sample in samples])
    durations = np.minimum(durations, 3.0 * np.median(durations))
    np.testing.assert_allclose(step, durations, atol=0.005 * step.max())
    bars = viewer.gauges.joints.content
    for name, q in zip(
        viewer.replay.variant.robot.joint_names, samples[40].robot_q, strict=True
    ):
        assert name in bars
        assert f"{np.degrees(q):.0f}°" in bars


def test_joint_bars_tell_a_position_limit_from_a_speed_limit() -> None:
    replay = make_replay()
    robot, sample = replay.variant.robot, replay.variant.samples[0]
    q, is_limited = robot.rest.copy(), np.zeros(len(robot.rest), dtype=bool)
    q[0], q[1] = robot.upper_limits[0], robot.lower_limits[1]
    is_limited[[0, 2]] = True
    bars = InstantGauges(replay.variant.robot, None).bars(
        [replace(sample, robot_q=q, is_limited=is_limited)]
    )
    colours = re.findall(r"text-align:right;color:(#\w+)", bars)
    assert colours == ["#d62929", "#d62929", "#f08c00"] + ["#2166d8"] * (len(q) - 3)


@pytest.mark.parametrize(
    "name", ["allegro_right", "three_finger", "hey5", "ur5_allegro"]
)
def test_joints_are_grouped_by_the_finger_whose_points_they_move(name: str) -> None:
    robot = load_hand(
        name, points=[p.name for p in load_hand(name).spec.points if p.finger]
    )
    groups = joints_by_finger(robot)
    found = [i for joints in groups.values() for i in joints]
    assert sorted(found) == list(range(len(robot.joint_names)))
    rest = robot.points(robot.rest)
    for finger, joints in groups.items():
        for i in joints:
            q = robot.rest.copy()
            q[i] += 0.05 if q[i] + 0.05 <= robot.upper_limits[i] else -0.05
            is_moved = np.linalg.norm(robot.points(q) - rest, axis=1) > 1e-6
            moved = {
                p.finger
                for p, m in zip(robot.reference_points, is_moved, strict=True)
                if m
            }
            assert moved <= {finger} if finger != "palm" else len(moved) != 1, (
                finger,
                i,
            )


@pytest.mark.slow
def test_a_message_is_shown_while_mapping_again(
    viewer: ReplayViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    remap = viewer.replay.remap
    monkeypatch.setattr(
        viewer.replay,
        "remap",
        lambda *options: (
            said.append(viewer.steering.message.content),
            remap(*options),
        ),
    )
    option_handles(viewer.steering)["ridge"].value = 0.3
    viewer.tick(0.0)
    assert said == ["mapping …"]
    assert not viewer.steering.message.visible
