"""Sessions of landmarks: the hand is measured first, and implausible landmarks are rejected."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from person_cases import worn
from service_tools import CACHE, Sampler, human_q, make_session, opening, run_now

from handmap_qp import load_hand
from handmap_qp.apps.service.opening import (
    CALIBRATION_SAMPLES,
    Hands,
    prepare_hands,
)
from handmap_qp.apps.service.session import Session
from handmap_qp.client.messages import PROTOCOL, Configure
from handmap_qp.errors import RefusedError
from handmap_qp.hands.human import HumanLengths
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.trackers.formats import read_recording

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

PERIOD = 1.0 / 60.0
SETTLING_SAMPLES = 10
"""More samples than the guard waits for after a fault."""


def landmarks_of(
    scale: float = 1.0, phase: float = 0.0
) -> tuple[tuple[float, ...], ...]:
    """Return landmarks of the model's hand [m], multiplied by a scale."""
    points = CACHE.human("right", "landmarks").points(human_q(phase), np.eye(4))
    return tuple(map(tuple, (scale * points).tolist()))


def test_options_changed_while_the_hand_is_measured_hold_afterwards() -> None:
    session, sample = make_session(input="landmarks"), Sampler()
    session.configure(Configure(protocol=PROTOCOL, seq=99, mapping={"ridge": 0.4}))
    for i in range(40):
        session.step(sample(PERIOD * i, landmarks=landmarks_of()), PERIOD * i)
    about = session.state(1, "", 0, 0.0).about
    assert session.mode == "following"
    assert about is not None
    assert about.mapping["ridge"] == 0.4
    assert about.lengths is not None
    # The landmarks were made from the model's hand.
    own = HumanLengths.from_urdf(CACHE.human("right", None).urdf_text)
    np.testing.assert_allclose(about.lengths.segments, own.segments, atol=1e-6)


def test_landmarks_are_measured_first_and_then_mapped(recordings: Any) -> None:
    recording = read_recording(sorted(recordings.glob("*_right.npz"))[0])
    seen = np.flatnonzero(recording.valid)[:50]
    session, sample = make_session(input="landmarks", has_detail=True), Sampler()
    commands = []
    for i, k in enumerate(seen):
        landmarks = tuple(map(tuple, recording.landmarks[k].tolist()))
        commands.append(
            session.step(sample(i * PERIOD, landmarks=landmarks), i * PERIOD)
        )
    states = [command.status for command in commands]
    assert states[:30] == ["calibrating"] * 30
    assert "calibrating" not in states[31:]
    assert all(command.q == tuple(session.robot.rest) for command in commands[:30])
    assert commands[-1].detail is not None
    assert {len(each.detail.held_by) for each in commands if each.detail} <= {0, 2}


def test_landmarks_that_are_no_hand_are_refused_at_once_and_the_session_is_as_it_was() -> (
    None
):
    session, sample = make_session(input="landmarks"), Sampler()
    good = CALIBRATION_SAMPLES // 2
    for i in range(good):
        session.step(sample(i * PERIOD, landmarks=landmarks_of()), i * PERIOD)
    before = session.record, session.mode
    for scale in (0.1, 1000.0):
        with pytest.raises(RefusedError, match="expected metres") as raised:
            session.step(sample(1.0 + scale, landmarks=landmarks_of(scale)), 1.0)
        assert (raised.value.code, raised.value.field) == ("invalid", "landmarks")
    assert (session.record, session.mode) == before
    # The watchdog ignores them, and the samples collected before still count.
    assert session.tick(good * PERIOD + session.request.watchdog) is not None
    for i in range(good, CALIBRATION_SAMPLES + SETTLING_SAMPLES):
        session.step(
            sample(2.0 + i * PERIOD, landmarks=landmarks_of()), 2.0 + i * PERIOD
        )
    assert session.mode == "following"


def test_samples_without_a_hand_do_not_count_in_the_measurement() -> None:
    session, sample = make_session(input="landmarks"), Sampler()
    lost: list[dict[str, Any]] = [
        {"landmarks": landmarks_of(0.0)},
        {"landmarks": None, "valid": False},
        {"landmarks": landmarks_of(), "confidence": 0.0},
    ]
    rules = []
    for i in range(2 * CALIBRATION_SAMPLES + 30):
        seen: dict[str, Any] = {"landmarks": landmarks_of(phase=1e-3 * i)}
        human = lost[i // 2 % 3] if i < 20 else seen
        command = session.step(sample(i * PERIOD, **human), i * PERIOD)
        rules.append(command.rule)
        if i < 20:
            assert (command.status, command.flags) == ("calibrating", (command.rule,))
    assert rules[:6] == ["zero", "zero", "missing", "missing", "missing", "missing"]
    assert session.mode == "following"
    about = session.state(1, "", 0, 0.0).about
    assert about is not None
    assert about.lengths is not None
    own = HumanLengths.from_urdf(CACHE.human("right", None).urdf_text)
    np.testing.assert_allclose(about.lengths.segments, own.segments, atol=1e-6)


def test_a_known_hand_needs_no_measuring() -> None:
    request = opening(input="landmarks", hand_length=0.19)
    hands: Hands = prepare_hands(request, CACHE, defer=run_now)
    assert hands.calibration is None
    assert hands.lengths is not None
    session = Session(request, hands, "test", 0.0)
    landmarks = hands.mapper.human.with_points("landmarks").points(human_q())
    command = session.step(
        Sampler()(landmarks=tuple(map(tuple, landmarks.tolist()))), 0.1
    )
    assert command.status != "calibrating"


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1000.0, 5.0, 0.1], ids=["mm", "picture", "tiny"])
def test_a_hand_in_other_units_is_not_measured_and_one_in_metres_is_thereafter(
    scale: float,
) -> None:
    session, sample = make_session(input="landmarks"), Sampler()
    for i in range(CALIBRATION_SAMPLES):
        with pytest.raises(RefusedError, match="expected metres") as raised:
            session.step(sample(i * PERIOD, landmarks=landmarks_of(scale)), i * PERIOD)
        assert (raised.value.code, raised.value.field) == ("invalid", "landmarks")
    assert session.mode == "waiting"
    for i in range(CALIBRATION_SAMPLES, 4 * CALIBRATION_SAMPLES):
        session.step(sample(i * PERIOD, landmarks=landmarks_of()), i * PERIOD)
    assert session.mode == "following"


@pytest.mark.slow
@pytest.mark.parametrize("is_known", [True, False], ids=["known", "measured"])
@pytest.mark.parametrize("scale", [1000.0, 2.5, 0.3], ids=["mm", "large", "small"])
def test_a_hand_of_another_size_is_not_mapped(scale: float, is_known: bool) -> None:
    lengths: dict[str, Any] = {"hand_length": 0.19} if is_known else {}
    session, sample = make_session(input="landmarks", **lengths), Sampler()
    for i in range(CALIBRATION_SAMPLES + 3):
        session.step(sample(i * PERIOD, landmarks=landmarks_of()), i * PERIOD)
    before, counts = session.posture[0].copy(), session.counts["steps"]
    with pytest.raises(RefusedError, match="expected metres") as raised:
        session.step(sample(0.9, landmarks=landmarks_of(scale, 1.0)), 0.9)
    assert (raised.value.code, raised.value.field) == ("invalid", "landmarks")
    np.testing.assert_array_equal(session.posture[0], before)
    times = [1.0 + i * PERIOD for i in range(SETTLING_SAMPLES)]
    commands = [
        session.step(sample(time, landmarks=landmarks_of()), time) for time in times
    ]
    assert commands[-1].status == "converged"
    assert session.counts["steps"] > counts


def test_a_release_during_the_measurement_holds_after_it() -> None:
    session, sample = make_session(input="landmarks"), Sampler()
    session.step(sample(0.0, landmarks=landmarks_of()), 0.0)
    session.release()
    before = session.posture[0].copy()
    commands = [
        session.step(
            sample(i * PERIOD, landmarks=landmarks_of(phase=0.05 * i)), i * PERIOD
        )
        for i in range(1, CALIBRATION_SAMPLES + 10)
    ]
    assert commands[-1].status == "released"
    session.clutch()
    now = (CALIBRATION_SAMPLES + 10) * PERIOD
    command = session.step(sample(now, landmarks=landmarks_of(phase=0.05 * 30)), now)
    # The reference is this sample, so the robot has nowhere to go.
    assert "slewing" not in command.flags
    np.testing.assert_allclose(session.posture[0], before, atol=1e-3)


def test_touches_correct_the_contact_gap_of_a_session() -> None:
    record = worn(600, gap=0.019)
    session, sample = make_session(**TELEOPERATION, hand_length=0.18), Sampler()
    gaps, last = [], np.array(session.robot.rest)
    for time, points in zip(record.time.tolist(), record.landmarks, strict=True):
        landmarks = tuple(map(tuple, points.tolist()))
        command = session.step(sample(time, landmarks=landmarks), time)
        step = np.abs(np.array(command.q) - last) / session.robot.velocity_limits
        assert step.max() <= PERIOD * (1.0 + 1e-6) or time == 0.0
        last = np.array(command.q)
        gaps.append(contact_gap_of(session))
    assert gaps[0] == 0.013
    assert gaps[-1] == pytest.approx(0.014)
    assert len(set(gaps)) == 2


@pytest.mark.parametrize(
    "given", [{"contact_gap": 0.013}, {"teleoperation": {"contact_gap": 0.013}}]
)
def test_a_contact_gap_that_is_given_is_not_measured(given: dict[str, Any]) -> None:
    session = make_session(**TELEOPERATION, hand_length=0.18, **given)
    assert contact_gap_of(session) == 0.013
    assert session._hands.gap_meter is None


TELEOPERATION: dict[str, Any] = {
    "input": "landmarks",
    "robot": "allegro_right",
    "preset": "teleoperation",
}


def contact_gap_of(session: Session) -> float:
    options = session._hands.choice.method
    assert isinstance(options, Teleoperation)
    return options.contact_gap


@pytest.mark.parametrize(
    ("time_from", "is_found"), [("server", True), ("client", False)]
)
def test_stamps_that_run_faster_than_samples_arrive_are_named_on_the_servers_clock(
    time_from: str, is_found: bool
) -> None:
    session = make_session(input="landmarks", hand_length=0.19, time_from=time_from)
    sample, person = Sampler(), HumanLengths.from_hand_length(0.19)
    human = load_hand("human", points="landmarks", lengths=person)
    rules = []
    for i in range(150):
        points = human.points(
            human.rest + 0.1 * np.sin(0.1 * i) * (human.upper_limits - human.rest)
        )
        landmarks = tuple(map(tuple, points.tolist()))
        rules.append(
            session.step(sample(2.0 * i * PERIOD, landmarks=landmarks), i * PERIOD).rule
        )
    assert set(rules) == ({"", "time"} if is_found else {""})
    if is_found:
        assert 0.5 < rules.index("time") * PERIOD < 1.6
        assert rules[-1] == "time"
