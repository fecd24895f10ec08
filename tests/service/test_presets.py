"""Presets of sessions: which one is chosen, its options, and what the robot then does."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from marks import slow
from service_tools import (
    CACHE,
    HERE,
    PERIOD,
    Sampler,
    change,
    client_of,
    follow,
    human_q,
    lose_sessions,
    make_session,
    serving,
    speeds,
)

from handmap_core.human.sample import TIPS
from handmap_qp import (
    Follower,
    HandMapper,
    IkOptions,
    MappingOptions,
    Recording,
    read_recording,
)
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.apps.service.opening import CALIBRATION_SAMPLES
from handmap_qp.apps.service.server import Server
from handmap_qp.apps.service.session import Session, to_pose
from handmap_qp.client.messages import About, Lengths
from handmap_qp.errors import RefusedError
from handmap_qp.human.measure import measure_hand
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.mapping.presets import PRESETS
from handmap_qp.se3 import affine, rotation_from_quat_wxyz

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

WITH_T = ("teleoperation", "paper", "object", "fixed_wrist")
FIXED = {"mount": "fixed"}


def opened(choices: dict[str, Any]) -> Session:
    """Open a session with the server's choice of preset, unless one is given."""
    asked: dict[str, Any] = {"preset": None} | choices
    return make_session(**asked)


def to_points(values: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    return tuple((x, y, z) for x, y, z in values.tolist())


def about(session: Session) -> About:
    found = session.state(1, "", 0, 0.0).about
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("choices", "preset", "ik"),
    [
        ({}, "teleoperation", PRESETS["teleoperation"].ik),
        ({"ik": {"damping": 0.3}}, "teleoperation", None),
        ({"mapping": {"rigid_from": "wrist"}}, "paper", IkOptions()),
        ({"human_points": "fingertips"}, "object", PRESETS["object"].ik),
        (
            FIXED | {"human_points": "fingertips", "mapping": {"rigid_from": "none"}},
            "paper",
            None,
        ),
        (
            {"preset": "object", "mapping": {"ridge": 0.4}},
            "object",
            PRESETS["object"].ik,
        ),
    ],
    ids=str,
)
def test_the_preset_follows_from_hands_and_options(
    choices: dict[str, Any], preset: str, ik: IkOptions | None
) -> None:
    session = opened(choices)
    told = about(session)
    assert told.preset == preset
    if preset == "teleoperation":
        assert (told.mapping, told.teleoperation) == ({}, Teleoperation().values)
    else:
        given = choices.get("mapping", {})
        assert told.teleoperation == {}
        assert given.items() <= told.mapping.items()
        assert told.mapping.keys() == MappingOptions().values.keys()
    if ik is not None:
        assert told.ik == ik.values
    assert session.step(Sampler()(), 0.1).status != "failed"


@pytest.mark.parametrize(
    ("choices", "field"),
    [
        ({"preset": "teleoperation", "options": {"pivot": "wrist"}}, "options.pivot"),
        ({"teleoperation": {"pinch": 2.0}}, "options.pinch"),
        ({"teleoperation": {"pinch_weight": "much"}}, "options.pinch_weight"),
        ({"teleoperation": {"residual_gain": 2.0}}, "options.residual_gain"),
        ({"teleoperation": {"ridge": 0.0}}, "options.ridge"),
        ({"preset": "object", "mapping": {"ridge": -1.0}}, "options.ridge"),
    ],
    ids=str,
)
def test_options_of_another_preset_are_refused_by_name(
    choices: dict[str, Any], field: str
) -> None:
    session, sample = make_session(preset=None), Sampler()
    session.step(sample(), 0.0)
    if "preset" not in choices and "mapping" in choices:
        choices = choices | {"preset": "paper"}
    before = about(session)
    for choose in (
        lambda: opened(choices),
        lambda: session.configure(change(**choices)),
    ):
        with pytest.raises(RefusedError) as raised:
            choose()
        assert raised.value.field == field
    assert about(session) == before


def test_an_empty_name_is_no_preset() -> None:
    session = make_session(preset="paper")
    session.step(Sampler()(), 0.0)
    with pytest.raises(RefusedError) as raised:
        session.configure(change(preset=""))
    assert raised.value.field == "preset"
    assert about(session).preset == "paper"


def test_options_alone_do_not_change_the_preset() -> None:
    session = opened({})
    with pytest.raises(RefusedError) as raised:
        session.configure(change(options={"stretch_max": 2.0}))
    assert raised.value.field == "options.stretch_max"
    assert about(session).preset == "teleoperation"
    session = opened({"human_points": "fingertips"})
    session.configure(change(mapping={"scale": 2.0}))
    assert (about(session).preset, about(session).mapping["scale"]) == ("object", 2.0)


@pytest.mark.parametrize(
    ("choices", "field"),
    [
        ({"preset": "teleoperation", "human_points": "fingertips"}, "human_points"),
        ({"preset": "object"} | FIXED, "options.rigid_from"),
        ({"input": "landmarks", "human_points": "contacts"}, "human_points"),
    ],
    ids=str,
)
def test_what_the_hands_do_not_allow_is_refused_by_name(
    choices: dict[str, Any], field: str
) -> None:
    with pytest.raises(RefusedError) as raised:
        make_session(**choices)
    assert raised.value.field == field


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(RefusedError, match="expected one of teleoperation") as raised:
        make_session(preset="claw")
    assert (raised.value.code, raised.value.field) == ("invalid", "preset")
    with pytest.raises(RefusedError, match="expected one of teleoperation") as raised:
        make_session().configure(change(preset="claw"))
    assert (raised.value.code, raised.value.field) == ("invalid", "preset")


def test_a_preset_brings_its_own_options_and_the_robot_goes_on() -> None:
    session, sample = (
        make_session(teleoperation={"pinch_weight": 1.0}, preset=None),
        Sampler(),
    )
    now = follow(session, sample, 0.0)
    session.configure(change(ik={"damping": 0.4}))
    assert about(session).teleoperation["pinch_weight"] == 1.0
    assert about(session).ik["damping"] == 0.4
    for preset in ("object", "paper", "teleoperation"):
        before = session.posture[0].copy()
        session.configure(change(preset=preset, ik={"rest_weight": 0.1}))
        np.testing.assert_array_equal(session.posture[0], before)
        assert about(session).preset == preset
        assert about(session).ik == PRESETS[preset].ik.values | {"rest_weight": 0.1}
        for i in range(20):
            last, now = session.posture[0].copy(), now + PERIOD
            command = session.step(sample(now, human_q(2.0 + 0.1 * i)), now)
            assert (speeds(session, last, command, PERIOD) <= 1.0 + 1e-6).all()
            assert command.status != "failed"
    assert about(session).teleoperation == Teleoperation().values


def test_a_preset_that_the_hands_do_not_allow_changes_nothing() -> None:
    session, sample = opened(FIXED), Sampler()
    session.step(sample(), 0.0)
    before, points = about(session), session._hands.mapper.robot.reference_points
    with pytest.raises(RefusedError) as raised:
        session.configure(change(preset="object"))
    assert raised.value.field == "options.rigid_from"
    assert about(session) == before
    assert session._hands.mapper.robot.reference_points == points
    assert session.step(sample(PERIOD), PERIOD).status != "failed"


def test_a_release_outlives_a_change_of_the_preset() -> None:
    session, sample = make_session(preset=None), Sampler()
    now = follow(session, sample, 0.0)
    session.release()
    before = session.posture[0].copy()
    session.configure(change(preset="object"))
    command = session.step(sample(now, human_q(3.0)), now + PERIOD)
    assert command.status == "released"
    np.testing.assert_array_equal(session.posture[0], before)


@pytest.mark.parametrize("preset", WITH_T)
def test_commands_describe_t_of_every_preset(preset: Any) -> None:
    session, sample = make_session(preset=preset, has_detail=True), Sampler()
    session.step(sample(), 0.0)
    command = session.step(sample(PERIOD, human_q(1.0)), PERIOD)
    detail = command.detail
    assert detail is not None
    assert command.residual > 0.0
    assert len(command.point_error) == len(detail.targets) == len(detail.points)
    motion, rigid, deformation = (
        np.array(getattr(detail, name))
        for name in ("motion", "motion_rigid", "motion_deformation")
    )
    if preset != "object":
        np.testing.assert_allclose(deformation @ rigid, motion, atol=1e-9)
    assert len(detail.stretches) == 3
    assert detail.human_wrist == HERE


# -- landmarks of a person


@pytest.fixture(scope="module")
def recording(recordings: Any) -> Recording:
    return read_recording(recordings / "leap_pinch_move_right.npz")


@pytest.fixture(scope="module")
def lengths(recording: Recording) -> Lengths:
    return lengths_of(recording)


def lengths_of(recording: Recording) -> Lengths:
    measured = measure_hand(recording)
    names = Lengths.__struct_fields__
    return Lengths(*(getattr(measured, name).tolist() for name in names))


def landmarks_of(
    recording: Recording, index: int
) -> tuple[tuple[float, float, float], ...]:
    return to_points(recording.landmarks[index])


def fist_of(recordings: Any) -> tuple[Recording, int]:
    recording = read_recording(recordings / "leap110_free_right.npz")
    index = find_poses(recording)["fist"]
    assert index is not None
    return recording, index


@pytest.mark.parametrize("robot", ["allegro_right", slow("three_finger")])
@pytest.mark.parametrize("start", ["lower", slow("upper"), slow("rest")])
def test_a_robot_anywhere_closes_to_the_fist_it_is_shown_first(
    recordings: Any, robot: str, start: str
) -> None:
    recording, index = fist_of(recordings)
    hand = CACHE.robot(robot, None, None)
    begin = {"lower": hand.lower_limits, "upper": hand.upper_limits, "rest": hand.rest}[
        start
    ]
    session = make_session(
        robot=robot,
        preset=None,
        input="landmarks",
        lengths=lengths_of(recording),
        robot_q=tuple(begin.tolist()),
    )
    sample, last = Sampler(), begin
    for i in range(1, 240):
        fist = sample(i * PERIOD, landmarks=landmarks_of(recording, index))
        command = session.step(fist, i * PERIOD)
        assert (speeds(session, last, command, PERIOD) <= 1.0 + 1e-6).all()
        assert (np.array(command.q) >= hand.lower_limits).all()
        assert (np.array(command.q) <= hand.upper_limits).all()
        if i == 1:
            # At its limit of some rad/s a joint moves a few degrees in one sample.
            assert np.abs(np.array(command.q) - begin).max() < 0.2
        last = np.array(command.q)
    # Every finger's tip is nearer to its knuckle than half of the finger's reach.
    pair = session._hands.mapper.robot
    closed = reach_shares(pair, last)
    opened = reach_shares(pair, hand.rest)
    assert (closed[1:] < 0.75).all(), closed
    assert (closed[1:] < opened[1:] - 0.1).all(), (closed, opened)


def reach_shares(robot: Any, q: np.ndarray) -> np.ndarray:
    """Return the distance from knuckle to tip of every finger as a share of its reach."""
    from handmap_core.ik.tasks import AttachedPoints
    from handmap_qp.hands.fingers import find_fingers

    shares = []
    configuration = robot.configuration()
    configuration.place(robot.configuration_vector(q))
    for chain in find_fingers(robot).values():
        ends = AttachedPoints(robot, [chain.knuckle, chain.tip]).positions(
            configuration
        )
        shares.append(np.linalg.norm(ends[1] - ends[0]) / chain.reach)
    return np.array(shares)


@pytest.mark.parametrize("preset", WITH_T)
@pytest.mark.parametrize("has_wrist", [False, True])
def test_landmarks_are_mapped_as_they_come(
    recording: Recording, lengths: Lengths, preset: Any, has_wrist: bool
) -> None:
    session, sample = (
        make_session(
            preset=preset, input="landmarks", lengths=lengths, has_detail=True
        ),
        Sampler(),
    )
    hands, choice = session._hands, session._hands.choice
    mapper = HandMapper(hands.mapper.human, hands.robot, choice.method, ik=choice.ik)
    mapper.reset(robot_q=hands.robot.rest)
    follower = Follower(mapper)
    turn = rotation_from_quat_wxyz((0.8, 0.0, 0.6, 0.0))
    for i in range(10):
        wrist = affine(turn, np.array([0.01 * i, 1.0, 0.0])) if has_wrist else None
        message = sample(i * PERIOD, landmarks=landmarks_of(recording, i))
        message = msgspec.structs.replace(message, wrist=to_pose(wrist))
        command = session.step(message, i * PERIOD)
        pose, _ = mapper.landmarks.read(recording.landmarks[i], wrist)
        step = follower.map(pose, command.dt)
        # This wrist does not turn with the palm, so the session follows it more slowly.
        assert command.rule == ("unproven" if has_wrist else "")
        if not {"slewing", "unproven"} & set(command.flags):
            np.testing.assert_allclose(command.q, step.command.q, atol=1e-9)
        assert command.detail is not None
        assert command.detail.human_q is None
        np.testing.assert_array_equal(command.detail.landmarks, message.landmarks)
        np.testing.assert_allclose(
            command.detail.human_points, step.human_points, atol=1e-9
        )
        expected = to_pose(step.human_wrist)
        assert expected is not None
        # They are on the robot's palm, which the session may bring there more slowly.
        np.testing.assert_allclose(command.detail.targets, step.targets, atol=1e-7)
        assert command.detail.human_wrist is not None
        np.testing.assert_allclose(
            command.detail.human_wrist.position, expected.position, atol=1e-12
        )


def measured_session(gap: float, **choices: Any) -> Session:
    """Return a session that has measured a hand whose thumb and index tips have this gap [m]."""
    session = make_session(input="landmarks", preset=None, **choices)
    points = CACHE.human("right", "landmarks").points(human_q())
    points[TIPS[1]] = points[TIPS[0]] + (gap, 0.0, 0.0)
    sample = Sampler()
    for i in range(CALIBRATION_SAMPLES + 2):
        session.step(sample(i * PERIOD, landmarks=to_points(points)), i * PERIOD)
    assert session.mode == "following"
    return session


@pytest.mark.parametrize(
    ("gap", "expected"),
    [
        (0.016, 0.016),
        (0.002, 0.012),
        (0.022, 0.020),
        (0.05, Teleoperation().contact_gap),
    ],
)
def test_the_contact_gap_is_measured_where_thumb_and_finger_touched(
    gap: float, expected: float
) -> None:
    session = measured_session(gap)
    assert about(session).teleoperation["contact_gap"] == pytest.approx(expected)
    session.configure(change(preset="object"))
    session.configure(change(preset="teleoperation"))
    assert about(session).teleoperation["contact_gap"] == pytest.approx(expected)


def test_the_contact_gap_of_the_client_wins() -> None:
    session = measured_session(0.016, teleoperation={"contact_gap": 0.005})
    assert about(session).teleoperation["contact_gap"] == 0.005


def test_a_preset_chosen_during_the_measurement_holds_after_it() -> None:
    session, sample = make_session(input="landmarks", preset=None), Sampler()
    points = to_points(CACHE.human("right", "landmarks").points(human_q()))
    for i in range(CALIBRATION_SAMPLES + 2):
        if i == 5:
            session.configure(change(preset="object", mapping={"ridge": 0.4}))
        session.step(sample(i * PERIOD, landmarks=points), i * PERIOD)
    assert session.mode == "following"
    assert (about(session).preset, about(session).mapping["ridge"]) == ("object", 0.4)
    assert session._hands.choice.method.values["ridge"] == 0.4


# -- clients


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as running:
        yield running


def test_a_client_that_sends_mapping_options_gets_the_paper(server: Server) -> None:
    with client_of(server) as client:
        client.open("allegro_right", mapping={"rigid_from": "wrist"})
        told = client.status().about
    assert told is not None
    assert (told["preset"], told["mapping"]["rigid_from"]) == ("paper", "wrist")


def test_presets_and_options_outlive_a_lost_session(server: Server) -> None:
    with client_of(server) as client:
        client.open("three_finger", name="kept", teleoperation={"pinch_weight": 2.0})
        client.configure(ik={"damping": 0.5})
        changes: list[dict[str, Any]] = [
            {"teleoperation": {"ridge": 0.2}},
            {"preset": "object", "mapping": {"ridge": 0.3}},
            {"mapping": {"scale": 0.5}},
            {"preset": "teleoperation"},
        ]
        for i, change_ in enumerate(changes):
            client.configure(**change_)
            before = client.status().about
            lose_sessions(server)
            assert client.status().about == before
            assert client.reopened == i + 1
            assert before is not None
            assert before["preset"] == ("object" if i in (1, 2) else "teleoperation")
