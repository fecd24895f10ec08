"""The client in one folder: imports, signatures, restarts of the server, and no hanging calls."""

from __future__ import annotations

import ast
import asyncio
import inspect
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from patience import PATIENCE
from service_tools import (
    LOCAL,
    address_of,
    assert_no_jump,
    client_of,
    connected,
    heard,
    human_q,
    send_until_reopened,
    serving,
)
from strategies import motion_of, rotations, translations

import handmap_core.client
from handmap_qp.apps.service.server import Server
from handmap_qp.client import (
    AsyncClient,
    Client,
    HandFields,
    ServiceError,
    ServiceTimeoutError,
    messages,
)
from handmap_qp.client.messages import Pose
from handmap_qp.hands.human import HumanLengths

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

FOLDER = Path(handmap_core.client.__file__).parent
WRIST = np.eye(4)


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as running:
        yield running


def test_it_needs_numpy_msgspec_and_zmq_and_nothing_else() -> None:
    imported: set[str] = set()
    for file in FOLDER.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                imported.add(node.module or "")
    assert {name.split(".")[0] for name in imported} - set(sys.stdlib_module_names) == {
        "numpy",
        "msgspec",
        "zmq",
    }


def test_a_copy_works_without_the_package(server: Server, tmp_path: Path) -> None:
    shutil.copytree(FOLDER, tmp_path / "copied")
    code = (
        "import sys; sys.path.insert(0, '.')\n"
        "sys.modules.update({'handmap_core': None, 'handmap_qp': None})\n"
        f"import copied; client = copied.Client({address_of(server)!r}, timeout={PATIENCE})\n"
        "client.open('three_finger', preset='paper')\n"
        f"print(client.step(q={human_q().tolist()}, wrist=[0, 0, 0, 0, 0, 0, 1]).status)\n"
        "client.close()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=2.0 * PATIENCE,
    )
    assert done.stdout.strip() == "converged", done.stderr


@given(st.builds(motion_of, rotations, translations))
def test_poses_survive_the_wire(matrix: np.ndarray) -> None:
    pose = Pose.of(matrix)
    assert np.allclose(pose.matrix, matrix, atol=1e-12)
    assert np.allclose(
        Pose.of([*pose.position, *pose.quat_xyzw]).matrix, matrix, atol=1e-12
    )


def test_an_array_of_another_shape_is_not_a_pose() -> None:
    with pytest.raises(ValueError, match="shape"):
        Pose.of(np.eye(3))


def test_asyncio_is_the_same(server: Server) -> None:
    async def main() -> None:
        async with AsyncClient(address_of(server), timeout=PATIENCE) as client:
            await client.open(
                "three_finger", mapping={"rigid_from": "wrist"}, watchdog=10.0
            )
            # Calls of several tasks take turns, and each gets its answer.
            commands = await asyncio.gather(
                *(client.step(q=human_q(0.01 * i), wrist=WRIST) for i in range(20))
            )
            assert len({command.seq for command in commands}) == 20
            # The subscription may not have arrived yet.
            async with asyncio.timeout(PATIENCE):
                while await client.latest(0.1) is None:
                    await client.send(q=human_q(), wrist=WRIST)
            await client.release()
            await client.clutch()
            await client.reset()
            assert (await client.status()).mode == "following"
            with pytest.raises(ServiceError, match="invalid: q"):
                await client.step(q=[0.0], wrist=WRIST)

    asyncio.run(main())


def test_a_cancelled_call_does_not_disturb_later_calls(server: Server) -> None:
    async def main() -> None:
        async with AsyncClient(address_of(server), timeout=PATIENCE) as client:
            await client.open("three_finger")
            cancelled = 0
            for _ in range(50):
                call = asyncio.ensure_future(client.step(q=human_q(), wrist=WRIST))
                # The request is sent, and the call waits, unless the answer was there at once.
                await asyncio.sleep(0.0)
                call.cancel()
                cancelled += isinstance(
                    (await asyncio.gather(call, return_exceptions=True))[0],
                    asyncio.CancelledError,
                )
            assert cancelled
            assert (await client.step(q=human_q(), wrist=WRIST, time=7.0)).time == 7.0

    asyncio.run(main())


@contextmanager
def ending() -> Iterator[None]:
    """Raise an error if the block hangs."""

    def complain(*_: object) -> None:
        raise AssertionError("the call hangs")

    before = signal.signal(signal.SIGALRM, complain)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("attempts", [1, 3])
@pytest.mark.parametrize("listens", [False, True], ids=["no server", "a silent server"])
def test_a_call_without_an_answer_ends_after_its_attempts(
    attempts: int, listens: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    connections: list[str] = []
    connect = zmq.Socket.connect

    def count(self: zmq.Socket, address: str) -> object:
        connections.append(address)
        return connect(self, address)

    monkeypatch.setattr(zmq.Socket, "connect", count)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        if listens:
            silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with (
            Client(address, timeout=0.2, attempts=attempts) as client,
            ending(),
            pytest.raises(ServiceTimeoutError),
        ):
            client.open("three_finger")
    assert connections == [address] * attempts


def test_a_step_before_open_is_refused(server: Server) -> None:
    with client_of(server) as client:
        with pytest.raises(ServiceError, match="no_session"):
            client.step(q=human_q(), wrist=WRIST)
        with pytest.raises(RuntimeError, match="open a session"):
            client.latest()


@pytest.mark.parametrize("streams", [False, True], ids=["requests", "stream"])
def test_after_a_restart_the_robot_goes_on_from_its_last_command(
    free_port: int, streams: bool
) -> None:
    client = Client(f"tcp://127.0.0.1:{free_port}", timeout=PATIENCE)
    with serving(LOCAL, port=free_port):
        client.open("three_finger")
        last = [client.step(q=human_q(0.2 * i), wrist=WRIST) for i in range(15)][-1]
    client.timeout = 0.1
    with pytest.raises(ServiceTimeoutError):
        client.step(q=human_q(), wrist=WRIST)
    client.timeout = PATIENCE
    with serving(LOCAL, port=free_port), client:
        sample: dict[str, Any] = {"q": human_q(1.0), "wrist": WRIST, "time": 1e3}
        if streams:
            send_until_reopened(client, **sample)
            command = heard(client, 1e3)
        else:
            command = client.step(**sample)
        assert client.reopened == 1
        assert_no_jump(client, last, command)
    assert command.wrist is not None
    assert last.wrist is not None
    assert (
        np.linalg.norm(np.subtract(command.wrist.position, last.wrist.position))
        <= 3.0**0.5 * 3.0 / 30.0
    )


def test_other_commands_too_find_the_new_server(free_port: int) -> None:
    client = Client(f"tcp://127.0.0.1:{free_port}", timeout=PATIENCE)
    with serving(LOCAL, port=free_port):
        client.open("three_finger", mount="fixed", mapping={"rigid_from": "none"})
        client.step(q=human_q(), wrist=WRIST)
    with serving(LOCAL, port=free_port), client:
        assert client.status().mode == "waiting"
        client.clutch()
        assert client.reopened == 1


def test_words_and_their_former_names_do_the_same(server: Server) -> None:
    with connected(server) as client:
        client.step(q=human_q(), wrist=WRIST)
        for disengage, engage in (
            (client.disengage, client.engage),
            (client.release, client.clutch),
            # By a client of one's own, in today's words.
            (
                lambda: client._run(client._do("disengage")),
                lambda: client._run(client._do("engage")),
            ),
        ):
            disengage()
            assert client.status().is_released
            engage()
            assert not client.status().is_released


def test_closing_twice_is_closing_once(server: Server) -> None:
    with connected(server) as client:
        client.step(q=human_q(), wrist=WRIST)
        client.close()
        client.close()


def public_methods(kind: type) -> dict[str, Callable[..., Any]]:
    return {
        name: method
        for name, method in inspect.getmembers(kind, inspect.isfunction)
        if not name.startswith("_")
    }


def methods_text(file: str) -> str:
    """Return the source of a client from its first request to its last."""
    text = (FOLDER / file).read_text(encoding="utf-8")
    return text[text.index("def open(") : text.index("self._close())")]


def test_the_clients_differ_by_async_and_await_alone() -> None:
    coroutines = methods_text("asynchronous.py").replace("async def ", "def ")
    assert methods_text("blocking.py").split() == [
        word for word in coroutines.split() if word != "await"
    ]


def documented(text: str | None, heading: str) -> dict[str, str]:
    """Return the explanation of each argument or attribute, on one line."""
    section = inspect.cleandoc(text or "").partition(f"{heading}:\n")[2]
    section = section.partition("\n\n")[0]
    entries = re.split(r"^    (?=\w+: )", section, flags=re.MULTILINE)
    named = (entry.partition(": ") for entry in entries if entry.strip())
    return {name: " ".join(about.split()) for name, _, about in named}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("open", messages.Open),
        ("step", messages.Step),
        ("send", messages.Step),
        ("reset", messages.Reset),
        ("configure", messages.Configure),
    ],
)
def test_methods_have_the_fields_of_their_messages(
    name: str, message: type[msgspec.Struct]
) -> None:
    method = vars(Client)[name]
    parameters = [*inspect.signature(method).parameters.values()][1:]
    assert [one.name for one in parameters] == [*message.__annotations__]
    optional = [one for one in parameters if one.name != "robot"]
    assert all(one.default is None and one.kind is one.KEYWORD_ONLY for one in optional)
    about = documented(method.__doc__, "Args")
    assert about == documented(message.__doc__, "Attributes")
    assert about.keys() == {one.name for one in parameters}


def test_a_hand_of_a_sample_has_the_fields_of_its_message() -> None:
    assert [*HandFields.__annotations__] == [*messages.HandSample.__annotations__]
    assert [*(HandFields.__doc__ or "").partition("Attributes")[2].split()] == [
        *(messages.HandSample.__doc__ or "").partition("Attributes")[2].split()
    ]


def test_both_clients_have_the_same_documented_methods_and_signatures() -> None:
    methods, coroutines = public_methods(Client), public_methods(AsyncClient)
    assert {"open", "step", "send", "latest", "watch", "configure"} <= methods.keys()
    assert methods.keys() == coroutines.keys()
    for name, method in methods.items():
        coroutine = coroutines[name]
        assert method.__doc__
        assert coroutine.__doc__
        assert method.__name__ == coroutine.__name__ == name  # ty: ignore[missing-attribute]
        assert inspect.iscoroutinefunction(coroutine)
        assert not inspect.iscoroutinefunction(method)
        assert inspect.signature(method) == inspect.signature(coroutine)


def test_an_argument_that_does_not_exist_is_rejected_before_sending() -> None:
    with Client() as client, pytest.raises(TypeError, match="wirst"):
        client.step(q=human_q(), wirst=WRIST)  # ty: ignore[unknown-argument]


def test_every_argument_of_open_reaches_the_server(server: Server) -> None:
    lengths = HumanLengths.from_hand_length(0.2)
    with client_of(server) as client:
        opened = client.open(
            "three_finger",
            name="every-argument",
            input="points",
            side="left",
            lengths={"bases": lengths.bases, "segments": lengths.segments},
            mount="floating",
            mapping={"ridge": 0.3},
            ik={"damping": 0.2},
            robot_q=np.full(8, 0.1),
            robot_wrist=WRIST,
            is_released=True,
            has_detail=True,
            is_shared=True,
        )
        state = client.status()
    about = state.about
    assert about is not None
    assert (opened.name, opened.q, state.is_released) == (
        "every-argument",
        (0.1,) * 8,
        True,
    )
    assert (about["input"], about["side"], about["mount"]) == (
        "points",
        "left",
        "floating",
    )
    assert (about["mapping"]["ridge"], about["ik"]["damping"]) == (0.3, 0.2)
    assert about["has_detail"]
    assert about["is_shared"]
    np.testing.assert_allclose(about["lengths"]["bases"], lengths.bases)


@pytest.mark.parametrize(
    "values", [{1.0}, object(), [[0.0], "x", None]], ids=["a set", "an object", "mixed"]
)
def test_values_that_are_not_numbers_are_rejected_before_sending(
    server: Server, values: Any
) -> None:
    with connected(server) as client:
        with pytest.raises((ValueError, ServiceError)):
            client.step(q=values, wrist=WRIST)
        with pytest.raises(ValueError, match=r"^wrist: expected"):
            client.step(q=human_q(), wrist=values)
        assert client.step(q=human_q(), wrist=WRIST).status == "converged"
