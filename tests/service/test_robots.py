"""A robot with two hands over the wire: two streams of landmarks, one command, one stop."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robot_cases import LENGTH, PEOPLE, landmarks_at, write_robot
from service_tools import (
    PERIOD,
    client_of,
    code_of,
    connected,
    lose_sessions,
    serving,
    skip,
)

from handmap_qp import HumanLengths, HumanSample
from handmap_qp.apps.service.opening import HandCache
from handmap_qp.apps.service.server import Server
from handmap_qp.client import Client, Command, ServiceError
from handmap_qp.errors import HandError
from handmap_qp.hands import Side
from handmap_qp.hands.robot import load_robot
from handmap_qp.mapping.presets import preset_choice
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.stream.robot_follower import RobotFollower

SIDES: tuple[Side, Side] = ("left", "right")
OPEN: dict[str, Any] = {"preset": None, "input": "landmarks", "hand_length": LENGTH}


def opened_with(**choices: Any) -> dict[str, Any]:
    """Return choices of a session of landmarks."""
    return OPEN | choices


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The description of a robot that walks."""
    file = write_robot(tmp_path_factory.mktemp("twin"))
    text = file.read_text(encoding="utf-8")
    file.write_text(f"{text}base: floating\n", encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def server(file: Path) -> Iterator[Server]:
    """A server that knows it."""
    with serving(hand=(file,), simulated_time=True) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[Client]:
    """A client with a session of the robot, in simulated time."""
    with connected(server, "twin", time_from="client", **OPEN) as client:
        yield client


def hands_at(time: float, *sides: Side) -> dict[str, Any]:
    """Return what a sample has of both hands, or of those named."""
    return {side: {"landmarks": landmarks_at(side, time)} for side in sides or SIDES}


def walk(client: Client, count: int, start: float = 0.0) -> Command:
    """Send samples of both hands; return the last command."""
    times = start + PERIOD * np.arange(count)
    return [client.step(time=t, hands=hands_at(t)) for t in times.tolist()][-1]


def joints_of(client: Client, part: str) -> list[int]:
    """Return the places of the joints of a side."""
    assert client.opened is not None
    names = client.opened.joint_names
    return [k for k, name in enumerate(names) if name.startswith(part)]


def test_commands_are_those_of_a_follower_in_this_process(
    file: Path, client: Client
) -> None:
    choice = preset_choice("teleoperation", PEOPLE["left"])
    mapper = RobotMapper(load_robot(file), PEOPLE, choice.method, ik=choice.ik)
    follower = RobotFollower(mapper)
    assert client.opened is not None
    assert client.opened.joint_names == mapper.robot.joint_names
    for i in range(90):
        time = i * PERIOD
        # One hand is missing from some samples, and not seen in others.
        sides = SIDES if i % 7 else SIDES[:1]
        hands = hands_at(time, *sides)
        if 40 < i < 55:
            hands["left"] = {"valid": False}
        samples: dict[Side, HumanSample] = {}
        for side in sides:
            valid = "landmarks" in hands[side]
            points = landmarks_at(side, time)
            samples[side] = HumanSample(time, side, points, valid=valid)
        base = np.eye(4)
        base[:2, 3] = 0.1 * np.sin(time), 0.05 * time
        command = client.step(time=time, hands=hands, base=base)
        mapper.base_pose = base
        step = follower.map_samples(samples, dt=command.dt)
        np.testing.assert_allclose(command.q, step.command.q, atol=1e-9)
        assert (command.status, command.rule) == (step.status, step.rule)
        np.testing.assert_allclose(command.wrist_error, step.wrist_error, atol=1e-9)
        assert command.arm_held_by == step.arm_held_by
        for side in SIDES:
            said, own = command.hands[side], step.hands[side]
            assert (said.status, said.rule) == (own.status, own.rule)
            assert said.arm_held_by == own.arm_held_by
            np.testing.assert_allclose(
                said.wrist.matrix, own.command.wrist, rtol=0.0, atol=1e-9
            )


def test_a_lost_hand_holds_its_side_and_the_other_goes_on(client: Client) -> None:
    walk(client, 30)
    left, right = (joints_of(client, side) for side in SIDES)
    assert len(left) == len(right) == 14
    held: list[Command] = []
    for i in range(30, 75):
        time = i * PERIOD
        hands = hands_at(time, "right") | {"left": {"valid": False}}
        held.append(client.step(time=time, hands=hands))
    first, *_, last = (np.array(command.q) for command in held[5:])
    assert np.abs(last - first)[left].max() < 0.02
    assert np.abs(last - first)[right].max() > 0.05
    assert held[-1].status != "held"
    assert held[-1].hands["left"].status == "held"
    assert held[-1].hands["left"].rule == held[-1].rule == "missing"
    assert held[-1].hands["right"].rule == ""
    both = {side: {"valid": False} for side in SIDES}
    assert client.step(time=75 * PERIOD, hands=both).status == "held"
    assert client.step(time=76 * PERIOD, hands=hands_at(76 * PERIOD)).status != "held"


def test_joints_keep_their_speed_limits_whatever_comes(client: Client) -> None:
    generator = np.random.default_rng(3)
    assert client.opened is not None
    before, speed = np.array(client.opened.q), np.array(client.opened.speed)
    lower, upper = client.opened.lower, client.opened.upper
    time, moved = 0.0, 0.0
    for _ in range(250):
        time += float(generator.choice([PERIOD, PERIOD, 0.0, -0.1, 0.3, 7.0]))
        hands: dict[str, Any] = {}
        for side in SIDES:
            kind = generator.choice(["seen", "far", "noisy", "lost", "none"])
            points = landmarks_at(side, time, 0.4 if kind == "far" else 0.0)
            if kind == "noisy":
                points = points + generator.normal(0.0, 0.02, points.shape)
            if kind != "none":
                hands[side] = {"landmarks": points, "valid": kind != "lost"}
        act = generator.choice([""] * 12 + ["release", "clutch", "reset", "configure"])
        if act == "configure":
            client.configure(options={"scale": float(generator.uniform(0.3, 2.0))})
        elif act:
            getattr(client, act)()
        if not hands:
            continue
        command = client.step(time=time, hands=hands)
        q = np.array(command.q)
        assert (np.abs(q - before) <= speed * command.dt + 1e-9).all()
        assert (q >= lower).all()
        assert (q <= upper).all()
        moved = max(moved, np.abs(q - before).max())
        before = q
    assert moved > 0.01


def test_one_stop_stops_all_joints_and_only_its_clearing_frees_them(
    client: Client, server: Server
) -> None:
    walk(client, 40)
    assert client.opened is not None
    with client_of(server) as other:
        other.stop(client.opened.name)
    walk(client, 30, 1.0)
    start = walk(client, 1, 2.0)
    command = walk(client, 30, 2.1)
    assert command.status == "stopped"
    np.testing.assert_allclose(command.q, start.q, atol=1e-9)
    with pytest.raises(ServiceError) as raised:
        client.clutch()
    assert code_of(raised)[0] == "stopped"
    client.clear(client.status().stop)
    client.clutch()
    assert not np.allclose(walk(client, 30, 3.0).q, start.q, atol=1e-3)


@pytest.mark.parametrize(
    ("sample", "field"),
    [
        ({"landmarks": landmarks_at("left", 0.0)}, "hands"),
        ({"valid": False}, "hands"),
        ({"hands": {}}, "hands"),
        ({"hands": hands_at(0.0), "valid": False}, "hands"),
        ({"hands": hands_at(0.0), "wrist": np.eye(4)}, "hands"),
        (
            {"hands": {"left": {"landmarks": [(0.0, 0.0, 0.0)] * 20}}},
            "hands.left.landmarks",
        ),
        ({"hands": {"left": {}}}, "hands.left.landmarks"),
        ({"hands": {"left": {"values": [0.0] * 75}}}, "hands.left.landmarks"),
    ],
)
def test_a_wrong_sample_is_refused_by_its_field(
    client: Client, sample: dict[str, Any], field: str
) -> None:
    before = walk(client, 3)
    with pytest.raises(ServiceError) as raised:
        client.step(time=0.1, **sample)
    code, found = code_of(raised)
    assert (code, found.partition("[")[0]) == ("invalid", field)
    after = client.step(time=0.11, hands=hands_at(0.11))
    assert np.abs(np.subtract(after.q, before.q)).max() < 0.5


def test_hands_in_other_units_are_refused_while_they_are_measured_and_held_else(
    server: Server,
) -> None:
    hands = {side: {"landmarks": 1e3 * landmarks_at(side, 0.0)} for side in SIDES}
    with connected(server, "twin", **opened_with(hand_length=None)) as client:
        with pytest.raises(ServiceError) as raised:
            client.step(hands=hands)
        assert code_of(raised) == ("invalid", "hands.left.landmarks")
    with connected(server, "twin", **OPEN) as client:
        command = client.step(hands=hands)
        assert (command.status, command.rule) == ("held", "size")
        assert {hand.rule for hand in command.hands.values()} == {"size"}


def test_poses_of_hands_are_checked(client: Client) -> None:
    bad = {"position": [0.0, 0.0, 0.0], "quat_xyzw": [0.0, 0.0, 0.0, 2.0]}
    request = {"type": "step", "time": 0.0, "hands": {"right": {"wrist": bad}}}
    with pytest.raises(ServiceError) as raised:
        client._run(client._call(request, Command))
    assert code_of(raised) == ("invalid", "hands.right.wrist.quat_xyzw")
    with pytest.raises(TypeError, match="left"):
        client.step(hands={"left": {"q": [0.0]}})


def test_hands_need_a_robot_with_two(server: Server) -> None:
    with connected(server, "three_finger", **OPEN) as client:
        with pytest.raises(ServiceError) as raised:
            client.step(hands=hands_at(0.0))
        assert code_of(raised) == ("invalid", "hands")
        command = client.step(landmarks=landmarks_at("right", 0.0))
        assert len(command.wrist_error) == 2
        assert command.hands == {}


@pytest.mark.parametrize(
    ("choices", "field"),
    [
        ({"input": "q"}, "input"),
        ({"input": "points"}, "input"),
        ({"mount": "fixed"}, "mount"),
        ({"robot_points": "fingertips"}, "robot_points"),
        ({"robot_wrist": np.eye(4)}, "robot_wrist"),
        ({"robot_q": [0.0] * 3}, "robot_q"),
        ({"options": {"scale": -1.0}}, "options.scale"),
    ],
)
def test_what_a_robot_cannot_take_is_refused(
    server: Server, choices: dict[str, Any], field: str
) -> None:
    with client_of(server) as client, pytest.raises(ServiceError) as raised:
        client.open("twin", **OPEN | choices)
    assert code_of(raised) == ("invalid", field)


def test_the_server_lists_its_robots(server: Server, file: Path) -> None:
    with client_of(server) as client:
        assert "twin" in client.status().two_handed
        assert "twin" not in client.status().robots
        with pytest.raises(ServiceError, match=r"three_finger.*twin"):
            client.open("g2")
    with pytest.raises(HandError, match="already"):
        HandCache((file, file))


def test_a_restarted_session_goes_on_where_its_robot_is(
    file: Path, tmp_path: Path
) -> None:
    state = tmp_path / "state"
    with serving(hand=(file,), state=state) as server:
        with connected(server, "twin", name="lab", **OPEN) as client:
            before = walk(client, 40)
            lose_sessions(server)
            again = walk(client, 1, 1.0)
            assert client.reopened == 1
            assert again.epoch == before.epoch
            assert client.opened is not None
            moved = np.abs(np.subtract(again.q, before.q))
            assert (moved <= np.array(client.opened.speed) * again.dt + 1e-9).all()
        record = server.dispatcher.sessions.store.records["lab"]
    assert record.robot == "twin"
    with serving(hand=(file,), state=state) as server, client_of(server) as client:
        skip(server, 3.0)
        start = [0.0] * len(record.q)
        client.open("twin", name="lab", restore=True, robot_q=start, **OPEN)
        assert client.opened is not None
        np.testing.assert_allclose(client.opened.q, record.q, atol=1e-9)


def test_a_hand_that_was_never_seen_stays_where_the_robot_was(server: Server) -> None:
    with connected(server, "twin", time_from="client", **OPEN) as client:
        assert client.opened is not None
        start = np.array(client.opened.q) + 0.15
        start = np.clip(start, client.opened.lower, client.opened.upper)
        client.reset(robot_q=start)
        commands = []
        for i in range(60):
            time = i * PERIOD
            commands.append(client.step(time=time, hands=hands_at(time, "right")))
        before, after = (commands[k].hands["left"].wrist.matrix for k in (0, -1))
        assert np.abs(after - before).max() < 1e-3
        fingers = joints_of(client, "left_hand")
        assert np.abs(np.array(commands[-1].q) - start)[fingers].max() < 1e-3


@pytest.mark.parametrize("sides", [SIDES, ("right",)])
def test_the_first_landmarks_measure_each_hand(
    server: Server, sides: tuple[Side, ...]
) -> None:
    with connected(server, "twin", **OPEN | {"hand_length": None}) as client:
        assert client.opened is not None
        time = 0.0
        command = client.step(time=time, hands=hands_at(time, *sides))
        while command.status == "calibrating":
            assert command.q == client.opened.q
            time += PERIOD
            command = client.step(time=time, hands=hands_at(time, *sides))
        assert time > 25 * PERIOD
        about = client.status().about
        assert about is not None
        own = HumanLengths.from_hand_length(LENGTH)
        np.testing.assert_allclose(
            about["lengths"]["segments"], own.segments, atol=1e-6
        )
        moved = walk(client, 20, time + PERIOD)
        assert {hand.rule for hand in moved.hands.values()} == {""}


def test_a_hand_alone_says_what_holds_its_arm(server: Server) -> None:
    left = OPEN | {"side": "left"}
    with connected(server, "g1_arm_left", time_from="client", **left) as client:
        assert client.opened is not None
        for i in range(60):
            time = i * PERIOD
            points = landmarks_at("left", time, 2.0 * time)
            command = client.step(time=time, landmarks=points)
        assert command.wrist_error[0] > 0.1
        assert command.arm_held_by in ("speed", "limit", "reach")


def test_only_a_robot_that_walks_has_its_base_elsewhere(
    server: Server, file: Path, client: Client
) -> None:
    walk(client, 40)
    base = np.eye(4)
    base[0, 3] = np.nan
    with pytest.raises(ServiceError, match="base"):
        client.step(time=2.0, hands=hands_at(2.0), base=base)
    fixed = file.read_text(encoding="utf-8").replace("floating", "fixed")
    still = file.with_name("still.yaml")
    still.write_text(fixed.replace("twin", "still"), encoding="utf-8")
    with (
        serving(hand=(still,), simulated_time=True) as other,
        connected(other, "still", time_from="client", **OPEN) as standing,
    ):
        walk(standing, 40)
        with pytest.raises(ServiceError, match="base: floating"):
            standing.step(time=2.0, hands=hands_at(2.0), base=np.eye(4))
    with connected(server, "allegro_right", time_from="client", **OPEN) as alone:
        points = landmarks_at("right", 0.0)
        for i in range(40):
            alone.step(time=i * PERIOD, landmarks=points)
        with pytest.raises(ServiceError, match="no floating base"):
            alone.step(time=2.0, landmarks=points, base=np.eye(4))
