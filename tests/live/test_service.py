"""The whole chain: a source, the service, commands; and the samples of a session recorded."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from faulty_replay import FaultyReplay
from injection import parse_faults
from live_cases import moving_hand
from patience import wait_until
from service_tools import (
    PATIENCE,
    address_of,
    client_of,
    connected,
    lose_sessions,
    serving,
)

from handmap_core.human.recording import sample_columns
from handmap_qp import InvalidInputError
from handmap_qp.apps.live.service import ServiceSink, ServiceSource
from handmap_qp.apps.live.source import Recorder, Replay, run
from handmap_qp.apps.service.server import Server
from handmap_qp.human.person import Person
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats import read_recording

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("patient")]


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as server:
        yield server


@pytest.fixture(scope="module")
def person() -> Person:
    return measure_person(moving_hand())


def test_a_replay_moves_the_robot(
    server: Server, person: Person, tmp_path: Path
) -> None:
    recording = moving_hand()
    sink = ServiceSink(
        address_of(server), "allegro_right", "right", name="chain", person=person
    )
    with client_of(server) as watcher:
        watcher.watch("chain")
        about = watcher.status().about
        assert about is not None
        assert about["preset"] == "teleoperation"
        assert about["teleoperation"]["contact_gap"] == person.contact_gap
        np.testing.assert_allclose(
            about["lengths"]["segments"], person.lengths.segments
        )
        before = watcher.status().q
        recorder = Recorder(tmp_path / "sent.npz")
        summary = run(Replay(recording), [sink, recorder])
    assert summary["sent"] == len(recording)
    assert summary["hand_lost"] == 1
    assert summary["recorded"] == len(recording)
    # The stream keeps the newest command only, so a busy machine reads fewer.
    assert 5 <= summary["commands"] <= summary["sent"]
    assert not summary["refusals"]
    assert "calibrating" not in summary["statuses"]
    assert sink.command is not None
    assert np.abs(np.subtract(sink.command.q, before)).max() > 0.1
    with pytest.raises(InvalidInputError, match="no session") as refused:
        ServiceSource(address_of(server), session="chain")
    assert refused.value.argument == "--session"


def test_a_lost_hand_is_sent_as_such_and_the_robot_holds(
    server: Server, person: Person
) -> None:
    sink = ServiceSink(address_of(server), "three_finger", "right", person=person)
    session = next(iter(server.dispatcher.sessions.by_secret.values()))
    summary = run(
        FaultyReplay(moving_hand(), parse_faults("dropout@0.3+0.4,silence@0.8+0.05")),
        [sink],
    )
    # 0.4 s without a hand is more than the watchdog's 0.25 s.
    assert session.counts["watchdog"] >= 1
    assert summary["hand_lost"] == pytest.approx(25, abs=2)
    assert summary["sent"] == summary["samples"]


def test_samples_that_are_no_hand_are_refused_and_counted(
    server: Server, person: Person
) -> None:
    sink = ServiceSink(address_of(server), "three_finger", "right", person=person)
    summary = run(FaultyReplay(moving_hand(), parse_faults("noise@0.5+9:1")), [sink])
    assert sum(summary["refusals"].values()) > 0
    assert summary["commands"] > 0
    assert list(summary["refusals"]) == ["invalid landmarks"]
    assert "expected metres" in summary["last_refusal"]
    assert summary["accepted"] > 0


def test_a_lost_session_is_opened_again(server: Server, person: Person) -> None:
    sink = ServiceSink(address_of(server), "three_finger", "right", person=person)
    lost = float("inf")
    with sink:
        for i, sample in enumerate(Replay(moving_hand())):
            if i == 20:
                lose_sessions(server)
                lost = sample.time
            sink.put(sample)
    assert sink.summary()["reopened"] == 1
    assert sink.command is not None
    assert sink.command.time > lost


def test_a_session_is_recorded_from_the_service(
    server: Server, person: Person, tmp_path: Path
) -> None:
    recording = moving_hand(90)
    choices: dict[str, Any] = {
        "name": "recorded",
        "person": person,
        "upright": "+y up, -z forward",
    }
    sink = ServiceSink(address_of(server), "three_finger", "right", **choices)
    file = tmp_path / "session.npz"
    summaries = []
    source = ServiceSource(address_of(server))  # the only open session
    assert (source.name, source.side) == ("recorded", "right")
    assert source.upright == "+y up, -z forward"
    thread = threading.Thread(
        target=lambda: summaries.append(
            run(source, [Recorder(file, upright=source.upright)])
        )
    )
    thread.start()
    run(Replay(recording), [sink])
    thread.join(PATIENCE)  # the source ends with the session
    assert not thread.is_alive()
    copy = read_recording(file)
    assert copy.upright == "+y up, -z forward"
    assert len(copy) == summaries[0]["recorded"] >= 10
    # Each recorded sample is one of the replay, at its time.
    clean = recording.landmarks[recording.valid]
    times = recording.time[recording.valid]
    rows = [
        int(np.flatnonzero((np.abs(clean - each) < 1e-12).all(axis=(1, 2)))[0])
        for each in copy.landmarks
    ]
    assert (np.diff(rows) > 0).all()
    np.testing.assert_allclose(copy.time, times[rows] - times[rows[0]], atol=1e-6)


def test_sessions_that_cannot_be_recorded_are_refused(server: Server) -> None:
    address = address_of(server)
    with pytest.raises(InvalidInputError, match="no session is open"):
        ServiceSource(address)
    with (
        connected(server, name="angles"),
        pytest.raises(InvalidInputError, match="one of q"),
    ):
        ServiceSource(address, session="angles")
    with (
        connected(server, name="plain", input="landmarks", hand_length=0.19),
        pytest.raises(InvalidInputError, match="has_detail"),
    ):
        ServiceSource(address, session="plain")
    with (
        connected(server, name="one"),
        connected(server, name="two"),
        pytest.raises(InvalidInputError, match=r"one, two|two, one"),
    ):
        ServiceSource(address)


def test_a_service_that_is_not_there_is_one_line(
    server: Server, free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("handmap_qp.apps.connection.TIMEOUT", 0.2)
    nobody = f"127.0.0.1:{free_port}"
    with pytest.raises(InvalidInputError, match=r"--to: .*handmap serve"):
        ServiceSink(nobody, "three_finger", "right")
    with pytest.raises(InvalidInputError, match=r"--from: .*handmap serve"):
        ServiceSource(nobody)
    monkeypatch.setattr("handmap_qp.apps.connection.TIMEOUT", PATIENCE)
    with pytest.raises(InvalidInputError, match=r"--to: .*no hand 'nonsense'"):
        ServiceSink(address_of(server), "nonsense", "right")
    for wrong in ("", ":", "127.0.0.1:port", "127.0.0.1:99999"):
        with pytest.raises(InvalidInputError, match="--to"):
            ServiceSink(wrong, "three_finger", "right")


def test_the_status_says_that_the_service_is_silent(
    server: Server, person: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServiceSink(
        address_of(server), "three_finger", "right", person=person
    ) as sink:
        assert "waiting" in sink.status()
        samples = iter(sample_columns(moving_hand()))

        def send() -> bool:
            sink.put(next(samples))
            return sink.command is not None

        wait_until(send)
        assert "three_finger" in sink.status()
        assert "held by" not in sink.status()
        assert sink.command is not None
        detail = {"held_by": ["palm", "finger1_distal"]}
        sink.command = msgspec.structs.replace(sink.command, detail=detail)
        assert sink.status().endswith("held by palm and finger1_distal")
        monkeypatch.setattr("handmap_qp.apps.live.service._SILENCE", -1.0)
        assert "no answer" in sink.status()
