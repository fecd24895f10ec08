"""A session says how often speed limits that are only assumed held its robot."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml
from service_tools import PERIOD, Sampler, human_q, opening, run_now

from handmap_qp import load_hand
from handmap_qp.apps.service.opening import HandCache, prepare_hands
from handmap_qp.apps.service.session import Session
from handmap_qp.client.messages import Command, State
from handmap_qp.hands import hand_files
from handmap_qp.hands.sources import urdf_path
from handmap_qp.mapping import ASSUMED_SHARE, AssumedSpeeds, assumed_note


def make_session(folder: Path, origin: str, speed: float) -> Session:
    """Return a session whose robot has one speed limit at all joints.

    Args:
        folder: Where its description is written.
        origin: Where its speeds are from (`HandSpec.speeds`).
        speed: The limit [rad/s].
    """
    spec = load_hand("three_finger").spec
    document = yaml.safe_load(hand_files()["three_finger"].read_text(encoding="utf-8"))
    document |= {
        "name": "own",
        "urdf": str(urdf_path(spec)),
        "speeds": origin,
        "limits": {joint: {"velocity": speed} for joint in spec.joints},
    }
    file = folder / "hand.yaml"
    file.write_text(yaml.safe_dump(document))
    request = opening("own")
    hands = prepare_hands(request, HandCache([file]), defer=run_now)
    return Session(request, hands, "test", 0.0)


def follow(session: Session, count: int = 120) -> list[Command]:
    """Send samples of a hand that closes and opens within a second."""
    sample = Sampler()
    return [
        session.step(sample(i * PERIOD, human_q(2.0 * np.pi * i * PERIOD)), i * PERIOD)
        for i in range(count)
    ]


def state_of(session: Session) -> State:
    return session.state(2, "0", 0, 0.0)


@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_the_share_is_that_of_the_commands(tmp_path: Path, speed: float) -> None:
    session = make_session(tmp_path, "assumed", speed)
    commands = follow(session)
    robot = session.robot
    held = 0
    for command in commands:
        at_limit = robot.at_position_limit(np.array(command.q))
        free = {*np.array(robot.joint_names)[~at_limit]}
        held += bool(free & {*command.at_limit})
    counted = state_of(session).assumed_speed
    assert counted is not None
    assert counted.share == held / len(commands)
    assert counted.share > 0.1
    assert counted.joint in robot.joint_names
    assert counted.is_often
    note = assumed_note(counted)
    assert f"in {100.0 * counted.share:.0f} % of the samples" in note
    assert "--speed" in note


def test_a_fast_enough_limit_holds_nothing(tmp_path: Path) -> None:
    session = make_session(tmp_path, "assumed", 500.0)
    follow(session)
    counted = state_of(session).assumed_speed
    assert counted is not None
    assert counted.share <= ASSUMED_SHARE
    assert not counted.is_often
    assert assumed_note(counted) == ""


def test_nothing_is_said_of_speeds_that_are_known(tmp_path: Path) -> None:
    session = make_session(tmp_path, "maker", 0.3)
    follow(session)
    assert state_of(session).assumed_speed is None


def test_there_is_no_share_before_the_first_sample(tmp_path: Path) -> None:
    session = make_session(tmp_path, "assumed", 0.3)
    counted = state_of(session).assumed_speed
    assert counted is not None
    assert (counted.share, counted.joint) == (0.0, "")
    assert AssumedSpeeds(session.robot).has_any


def test_a_few_samples_are_not_often(tmp_path: Path) -> None:
    """At its start, a robot goes to the person's posture as fast as it may."""
    session = make_session(tmp_path, "assumed", 0.3)
    follow(session, 20)
    counted = state_of(session).assumed_speed
    assert counted is not None
    assert counted.share > ASSUMED_SHARE
    assert not counted.is_often


def test_samples_that_the_robot_does_not_follow_do_not_count(tmp_path: Path) -> None:
    session = make_session(tmp_path, "assumed", 0.3)
    follow(session)
    before = state_of(session).assumed_speed
    session.release()
    follow(session)
    assert state_of(session).assumed_speed == before


def test_answers_of_servers_that_do_not_count_are_read(tmp_path: Path) -> None:
    session = make_session(tmp_path, "assumed", 0.3)
    state = state_of(session)
    sent = msgspec.to_builtins(state)
    read = msgspec.json.decode(msgspec.json.encode(state), type=State)
    assert read.assumed_speed == state.assumed_speed
    del sent["assumed_speed"]
    assert msgspec.convert(sent, State).assumed_speed is None
