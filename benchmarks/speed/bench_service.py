"""Load on the mapping service, beside a bare echo of the same transport in the same run.

The loads are one client that sends landmarks at 90 Hz in process, over ZeroMQ and over WebSocket,
one client at 1 kHz, thirty clients at 60 Hz, and one client over WebSocket, for a minute each. A
share of the round trips goes to the echo, which neither reads nor maps, from the same client and
with messages of the same length. So the load of the machine affects both alike.

A second table has the sessions that a server serves by the number of its worker processes, and the
round trips of stops while it is loaded.

    python benchmarks bench_service --picture service.png --json service.json
"""

from __future__ import annotations

import asyncio
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import common
import msgspec
import numpy as np
import zmq
import zmq.asyncio
from service_clients import HumanMotion, pace
from service_process import ServiceProcess, echoing, serving
from service_sessions import sessions_by_cores

from handmap_qp.apps.service.dispatch import Dispatcher
from handmap_qp.apps.service.logs import Metrics
from handmap_qp.apps.service.opening import HandCache
from handmap_qp.apps.service.sessions import Sessions
from handmap_qp.apps.service.settings import Settings
from handmap_qp.client import AsyncClient, Client

# Number of steps per echo.
_ECHO_EVERY = 20
_CLIENTS_A_PROCESS = 10
_TRACKER_RATE = 90.0
_TRACKED = {"robot": "allegro_right", "input": "landmarks", "hand_length": 0.18}
_SESSIONS_CAPTION = (
    "server_us, worker_us: CPU time a sample of the process that serves, and of all workers.\n"
    "sessions: how many at 90 Hz leave the busiest process, with a core of its own, a tenth of its "
    "time.\nmapped_%: of the samples that were sent; the others were replaced by newer ones.\n"
    "stop: round trip of a stop of another session meanwhile."
)
Ask = Callable[[bytes], Any]


def landmarks_at_90_hz(
    service: ServiceProcess, echo: dict[str, int], file: Path, duration: float
) -> list[dict[str, Any]]:
    """Send the landmarks of a recording in three ways, each beside its echo.

    In process, the dispatcher is called without a transport, and the echo is an empty call.
    """
    landmarks = np.load(file)["landmarks"].astype(float)
    # Forth and back, so that the hand never jumps.
    rows = [tuple(map(tuple, each.tolist())) for each in (*landmarks, *landmarks[::-1])]
    answers: list[bytes] = []
    dispatcher = Dispatcher(Sessions(Settings(rate=1e6), HandCache(), Metrics()))

    def in_process(message: bytes) -> None:
        dispatcher.receive(message, "benchmark", answers.append)

    async def open_in_process() -> None:
        in_process(_message("open", 1, **_TRACKED))
        while not answers:
            await asyncio.sleep(0.01)

    asyncio.run(open_in_process())
    found = [
        _track(
            "in process",
            in_process,
            lambda message: None,
            time.process_time,
            rows,
            duration,
        )
    ]
    for name, connected in (("ZeroMQ", _over_zmq), ("WebSocket", _over_websocket)):
        with connected(service, echo) as (ask, bare):
            ask(_message("open", 1, **_TRACKED))
            found.append(_track(name, ask, bare, service.cpu, rows, duration))
            ask(_message("close", 2**50))
    return found


def _message(kind: str, seq: int, **fields: Any) -> bytes:
    head = {"type": kind, "protocol": 2, "seq": seq, "session": "s" * 32}
    return msgspec.msgpack.encode(head | fields)


@contextmanager
def _over_zmq(
    service: ServiceProcess, echo: dict[str, int]
) -> Iterator[tuple[Ask, Ask]]:
    """Yield functions that send a message to the service, and to its echo, and wait."""
    with (
        zmq.Context() as context,
        context.socket(zmq.DEALER) as socket,
        context.socket(zmq.DEALER) as bare,
    ):
        socket.linger = bare.linger = 0
        socket.connect(service.address)
        bare.connect(f"tcp://127.0.0.1:{echo['requests']}")
        yield (
            lambda message: (socket.send(message), socket.recv()),
            lambda message: (bare.send(message), bare.recv()),
        )


@contextmanager
def _over_websocket(
    service: ServiceProcess, echo: dict[str, int]
) -> Iterator[tuple[Ask, Ask]]:
    """Yield functions that send a message to the service, and to its echo, and wait."""
    from websockets.sync.client import connect

    with (
        connect(f"ws://127.0.0.1:{service.ports['web']}", compression=None) as socket,
        connect(f"ws://127.0.0.1:{echo['web']}", compression=None) as bare,
    ):
        yield (
            lambda message: (socket.send(message), socket.recv()),
            lambda message: (bare.send(message), bare.recv()),
        )


def _track(
    name: str,
    ask: Ask,
    bare: Ask,
    clock: Callable[[], float],
    rows: Sequence[Any],
    duration: float,
) -> dict[str, Any]:
    """Send landmarks at the rate of a tracker, each sample to the service and to its echo."""
    steps, echoes, late, cpu = [], [], 0.0, 0.0
    started = time.monotonic()
    before = clock()
    for i, now in enumerate(pace(_TRACKER_RATE, duration)):
        late = max(late, now - i / _TRACKER_RATE)
        message = _message("step", i + 2, time=now, landmarks=rows[i % len(rows)])
        begun = clock()
        steps.append(timed(lambda message=message: ask(message)))
        cpu += clock() - begun
        echoes.append(timed(lambda message=message: bare(message)))
    if name != "in process":
        # A process that serves works between the steps too.
        cpu = clock() - before
    elapsed = time.monotonic() - started
    rate = len(steps) / elapsed
    return row(f"landmarks, 90 Hz, {name}", steps, echoes, lost=0, rate=rate) | {
        "skipped": 0,
        "late_ms": 1e3 * late,
        "server_%": 100.0 * cpu / elapsed,
        "server_us": 1e6 * cpu / len(steps),
    }


def one_client(
    service: ServiceProcess, echo: str, robot: str, rate: float, duration: float
) -> dict[str, Any]:
    """Run one client at a steady rate that waits for each answer."""
    motion, steps, echoes, late = HumanMotion(), [], [], 0.0
    with (
        Client(service.address, timeout=30.0) as client,
        zmq.Context() as context,
        context.socket(zmq.DEALER) as bare,
    ):
        bare.linger = 0
        bare.connect(echo)
        client.open(robot, max_dt=max(1e-3, 2.0 / rate))
        payload = msgspec.msgpack.encode(
            {
                "type": "step",
                "q": [0.0] * 20,
                "wrist": [[0.0] * 3, [0.0] * 4],
                "session": "s" * 32,
            }
        )
        before, started = service.cpu(), time.monotonic()
        for i, now in enumerate(pace(rate, duration)):
            late = max(late, now - i / rate)
            steps.append(timed(lambda now=now: client.step(**motion(now))))
            if i % _ECHO_EVERY == 0:
                echoes.append(timed(lambda: (bare.send(payload), bare.recv())))
        elapsed, cpu = time.monotonic() - started, service.cpu() - before
        counted = client.status().counts["steps"]
    return row(
        f"1 client, {rate:g} Hz",
        steps,
        echoes,
        lost=round(rate * duration) - counted,
        rate=len(steps) / elapsed,
    ) | {
        "skipped": 0,
        "late_ms": 1e3 * late,
        "server_%": 100.0 * cpu / elapsed,
        "server_us": 1e6 * cpu / len(steps),
    }


def many_clients(
    service: ServiceProcess,
    echo: str,
    robot: str,
    count: int,
    rate: float,
    duration: float,
) -> dict[str, Any]:
    """Run independent clients, several per process."""
    parts = [
        range(first, min(first + _CLIENTS_A_PROCESS, count))
        for first in range(0, count, _CLIENTS_A_PROCESS)
    ]
    before, started = service.cpu(), time.monotonic()
    context = multiprocessing.get_context("spawn")
    with context.Pool(len(parts)) as pool:
        found = pool.starmap(
            _some_clients,
            [
                (service.address, echo, robot, list(part), rate, duration)
                for part in parts
            ],
        )
    elapsed, cpu = time.monotonic() - started, service.cpu() - before
    steps, echoes = (
        np.concatenate([part[key] for part in found]) for key in ("steps", "echoes")
    )
    counted = sum(part["counted"] for part in found)
    skipped = sum(part["skipped"] for part in found)
    lost = round(rate * duration) * count - skipped - counted
    return row(
        f"{count} clients, {rate:g} Hz",
        steps,
        echoes,
        lost=lost,
        rate=len(steps) / duration,
    ) | {
        "skipped": skipped,
        "late_ms": 1e3 * max(part["late"] for part in found),
        "server_%": 100.0 * cpu / elapsed,
        "server_us": 1e6 * cpu / len(steps),
    }


def _some_clients(
    address: str, echo: str, robot: str, seeds: list[int], rate: float, duration: float
) -> dict[str, Any]:
    """Run the clients of one process; at top level, where multiprocessing finds it."""

    async def one(
        seed: int, opened: asyncio.Barrier
    ) -> tuple[list[float], list[float], float, int, int]:
        motion, steps, echoes, late, skipped = HumanMotion(seed), [], [], 0.0, 0
        bare = zmq.asyncio.Context.instance().socket(zmq.DEALER)
        bare.linger = 0
        bare.connect(echo)
        async with AsyncClient(address, timeout=30.0) as client:
            await client.open(robot)
            await opened.wait()
            # Spread the clients over a period, as independent clients would be.
            started = time.monotonic() + (seed * 0.618 % 1.0) / rate
            for i in range(round(rate * duration)):
                await asyncio.sleep(max(0.0, started + i / rate - time.monotonic()))
                behind = time.monotonic() - started - i / rate
                late = max(late, behind)
                if behind > 1.0 / rate:
                    # A tracker would have a newer sample by now.
                    skipped += 1
                    continue
                sample, before = motion(i / rate), time.perf_counter()
                await client.step(**sample)
                steps.append(time.perf_counter() - before)
                if i % _ECHO_EVERY == 0:
                    before = time.perf_counter()
                    await bare.send(b"x" * 400)
                    await bare.recv()
                    echoes.append(time.perf_counter() - before)
            counted = (await client.status()).counts["steps"]
        bare.close()
        return steps, echoes, late, counted, skipped

    async def every() -> list[tuple[list[float], list[float], float, int, int]]:
        opened = asyncio.Barrier(len(seeds))
        return await asyncio.gather(*(one(seed, opened) for seed in seeds))

    found = asyncio.run(every())
    return {
        "steps": np.concatenate([part[0] for part in found]),
        "echoes": np.concatenate([part[1] for part in found]),
        "late": max(part[2] for part in found),
        "counted": sum(part[3] for part in found),
        "skipped": sum(part[4] for part in found),
    }


def over_websocket(
    service: ServiceProcess, echo: int, robot: str, rate: float, duration: float
) -> dict[str, Any]:
    """Run one client over WebSocket that waits for each answer."""
    from websockets.sync.client import connect

    motion, steps, echoes, late = HumanMotion(), [], [], 0.0
    head = {"protocol": 1, "session": "a-secret-of-the-benchmark"}
    with (
        connect(
            f"ws://127.0.0.1:{service.ports['web']}", compression=None
        ) as connection,
        connect(f"ws://127.0.0.1:{echo}", compression=None) as bare,
    ):

        def ask(message: dict[str, Any]) -> dict[str, Any]:
            connection.send(msgspec.msgpack.encode(head | message))
            answer = connection.recv()
            assert isinstance(answer, bytes)
            return msgspec.msgpack.decode(answer)

        ask({"type": "open", "seq": 1, "robot": robot})
        before, started = service.cpu(), time.monotonic()
        for i, now in enumerate(pace(rate, duration)):
            late = max(late, now - i / rate)
            sample = motion(now)
            wrist = {
                "position": sample["wrist"][:3].tolist(),
                "quat_xyzw": sample["wrist"][3:].tolist(),
            }
            message = {
                "type": "step",
                "seq": i + 2,
                "time": now,
                "q": sample["q"].tolist(),
                "wrist": wrist,
            }
            steps.append(timed(lambda message=message: ask(message)))
            if i % _ECHO_EVERY == 0:
                echoes.append(timed(lambda: (bare.send(b"x" * 400), bare.recv())))
        elapsed, cpu = time.monotonic() - started, service.cpu() - before
        counted = ask({"type": "status", "seq": len(steps) + 2})["counts"]["steps"]
        ask({"type": "close", "seq": len(steps) + 3})
    lost = round(rate * duration) - counted
    return row(
        f"WebSocket, {rate:g} Hz", steps, echoes, lost=lost, rate=len(steps) / elapsed
    ) | {
        "skipped": 0,
        "late_ms": 1e3 * late,
        "server_%": 100.0 * cpu / elapsed,
        "server_us": 1e6 * cpu / len(steps),
    }


def timed(call: Any) -> float:
    """Measure the wall time of a call [s]."""
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def row(
    load: str,
    steps: Sequence[float] | np.ndarray,
    echoes: Sequence[float] | np.ndarray,
    *,
    lost: int,
    rate: float,
) -> dict[str, Any]:
    """Summarise a load; times in microseconds."""
    step, echo = 1e6 * np.asarray(steps), 1e6 * np.asarray(echoes)
    quantiles = {"p50": 50, "p99": 99, "p99.9": 99.9}
    return {
        "load": load,
        "steps": len(step),
        "lost": lost,
        "rate": rate,
        **{
            f"{name}_us": float(np.percentile(step, q)) for name, q in quantiles.items()
        },
        "max_us": float(step.max()),
        **{
            f"echo_{name}_us": float(np.percentile(echo, q))
            for name, q in quantiles.items()
            if name != "p99.9"
        },
    }


def draw(rows: list[dict[str, Any]]) -> Any:
    """Draw the round trips of every load beside those of the echo."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 0.9 + 0.75 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for i, entry in enumerate(rows):
        for offset, prefix, colour in (
            (0.18, "echo_", common.PALETTE[5]),
            (-0.18, "", common.PALETTE[0]),
        ):
            low, high = entry[f"{prefix}p50_us"] / 1e3, entry[f"{prefix}p99_us"] / 1e3
            axes.plot(
                [low, high],
                [i + offset] * 2,
                color=colour,
                lw=2.5,
                solid_capstyle="butt",
            )
            axes.plot(low, i + offset, "o", color=colour, ms=6)
            axes.plot(high, i + offset, "|", color=colour, ms=12, mew=2.5)
            axes.annotate(
                f"{low:.2f} to {high:.2f}",
                (high, i + offset),
                (6, 0),
                textcoords="offset points",
                va="center",
                size=8,
            )
    axes.plot([], [], "-o", color=common.PALETTE[0], label="step, p50 to p99")
    axes.plot([], [], "-o", color=common.PALETTE[5], label="bare echo")
    axes.set_yticks(range(len(rows)), [entry["load"] for entry in rows])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.set_xlim(
        left=0.0,
        right=1.2
        * max(max(entry["p99_us"], entry["echo_p99_us"]) for entry in rows)
        / 1e3,
    )
    axes.set_xlabel("round trip [ms]")
    axes.set_title("The mapping service beside a bare echo")
    axes.grid(axis="y", visible=False)
    axes.legend(loc="lower right")
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser(
        "Load on the mapping service, beside a bare echo of the same transport."
    )
    parser.add_argument(
        "--duration",
        type=float,
        default=60.0,
        metavar="S",
        help="time of each load [s]; 60 by default",
    )
    parser.add_argument(
        "--clients",
        type=int,
        default=30,
        metavar="N",
        help="clients at 60 Hz; 30 by default",
    )
    parser.add_argument(
        "--robot", default="three_finger", help="robot hand; three_finger by default"
    )
    parser.add_argument(
        "--workers",
        type=int,
        nargs="*",
        default=[0, 1, 2],
        metavar="N",
        help="worker processes of the servers that many sessions load; 0 1 2 by default",
    )
    parser.add_argument(
        "--sessions",
        type=int,
        default=20,
        metavar="N",
        help="sessions at 90 Hz that load them; 20 by default",
    )
    arguments = common.parse_arguments(parser, words)
    duration, clients = (
        (0.5, 4) if arguments.quick else (arguments.duration, arguments.clients)
    )
    with (
        serving(web=True, web_port=0) as service,
        echoing() as echo,
        common.progress("loads", 4) as advance,
    ):
        bare = f"tcp://127.0.0.1:{echo['requests']}"
        recording = common.find_recordings(arguments.recordings)[0]
        rows = landmarks_at_90_hz(service, echo, recording, duration)
        advance()
        rows.append(one_client(service, bare, arguments.robot, 1000.0, duration))
        advance()
        memory = service.memory()
        rows.append(
            many_clients(service, bare, arguments.robot, clients, 60.0, duration)
        )
        advance()
        rows.append(
            over_websocket(service, echo["web"], arguments.robot, 200.0, duration / 2.0)
        )
        advance()
        growth = service.memory() - memory
    caption = (
        "Wall times of a round trip in us. lost: sent and not answered. "
        "skipped: not sent, because the client was late by more than a period.\n"
        "late_ms: largest delay of a client. server_us: CPU time of the server a step, with what "
        "it does between steps.\n"
        f"Resident memory grew by {growth:.1f} MB after the first load."
    )
    common.print_table(
        "The mapping service under load",
        rows,
        to_stderr=arguments.json == "-",
        caption=caption,
    )
    # A quick run shows that it works: the server alone and one with a worker, a turn each.
    sessions, workers, rounds = arguments.sessions, arguments.workers, 3
    if arguments.quick:
        sessions, workers, rounds = 2, workers[:2], 1
    by_cores = sessions_by_cores(
        workers, recording, sessions, _TRACKER_RATE, duration, rounds
    )
    if by_cores:
        common.print_table(
            "Sessions by cores",
            by_cores,
            to_stderr=arguments.json == "-",
            caption=_SESSIONS_CAPTION,
        )
    common.write_json(
        arguments.json,
        "service",
        {"rows": rows, "memory_growth_MB": growth, "sessions": by_cores},
    )
    common.save_picture(arguments.picture, lambda: draw(rows))


if __name__ == "__main__":
    main()
