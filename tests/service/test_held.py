"""Sessions that grip by measured joints, or touch a known object; what they refuse."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
import pytest
from holding import hold
from msgspec.structs import replace
from picks import made_pick
from service_tools import (
    CACHE,
    PERIOD,
    Sampler,
    change,
    client_of,
    code_of,
    opening,
    serving,
)

from handmap_core.ik.tasks import AttachedPoints
from handmap_qp import Recording
from handmap_qp.apps.service.opening import prepare_hands
from handmap_qp.apps.service.session import Session
from handmap_qp.client import ServiceError
from handmap_qp.client.messages import PROTOCOL, Command, HandSample, Measured, Pose
from handmap_qp.errors import RefusedError
from handmap_qp.hands.human import HumanLengths
from handmap_qp.human import sample_columns
from handmap_qp.mapping.hand_pair import robot_fingers
from handmap_qp.stream.held_object import ObjectFollower

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

CUBE = "box:0.04"
ALLEGRO: dict[str, Any] = {
    "robot": "allegro_right",
    "preset": "teleoperation",
    "input": "landmarks",
    "time_from": "client",
}


def session_of(**choices: Any) -> Session:
    """Make a session whose person has the hand of the model."""
    request = opening(**ALLEGRO | choices)
    return Session(request, prepare_hands(request, CACHE), "test", 0.0)


def rows(points: np.ndarray) -> tuple[Any, ...]:
    return tuple(map(tuple, points.tolist()))


class Stuck:
    """A robot whose joints stay where they are at some moment, as around an object."""

    def __init__(self, session: Session, since: int) -> None:
        self.since = since
        self.q = tuple(session.robot.rest.tolist())

    def follow(self, i: int, command: Command) -> None:
        if i < self.since:
            self.q = command.q


def pick(
    session: Session,
    sampler: Sampler,
    count: int = 110,
    since: int = 55,
    *,
    by_driver: bool = False,
    **held: Any,
) -> Iterator[Command]:
    """A hand closes at .8 s, around what stops the robot then.

    A driver measures the joints where `by_driver` is given, else they come with the samples.
    """
    recording = made_pick("right")
    robot = Stuck(session, since)
    for i in range(count):
        landmarks = rows(recording.landmarks[i % 110])
        measured: dict[str, Any] = {} if by_driver else {"measured_q": robot.q}
        if by_driver:
            read = Measured(protocol=PROTOCOL, seq=i, name="test", measured_q=robot.q)
            session.measure(read, PERIOD * i - 0.004)
        sample = sampler(PERIOD * i, landmarks=landmarks, **measured, **held)
        command = session.step(sample, PERIOD * i)
        robot.follow(i, command)
        yield command


def test_a_grip_goes_out_with_its_torques_and_stays_while_samples_are_lost() -> None:
    session, sampler = session_of(grip={"force": 4.0}), Sampler()
    commands = list(pick(session, sampler))
    assert commands[40].effort == ()
    last = commands[-1]
    assert len(last.effort) == len(last.q)
    assert np.abs(last.effort).max() > 0.05
    lost = sampler(2.0, landmarks=None, valid=False, measured_q=last.q)
    command = session.step(lost, 2.0)
    assert command.status == "held"
    np.testing.assert_allclose(command.effort, last.effort, rtol=0.2, atol=1e-3)
    # Silence: the watchdog's commands have them too.
    now = 2.0 + session.request.watchdog
    silent = [session.tick(now + wait) for wait in (0.0, 0.1)]
    assert [each and each.effort for each in silent] == [command.effort] * 2
    assert command.effort
    session.clutch()
    command = session.step(
        sampler(5.0, landmarks=lost.landmarks, valid=False, measured_q=last.q), 5.0
    )
    assert command.effort == ()


@pytest.mark.parametrize("by_driver", [False, True])
def test_a_session_grips_by_default_where_joints_are_measured(by_driver: bool) -> None:
    session = session_of()
    *_, last = pick(session, Sampler(), by_driver=by_driver)
    asked = session_of(grip={})
    *_, other = pick(asked, Sampler(), by_driver=by_driver)
    assert np.abs(last.effort).max() > 0.05
    np.testing.assert_array_equal(last.q, other.q)
    np.testing.assert_array_equal(last.effort, other.effort)
    # It is told another force, as one that was opened with a grip, and then needs no joints.
    session.configure(change(grip={"force": 2.5}))
    hand = rows(made_pick("right").landmarks[-1])
    command = session.step(Sampler()(3.0, landmarks=hand), 3.0)
    assert np.abs(command.effort).max() < 0.7 * np.abs(last.effort).max()


def test_a_session_without_a_grip_follows_as_before_whatever_is_measured() -> None:
    off, plain = session_of(grip=False), session_of()
    sampler, other = Sampler(), Sampler()
    commands = list(pick(off, sampler))
    hands = made_pick("right").landmarks
    for i, command in enumerate(commands):
        landmarks = rows(hands[i])
        # Without measured joints, nothing is met.
        same = plain.step(other(PERIOD * i, landmarks=landmarks), PERIOD * i)
        assert command.effort == same.effort == ()
        np.testing.assert_array_equal(command.q, same.q)
    assert commands[-1].following_error
    with pytest.raises(RefusedError) as raised:
        off.configure(change(grip={"force": 2.0}))
    assert raised.value.field == "grip"


def test_joints_that_a_driver_does_not_measure_any_more_meet_nothing() -> None:
    session, sampler = session_of(), Sampler()
    robot = session.robot.rest
    for i, landmarks in enumerate(made_pick("right").landmarks[:110]):
        if i < 20:
            read = Measured(
                protocol=PROTOCOL, seq=i, name="test", measured_q=tuple(robot.tolist())
            )
            session.measure(read, PERIOD * i)
        sample = sampler(PERIOD * i, landmarks=rows(landmarks))
        assert session.step(sample, PERIOD * i).effort == ()


def test_another_preset_grips_nothing_and_the_former_one_again() -> None:
    session, sampler = session_of(), Sampler()
    *_, last = pick(session, sampler)
    assert last.effort
    session.configure(change(preset="fingertip-vectors"))
    hand = rows(made_pick("right").landmarks[-1])
    for i in range(3):
        time = 2.0 + PERIOD * i
        sample = sampler(time, landmarks=hand, measured_q=last.q)
        assert session.step(sample, time).effort == ()


def test_both_hands_of_a_robot_grip_by_default() -> None:
    request = opening(**ALLEGRO | {"robot": "ur5_pair"})
    session = Session(request, prepare_hands(request, CACHE), "test", 0.0)
    robot = Stuck(session, 55)
    sampler = Sampler()
    made = {side: made_pick(side).landmarks for side in ("left", "right")}
    for i in range(110):
        hands = {
            side: HandSample(landmarks=rows(each[i])) for side, each in made.items()
        }
        sample = sampler(PERIOD * i, wrist=None, hands=hands, measured_q=robot.q)
        command = session.step(sample, PERIOD * i)
        robot.follow(i, command)
    for own in session.robot.finger_joints:
        assert np.abs(np.array(command.effort)[own]).max() > 0.01


def test_the_force_of_a_grip_is_told_in_the_session() -> None:
    session, sampler = session_of(grip={"force": 4.0}), Sampler()
    *_, before = pick(session, sampler)
    session.configure(change(grip={"force": 2.0}))
    hand = rows(made_pick("right").landmarks[-1])
    for i in range(10):
        time = 2.0 + PERIOD * i
        sample = sampler(time, landmarks=hand, measured_q=before.q)
        command = session.step(sample, time)
    np.testing.assert_allclose(command.effort, np.array(before.effort) / 2.0, rtol=0.05)
    with pytest.raises(RefusedError) as raised:
        session.configure(change(grip={"force": -1.0}))
    assert raised.value.field == "grip.force"
    assert session.request.grip == {"force": 2.0}


def middle(session: Session, command: Command) -> np.ndarray:
    """Middle between the pads of thumb and index in the robot's world [m], shape (3,)."""
    robot = session.robot
    assert command.wrist is not None
    placed = robot.configuration()
    placed.place(robot.configuration_vector(np.array(command.q), command.wrist.matrix))
    pads = robot_fingers(robot).pads
    return (
        AttachedPoints(robot, [pads[name].place for name in ("thumb", "index")])
        .positions(placed)
        .mean(axis=0)
    )


def test_a_known_place_moves_the_pads_to_it() -> None:
    session = session_of(grip={})
    *_, plain = pick(session, Sampler(), 75, since=75)
    centre = middle(session, plain) + np.array((0.0, 0.0, 0.01))
    seen = session_of(grip={})
    *_, last = pick(seen, Sampler(), 75, since=75, object_centre=tuple(centre.tolist()))
    assert np.linalg.norm(middle(seen, last) - centre) < 0.005


def test_a_known_object_is_touched_as_by_the_follower() -> None:
    made = hold("cube", "turn +1z").recording
    corners = 0.02 * np.array(list(product((-1.0, 1.0), repeat=3)))
    session, plain, sampler = session_of(object=rows(corners)), session_of(), Sampler()
    own = prepare_hands(opening(**ALLEGRO, object=CUBE), CACHE).follower
    assert isinstance(own, ObjectFollower)
    assert made.object_pose is not None
    columns = sample_columns(made)
    for i, pose in enumerate(made.object_pose):
        hand = rows(made.landmarks[i])
        sample = sampler(time := float(made.time[i]), landmarks=hand)
        other = plain.step(sample, time)
        sample = replace(sample, object_pose=Pose.from_matrix(pose))
        command = session.step(sample, time)
        step = own.map_sample(columns.sample(i), pose)
        if i == len(made) - 1:
            assert "off_object" not in command.flags
            # Sessions begin at rest, and forget it; processors round differently.
            np.testing.assert_allclose(command.q, step.command.q, atol=5e-3)
            assert np.abs(np.subtract(command.q, other.q)).max() > 0.1
    # An object that is not seen any more lets go; a thumb that it led elsewhere finds back.
    for i in range(180):
        time = float(made.time[-1]) + PERIOD * (i + 1)
        sample = sampler(time, landmarks=rows(made.landmarks[-1]))
        errors = np.subtract(session.step(sample, time).q, plain.step(sample, time).q)
        if i == 179:
            np.testing.assert_allclose(errors, 0.0, atol=0.05)


def test_a_known_object_is_pressed_with_the_force_that_is_told() -> None:
    made = hold("cube", "turn +1z").recording
    assert made.object_pose is not None
    session, sampler = session_of(object=CUBE, grip={"force": 4.0}), Sampler()
    efforts = []
    for i, pose in enumerate(made.object_pose):
        if i == 140:
            session.configure(change(grip={"force": 2.0}))
        sample = sampler(float(made.time[i]), landmarks=rows(made.landmarks[i]))
        sample = replace(sample, object_pose=Pose.from_matrix(pose))
        efforts.append(session.step(sample, float(made.time[i])).effort)
    assert efforts[0] == ()
    half = np.array(efforts[130]) / 2.0
    assert np.abs(half).max() > 0.05
    np.testing.assert_allclose(efforts[-1], half, atol=0.02)


@pytest.mark.parametrize(
    ("choices", "field"),
    [
        ({"grip": {"force": 0.0}}, "grip.force"),
        ({"grip": {"strength": 1.0}}, "grip.strength"),
        ({"grip": {}, "input": "q"}, "grip"),
        ({"grip": {}, "preset": "object"}, "grip"),
        ({"object": CUBE, "input": "points"}, "object"),
        ({"object": "box:0"}, "object"),
        ({"object": "box:0.1.2"}, "object"),
        ({"object": ((0.0, 0.0, 0.0),) * 4}, "object"),
        ({"object": CUBE, "resume": "clutch"}, "object"),
        ({"grip": True, "preset": "object"}, "grip"),
        ({"robot": "ur5_pair", "object": CUBE}, "object"),
    ],
)
def test_what_cannot_be_held_is_refused_with_its_field(
    choices: dict[str, Any], field: str
) -> None:
    with pytest.raises(RefusedError) as raised:
        session_of(**choices)
    assert (raised.value.code, raised.value.field) == ("invalid", field)


@pytest.mark.parametrize(
    ("choices", "held", "field"),
    [
        ({}, {"object_centre": (0.0, 0.0, 0.0)}, "object_centre"),
        (
            {"grip": False},
            {"object_centre": (0.0, 0.0, 0.0), "measured_q": (0.0,) * 16},
            "object_centre",
        ),
        ({"grip": {}}, {"object_pose": Pose((0, 0, 0), (0, 0, 0, 1))}, "object_pose"),
        ({"grip": {}}, {}, "measured_q"),
        ({"grip": {}}, {"measured_q": (0.0,) * 15}, "measured_q"),
    ],
)
def test_a_sample_must_hold_what_its_session_was_opened_for(
    choices: dict[str, Any], held: dict[str, Any], field: str
) -> None:
    session, sampler = session_of(**choices), Sampler()
    sample = sampler()
    if choices.get("input") != "q":
        sample = sampler(landmarks=rows(made_pick("right").landmarks[0]))
    with pytest.raises(RefusedError) as raised:
        session.step(replace(sample, **held), 0.0)
    assert (raised.value.code, raised.value.field) == ("invalid", field)
    assert session.counts["refused"] == 1


def test_a_grip_that_there_is_not_cannot_be_changed() -> None:
    with pytest.raises(RefusedError) as raised:
        session_of(object=CUBE).configure(change(grip={"force": 2.0}))
    assert raised.value.field == "grip"


def test_a_client_grips_and_touches_by_arrays() -> None:
    recording: Recording = made_pick("right")
    own = HumanLengths.from_urdf(CACHE.human("right", None).urdf_text)
    lengths = {"bases": own.bases, "segments": own.segments}
    choices: dict[str, Any] = {
        "preset": "teleoperation",
        "input": "landmarks",
        "lengths": lengths,
    }
    with serving() as server, client_of(server) as client:
        opened = client.open("allegro_right", grip={"force": 3.0}, **choices)
        rest = np.array(opened.q)
        hand = recording.landmarks[0]
        assert client.step(landmarks=hand, measured_q=rest).effort == ()
        client.configure(grip={"force": 2.0})
        with pytest.raises(ServiceError) as raised:
            client.step(landmarks=hand)
        assert code_of(raised) == ("invalid", "measured_q")
        client.open("allegro_right", object=CUBE, **choices)
        assert client.step(landmarks=hand, object_pose=np.eye(4)).rule == ""
        with pytest.raises(ServiceError) as raised:
            client.open("allegro_right", object="/etc/passwd", **choices)
        assert code_of(raised) == ("invalid", "object")
