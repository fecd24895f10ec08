"""A session of a real mapping service in the view: what is shown, and how it is steered."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)
pytest.importorskip(
    "zmq", reason="pyzmq is not installed: pip install 'handmap-qp[service]'"
)

import service_tools
from patience import PATIENCE, wait_until
from service_tools import (
    address_of,
    client_of,
    connected,
    human_q,
    in_loop,
    lose_sessions,
)
from viewer_cases import option_handles

from handmap_qp import InvalidInputError, MappingOptions, load_hand
from handmap_qp.apps.service.keys import make_keys
from handmap_qp.apps.service.server import Server
from handmap_qp.apps.viewer.live import LiveViewer
from handmap_qp.apps.viewer.remote import ServiceSession
from handmap_qp.apps.viewer.sample import ViewSample
from handmap_qp.apps.viewer.serving import serving
from handmap_qp.client import Client, Command
from handmap_qp.client.messages import About
from handmap_qp.hands.human import HumanLengths
from handmap_qp.mapping import assumed_speeds
from handmap_qp.mapping.presets import preset_choice
from handmap_qp.se3 import affine, rotation_from_quat_wxyz
from handmap_qp.trackers.formats import DEMO, read_hands

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

WRIST = np.eye(4)
WRIST[:3, 3] = 0.1, 0.2, 0.3


@pytest.fixture(autouse=True)
def patient_view(patient: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the view wait long for a service, too."""
    monkeypatch.setattr("handmap_qp.apps.viewer.remote._TIMEOUT", PATIENCE)


@pytest.fixture(scope="module")
def service() -> Iterator[Server]:
    with service_tools.serving() as running:
        yield running


def host_of(service: Server) -> str:
    return address_of(service).removeprefix("tcp://")


@contextmanager
def moving(
    client: Client, sample: Callable[[int], dict[str, Any]] | None = None
) -> Iterator[list[Command]]:
    """Send samples all the time; yields the list of the client's commands."""
    is_over, commands = threading.Event(), list[Command]()

    def move() -> None:
        while not is_over.wait(0.02):
            i = len(commands)
            commands.append(
                client.step(
                    **(
                        {"q": human_q(0.05 * i), "wrist": WRIST}
                        if sample is None
                        else sample(i)
                    )
                )
            )

    thread = threading.Thread(target=move)
    thread.start()
    try:
        yield commands
    finally:
        is_over.set()
        thread.join()


@contextmanager
def watching(
    service: Server, **choices: Any
) -> Iterator[tuple[ServiceSession, Iterator[ViewSample]]]:
    session = ServiceSession(host_of(service), patience=PATIENCE, **choices)
    samples = iter(session)
    try:
        yield session, samples
    finally:
        session.close()
        for _ in samples:
            pass


# A floating hand, and one on an arm with mimic joints.
@pytest.mark.slow
@pytest.mark.parametrize("robot", ["allegro_right", "tiago_arm"])
def test_what_is_shown_is_what_was_mapped(service: Server, robot: str) -> None:
    options = {"ridge": 0.3, "pivot": "palm"}
    with (
        connected(
            service, robot=robot, name="lab", has_detail=True, mapping=options
        ) as client,
        moving(client) as commands,
        watching(service, session="lab") as (session, samples),
    ):
        # If its client pauses, the service repeats the robot's posture without details.
        shown = list(islice((sample for sample in samples if sample.is_seen), 5))
    assert (session.robot.name, session.choice.method) == (
        robot,
        MappingOptions(ridge=0.3, pivot="palm"),
    )
    sent = {command.q: command for command in commands}
    for sample in shown:
        command = sent[tuple(sample.robot_q.tolist())]
        assert command.detail is not None
        # Points of the service against those of the local model.
        np.testing.assert_allclose(
            sample.robot_points, command.detail["points"], atol=1e-9
        )
        (human,) = sample.humans
        assert human.q is not None
        assert human.points is not None
        assert human.wrist is not None
        np.testing.assert_allclose(
            human.points,
            session.human.points(human.q, human.wrist),
            atol=1e-9,
        )
        np.testing.assert_allclose(sample.point_error, command.point_error, atol=1e-9)
        np.testing.assert_allclose(human.wrist, WRIST, atol=1e-12)
        # The pivot is the palm, which this finger motion does not move.
        assert human.pivot is not None
        np.testing.assert_allclose(
            human.pivot, (WRIST @ session.human.wrist_to_palm)[:3, 3], atol=0.03
        )


@pytest.mark.slow
def test_teleoperation_is_shown_with_the_points_that_it_moves(service: Server) -> None:
    with (
        connected(
            service, "allegro_right", None, name="lab", has_detail=True
        ) as client,
        moving(client) as commands,
        watching(service, session="lab") as (session, samples),
    ):
        shown = list(islice((sample for sample in samples if sample.is_seen), 5))
    assert session.choice == preset_choice("teleoperation")
    assert len(session.robot.reference_points) > len(
        load_hand("allegro_right").reference_points
    )
    sent = {command.q: command for command in commands}
    for sample in shown:
        command = sent[tuple(sample.robot_q.tolist())]
        assert command.detail is not None
        assert sample.targets is not None
        (human,) = sample.humans
        assert human.motion_deformation is not None
        assert sample.held_by == command.detail["held_by"]
        np.testing.assert_allclose(
            sample.targets, command.detail["targets"], atol=1e-12
        )
        np.testing.assert_allclose(
            human.motion_deformation,
            command.detail["motion_deformation"],
            atol=1e-12,
        )
        assert len(sample.robot_points) == len(session.robot.reference_points)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "is_slow"), [("svh_right", True), ("allegro_right", False)]
)
def test_the_service_says_whether_the_hand_is_slow(
    service: Server, robot: str, is_slow: bool
) -> None:
    with connected(service, robot, None, name="lab", has_detail=True) as client:
        with (
            moving(client),
            watching(service, session="lab") as (session, samples),
        ):
            next(samples)
        # A client belongs to one thread at a time.
        fist = client.status().fist
    assert fist is not None
    expected = f"needs {fist.time:.1f} s for a fist: a person is faster"
    assert (expected in session.slow_note) == is_slow
    assert bool(session.slow_note) == is_slow


@pytest.mark.slow
def test_the_service_says_how_often_assumed_speeds_hold_the_hand(
    service: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    # However seldom they do, and however few the samples are.
    monkeypatch.setattr(assumed_speeds, "ASSUMED_SHARE", -1.0)
    monkeypatch.setattr(assumed_speeds, "_LEAST_SAMPLES", 0)
    with (
        connected(service, "leap_right", None, name="lab", has_detail=True) as client,
        moving(client),
        watching(service, session="lab") as (session, samples),
    ):
        while "Assumed speed limits held a joint" not in session.slow_note:
            next(samples)


@pytest.mark.slow
def test_the_preset_of_a_shared_session_is_switched_and_shown(service: Server) -> None:
    with (
        connected(service, "allegro_right", None, name="lab", is_shared=True) as client,
        serving() as page,
        ExitStack() as views,
    ):
        with moving(client):
            session = ServiceSession(host_of(service))
            viewer = views.enter_context(closing(LiveViewer(page, session)))
            steering = viewer.steering
            assert steering is not None
            assert steering.controls["preset"].handle.value == "teleoperation"
            many = len(session.robot.reference_points)
            for preset, count in (("object", 4), ("teleoperation", many)):
                steering.controls["preset"].handle.value = preset
                tick_until(viewer, partial(is_shown, viewer, session, preset, count))
                assert about_lab(service).preset == preset
        # A client belongs to one thread at a time, so no samples are sent meanwhile.
        client.configure(preset="object", mapping={"ridge": 0.5})
        with moving(client):
            tick_until(viewer, lambda: option_handles(steering)["ridge"].value == 0.5)
            assert steering.controls["preset"].handle.value == "object"


def is_shown(
    viewer: LiveViewer, session: ServiceSession, preset: str, count: int
) -> bool:
    """Return whether the view has a preset, and points and targets that it moves."""
    sample = viewer.sample
    points = (sample.robot_points, sample.targets)
    return session.choice.preset == preset and all(
        found is not None and len(found) == count for found in points
    )


def test_the_human_of_a_session_of_landmarks_is_drawn_as_its_landmarks(
    service: Server,
) -> None:
    person = load_hand("human", points="landmarks", hand_length=0.21)
    postures = [human_q(0.05 * i) for i in range(40)]

    def landmarks(i: int) -> dict[str, Any]:
        return {"landmarks": person.points(postures[i % 40], WRIST)}

    with (
        connected(
            service,
            input="landmarks",
            preset=None,
            hand_length=0.21,
            is_shared=True,
            name="lab",
        ) as client,
        moving(client, landmarks),
        watching(service, session="lab") as (session, samples),
    ):
        shown = list(islice((sample for sample in samples if sample.is_seen), 10))
    for sample in shown:
        (human,) = sample.humans
        assert human.q is not None
        drawn = session.human.points(human.q, human.wrist)
        # Fitted from the sample before, which may be another posture.
        assert np.linalg.norm(drawn - human.points, axis=1).mean() < 5e-3


@pytest.mark.slow
def test_the_human_hand_has_the_lengths_that_the_service_measured(
    service: Server,
) -> None:
    person = load_hand("human", points="landmarks", hand_length=0.21)

    def landmarks(i: int) -> dict[str, Any]:
        return {"landmarks": person.points(human_q(0.05 * i), WRIST)}

    with (
        connected(service, name="lab", input="landmarks", is_shared=True) as client,
        moving(client, landmarks),
        watching(service, session="lab") as (session, samples),
    ):
        next(samples)
    measured = HumanLengths.from_urdf(session.human.urdf_text)
    np.testing.assert_allclose(
        measured.segments, HumanLengths.from_hand_length(0.21).segments, atol=2e-3
    )


@pytest.mark.slow
def test_a_shared_session_is_steered_from_the_view(service: Server) -> None:
    with (
        connected(service, name="lab", is_shared=True) as client,
        moving(client) as commands,
        serving() as page,
    ):
        viewer = LiveViewer(page, ServiceSession(host_of(service)))
        assert viewer.steering is not None
        try:
            option_handles(viewer.steering)["deformation_gain"].value = 0.0
            viewer.tick()
            wait_until(lambda: mapping_of(service)["deformation_gain"] == 0.0)
            viewer.steering.release.value = True
            tick_until(viewer, lambda: commands[-1].status == "released")
            wait_until(lambda: viewer.sample.status == "released")
            viewer.tick()
            assert not viewer.steering.clutch.disabled
            viewer.steering.clutch.value = True
            tick_until(viewer, lambda: commands[-1].status != "released")
        finally:
            viewer.close()
    assert commands[-1].detail is not None


def about_lab(service: Server) -> About:
    """Return the properties of the session `lab`."""
    about = in_loop(
        service,
        lambda: service.dispatcher.sessions.named("lab").state(1, "", 0, 0.0).about,
    )
    assert about is not None
    return about


def mapping_of(service: Server) -> dict[str, Any]:
    """Return the mapping options in force there."""
    return about_lab(service).mapping


def tick_until(viewer: LiveViewer, is_done: Callable[[], bool]) -> None:
    def tick_and_see() -> bool:
        viewer.tick()
        return is_done()

    wait_until(tick_and_see)


@pytest.mark.slow
def test_two_views_and_the_client_do_not_undo_what_the_others_set(
    service: Server,
) -> None:
    with (
        connected(service, name="lab", is_shared=True) as client,
        moving(client),
        serving() as one,
        serving() as other,
    ):
        viewers = [
            LiveViewer(page, ServiceSession(host_of(service))) for page in (one, other)
        ]
        first, second = (
            option_handles(viewer.steering)
            for viewer in viewers
            if viewer.steering is not None
        )
        try:
            first["ridge"].value = 0.5
            tick_until(viewers[0], lambda: mapping_of(service)["ridge"] == 0.5)
            second["scale"].value = 2.0
            tick_until(viewers[1], lambda: mapping_of(service)["scale"] == 2.0)
            assert mapping_of(service)["ridge"] == 0.5
            tick_until(viewers[0], lambda: first["scale"].value == 2.0)
            tick_until(viewers[1], lambda: second["ridge"].value == 0.5)
            assert (mapping_of(service)["ridge"], mapping_of(service)["scale"]) == (
                0.5,
                2.0,
            )
        finally:
            for viewer in viewers:
                viewer.close()


@pytest.mark.slow
def test_options_that_were_lost_with_the_session_are_lost_in_the_view_too(
    service: Server,
) -> None:
    with (
        connected(service, name="lab", is_shared=True) as client,
        moving(client),
        serving() as page,
    ):
        session = ServiceSession(host_of(service))
        viewer = LiveViewer(page, session)
        assert viewer.steering is not None
        handles = option_handles(viewer.steering)
        try:
            handles["ridge"].value = 0.5
            # Wait until the view shows it; otherwise 0.1 below could be the old value.
            tick_until(viewer, lambda: session.choice.method.values["ridge"] == 0.5)
            lose_sessions(service)
            tick_until(viewer, lambda: handles["ridge"].value == 0.1)
            assert mapping_of(service)["ridge"] == 0.1
        finally:
            viewer.close()
    assert client.reopened == 1


OTHER_HANDS: dict[str, dict[str, Any]] = {
    "robot": {"robot": "three_finger"},
    "human points": {"human_points": "fingertips"},
    "side of the human": {"side": "left"},
}


@pytest.mark.slow
@pytest.mark.parametrize("changes", OTHER_HANDS.values(), ids=OTHER_HANDS.keys())
def test_a_session_that_comes_back_with_other_hands_ends_the_view_of_the_old_ones(
    service: Server, changes: dict[str, Any]
) -> None:
    usual: dict[str, Any] = {"robot": "allegro_right", "name": "lab", "is_shared": True}
    with watching_after(service, usual) as (session, samples):
        with connected(service, **(usual | changes)) as client, moving(client):
            for sample in samples:
                (human,) = sample.humans
                assert human.points is not None
                assert len(human.points) == len(session.human.reference_points)
                assert len(sample.robot_points) == len(session.robot.reference_points)
        assert session.is_outdated


@contextmanager
def watching_after(
    service: Server, choices: dict[str, Any]
) -> Iterator[tuple[ServiceSession, Iterator[ViewSample]]]:
    """Yield a view of a session that has just been closed."""
    with ExitStack() as stack:
        with connected(service, **choices) as client, moving(client):
            session, samples = stack.enter_context(watching(service))
            next(samples)
        yield session, samples


def test_wrist_is_estimated_from_points_without_one(service: Server) -> None:
    human = load_hand("human")
    pose = affine(rotation_from_quat_wxyz((0.6, 0.0, 0.8, 0.0)), WRIST[:3, 3])

    def points(i: int) -> dict[str, Any]:
        return {"points": human.points(human.rest + 1e-4 * np.sin(i), pose)}

    with (
        connected(
            service, name="lab", input="points", is_shared=True, robot_wrist=np.eye(4)
        ) as client,
        moving(client, points),
        watching(service) as (_, samples),
    ):
        sample = next(samples)
    (seen,) = sample.humans
    assert seen.q is None
    assert seen.wrist is not None
    np.testing.assert_allclose(seen.wrist, pose, atol=2e-3)


def test_details_are_requested_again_after_a_session_is_reopened(
    service: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Disable the periodic status request.
    monkeypatch.setattr("handmap_qp.apps.viewer.remote._STATUS_PERIOD", np.inf)
    with (
        connected(service, name="lab", is_shared=True) as client,
        moving(client),
        watching(service) as (_, samples),
    ):
        assert next(samples).is_seen
        lose_sessions(service)
        wait_until(lambda: client.reopened)
        wait_until(lambda: next(samples) and about_lab(service).has_detail)
        wait_until(lambda: next(samples).is_seen)


@pytest.mark.slow
def test_an_encrypted_service_is_shown_only_with_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_keys(tmp_path, ["tracker", "viewer"])
    tracker, viewer = (
        (tmp_path / f"{name}.key_secret", tmp_path / "server.key")
        for name in ("tracker", "viewer")
    )
    with (
        service_tools.serving(keys=tmp_path) as service,
        client_of(service, keys=tracker) as client,
    ):
        client.open("three_finger", name="lab", is_shared=True)
        with moving(client), watching(service, keys=viewer) as (session, samples):
            assert next(samples).is_seen
            session.request("release")
            wait_until(lambda: next(samples).status == "released")
            assert session.is_released
            session.request("stop")
            wait_until(
                lambda: next(samples).status == "stopped" and session.stop_number > 0
            )
            session.request("clear", session.stop_number)
            wait_until(
                lambda: next(samples).status == "released" and session.stop_number == 0
            )
        for name in ("viewer.remote._TIMEOUT", "connection.TIMEOUT"):
            monkeypatch.setattr(f"handmap_qp.apps.{name}", 0.1)
        with pytest.raises(InvalidInputError, match="no service answers"):
            ServiceSession(host_of(service))


def test_sessions_that_cannot_be_shown_are_explained(service: Server) -> None:
    def show(**choices: Any) -> None:
        ServiceSession(host_of(service), patience=0.2, **choices)

    with pytest.raises(InvalidInputError, match="no session is open"):
        show()
    with connected(service, name="a"):
        with pytest.raises(
            InvalidInputError, match="open it with has_detail=True or is_shared=True"
        ):
            show()
        with pytest.raises(InvalidInputError, match="no session 'c'"):
            show(session="c")
        with (
            connected(service, name="b"),
            pytest.raises(
                InvalidInputError, match="--session: several sessions are open: a, b"
            ),
        ):
            show()
    with (
        connected(service, name="a", input="landmarks", is_shared=True),
        pytest.raises(InvalidInputError, match="not been measured"),
    ):
        show()
    with (
        connected(service, name="a", is_shared=True) as client,
        moving(client),
        watching(service, robot="allegro_right") as (_, samples),
        pytest.raises(InvalidInputError, match="of another hand"),
    ):
        next(samples)


@pytest.mark.slow
def test_both_hands_of_a_robot_are_shown(service: Server) -> None:
    demo = {
        side: recording.landmarks[recording.valid]
        for side, recording in read_hands([DEMO]).items()
    }

    def both(i: int) -> dict[str, Any]:
        hands = {side: {"landmarks": demo[side][2 * i % 200]} for side in demo}
        # Now and then one hand is not seen.
        return {"hands": hands | ({"left": {"valid": False}} if i % 20 == 19 else {})}

    choices = {"input": "landmarks", "hand_length": 0.18, "has_detail": True}
    with (
        connected(service, "g1", None, name="lab", **choices) as client,
        moving(client, both) as commands,
        watching(service, session="lab") as (session, samples),
    ):
        shown = list(islice((sample for sample in samples if sample.is_seen), 10))
    sent = {command.q: command for command in commands}
    whole = 0
    for sample in shown:
        command = sent[tuple(sample.robot_q.tolist())]
        details = [command.hands[hand.side].detail for hand in session.robot.hands]
        if not all(details):
            continue
        whole += 1
        points, targets = (
            np.vstack([getattr(each, name) for each in details])
            for name in ("points", "targets")
        )
        np.testing.assert_allclose(sample.robot_points, points, atol=1e-9)
        np.testing.assert_array_equal(sample.targets, targets)
        np.testing.assert_allclose(sample.point_error, command.point_error, atol=1e-9)
        for seen, human in zip(sample.humans, session.human.hands, strict=True):
            # The drawn hand lies on the landmarks of its own side.
            assert seen.q is not None
            drawn = human.with_points("landmarks").points(seen.q, seen.wrist)
            errors = np.linalg.norm(drawn - seen.landmarks, axis=1)
            assert errors.max() < 0.03
    assert whole > 5
