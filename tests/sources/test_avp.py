"""An Apple Vision Pro: a server that speaks as the app does, and what `track avp` makes of it."""

from __future__ import annotations

import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE
from source_cases import (
    SENDER,
    Tracked,
    assert_same,
    demo,
    free_port,
    run,
    run_beside,
    start,
    track,
)

from handmap_core.human.sample import HumanSample
from handmap_qp.hands import Side
from handmap_qp.trackers import SIDES, load_layout

avp = pytest.importorskip(
    "handmap_sources.avp", reason="needs packages/sources and what it installs"
)
# Servers are processes.
pytestmark = pytest.mark.slow


def recorded(samples: list[HumanSample]) -> tuple[np.ndarray, np.ndarray]:
    """Return wrists in the app's world, y up, and joints in their frames, as the app has them.

    The wrist turns and moves in each sample; where it is does not change the landmarks. After the
    joints come forearm and markers, and the app uses last rows for something else.
    """
    layout = load_layout("visionpro27")
    wrists, joints = [], []
    for i, sample in enumerate(samples):
        # z up to y up, written out.
        x, y, z = sample.landmarks.T
        turned = np.column_stack([x, z, -y])
        place = HumanSample(0.0, sample.side, turned)
        world = layout.write(place)[:25]
        angle = 0.3 + 0.01 * i
        c, s = np.cos(angle), np.sin(angle)
        wrist = world[0].copy()
        wrist[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        wrists.append(wrist)
        more = np.full((4, 4, 4), 666.0)
        joints.append(np.concatenate([np.linalg.inv(wrist) @ world, more]))
    all_wrists, all_joints = np.array(wrists), np.array(joints)
    all_wrists[:, 3] = all_joints[:, :, 3] = 0.5, 0.0, 0.0, 1001.0
    return all_wrists, all_joints


def saved(file: Path, samples: list[HumanSample], **more: Any) -> Path:
    """Write what a server plays."""
    wrists, joints = recorded(samples)
    fields: dict[str, Any] = {"wrists": wrists, "joints": joints, "rests": 0}
    fields |= {"side": samples[0].side, "ends": True} | more
    np.savez(file, **fields)
    return file


@contextmanager
def headset(port: int, file: Path) -> Iterator[subprocess.Popen[str]]:
    with start(SENDER, "avp", f"127.0.0.1:{port}", file) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def tracked(
    file: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, *words: str
) -> tuple[Tracked, bytes]:
    """Track what a server plays, and return it with what the server was asked."""
    port = free_port(socket.SOCK_STREAM)
    with headset(port, file) as process:
        command = ["avp", f"127.0.0.1:{port}", *words]
        wait = partial(process.wait, PATIENCE)
        result = track(command, wait, capsys, tmp_path)
        assert process.stdout is not None
        return result, bytes.fromhex(process.stdout.readline())


@pytest.mark.parametrize("side", SIDES)
def test_a_hand_comes_as_the_app_sends_it(
    side: Side, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = saved(tmp_path / "avp.npz", demo(side))
    result, asked = tracked(file, capsys, tmp_path, "--side", side)
    # Each pose once, although each was sent twice.
    assert_same(result.recording, demo(side))
    assert result.recording.side == side
    assert result.recording.upright == "+z up, +y forward"
    assert result.troubles == {"disconnected": 1}
    assert sum("connection is lost" in line for line in result.messages) == 1
    # The app wants to know who asks, and which version: entries 1 to 5 and 13 of the head.
    head = b"".join(
        bytes([number << 3 | 5]) + struct.pack("<f", entry)
        for number, entry in [(1, 888.0), (2, 127.0), (5, 1.0), (13, 25000.0)]
    )
    assert asked == bytes([3 << 3 | 2, len(head)]) + head


def test_a_hand_that_stands_still_exactly_is_not_seen(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    samples = demo()[:10]
    file = saved(tmp_path / "avp.npz", samples, rests=150)
    result, _ = tracked(file, capsys, tmp_path)
    assert_same(result.recording, samples)
    time, valid = result.recording.time, result.recording.valid
    last = np.flatnonzero(valid)[-1]
    # Neither before it was seen, nor after it was lost.
    assert not valid[0]
    assert last + 10 < len(valid)
    assert time[last + 1] - time[last] > 0.2


def test_the_other_hand_is_not_mapped(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    port = free_port(socket.SOCK_STREAM)
    file = saved(tmp_path / "avp.npz", demo("left")[:10])
    out = tmp_path / "tracked.npz"
    with headset(port, file) as process:
        wait = partial(process.wait, PATIENCE)
        words = ["track", "avp", f"127.0.0.1:{port}", "--record", str(out)]
        assert run_beside(wait, *words) == 2
    message = capsys.readouterr().err
    assert "no joints" in message
    assert "not seen in any" in message
    assert not out.exists()


def test_damaged_poses_are_not_mapped(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    samples = demo()[:10]
    wrists, joints = recorded(samples)
    wrists[3, :3, :3] *= 1.5
    joints[4, 7, 0, 3] = np.nan
    wrists[5, 0, 3] = np.inf
    joints = joints.astype(np.float32)
    file = saved(tmp_path / "avp.npz", samples, wrists=wrists, joints=joints)
    result, _ = tracked(file, capsys, tmp_path)
    assert_same(result.recording, samples[:3] + samples[6:])
    assert result.troubles["damaged"] >= 1


def test_a_lost_connection_is_made_again(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    samples = demo()[:20]
    halves = samples[:10], samples[10:]
    # The first stream is cut off, and the second one ends.
    files = [
        saved(tmp_path / f"{i}.npz", half, ends=bool(i))
        for i, half in enumerate(halves)
    ]
    port = free_port(socket.SOCK_STREAM)
    with headset(port, files[0]) as first:

        def send() -> None:
            first.wait(PATIENCE)
            with headset(port, files[1]) as second:
                second.wait(PATIENCE)

        result = track(["avp", f"127.0.0.1:{port}"], send, capsys, tmp_path)
    assert_same(result.recording, samples)
    assert result.troubles == {"disconnected": 2}
    assert sum("connection is lost" in line for line in result.messages) == 1


@pytest.mark.parametrize(
    ("host", "complaint"),
    [
        ("127.0.0.1:{port}", "no Tracking Streamer answers at 127.0.0.1"),
        ("nowhere.invalid", "HOST: "),
    ],
)
def test_a_headset_that_is_not_there_is_one_line(
    host: str, complaint: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    host = host.format(port=free_port(socket.SOCK_STREAM))
    assert run("track", "avp", host, "--record", str(tmp_path / "out.npz")) == 2
    message = capsys.readouterr().err
    assert complaint in message
    assert message.count("\n") == 1
    assert not [*tmp_path.iterdir()]


def test_the_command_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run("track", "avp", "--help")
    page = capsys.readouterr().out
    for text in ("Tracking Streamer", "--side", "--record", "--robot", "Examples:"):
        assert text in page
    assert "--layout" not in page
    with pytest.raises(SystemExit):
        run("track", "--help")
    page = capsys.readouterr().out
    assert "track avp        Track a hand with an Apple Vision Pro" in page
    with pytest.raises(SystemExit):
        run("--completion", "bash")
    script = capsys.readouterr().out
    assert "datagrams" in script
