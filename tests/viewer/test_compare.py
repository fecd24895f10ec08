"""The view with two robots: comparison, landmarks, trails, and pages of any samples."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
import trimesh

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from viewer_cases import (
    COUNT,
    closing_motion,
    closing_recording,
    make_replay,
    option_handles,
    plotted,
    press,
)

from handmap_core.human.sample import TIPS
from handmap_core.trackers.hand_geometry import BONES, NEIGHBOURS
from handmap_qp import HandMapper, InvalidInputError, load_hand
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.apps.viewer.controls import KEPT, NOTHING
from handmap_qp.apps.viewer.gauges import SECOND
from handmap_qp.apps.viewer.page import make_page
from handmap_qp.apps.viewer.replay import ReplayViewer
from handmap_qp.apps.viewer.sample import Variant, ViewSample
from handmap_qp.apps.viewer.scene import BrowserCameras, HandScene
from handmap_qp.mapping.by_name import METHODS
from handmap_qp.mapping.presets import PRESETS
from handmap_qp.se3 import affine, rotation_from_quat_wxyz, transform_points

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow


@pytest.fixture
def viewer(server: Any) -> ReplayViewer:
    """A viewer paused at its first sample."""
    shown = ReplayViewer(server, make_replay())
    shown.play_bar.toggle()
    return shown


def node(viewer: ReplayViewer, name: str) -> Any:
    return viewer.server.scene.get_handle_by_name(name)


def in_scene(frame: Any, points: np.ndarray) -> np.ndarray:
    """Return points of a figure's world in the scene."""
    pose = affine(rotation_from_quat_wxyz(frame.wxyz), np.array(frame.position))
    return transform_points(pose, np.asarray(points))


def seek(viewer: ReplayViewer, index: int) -> None:
    viewer.play_bar.slider.value = float(viewer.replay.time[index])
    viewer.tick(0.0)


def test_a_second_robot_follows_the_same_samples_by_its_own_method(
    viewer: ReplayViewer,
) -> None:
    compare, robot, replay = (
        viewer.steering.controls["compare"].handle,
        load_hand("three_finger"),
        viewer.replay,
    )
    assert set(compare.options) == {NOTHING, KEPT, *PRESETS}
    before = [sample.robot_q for sample in replay.variant.samples]
    compare.value = "finger-vectors"
    seek(viewer, COUNT - 1)
    method, ik = METHODS["finger-vectors"](), PRESETS["object"].ik
    mapper = HandMapper(closing_motion().human, robot, method, ik=ik)
    expected = map_recording(mapper, closing_recording())
    assert replay.other is not None
    np.testing.assert_allclose(
        [sample.robot_q for sample in replay.other.samples], expected.q, atol=1e-12
    )
    np.testing.assert_array_equal(
        [sample.robot_q for sample in replay.variant.samples], before
    )
    assert node(viewer, "/robot_2_name").text == "three_finger\nfinger-vectors"
    for robot_node, sample in (
        ("/robot", viewer.sample),
        ("/robot_2", replay.other.samples[-1]),
    ):
        for i, point in enumerate(sample.robot_points):
            np.testing.assert_array_equal(
                node(viewer, f"{robot_node}/points/{i}").position, point
            )
    # Human, first and second robot stand side by side, from the left (+x) to the right.
    places = [
        node(viewer, f"/{name}_name").position[0]
        for name in ("human", "robot", "robot_2")
    ]
    assert places == sorted(places, reverse=True)
    assert "finger-vectors" in viewer.gauges.table.content
    _, error = plotted(viewer.gauges.error.content, SECOND)
    expected = 1e3 * np.array([s.point_error.mean() for s in replay.other.samples])
    np.testing.assert_allclose(
        error, expected[np.isfinite(expected)], atol=0.005 * error.max()
    )
    # Release holds both.
    press(viewer.steering.release)
    viewer.tick(0.0)
    assert {v.samples[-1].status for v in replay.variants} == {"released"}
    compare.value = NOTHING
    viewer.tick(0.0)
    assert len(replay.variants) == 1
    assert not node(viewer, "/robot_2").visible


def test_kept_options_stay_while_others_change(viewer: ReplayViewer) -> None:
    replay = viewer.replay
    before = replay.variant.samples
    press(viewer.steering.keep)
    viewer.tick(0.0)
    option_handles(viewer.steering)["deformation_gain"].value = 0.0
    viewer.tick(0.0)
    assert replay.other is not None
    assert [variant.label for variant in replay.variants] == [
        "paper, changed",
        "paper, kept",
    ]
    for kept, sample in zip(replay.other.samples, before, strict=True):
        np.testing.assert_allclose(kept.robot_q, sample.robot_q, atol=1e-12)
    assert np.abs(replay.variant.samples[-1].robot_q - before[-1].robot_q).max() > 0.05


def test_the_landmarks_stand_beside_the_hand_as_they_were_tracked(
    viewer: ReplayViewer,
) -> None:
    assert not node(viewer, "/landmarks").visible
    viewer.display.landmarks.value = True
    seek(viewer, 40)
    landmarks = closing_recording().landmarks[40]
    shown = in_scene(node(viewer, "/landmarks"), landmarks)
    for i, point in enumerate(landmarks):
        np.testing.assert_allclose(
            node(viewer, f"/landmarks/points/{i}").position, point
        )
    np.testing.assert_allclose(
        node(viewer, "/landmarks/bones").points,
        landmarks[[*BONES, *NEIGHBOURS]],
        atol=1e-6,
    )
    hand = in_scene(node(viewer, "/human"), landmarks)
    # The same landmarks as on the drawn hand, shifted to the left of it.
    shift = shown - hand
    np.testing.assert_allclose(shift, np.tile(shift[0], (21, 1)), atol=1e-9)
    assert shown[:, 0].min() > hand[:, 0].max()
    viewer.display.landmarks.value = False
    viewer.tick(0.0)
    assert not node(viewer, "/landmarks").visible


@pytest.mark.parametrize("follow", ["hands", "world"])
def test_trails_are_the_paths_of_the_tips_until_they_are_cleared(
    viewer: ReplayViewer, follow: Literal["hands", "world"]
) -> None:
    viewer.display.trails.value, viewer.display.follow.value = True, follow
    seen = []
    for i in range(5):
        seek(viewer, i)
        (human,) = viewer.sample.humans
        assert human.landmarks is not None
        tips = human.landmarks[TIPS]
        seen.append(in_scene(node(viewer, "/human"), tips))
    # On the screen, a trail is where the tips were seen.
    drawn = in_scene(
        node(viewer, "/human"), node(viewer, "/human/trail").points.reshape(-1, 3)
    )
    expected = np.stack([seen[:-1], seen[1:]], axis=2).reshape(-1, 3)
    np.testing.assert_allclose(drawn, expected, atol=1e-5)
    assert node(viewer, "/robot/trail").visible
    press(viewer.display.clear)
    viewer.tick(0.0)
    assert not node(viewer, "/human/trail").visible
    seek(viewer, 6)
    seek(viewer, 7)
    assert len(node(viewer, "/human/trail").points) == len(TIPS)
    # Time that goes back starts it again.
    seek(viewer, 0)
    assert not node(viewer, "/human/trail").visible


def test_a_page_of_a_robot_and_an_object_needs_no_human_hand(server: Any) -> None:
    robot = load_hand("three_finger")
    cube = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False)
    pose = affine(np.eye(3), np.array([0.1, 0.2, 0.3]))
    samples = [
        ViewSample(
            time=0.1 * i,
            robot_q=robot.rest,
            robot_wrist=np.eye(4),
            robot_points=robot.points(robot.rest, np.eye(4)),
            object_pose=affine(np.eye(3), 0.1 * i * pose[:3, 3]),
            note=f"{i} N",
        )
        for i in range(3)
    ]
    # Up, as the scene has it, is +z here.
    turn = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    variant = Variant("squeeze", robot, None, samples, cube, turn)
    scene = HandScene(server, None, [variant])
    scene.draw([samples[-1]])
    solid = server.scene.get_handle_by_name("/robot/object")
    np.testing.assert_allclose(solid.position, 0.2 * pose[:3, 3])
    frame = server.scene.get_handle_by_name("/robot")
    np.testing.assert_allclose(rotation_from_quat_wxyz(frame.wxyz), turn, atol=1e-9)
    name = server.scene.get_handle_by_name("/robot_name").text
    assert name.splitlines() == ["three_finger", "squeeze", "2 N"]
    page = make_page("A <cube>", None, [variant]).decode()
    assert "<title>A &lt;cube&gt; - handmap view</title>" in page
    assert "0.2 s, 3 samples" in page
    # A human without what it does is one error.
    with pytest.raises(InvalidInputError, match="variants: expected samples with"):
        make_page("A cube", load_hand("human"), [variant])


@pytest.mark.parametrize("window", [(1440, 900), (500, 600), (240, 900), (1000, 200)])
def test_the_box_and_the_names_below_fit_every_window(
    server: Any, window: tuple[int, int]
) -> None:
    size = np.array([0.5, 0.3, 0.2])
    cameras = BrowserCameras(server)
    cameras.fit(*size)
    distance, low = cameras._view(*window)
    direction, fov = cameras.view["direction"], cameras.view["fov"]
    eye = distance * np.array(direction) + (0.0, low, 0.0)
    forward = -np.array(direction)
    right = np.array([-1.0, 0.0, 0.0])
    up = np.cross(right, forward)
    signs = np.array([[x, y] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    # The middle of the box: hands are widest there, not at its front.
    seen = np.column_stack([signs * size[:2], np.zeros(4)]) - eye
    pixels = window[1] / (2.0 * np.tan(0.5 * fov))
    x = pixels * (seen @ right) / (seen @ forward)
    y = pixels * (seen @ up) / (seen @ forward)
    assert np.abs(x).max() < 0.5 * window[0]
    assert y.max() < 0.5 * window[1]
    assert y.min() > -0.5 * window[1] + 60, "the names"
