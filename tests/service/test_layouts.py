"""Sessions whose samples are in a tracker's own layout."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from layout_cases import wrist_beside
from service_tools import (
    CACHE,
    PERIOD,
    SECRET,
    Sampler,
    change,
    code_of,
    connected,
    human_q,
    make_session,
    opening,
    serving,
)

from handmap_core.human.sample import HumanSample
from handmap_qp.apps.service.dispatch import decode_request
from handmap_qp.apps.service.opening import prepare_hands
from handmap_qp.apps.service.session import Session, to_pose
from handmap_qp.client import ServiceError
from handmap_qp.client.messages import PROTOCOL, Error, Step
from handmap_qp.errors import RefusedError
from handmap_qp.trackers.layouts.base import Layout
from handmap_qp.trackers.layouts.tables import load_layout

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

LENGTH = 0.19
POINTS = ("webxr25", "unity26", "mano21")
OTHERS = ("angles20", "markers13", "visionpro27")


def landmarks_at(phase: float) -> np.ndarray:
    return CACHE.human("right", "landmarks").points(human_q(phase), np.eye(4))


def values_of(layout: Layout, landmarks: np.ndarray) -> tuple[float, ...]:
    return tuple(layout.write(HumanSample(0.0, "right", landmarks)).ravel().tolist())


def follow_by(session: Session, samples: list[dict[str, Any]]) -> np.ndarray:
    """Send samples at 60 Hz; return the postures commanded, shape (T, n)."""
    postures = []
    for i, each in enumerate(samples):
        step = Step(
            protocol=PROTOCOL, seq=i + 2, session=SECRET, time=i * PERIOD, **each
        )
        postures.append(session.step(step, i * PERIOD).q)
    return np.array(postures)


@pytest.mark.parametrize("name", POINTS)
def test_a_layout_moves_the_robot_as_its_landmarks_do(name: str) -> None:
    layout = load_layout(name)
    hands = [values_of(layout, landmarks_at(0.08 * i)) for i in range(15)]
    read = [layout.read(np.array(values), time=0.0, side="right") for values in hands]
    assert all((sample.wrist is not None) == layout.has_wrist for sample in read)
    choices: dict[str, Any] = {
        "input": "landmarks",
        "hand_length": LENGTH,
        "has_detail": True,
    }
    direct = make_session(preset="teleoperation", **choices)
    through = make_session(preset="teleoperation", layout=name, **choices)
    expected = follow_by(
        direct,
        [
            {
                "landmarks": tuple(map(tuple, each.landmarks.tolist())),
                "wrist": to_pose(each.wrist),
            }
            for each in read
        ],
    )
    found = follow_by(through, [{"values": values, "wrist": None} for values in hands])
    assert np.abs(expected[-1] - expected[0]).max() > 0.05
    # A wrist passes through a quaternion on its way to the first session.
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_state_names_the_layout_and_an_unseen_hand_needs_no_values() -> None:
    session = make_session(input="landmarks", hand_length=LENGTH, layout="webxr25")
    about = session.state(1, "", 0, 0.0).about
    assert about is not None
    assert about.layout == "webxr25"
    sample = Sampler()
    command = session.step(sample(0.0, wrist=None, valid=False, values=None), 0.0)
    assert command.rule == "missing"


def test_a_wrist_beside_the_values_is_in_the_axes_of_the_layout() -> None:
    layout = load_layout("angles20")
    pose = np.eye(4)
    pose[:3, 3] = 0.1, 0.2, 0.3
    theirs = wrist_beside(layout, pose, "right")
    assert theirs is not None
    session = make_session(
        input="landmarks", hand_length=LENGTH, layout="angles20", has_detail=True
    )
    values = values_of(layout, landmarks_at(0.0))
    command = session.step(Sampler()(0.0, wrist=to_pose(theirs), values=values), 0.0)
    assert command.detail is not None
    found = command.detail.human_wrist
    assert found is not None
    np.testing.assert_allclose(found.matrix, pose, atol=1e-9)


@pytest.mark.parametrize(
    ("choices", "field"),
    [
        ({"input": "landmarks", "layout": "webxr"}, "layout"),
        ({"input": "landmarks", "layout": "..hand.yaml"}, "layout"),
        ({"input": "q", "layout": "webxr25"}, "layout"),
        ({"input": "points", "layout": "webxr25"}, "layout"),
    ],
)
def test_a_layout_that_cannot_be_is_refused(
    choices: dict[str, Any], field: str
) -> None:
    request = opening(**choices)
    with pytest.raises(RefusedError) as raised:
        Session(request, prepare_hands(request, CACHE), "test", 0.0)
    assert raised.value.field == field


def test_samples_of_another_form_are_refused() -> None:
    layout = load_layout("webxr25")
    hand = landmarks_at(0.0)
    rows = tuple(map(tuple, hand.tolist()))
    session = make_session(input="landmarks", hand_length=LENGTH, layout="webxr25")
    plain = make_session(input="landmarks", hand_length=LENGTH)
    sample, before = Sampler(), session.record
    values = values_of(layout, hand)
    for refusing, wrong, field in (
        (session, {"landmarks": rows}, "landmarks"),
        (session, {"values": values[:-1]}, "values"),
        (session, {"values": values[:63]}, "values"),
        (session, {"values": None}, "values"),
        (session, {"values": ()}, "values"),
        (plain, {"values": values}, "landmarks"),
        (plain, {"values": values, "landmarks": rows}, "values"),
    ):
        with pytest.raises(RefusedError) as raised:
            refusing.step(sample(0.0, wrist=None, **wrong), 0.0)
        assert (raised.value.code, raised.value.field) == ("invalid", field)
        assert "\n" not in str(raised.value)
    assert session.record == before


@pytest.mark.parametrize("value", [np.nan, np.inf, 2e6])
def test_numbers_out_of_range_are_found_while_decoding(value: float) -> None:
    step = Step(protocol=PROTOCOL, seq=1, session=SECRET, time=0.0, values=(0.0, value))
    answer = decode_request(msgspec.msgpack.encode(step))
    assert isinstance(answer, Error)
    assert answer.field == "values[1]"


def test_the_client_sends_angles_markers_and_matrices_too() -> None:
    with serving() as server:
        for name in OTHERS:
            layout = load_layout(name)
            sample = HumanSample(0.0, "right", landmarks_at(0.3))
            values = layout.write(sample)
            wrist = wrist_beside(layout, np.eye(4), "right")
            with connected(
                server, input="landmarks", layout=name, hand_length=LENGTH, preset=None
            ) as client:
                command = client.step(values=values, wrist=wrist)
                assert command.status != "held", (name, command.rule)
                with pytest.raises(ServiceError) as raised:
                    client.step(values=values.ravel()[:-1])
                assert code_of(raised) == ("invalid", "values")


def test_an_arm_goes_up_with_a_headset_and_clutching_keeps_it() -> None:
    choices: dict[str, Any] = {"input": "landmarks", "hand_length": LENGTH}
    session = make_session(
        robot="ur5_allegro", preset="teleoperation", layout="webxr25", **choices
    )
    layout = load_layout("webxr25")
    count = 0

    def palm_after(height: float) -> np.ndarray:
        """Rise to a height in half a second and settle; return where the palm is [m]."""
        nonlocal count
        for i in range(60):
            place = np.array([0.0, height * min(1.0, i / 30), 0.0])
            values = values_of(layout, landmarks_at(0.0) + place)
            step = Step(
                protocol=PROTOCOL, seq=count + 2, session=SECRET, time=count * PERIOD
            )
            step = msgspec.structs.replace(step, values=values)
            session.step(step, count * PERIOD)
            count += 1
        return session.robot.frame_pose("palm", session.posture[0])[:3, 3]

    for _ in range(2):
        moved = palm_after(0.05) - palm_after(0.0)
        assert moved[2] > 0.03
        np.testing.assert_allclose(moved[:2], 0.0, atol=2e-3)
        about = session.state(1, "", 0, count * PERIOD).about
        assert about is not None
        assert about.options["alignment"] == "y-up"
        assert about.upright == "+y up, -z forward"
        session.release()
        session.clutch()
    session.configure(change(options={"alignment": "world"}))
    moved = palm_after(0.05) - palm_after(0.0)
    assert moved[1] > 0.03
    np.testing.assert_allclose(moved[[0, 2]], 0.0, atol=2e-3)
