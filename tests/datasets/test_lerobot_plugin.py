"""The teleoperator and the simulated hand of LeRobot, in `packages/lerobot`.

Most of it is tried with stand-ins for LeRobot's base classes. LeRobot itself records and trains
where the variable `HANDMAP_LEROBOT_PYTHON` names an interpreter that has it and the plug-in.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from lerobot_runs import run_lerobot
from service_tools import HERE, address_of, client_of, human_q, serving

from handmap_qp import load_hand

PLUGIN = Path(__file__).parents[2] / "packages" / "lerobot"
PYTHON = os.environ.get("HANDMAP_LEROBOT_PYTHON", "")

pytestmark = pytest.mark.slow


class _Base:
    """What both base classes do with a configuration."""

    def __init__(self, config: Any) -> None:
        self.id = config


class _Config:
    @classmethod
    def register_subclass(cls, name: str) -> Any:
        return lambda made: made


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The plug-in, on stand-ins for LeRobot."""
    pytest.importorskip("trimesh")
    pytest.importorskip("mujoco")
    for kind in ("Teleoperator", "Robot"):
        module = ModuleType(f"lerobot.{kind.lower()}s")
        vars(module).update({kind: _Base, f"{kind}Config": _Config})
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(sys.modules, "lerobot", ModuleType("lerobot"))
    monkeypatch.syspath_prepend(PLUGIN)
    import lerobot_teleoperator_handmap as made

    yield made
    for name in [name for name in sys.modules if name.startswith(made.__name__)]:
        monkeypatch.delitem(sys.modules, name)


@pytest.mark.parametrize("robot", ["three_finger", "g1_arm_left"])
def test_an_action_says_the_command(plugin: Any, robot: str) -> None:
    from lerobot_teleoperator_handmap.actions import action_of, command_of, features

    hand = load_hand(robot)
    wrist = np.eye(4)
    wrist[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    wrist[:3, 3] = 0.1, -0.2, 0.3
    action = action_of(hand, hand.rest, wrist)
    assert list(action) == list(features(hand))
    assert [action[f"{name}.pos"] for name in hand.joint_names] == list(hand.rest)
    # A policy's quaternion is not quite one.
    for name in ("qw", "qx", "qy", "qz"):
        if hand.is_floating:
            action[f"wrist.{name}"] *= 1.1
    q, place = command_of(hand, action)
    np.testing.assert_array_equal(q, hand.rest)
    if hand.is_floating:
        assert place is not None
        np.testing.assert_allclose(place, wrist, atol=1e-12)
    else:
        assert place is None


def test_a_recording_is_played_to_and_fro_without_a_jump(
    plugin: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    teleop = plugin.Handmap(plugin.HandmapConfig(hand="three_finger"))
    with pytest.raises(ConnectionError, match="connect"):
        teleop.get_action()
    teleop.connect()
    assert teleop.is_connected
    actions = []
    length = teleop._source._motion.time[-1] - teleop._source._motion.time[0]
    for now in np.arange(0.0, 2.0 * length + 0.5, 1.0 / 30.0):  # noqa: B007  (read by the clock)
        actions.append(list(teleop.get_action().values()))
    joints = np.array(actions)[:, : len(teleop.hand.joint_names)]
    speeds = np.abs(np.diff(joints, axis=0)) * 30.0
    assert np.all(speeds <= teleop.hand.velocity_limits * (1.0 + 1e-9))
    assert np.ptp(joints, axis=0).max() > 0.3
    now = 2.0 * length
    np.testing.assert_array_equal(list(teleop.get_action().values()), actions[0])
    teleop.disconnect()
    assert not teleop.is_connected


def test_a_session_is_followed(plugin: Any) -> None:
    with serving() as server, client_of(server) as tracker:
        tracker.open("three_finger", name="lab", preset="paper")
        for i in range(20):
            command = tracker.step(q=human_q(0.1 * i), wrist=HERE)
        made = {"session": "lab", "address": address_of(server)}
        teleop = plugin.Handmap(plugin.HandmapConfig(hand="three_finger", **made))
        teleop.connect()
        action = teleop.get_action()
        assert [action[f"{name}.pos"] for name in command.joint_names] == [*command.q]
        teleop.disconnect()
        other = plugin.Handmap(plugin.HandmapConfig(hand="g1_arm_left", **made))
        with pytest.raises(ValueError, match="drives a hand with the joints"):
            other.connect()


def test_the_simulated_hand_goes_where_actions_say(
    plugin: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    from lerobot_teleoperator_handmap.actions import action_of

    robot = plugin.HandmapHand(plugin.HandmapHandConfig(hand="three_finger"))
    with pytest.raises(ConnectionError, match="connect"):
        robot.send_action({})
    robot.connect()
    hand = robot.hand
    before = robot.get_observation()
    assert before["front"].shape == robot.observation_features["front"]
    goal = hand.rest + 0.3 * (hand.upper_limits - hand.rest)
    sent = action_of(hand, goal, np.eye(4))
    robot.send_action(action_of(hand, hand.rest, np.eye(4)))
    for now in np.arange(0.1, 1.0, 0.1):  # noqa: B007  (read by the clock)
        assert robot.send_action(sent) == pytest.approx(sent)
    after = robot.get_observation()
    for name, value in sent.items():
        assert after[name] == pytest.approx(value, abs=0.02)
    assert np.any(after["front"] != before["front"])
    robot.disconnect()
    assert not robot.is_connected


@pytest.mark.skipif(
    not PYTHON, reason="lerobot and the plug-in are elsewhere (HANDMAP_LEROBOT_PYTHON)"
)
def test_lerobot_records_and_trains(tmp_path: Path) -> None:
    """The two commands of `packages/lerobot/README.md`, shorter."""
    shared = ["--dataset.repo_id=lab/pinch", f"--dataset.root={tmp_path / 'set'}"]
    commands = Path(PYTHON).parent
    run_lerobot(
        tmp_path,
        str(commands / "lerobot-record"),
        *shared,
        "--robot.type=handmap_hand",
        "--teleop.type=handmap",
        "--dataset.single_task=Pinch",
        "--dataset.num_episodes=1",
        "--dataset.episode_time_s=3",
        "--dataset.fps=10",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    )
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["robot_type"] == "handmap_hand"
    assert info["total_frames"] == pytest.approx(30, abs=3)
    video = tmp_path / "set/videos/observation.images.front"
    assert list(video.rglob("*.mp4"))
    run_lerobot(
        tmp_path,
        str(commands / "lerobot-train"),
        *shared,
        "--dataset.video_backend=pyav",
        "--policy.type=act",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--policy.pretrained_backbone_weights=null",
        "--policy.dim_model=64",
        "--policy.n_heads=2",
        "--policy.chunk_size=8",
        "--policy.n_action_steps=8",
        "--steps=10",
        "--batch_size=2",
        "--num_workers=0",
        f"--output_dir={tmp_path / 'out'}",
    )
    assert (tmp_path / "out/checkpoints/000010/pretrained_model").is_dir()
