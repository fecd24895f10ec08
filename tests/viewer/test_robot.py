"""The view of a robot with two hands, which follows recordings of both."""

from __future__ import annotations

from copy import copy
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from viewer_cases import option_handles

from handmap_qp import InvalidInputError
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.offline.trajectory import map_hands
from handmap_qp.apps.viewer.cli import View
from handmap_qp.apps.viewer.gauges import InstantGauges, joints_by_finger
from handmap_qp.apps.viewer.replay import Replay, ReplayViewer
from handmap_qp.hands.robot import load_robot
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.stream.measurement import measure_person
from handmap_qp.stream.robot_follower import RobotFollower, paired
from handmap_qp.trackers.formats import read_hands

# Whole robots: not for the fast suite.
pytestmark = pytest.mark.slow

DEMO = Path("demo")


@cache
def replay_of_demo() -> Replay:
    return View().replay(DEMO, "g1")


def test_both_hands_are_mapped_as_by_the_command_map() -> None:
    replay = replay_of_demo()
    hands = list(read_hands([DEMO]).values())
    robot = load_robot("g1")
    expected, *_ = map_hands(hands, robot, measure_person(*hands), MappingArguments())
    samples = replay.variant.samples
    np.testing.assert_allclose([s.robot_q for s in samples], expected.q, atol=1e-12)
    np.testing.assert_allclose(
        [s.robot_points for s in samples], expected.points, atol=1e-12
    )
    sample = samples[len(samples) // 2]
    for hand, seen in zip(replay.human.hands, sample.humans, strict=True):
        # The drawn hand lies on the landmarks of its own side.
        assert seen.landmarks is not None
        assert seen.q is not None
        drawn = hand.with_points("landmarks").points(seen.q, seen.wrist)
        errors = np.linalg.norm(drawn - seen.landmarks, axis=1)
        assert np.median(errors) < 0.01


def test_the_scene_has_both_human_hands_and_an_upright_robot(server: Any) -> None:
    replay = replay_of_demo()
    viewer = ReplayViewer(server, replay)
    viewer.play_bar.toggle()
    viewer.play_bar.slider.value = 3.0
    viewer.tick(0.0)
    node = server.scene.get_handle_by_name
    names = ("landmarks_right_name", "human_right_name", "human_left_name")
    assert [node(f"/{name}").text for name in names] == [
        "landmarks right",
        "human right",
        "human left",
    ]
    # Seen from the front, the right hand is on the left, where the scene's x is larger.
    right, left, robot = (
        node(f"/{name}_name").position[0]
        for name in ("human_right", "human_left", "robot")
    )
    assert right > left > robot
    *_, figure = viewer.scene._figures
    np.testing.assert_allclose(figure.axes @ (0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    assert [node(f"/robot/points/{i}").visible for i in range(12)] == [True] * 12
    # The base of the robot stays where it is.
    before = node("/robot").position
    viewer.play_bar.slider.value = 6.0
    viewer.tick(0.0)
    np.testing.assert_allclose(node("/robot").position, before, atol=1e-12)


def test_the_gauges_tell_the_hands_apart() -> None:
    replay = replay_of_demo()
    sample = replay.variant.samples[60]
    gauges = InstantGauges(replay.variant.robot, replay.human)
    groups = joints_by_finger(replay.variant.robot)
    assert {"left thumb", "right thumb", "body and arms"} <= groups.keys()
    assert sorted(i for group in groups.values() for i in group) == list(
        range(len(replay.variant.robot.joint_names))
    )
    assert gauges.pinches(sample, 0) != gauges.pinches(sample, 1)
    table = gauges.table([sample], ["paper"])
    assert "left pinch gaps" in table
    assert "right pinch gaps" in table
    # Of both wrists, the one farther from its target.
    choice = replay.choice
    mapper = RobotMapper(
        load_robot("g1"), replay.human.by_side, choice.method, ik=choice.ik
    )
    samples = paired({hand.side: hand for hand in read_hands([DEMO]).values()})
    steps = map(RobotFollower(mapper).map_samples, samples)
    step = next(islice(steps, 60, None))
    wrists = [
        (each.command.wrist[:3, 3], each.wrist_target[:3, 3])
        for each in step.hands.values()
    ]
    errors = [np.linalg.norm(at - target) for at, target in wrists]
    assert gauges.errors(sample)[2] == pytest.approx(max(errors))
    assert max(errors) > 1.1 * min(errors)


def test_options_clutch_and_comparison_move_the_whole_robot(server: Any) -> None:
    replay = copy(replay_of_demo())
    replay.switches = {}
    viewer = ReplayViewer(server, replay)
    viewer.play_bar.toggle()
    before = replay.variant.samples[-1].robot_q
    option_handles(viewer.steering)["pinch_weight"].value = 0.0
    viewer.tick(0.0)
    assert np.abs(replay.variant.samples[-1].robot_q - before).max() > 1e-3
    viewer.steering.controls["compare"].handle.value = "paper"
    viewer.tick(0.0)
    assert len(replay.variants) == 2
    viewer.play_bar.slider.value = 2.0
    viewer.tick(0.0)
    replay.switch("release", viewer.index)
    replay.remap(replay.choice)
    assert replay.variant.samples[-1].status == "released"
    assert replay.variant.samples[-1].targets is None


def test_recordings_that_do_not_fit_the_robot_are_refused() -> None:
    cases = [
        (View(mirror=True), "g1", "--mirror"),
        (View(other=DEMO), "g1", "RECORDING"),
        (View(other=DEMO), "allegro_right", "RECORDING"),
    ]
    for view, robot, argument in cases:
        with pytest.raises(InvalidInputError) as caught:
            view.replay(DEMO, robot)
        assert caught.value.argument == argument
