"""`handmap drive` between a service and emulated motors, as processes of their own."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmap_drive import DRIVERS
from handmap_drive.processes import Emulator
from marks import rotated
from patience import PATIENCE, kept_going, wait_until
from service_tools import address_of, client_of, connected, human_q, in_loop, serving

from handmap_qp import cli
from handmap_qp.apps.datasets.robot_log import read_robot_log
from handmap_qp.apps.service.server import Server
from handmap_qp.client import Client

for module in ("dynamixel_sdk", "pymodbus"):
    pytest.importorskip(module, reason="needs packages/drive and what it installs")


class Chain:
    """A session that moves, the command, and the motors."""

    def __init__(self, server: Server, owner: Client, emulator: Emulator) -> None:
        self.server, self.owner, self.emulator = server, owner, emulator
        self.process: subprocess.Popen[str] | None = None
        self._options: tuple[str, ...] = ()
        self._stdin = subprocess.DEVNULL
        self._had_torque = False
        self._phase = 0.0
        self.is_still = False
        # The samples are sent by another thread.
        self.turn = threading.Lock()
        assert owner.opened is not None
        self.words = [
            *(sys.executable, "-m", "handmap_qp.cli", "drive", "lab"),
            *("--port", emulator.port),
            *("--from", address_of(server)),
        ]

    def move(self) -> None:
        """Send the next sample of a hand that opens and closes."""
        self._phase += 0.02 * (not self.is_still)
        with self.turn:
            self.owner.step(q=human_q(self._phase), wrist=np.eye(4))

    def start(self, *options: str, stdin: int = subprocess.DEVNULL) -> None:
        self._options, self._stdin = options, stdin
        self.process = subprocess.Popen(
            [*self.words, *options],
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def end(self) -> tuple[int, str, str]:
        """Return exit code, stdout and stderr of the command."""
        assert self.process is not None
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err

    def wait_for(self, *, torque: bool) -> None:
        wait_until(lambda: self._has(torque))
        self._had_torque |= torque

    def _has(self, torque: bool) -> bool:
        # Emulated motors that get no turn on a busy machine are silent, which ends the command.
        assert self.process is not None
        if not self._had_torque and self.process.poll() is not None:
            self.process.communicate()
            self.start(*self._options, stdin=self._stdin)
        return bool((self.emulator.order()["torque"] == torque).all())

    @property
    def has_torque(self) -> bool:
        return bool(self.emulator.order()["torque"].any())


# Emulated motors answer when the machine gives them a turn. Only an Ability hand must be seen to
# be silent: in less than the time after which the loop takes this computer to be late.
HANDS = {
    "dynamixel": ("servos", {"full": 2352, "patience": 5.0}, {"zero": 3.14159}),
    "inspire": (
        "inspire_right",
        {"full": 1000, "patience": 2.0},
        {"zero": 1000, "ratio": -680.3},
    ),
    "ability": ("ability", {"full": 621, "address": 80, "patience": 0.2}, {"zero": 0}),
}
"""Driver, and what a table of these motors has, by kind.

Tests of drivers and of resets meet each kind with resets and lost ports. Here the suite meets each
kind once, and with `--full` each with each fault.
"""


@pytest.fixture
def chain(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Chain]:
    kind = getattr(request, "param", "dynamixel")
    with made_chain(kind, tmp_path) as made, kept_going(made.move, 0.015):
        yield made


@pytest.fixture(scope="module")
def idle_chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    """A chain whose motors stay as they are: words of the command are refused before."""
    folder = tmp_path_factory.mktemp("chain")
    with made_chain("dynamixel", folder) as made, kept_going(made.move, 0.05):
        yield made


@contextmanager
def made_chain(kind: str, folder: Path) -> Iterator[Chain]:
    """Let a service and emulated motors of a kind run, with their table in a folder."""
    driver, fields, place = HANDS[kind]
    with (
        serving() as server,
        connected(server, name="lab", is_shared=True) as owner,
        Emulator(kind, "--ids", "0-7", "--angle", "0.1") as emulator,
    ):
        assert owner.opened is not None
        # A hand has six motors.
        count = 8 if kind == "dynamixel" else 6
        motors = [
            {"joint": [name], "id": i, "range": [-3, 3]} | place
            for i, name in enumerate(owner.opened.joint_names[:count])
        ]
        table = {
            "bus": kind,
            "baud": 1000000,
            "rate": 80.0,
            "speed": 8.0,
            "effort": 0.15,
            "motors": motors,
        }
        file = folder / "motors.yaml"
        file.write_text(json.dumps(table | fields))
        chain = Chain(server, owner, emulator)
        chain.words += ["--driver", driver, "--motors", str(file)]
        try:
            yield chain
        finally:
            if chain.process and chain.process.poll() is None:
                chain.process.kill()
                chain.process.communicate()


@pytest.mark.parametrize("chain", rotated(HANDS, 3, 1), indirect=True)
def test_the_stop_of_another_client_and_a_frozen_server_reach_the_motors(
    chain: Chain,
) -> None:
    chain.start("--no-deadman", "--json")
    chain.wait_for(torque=True)
    with client_of(chain.server) as page:
        page.stop("lab", reason="somebody stepped in")
        chain.wait_for(torque=False)
        page.watch("lab")
        page.clear(page.status().stop)
    with chain.turn:
        chain.owner.clutch()
    chain.wait_for(torque=True)
    # Nothing comes from the server, not even a heartbeat, and its sockets stay open.
    thaw = threading.Event()
    frozen = threading.Thread(target=in_loop, args=(chain.server, thaw.wait))
    frozen.start()
    time.sleep(0.5)
    chain.wait_for(torque=False)
    thaw.set()
    frozen.join()
    chain.wait_for(torque=True)
    assert chain.process is not None
    chain.process.send_signal(signal.SIGINT)
    code, out, err = chain.end()
    assert code == 0
    summary = json.loads(out)
    assert summary["turns"] > 0
    assert summary["stops"] >= 2
    # On a busy machine there may be more lines.
    assert "handmap: stopped: the session is stopped\n" in err
    assert "handmap: stopped: no command arrives\n" in err
    assert not chain.has_torque


@pytest.mark.parametrize("chain", rotated(HANDS, 3, 2), indirect=True)
def test_motors_that_are_reset_are_a_stop(chain: Chain) -> None:
    chain.start("--no-deadman", "--json")
    chain.wait_for(torque=True)
    assert chain.process is not None
    assert chain.process.stderr is not None
    # An Ability hand shows a start by its silence only, which a late computer may not notice.
    boot = 0.1 if "ability" in chain.words else 0.0
    with kept_going(lambda: chain.emulator.order(reboot={"1": boot}), 0.5):
        # On a busy machine there may be more lines.
        for line in chain.process.stderr:
            if "torque lost" in line or "the motors do not answer" in line:
                break
    chain.wait_for(torque=True)
    chain.process.send_signal(signal.SIGINT)
    code, out, _ = chain.end()
    assert code == 0
    assert json.loads(out)["stops"] >= 1
    assert not chain.has_torque


def test_the_session_hears_where_the_joints_are(chain: Chain, tmp_path: Path) -> None:
    file = tmp_path / "take.npz"
    chain.start("--no-deadman", "--log", str(file), "--task", "wave")
    chain.wait_for(torque=True)
    with client_of(chain.server) as page:
        page.watch("lab")

        def error() -> float | None:
            command = page.latest(1.0)
            told = command.following_error if command else ()
            return max(map(abs, told)) if told else None

        # The motors follow. While the hand moves, a busy machine lets them lag without a bound.
        chain.is_still = True
        wait_until(lambda: (now := error()) is not None and now < 0.3)
    # Ctrl-Z does not freeze it with a goal on its way.
    assert chain.process is not None
    chain.process.send_signal(signal.SIGTSTP)
    code, _, err = chain.end()
    assert code == 0
    assert not chain.has_torque
    # Motors that had no time to arrive leave no log, and say so.
    if "is not written" not in err:
        log = read_robot_log(file)
        assert (log.task, log.robot) == ("wave", "servos")
        assert len(log.joint_names) == 8


def test_motors_move_only_while_the_space_bar_is_held(chain: Chain) -> None:
    terminal, keyboard = pty.openpty()
    chain.start(stdin=keyboard)
    with kept_going(lambda: os.write(terminal, b" "), 0.03):
        chain.wait_for(torque=True)
    # On a busy machine torque may be gone for other reasons, and come back at once.
    time.sleep(0.5)
    chain.wait_for(torque=False)
    # A single stroke is none that is held, nor is another key.
    os.write(terminal, b" ")
    for _ in range(20):
        os.write(terminal, b"x")
        assert not chain.has_torque
        time.sleep(0.01)
    assert chain.process is not None
    chain.process.send_signal(signal.SIGTERM)
    code, _, err = chain.end()
    assert code == 0
    assert err.endswith("handmap: stopped: the dead man's key is not held\n")


@pytest.mark.parametrize("chain", rotated(HANDS, 3), indirect=True)
def test_a_port_that_is_gone_ends_it_with_one_line(chain: Chain) -> None:
    chain.start("--no-deadman")
    chain.wait_for(torque=True)
    start = chain.emulator.order()["angle"]
    wait_until(lambda: np.ptp((chain.emulator.order()["angle"], start), 0).max() > 0.05)
    chain.emulator.order(unplug=True)
    code, out, err = chain.end()
    assert code == 2
    assert "following error" in out
    assert err.splitlines()[-1].startswith("handmap: --port: ")
    assert all(line.startswith("handmap: ") for line in err.splitlines())


def test_motors_of_a_command_that_is_killed_stop_themselves(chain: Chain) -> None:
    chain.start("--no-deadman")
    chain.wait_for(torque=True)
    assert chain.process is not None
    chain.process.kill()
    chain.end()

    def rests() -> bool:
        goal = chain.emulator.order()["goal"]
        time.sleep(0.3)
        state = chain.emulator.order()
        return (state["goal"] == goal).all() and np.allclose(
            goal, state["angle"], atol=1e-3
        )

    wait_until(rests)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            ["--driver", "leep"],
            f"--driver: expected one of {', '.join(DRIVERS)}, got 'leep': did you mean",
        ),
        (
            ["--driver", "leap", "--motors", "none", "--no-deadman"],
            "--motors: none: No such file",
        ),
        (["--from", "127.0.0.1:1"], "--from: no service answers"),
        (["--port", "/dev/none", "--no-deadman"], "--port: "),
        (["--temperature", "nan"], "--temperature: expected more than 0, got nan"),
        (["--effort", "nan", "--no-deadman"], "--effort: expected a share, 0 to 1"),
        (["--down", "0", "0", "0"], "--down: expected a direction"),
        (["--down", "0", "0", "1"], "--down: expected --tuning too"),
        (["--task", "lift a cup"], "--task: expected --log too"),
        (["--log", "take.csv"], "--log: expected a file that ends in .npz"),
        ([], "--no-deadman: expected a terminal whose space bar"),
        (["--from", "HERE", "other"], "SESSION: the service refused the session: "),
    ],
)
def test_wrong_words_are_one_line(
    words: list[str],
    text: str,
    idle_chain: Chain,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Only where no service is, none is waited for: a busy machine answers late.
    patience = 0.5 if "127.0.0.1:1" in words else PATIENCE
    monkeypatch.setattr("handmap_qp.apps.connection.TIMEOUT", patience)
    given: list[Any] = [*idle_chain.words[3:]]
    if "other" in words:
        given[1] = "other"
    else:
        given += words
    assert cli.main(given) == 2
    printed = capsys.readouterr()
    if "other" in words:
        assert printed.err.endswith("open are lab\n")
    assert printed.err.startswith(f"handmap: {text}")
    assert printed.err.count("\n") == 1


def test_without_a_name_the_only_session_is_taken_and_several_are_listed(
    idle_chain: Chain, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*idle_chain.words[3:], "--effort", "nan", "--no-deadman"]
    words.remove("lab")
    assert cli.main(words) == 2
    # The session was found: the next mistake is named.
    assert capsys.readouterr().err.startswith("handmap: --effort: ")
    with connected(idle_chain.server, name="other", is_shared=True):
        assert cli.main(words) == 2
    assert capsys.readouterr().err == (
        "handmap: SESSION: several sessions are open: lab, other: name one as SESSION\n"
    )
    with serving() as server:
        words[words.index("--from") + 1] = address_of(server)
        assert cli.main(words) == 2
    assert capsys.readouterr().err.startswith("handmap: SESSION: no session is open at")
