"""The bridge from OpenXR: the real loader, a runtime of our own, and `track datagrams`."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE
from source_cases import (
    PACKAGE,
    assert_same,
    demo,
    free_port,
    track,
    wait_for_datagrams,
    wait_until_read,
)

from handmap_core.human.sample import HumanSample
from handmap_qp.trackers import load_layout

pytest.importorskip("xr", reason="needs pyopenxr")
if not shutil.which("cc"):
    pytest.skip("needs a C compiler", allow_module_level=True)
pytestmark = pytest.mark.slow

RUNTIME = Path(__file__).with_name("openxr_runtime.py")
BRIDGE = PACKAGE / "handmap_sources" / "openxr.py"


def program(*words: object, **more: str) -> subprocess.Popen[str]:
    """Start a program with the package on its path."""
    path = os.pathsep.join([str(PACKAGE), *sys.path])
    return subprocess.Popen(
        [sys.executable, *map(str, words)],
        env={**os.environ, "PYTHONPATH": path, **more},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def shown(folder: Path, samples: list[HumanSample], hand: int) -> Path:
    """Write what the runtime shows: sample 3 of the hand is not seen, nor is the other hand."""
    joints = np.full((len(samples), 2, 26, 7), np.nan)
    for i, sample in enumerate(samples):
        joints[i, hand] = load_layout("openxr26").write(sample)
    joints[3, hand, 12] = np.nan
    np.save(folder / "joints.npy", joints)
    return folder


@pytest.mark.parametrize(("hand", "side"), [(1, "right"), (0, "left")])
def test_what_the_runtime_shows_arrives(
    hand: int, side: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    samples = demo()[:20]
    folder = shown(tmp_path, samples, hand)
    ports = {each: free_port(socket.SOCK_DGRAM) for each in ("right", "left")}

    def send() -> None:
        wait_for_datagrams(ports[side])
        targets = [f"--{each}=127.0.0.1:{port}" for each, port in ports.items()]
        with program(RUNTIME, folder, *targets) as process:
            calls, complaint = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0, complaint
        wait_until_read(ports[side])
        # The session is left as it was entered.
        assert calls.rstrip().endswith('"xrDestroySession", "xrDestroyInstance"]')

    address = f"udp://127.0.0.1:{ports[side]}"
    words = ["datagrams", address, "--layout", "openxr26", "--side", side]
    result = track(words, send, capsys, tmp_path)
    recording = result.recording
    assert_same(recording, samples[:3] + samples[4:])
    assert np.flatnonzero(~recording.valid).tolist() == [3]
    assert recording.side == side
    assert recording.upright == "+y up, -z forward"
    assert not result.troubles


def test_a_missing_extension_or_runtime_is_one_line(tmp_path: Path) -> None:
    target = "--right=127.0.0.1:1"
    shown(tmp_path, demo()[:4], 1)
    lacking = {"LACKING": "XR_MND_headless"}
    with program(RUNTIME, tmp_path, target, **lacking) as process:
        _, complaint = process.communicate(timeout=PATIENCE)
    assert complaint == "openxr: the OpenXR runtime lacks XR_MND_headless\n"
    assert process.returncode == 1
    # The loader's own lines come before ours.
    with program(BRIDGE, target, XR_RUNTIME_JSON=str(tmp_path / "none")) as process:
        _, complaint = process.communicate(timeout=PATIENCE)
    assert complaint.splitlines()[-1].startswith("openxr: ")
    assert "Traceback" not in complaint
    assert process.returncode == 1


@pytest.mark.parametrize("word", ["127.0.0.1", "127.0.0.1:", "127.0.0.1:65536"])
def test_an_address_without_a_port_is_refused_at_the_start(
    word: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from handmap_sources import openxr

    monkeypatch.setattr(sys, "argv", ["openxr.py", f"--right={word}"])
    with pytest.raises(SystemExit):
        openxr.main()
    complaint = f"--right: invalid address value: '{word}'"
    assert complaint in capsys.readouterr().err


def test_it_ends_by_ctrl_c_and_closes_its_session(tmp_path: Path) -> None:
    shown(tmp_path, demo()[:4] * 50, 1)
    with socket.socket(type=socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        target = f"--right=127.0.0.1:{receiver.getsockname()[1]}"
        receiver.settimeout(PATIENCE)
        with program(RUNTIME, tmp_path, target) as process:
            assert receiver.recv(65536).startswith(b'{"time": ')
            process.send_signal(signal.SIGINT)
            calls, complaint = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    assert not complaint
    assert calls.rstrip().endswith('"xrDestroyInstance"]')


def test_it_imports_nothing_of_the_house() -> None:
    assert "handmap_qp" not in BRIDGE.read_text().partition('"""\n\nimport')[2]
