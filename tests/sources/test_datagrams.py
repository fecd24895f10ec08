"""Gloves by UDP and ZeroMQ: what arrives is what was sent, and what is wrong is never mapped."""

from __future__ import annotations

import json
import math
import socket
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from patience import PATIENCE
from source_cases import (
    SENDER,
    Tracked,
    assert_same,
    demo,
    free_port,
    run,
    start,
    track,
    wait_for_datagrams,
    wait_until_read,
)

from handmap_core.human.sample import HumanSample
from handmap_qp import HumanLengths, load_hand, load_layout
from handmap_qp.apps.live.cli import Target
from handmap_qp.human.person import Person, write_person

datagrams = pytest.importorskip(
    "handmap_sources.datagrams", reason="needs packages/sources and what it installs"
)
HOST = "127.0.0.1"
STEP = 0.01


def message(i: int, layout: str = "manus25", **changes: Any) -> dict[str, Any]:
    """Return the i-th sample of the demo as a device sends it, whose clock began 100 s ago."""
    joints = load_layout(layout).write(demo()[i]).tolist()
    return {"time": 100.0 + STEP * i, "side": "right", "joints": joints} | changes


def packet(i: int, **changes: Any) -> str:
    """Return such a message on the wire, in hexadecimal digits."""
    return json.dumps(message(i, **changes)).encode().hex()


def tracked(
    lines: list[str],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    layout: str = "manus25",
    kind: str = "udp",
) -> Tracked:
    """Track what a sender sends line by line."""
    file = tmp_path / "packets.txt"
    file.write_text("\n".join(lines))
    is_udp = kind == "udp"
    port = free_port(socket.SOCK_DGRAM if is_udp else socket.SOCK_STREAM)
    address = f"{'udp' if is_udp else 'tcp'}://{HOST}:{port}"

    def send() -> None:
        if is_udp:
            wait_for_datagrams(port)
        with start(SENDER, kind, f"{HOST}:{port}", file) as process:
            assert process.wait(PATIENCE) == 0
        if is_udp:
            wait_until_read(port)

    return track(["datagrams", address, "--layout", layout], send, capsys, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "form"), [("udp", msgspec.json), ("zmq", msgspec.msgpack)]
)
def test_what_arrives_is_what_was_sent(
    kind: str, form: Any, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    layout = "manus25" if form is msgspec.json else "openxr26"
    # As many as a receiver that is held up may find waiting.
    count = 20
    lines = [form.encode(message(i, layout)).hex() for i in range(count)]
    result = tracked(lines, capsys, tmp_path, layout, kind)
    assert_same(result.recording, demo()[:count])
    # On the sender's clock.
    np.testing.assert_allclose(result.recording.time, STEP * np.arange(count))
    assert not result.troubles
    assert result.recording.upright == load_layout(layout).upright


@pytest.mark.slow
def test_what_is_wrong_is_counted_told_once_and_not_mapped(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    whole = bytes.fromhex(packet(3))
    lines = [
        packet(0),
        packet(0),
        packet(1, time=1e300),
        packet(2),  # 1 is lost on the way, or late:
        packet(1),
        packet(1),
        whole[:-9].hex(),
        whole.replace(b"0.", b"0x", 1).hex(),
        "c1",
        packet(3, joints=message(3)["joints"][:-1]),
        packet(3, joints=[[1e9, 0, 0, math.nan]]),
        packet(3, joints=None),
        packet(3, confidence=2.0),
        (whole + b" " * datagrams.LARGEST).hex(),
        packet(3, side="left"),
        packet(3, side="left"),
        packet(3),
        "from 127.0.0.2",
        packet(4),
        packet(5),
    ]
    result = tracked(lines, capsys, tmp_path)
    assert_same(result.recording, [demo()[i] for i in (0, 2, 3)])
    assert result.troubles == {
        "not in order": 4,
        "damaged": 7,
        "too large": 1,
        "other hand": 2,
        "another sender": 2,
    }
    told = [line for line in result.messages if "silent" not in line]
    assert sum("more of this is counted only" in line for line in told) >= 5
    for text in (
        "late or twice",
        "cannot be read",
        "32768 bytes",
        "left hand",
        "127.0.0.2",
    ):
        assert sum(text in line for line in result.messages) == 1, text


@pytest.mark.slow
def test_a_silence_is_told_once_and_ends_nothing(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(datagrams, "SILENCE", 0.1)
    result = tracked([packet(0), "wait", packet(1)], capsys, tmp_path)
    assert_same(result.recording, demo()[:2])
    np.testing.assert_allclose(result.recording.time, [0.0, STEP], atol=1e-9)
    assert not result.troubles
    assert result.summary["troubles"]["silent"] >= 2
    assert sum("nothing has arrived" in line for line in result.messages) == 1


def test_a_sender_that_starts_again_goes_on_but_no_other_takes_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 50.0
    monkeypatch.setattr(datagrams, "monotonic", lambda: now)
    source = datagrams.TrackDatagrams(address="udp://:1", layout="manus25")

    def sent(
        i: int, host: str = HOST, port: int = 1, *, wait: float = STEP, **changes: Any
    ) -> HumanSample | None:
        nonlocal now
        now += wait
        return source._sample(bytes.fromhex(packet(i, **changes)), (host, port))

    def time(*words: Any, **more: Any) -> float:
        sample = sent(*words, **more)
        assert sample is not None, source.troubles
        return sample.time

    silence = 1.01 * datagrams.SILENCE
    # Ours counts where a sender begins, and then its own.
    first = time(0)
    assert first == now
    assert time(1, wait=0.5) == pytest.approx(first + STEP)
    # The same clock after a silence.
    assert time(2, wait=silence, time=102.5) == pytest.approx(first + 2.5)
    assert sent(3, "127.0.0.2", wait=silence) is None
    assert source.troubles == {"another sender": 1}
    # The same machine with another port, whose clock begins anew: only after a silence.
    assert time(3, port=2, wait=1.0, time=0.0) == now
    assert sent(4, port=3, time=0.0) is None
    assert time(4, port=2, time=STEP) == pytest.approx(now - STEP)
    # A clock that is set.
    assert sent(5, port=2, time=1e6) is None
    assert source.troubles == {"another sender": 2, "not in order": 1}
    assert time(5, port=2, wait=silence, time=2e6) == pytest.approx(now)
    assert time(6, port=2, time=2e6 + STEP) == pytest.approx(now)
    # The hand is lost.
    lost = sent(7, port=2, time=2e6 + 2.0 * STEP, valid=False)
    assert lost is not None
    assert not lost.valid


def read_as(layout: str, person: Path | None = None, **fields: Any) -> HumanSample:
    """Return what a source makes of a message."""
    target = Target(person=person)
    place = "udp://:1"
    source = datagrams.TrackDatagrams(address=place, layout=layout, target=target)
    sample = source._sample(msgspec.json.encode(fields), (HOST, 1))
    assert sample is not None, source.troubles
    return sample


def test_angles_come_by_name_and_are_of_the_person(tmp_path: Path) -> None:
    glove, human = load_layout("manus"), load_hand("human")
    values = glove.write_posture(human, human.rest + 0.1, np.eye(4))
    angles = dict(zip(glove.columns, values.tolist(), strict=True))
    truth = glove.read(angles, time=0.0, side="right").landmarks
    backwards = dict(reversed(angles.items()))
    found = read_as("manus", joints=backwards).landmarks
    np.testing.assert_array_equal(found, truth)
    lengths = HumanLengths.from_hand_length(0.23)
    write_person(Person("large", lengths, 0.015), tmp_path / "large.yaml")
    large = read_as("manus", tmp_path / "large.yaml", joints=angles).landmarks
    size = np.linalg.norm(large[12] - large[0]) / np.linalg.norm(found[12] - found[0])
    assert 1.15 < size < 1.3


def test_a_wrist_comes_beside_joints() -> None:
    layout = load_layout("visionpro25")
    joints = layout.write(demo()[0])
    pose = np.eye(4)
    pose[:3, 3] = 0.1, 0.2, 0.3
    truth = layout.read(joints, time=0.0, side="right", wrist=pose)
    found = read_as("visionpro25", joints=joints.tolist(), wrist=pose.tolist())
    np.testing.assert_array_equal(found.landmarks, truth.landmarks)
    assert found.wrist is not None
    assert truth.wrist is not None
    np.testing.assert_array_equal(found.wrist, truth.wrist)


# Of the right types, so that they come as far as possible.
ODD = st.floats() | st.sampled_from([None, True, -(2**63), "1", {}])
LISTS = st.recursive(ODD, lambda inner: st.lists(inner, max_size=4))
FIELDS = {
    "time": st.floats(),
    "side": st.sampled_from([None, "right", "left", "middle"]),
    "joints": st.just(message(0)["joints"])
    | st.lists(LISTS)
    | st.dictionaries(st.text(max_size=3), st.floats()),
    "wrist": st.none() | st.just(np.eye(4).tolist()) | st.lists(LISTS),
    "valid": st.booleans(),
    "confidence": st.floats(),
}
MESSAGES = st.fixed_dictionaries({}, optional=FIELDS).map(msgspec.msgpack.encode)


@given(st.binary() | MESSAGES, st.sampled_from(["manus", "visionpro25", "manus25"]))
def test_no_message_ends_it(wire: bytes, layout: str) -> None:
    source = datagrams.TrackDatagrams(address="udp://:1", layout=layout)
    sample: HumanSample | None = source._sample(wire, (HOST, 1))
    if sample is None:
        assert source.troubles.total() == 1
    else:
        assert math.isfinite(sample.time)
        assert not sample.valid or np.isfinite(sample.landmarks).all()


def test_a_deep_message_ends_nothing() -> None:
    source = datagrams.TrackDatagrams(address="udp://:1", layout="manus25")
    deep = b'{"joints": ' + 100000 * b"["
    assert source._sample(deep[: datagrams.LARGEST], (HOST, 1)) is None
    assert source.troubles == {"damaged": 1}


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["udp://127.0.0.1", "--layout", "manus25"], "ADDRESS: expected udp://:PORT"),
        (["udp://:99999", "--layout", "manus25"], "ADDRESS: "),
        (["udp://8.8.8.8:5580", "--layout", "manus25"], "ADDRESS: Cannot assign"),
        (["tcp://*:5580", "--layout", "manus25"], "ADDRESS: Invalid argument"),
        (["udp://:5580", "--layout", "manus52"], "did you mean manus25?"),
    ],
)
def test_every_mistake_is_one_line(
    words: list[str],
    complaint: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    record = ["--record", str(tmp_path / "out.npz")]
    assert run("track", "datagrams", *words, *record) == 2
    message = capsys.readouterr().err
    assert complaint in message
    assert message.count("\n") == 1
    assert not [*tmp_path.iterdir()]
