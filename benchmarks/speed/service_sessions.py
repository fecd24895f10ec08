"""How many sessions a server serves, by its worker processes, and how long a stop takes meanwhile.

All servers run at the same time, and each gets its load in turn, so that the load of the machine
affects them alike. What fits is computed from CPU times, which other programs hardly change.
"""

from __future__ import annotations

import math
import multiprocessing
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zmq
from service_clients import pace
from service_process import ServiceProcess, serving

from handmap_qp.client import Client

_STOP_RATE = 20.0
_MOST_LOAD = 0.9
"""Share of its time that each process may work, as `handmap serve --max-load` has it."""
_VICTIM = "stopped-session"


def sessions_by_cores(
    workers: Sequence[int],
    file: Path,
    sessions: int,
    rate: float,
    duration: float,
    rounds: int = 3,
) -> list[dict[str, Any]]:
    """Stream the landmarks of a recording in many sessions, and stop another one meanwhile.

    Args:
        workers: Numbers of worker processes; 0 maps in the process that serves.
        file: The recording.
        sessions: Sessions at once.
        rate: Samples of each per second.
        duration: Time of each server under load [s].
        rounds: Turns that each server gets.
    """
    runs: dict[int, list[dict[str, Any]]] = {count: [] for count in workers}
    with ExitStack() as stack:
        servers = {
            count: stack.enter_context(serving(workers=count, max_load=1.0))
            for count in workers
        }
        for _ in range(rounds):
            for count, service in servers.items():
                took = duration / rounds
                runs[count].append(_load(service, file, sessions, rate, took))
    return [_row(count, runs[count], sessions, rate) for count in workers]


def _load(
    service: ServiceProcess, file: Path, sessions: int, rate: float, duration: float
) -> dict[str, Any]:
    """Load one server; return CPU times and the round trips of stops."""
    context = multiprocessing.get_context("spawn")
    opened = context.Event()
    go = context.Event()
    found = context.Queue()
    trackers = context.Process(
        target=_stream,
        args=(service.address, file, sessions, rate, duration, opened, go, found),
    )
    trackers.start()
    with Client(service.address, timeout=60.0) as victim:
        victim.open("three_finger", name=_VICTIM, preset="paper")
        opened.wait(120.0)
        before = service.cpu(), sum(service.worker_cpu())
        go.set()
        stops = []
        with Client(service.address, timeout=60.0) as operator:
            for _ in pace(_STOP_RATE, duration):
                began = time.perf_counter()
                operator.stop(_VICTIM)
                stops.append(time.perf_counter() - began)
        after = service.cpu(), sum(service.worker_cpu())
        sent, mapped = found.get(timeout=120.0)
        victim.clear(victim.status().stop)
    trackers.join()
    return {
        "server": after[0] - before[0],
        "workers": after[1] - before[1],
        "stops": stops,
        "sent": sent,
        "mapped": mapped,
    }


def _stream(
    address: str,
    file: Path,
    sessions: int,
    rate: float,
    duration: float,
    opened: Any,
    go: Any,
    found: Any,
) -> None:
    """Stream samples in many sessions; at top level, where multiprocessing finds it."""
    landmarks = np.load(file)["landmarks"].astype(float)
    rows = [each.tolist() for each in (*landmarks, *landmarks[::-1])]
    clients = [Client(address, timeout=60.0) for _ in range(sessions)]
    for client in clients:
        client.open("allegro_right", input="landmarks", hand_length=0.18)
    with zmq.Context() as context, ExitStack() as stack:
        sockets = [
            stack.enter_context(context.socket(zmq.DEALER)) for _ in range(sessions)
        ]
        for socket in sockets:
            socket.linger = 0
            socket.connect(address)
        opened.set()
        go.wait()
        sent = 0
        # Sessions send in turn, as independent trackers would.
        for i, now in enumerate(pace(rate * sessions, duration)):
            which, frame = i % sessions, i // sessions
            secret = clients[which]._addressee["session"]
            sample = {
                "type": "sample",
                "protocol": 2,
                "seq": frame + 10,
                "session": secret,
                "time": now,
                "landmarks": rows[(frame + 7 * which) % len(rows)],
            }
            sockets[which].send(msgspec.msgpack.encode(sample), zmq.NOBLOCK)
            sent += 1
        time.sleep(0.2)
    # Their own numbers are behind those of the samples.
    with Client(address, timeout=60.0) as watcher:
        mapped = 0
        for client in clients:
            assert client.opened is not None
            watcher.watch(client.opened.name)
            mapped += watcher.status().counts.get("steps", 0)
    for client in clients:
        client._seq = 2**50
        client.close()
    found.put((sent, mapped))


def _row(
    workers: int, runs: Sequence[dict[str, Any]], sessions: int, rate: float
) -> dict[str, Any]:
    """Summarise the turns of one server."""
    sent = sum(run["sent"] for run in runs)
    mapped = max(1, sum(run["mapped"] for run in runs))
    # A server that maps itself spends most on samples that are mapped.
    server = sum(run["server"] for run in runs) / (sent if workers else mapped)
    mapping = sum(run["workers"] for run in runs) / mapped
    stops = 1e3 * np.concatenate([run["stops"] for run in runs])
    # Each process has a core.
    busiest = max(server, mapping / max(1, workers))
    return {
        "workers": workers,
        "cores": workers + 1,
        "load": f"{sessions} sessions, {rate:g} Hz",
        "mapped_%": 100.0 * mapped / sent,
        "server_us": 1e6 * server,
        "worker_us": 1e6 * mapping,
        "sessions": math.floor(_MOST_LOAD / (busiest * rate)),
        "stop_p50_ms": float(np.percentile(stops, 50)),
        "stop_p99_ms": float(np.percentile(stops, 99)),
        "stop_max_ms": float(stops.max()),
    }
