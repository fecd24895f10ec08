"""Input that a client rejects before sending, and the state after a refusal."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE
from service_tools import address_of, connected, human_q, serving

from handmap_qp.apps.service.keys import make_keys
from handmap_qp.apps.service.server import Server
from handmap_qp.client import AsyncClient, Client, ServiceError
from handmap_qp.client.messages import Pose

WRIST = np.eye(4)
NO_POSES: dict[str, Any] = {
    "zeros, as of a hand that is lost": np.zeros((4, 4)),
    "a mirrored one": np.diag([1.0, 1.0, -1.0, 1.0]),
    "a scaled one": np.diag([2.0, 2.0, 2.0, 1.0]),
    "a sheared one": WRIST + np.eye(4, k=1) * 0.1,
    "a wrong last row": np.vstack([WRIST[:3], np.full(4, 5.0)]),
    "no numbers": np.full((4, 4), np.nan),
    "another shape": np.eye(3),
}


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as running:
        yield running


@pytest.mark.parametrize("matrix", NO_POSES.values(), ids=NO_POSES.keys())
def test_a_matrix_that_is_no_pose_is_not_made_one(
    server: Server, matrix: np.ndarray
) -> None:
    # The client must reject it, because any matrix has a nearest quaternion to send.
    with connected(server) as client:
        before = client.step(q=human_q(), wrist=WRIST)
        with pytest.raises(ValueError, match=r"^wrist: expected"):
            client.step(q=human_q(), wrist=matrix)
        with pytest.raises(ValueError, match=r"^robot_wrist: expected"):
            client.reset(robot_wrist=matrix)
        assert client.step(q=human_q(), wrist=WRIST).seq == before.seq + 1
    with pytest.raises(ValueError, match=r"^pose: expected"):
        Pose.of(matrix)


@pytest.mark.parametrize(
    "address", ["127.0.0.1:5570", "tcp://127.0.0.1", "tcp://127.0.0.1:http", ""]
)
def test_an_invalid_address_is_rejected_at_once(address: str) -> None:
    with pytest.raises(ValueError, match="expected an address such as tcp://127"):
        Client(address)


def test_a_public_key_is_not_taken_for_a_clients_own(tmp_path: Path) -> None:
    make_keys(tmp_path, ["tracker"])
    with pytest.raises(ValueError, match="holds no secret key"):
        Client(keys=(tmp_path / "tracker.key", tmp_path / "server.key"))


def test_a_refused_opening_leaves_the_session_as_it_was(server: Server) -> None:
    with connected(server, name="lab") as client, Client(address_of(server)) as watcher:
        first = client.step(q=human_q(), wrist=WRIST)
        watcher.watch("lab")
        for who in (client, watcher):
            with pytest.raises(ServiceError, match="nobody"):
                who.open("nobody")
        after = client.step(q=human_q(0.1), wrist=WRIST)
        assert (after.name, after.epoch, client.reopened) == ("lab", first.epoch, 0)
        assert watcher.status().names == ("lab",)


def test_a_task_that_waits_for_commands_takes_the_stream_that_another_task_opens(
    server: Server,
) -> None:
    async def main() -> None:
        async with AsyncClient(address_of(server), timeout=PATIENCE) as client:
            await client.open("three_finger", watchdog=10.0)
            waiting = asyncio.create_task(client.latest(60.0))
            await asyncio.sleep(0)
            other = await client.open("three_finger", watchdog=10.0)
            # The subscription may reach the server later than the first command.
            while not waiting.done():
                await client.step(q=human_q(), wrist=WRIST)
                await asyncio.sleep(0.01)
            command = await waiting
            assert command is not None
            assert command.name == other.name
            waiting = asyncio.create_task(client.latest(60.0))
            await asyncio.sleep(0)
            await client.close()
            await asyncio.wait_for(waiting, 30.0)

    asyncio.run(main())


def test_closing_ends_a_wait_whose_command_arrives_just_then(server: Server) -> None:
    async def main(turns: int) -> None:
        client = AsyncClient(address_of(server), timeout=PATIENCE)
        await client.watch("lab")
        waiting = asyncio.create_task(client.latest(60.0))
        await asyncio.sleep(0.05)
        # The command arrives while the event loop is blocked. The wait ends some turns later.
        tracker.step(q=human_q(), wrist=WRIST)
        time.sleep(0.02)
        for _ in range(turns):
            await asyncio.sleep(0.0)
        await client.close()
        await asyncio.wait_for(waiting, 30.0)

    with connected(server, name="lab", watchdog=10.0) as tracker:
        for turns in range(8):
            asyncio.run(main(turns))


def test_a_message_taken_by_another_task_is_not_an_error(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def main() -> None:
        async with AsyncClient(address_of(server), timeout=PATIENCE) as client:
            await client.open("three_finger")
            events = iter([True])

            async def is_ready(*_: object) -> bool:
                return next(events)

            # The event comes, but the message is gone.
            with monkeypatch.context() as patched:
                patched.setattr(client, "_is_ready", is_ready)
                assert await client.latest() is None
            assert list(events) == []

    asyncio.run(main())
