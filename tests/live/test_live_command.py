"""`handmap live`: one command starts service, page and tracker, and ends them together."""

from __future__ import annotations

import os
import re
import signal
import socket
import ssl
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
import segno
from browser import Browser, find_chromium

from handmap_qp import cli
from handmap_qp.apps.live import reach as reaching
from handmap_qp.apps.live.reach import Reach, network_reach, qr_code
from handmap_qp.apps.live.together import instructions, page_address
from handmap_qp.apps.service.keys import read_token
from handmap_qp.errors import InvalidInputError

pytestmark = pytest.mark.slow


@pytest.fixture
def reach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Reach:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    return network_reach("127.0.0.1")


def chosen(robot: str) -> dict[str, list[str]]:
    """Return what the page's address chooses for a robot."""
    query = urlsplit(page_address(None, 5572, robot)).query
    return parse_qs(query, keep_blank_values=True)


def test_the_address_chooses_a_robot_for_each_hand_that_it_fits() -> None:
    assert chosen("") == {}
    assert chosen("leap") == {"right": ["leap_right"], "left": ["leap_left"]}
    assert chosen("leap_left") == {"right": [""], "left": ["leap_left"]}
    assert chosen("three_finger") == {
        "right": ["three_finger"],
        "left": ["three_finger"],
    }
    assert chosen("g1") == {"robot": ["g1"]}


def test_the_code_is_that_of_the_address() -> None:
    address = (
        "https://192.168.1.5:5572/?right=leap_right&left=leap_left#token=" + 32 * "a"
    )
    code = qr_code(address)
    # Two rows of the code in each line; light modules are drawn.
    rows = [
        [letter in light for letter in line]
        for line in code.splitlines()
        for light in ("█▀", "█▄")
    ]
    expected = segno.make_qr(address, error="l").matrix_iter(border=2)
    drawn = [[not dark for dark in row] for row in expected]
    assert rows[: len(drawn)] == drawn


def test_the_secret_is_where_no_server_logs_it(reach: Reach) -> None:
    parts = urlsplit(page_address(reach, 5572, "leap"))
    assert parts.scheme == "https"
    assert parts.fragment == f"token={reach.token}"
    assert reach.token not in parts.query
    # The service takes it, and the files are their owner's alone.
    assert read_token(reach.token_file) == reach.token
    for file in (reach.key, reach.token_file):
        assert file.stat().st_mode & 0o077 == 0


def test_certificate_and_token_stay_until_one_ends(
    reach: Reach, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = reach.certificate.read_bytes()
    assert network_reach("127.0.0.1").token == reach.token
    assert reach.certificate.read_bytes() == before
    # Another address needs another certificate; the token is the service's.
    other = network_reach("::1")
    assert other.certificate != reach.certificate
    assert other.token == reach.token
    # A certificate that ends soon is made again.
    monkeypatch.setattr(reaching, "_DAYS", 1)
    reach.certificate.unlink()
    network_reach("127.0.0.1")
    short = reach.certificate.read_bytes()
    monkeypatch.undo()
    monkeypatch.setenv("XDG_DATA_HOME", str(reach.key.parents[2]))
    network_reach("127.0.0.1")
    assert reach.certificate.read_bytes() != short


def test_without_openssl_the_cable_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InvalidInputError, match=r"openssl is missing.*cable"):
        network_reach("127.0.0.1")


@pytest.mark.parametrize("has_source", [True, False])
@pytest.mark.parametrize("is_network", [True, False])
def test_the_person_reads_address_and_stop(
    reach: Reach, *, has_source: bool, is_network: bool
) -> None:
    way = reach if is_network else None
    page = page_address(way, 5572, "")
    text = instructions(page, way, 5572, has_source=has_source)
    *_, last, before = text.splitlines()
    assert page in text.splitlines()[0]
    assert qr_code(page) in text
    assert "Emergency stop" in last + before
    assert ("adb reverse tcp:5572" in text) == (not has_source and not is_network)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--camera", "0", "--recording", "demo"], "excludes --recording"),
        (["--address", "192.168.1.5"], "needs --network"),
        (["--port", "65534"], "--port"),
        (["--recording", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_a_mistake_is_one_line_before_anything_starts(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["live", "--no-open", *words]) == 2
    written = capsys.readouterr()
    assert message in written.err
    assert written.err.count("\n") == 1
    assert not written.out


@contextmanager
def running(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run the command; the process and the address that it prints. It must end by Ctrl-C."""
    process = subprocess.Popen(
        [sys.executable, "-m", "handmap_qp.cli", "live", "--no-open", *words],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONIOENCODING": "utf-8"},
    )
    assert process.stdout is not None
    try:
        found = re.search(r"https?://\S+", process.stdout.readline())
        assert found
        yield process, found[0]
        process.send_signal(signal.SIGINT)
        process.stdout.read()
        assert process.wait() == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.usefixtures("patient")
def test_the_page_is_served_to_the_network_by_its_certificate(
    reach: Reach,
) -> None:
    with running("--port", "0", "--network", "--address", reach.host) as (_, page):
        trusted = ssl.create_default_context(cafile=str(reach.certificate))
        with urllib.request.urlopen(page, context=trusted) as answer:
            assert b"Emergency stop" in answer.read()


@pytest.mark.usefixtures("patient")
def test_a_stop_on_the_page_holds_what_the_command_moves() -> None:
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium; HANDMAP_CHROMIUM names one")
    with (
        running("--port", "0", "--recording", "demo") as (_, page),
        Browser(program, size=(1100, 1000)) as browser,
    ):
        browser.open(page)
        mode = "document.querySelector('#robots [data-name=live] .mode')?.textContent"
        browser.wait_for(f"{mode} === 'follows a hand'")
        browser.evaluate("document.querySelector('#stop').click(); 0")
        browser.wait_for(f"{mode}?.startsWith('emergency stop')")
        browser.evaluate(
            "document.querySelector('#robots [data-name=live] .clear').click(); 0"
        )
        # Samples still arrive, and nothing moves until somebody engages it.
        browser.wait_for(f"{mode} === 'holds until Engage'")
        assert browser.errors == []


def test_a_port_in_use_ends_it_with_the_reason() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        words = ["live", "--no-open", "--port", str(min(port, 65533))]
        result = subprocess.run(
            [sys.executable, "-m", "handmap_qp.cli", *words],
            capture_output=True,
            text=True,
            check=False,
        )
    assert result.returncode == 2
    assert "the service did not start" in result.stderr
    assert str(port) in result.stderr
    assert not result.stdout
