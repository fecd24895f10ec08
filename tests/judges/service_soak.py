"""An hour of everything at once: memory, open files and latency of the service stay flat.

Well-behaved clients at 60 Hz run beside clients that open, change and close sessions, vanish, send
invalid messages, subscribe, and press the emergency stop. The exit code is 1 if memory grows by
more than 15 MB after the first quarter, files stay open, a robot exceeds its limits, or the service
logs a failure.

    python tests/judges service_soak --json soak.json
    python tests/judges service_soak --duration 300
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import common
import numpy as np
import zmq
from service_clients import TIMEOUT, HumanMotion, honest, summary
from service_faults import ask_and_reset
from service_invalid import InvalidMessages
from service_process import ServiceProcess, serving

from handmap_qp.client import Client, ServiceError, ServiceTimeoutError

_KEPT = 40
_HANDS = ("three_finger", "allegro_right", "hey5")


class Disturber(threading.Thread):
    """Does one thing after the other, about ten times a second.

    Args:
        service: The service.
    """

    def __init__(self, service: ServiceProcess) -> None:
        super().__init__(daemon=True)
        self._service, self._ended = service, threading.Event()
        self.done = Counter[str]()
        self._invalid = InvalidMessages("a-secret-that-nobody-has-1234", "nobody", 0)
        self._motion = HumanMotion(7)

    def run(self) -> None:
        """Work until `end`."""
        works = (
            self._session,
            self._vanish,
            self._send_invalid,
            self._subscribe,
            self._emergency,
        )
        for number in range(10**9):
            if self._ended.wait(0.1):
                return
            work = works[number % len(works)]
            try:
                work(number)
                self.done[work.__name__.strip("_")] += 1
            except (ServiceError, ServiceTimeoutError, OSError) as error:
                self.done[f"{work.__name__.strip('_')}: {type(error).__name__}"] += 1

    def fill_caches(self) -> None:
        """Open as many different sessions as the service keeps hands of."""
        for number in range(_KEPT):
            with suppress(ServiceError, ServiceTimeoutError):
                self._session(5 * number)

    def end(self) -> None:
        """Stop."""
        self._ended.set()
        self.join(10.0)

    def _session(self, number: int) -> None:
        with Client(self._service.address, timeout=5.0) as client:
            length = 0.16 + 0.0005 * (number % 60)
            client.open(_HANDS[number // 5 % len(_HANDS)], hand_length=length)
            for i in range(5):
                client.step(**self._motion(0.02 * i))
            client.configure(ik={"rest_weight": 0.1 + 0.01 * (number % 10)})
            client.clutch()

    def _vanish(self, number: int) -> None:
        ask_and_reset(self._service.ports["web"], number)

    def _send_invalid(self, _: int) -> None:
        with zmq.Context.instance().socket(zmq.DEALER) as socket:
            socket.linger = 0
            socket.connect(self._service.address)
            for _ in range(50):
                socket.send(self._invalid())
            time.sleep(0.02)

    def _subscribe(self, _: int) -> None:
        with zmq.Context.instance().socket(zmq.SUB) as socket:
            socket.linger = 0
            socket.connect(f"tcp://127.0.0.1:{self._service.ports['stream']}")
            socket.subscribe(b"honest-0\0")
            socket.poll(200)

    def _emergency(self, _: int) -> None:
        with Client(self._service.address, timeout=5.0) as client:
            client.open("three_finger", name="stopped")
            client.stop(reason="soak")
            client.clear(client.status().stop)


class Course(NamedTuple):
    """What a soak measured over time.

    Attributes:
        minutes: Times of memory and files [min].
        memory: Memory of the service [MB].
        files: Files that it had open.
        waits: Times of the calls of each client, in their order [ms].
    """

    minutes: np.ndarray
    memory: np.ndarray
    files: np.ndarray
    waits: list[np.ndarray]


def soak(duration: float) -> tuple[dict[str, Any], Course]:
    """Run for a time [s]; return the figures, and their course."""
    with tempfile.TemporaryDirectory() as folder:
        files = {"state": Path(folder) / "state", "audit": Path(folder) / "audit.jsonl"}
        with (
            serving(web=True, web_port=0, idle=5.0, **files) as service,
            honest(service, 3) as clients,
        ):
            disturber = Disturber(service)
            disturber.fill_caches()
            disturber.start()
            memory: list[float] = []
            opened: list[int] = []
            end = time.monotonic() + duration
            while time.monotonic() < end:
                time.sleep(min(1.0, duration / 60.0))
                memory.append(service.memory())
                opened.append(service.files())
            disturber.end()
            waits = [1e3 * np.array(client.times) for client in clients]
    times = np.concatenate(waits)
    quarter = len(memory) // 4
    later = np.array(memory[quarter:])
    hours = np.arange(len(later)) * duration / len(memory) / 3600.0
    slope = float(np.polyfit(hours, later, 1)[0]) if len(later) > 2 else 0.0
    found = summary(
        clients,
        memory_start_MB=memory[0],
        memory_end_MB=memory[-1],
        memory_growth_MB=max(
            0.0, float(np.median(later[-10:]) - np.median(later[:10]))
        ),
        memory_slope_MB_per_h=slope,
        files_growth=max(opened[-10:]) - max(opened[quarter : quarter + 10]),
        failures=len(service.failures),
        **{f"p{p:g}_ms": float(np.percentile(times, p)) for p in (50, 99, 99.9, 100)},
        disturbances=dict(disturber.done),
        seconds=duration,
    )
    for line in service.failures[:5]:
        print(line, file=sys.stderr)
    if found["files_growth"] > 10:
        found["wrong"].append("files stayed open")
    if not disturber.done["session"]:
        found["wrong"].append("no disturbance")
    with suppress(ValueError):
        # A client that timed out has missed a command, which is not a jump.
        if found["timeouts"]:
            found["wrong"].remove("a robot jumped")
    minutes = np.linspace(0.0, duration / 60.0, len(memory))
    return found, Course(minutes, np.array(memory), np.array(opened), waits)


def draw(course: Course) -> Any:
    """Draw memory, open files and the times of calls over the time of a soak."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    above, middle, below = figure.subplots(3, sharex=True)
    above.plot(course.minutes, course.memory, color=common.PALETTE[0])
    above.set(ylabel="memory [MB]", ylim=(0.0, 1.15 * course.memory.max()))
    middle.plot(course.minutes, course.files, color=common.PALETTE[1])
    middle.set(ylabel="open files", ylim=(0.0, 1.15 * course.files.max()))
    for share, colour in ((50.0, 0), (99.0, 1), (100.0, 3)):
        parts = [np.array_split(waits, 60) for waits in course.waits]
        together = [np.concatenate(part) for part in zip(*parts, strict=True)]
        values = [np.percentile(part, share) for part in together if len(part)]
        places = (np.arange(len(values)) + 0.5) * course.minutes[-1] / len(values)
        label = "largest" if share == 100.0 else f"p{share:g}"
        below.plot(places, values, color=common.PALETTE[colour], label=label)
    below.set(xlabel="time [min]", ylabel="time of a call [ms]", yscale="log")
    below.legend()
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Soak, print the table."""
    parser = common.make_parser("An hour of everything at once.")
    parser.add_argument(
        "--duration", type=float, default=3600.0, metavar="S", help="time [s]"
    )
    arguments = common.parse_arguments(parser, words)
    found, course = soak(20.0 if arguments.quick else arguments.duration)
    rows = [
        {
            "what": key,
            "value": ", ".join(map(str, value)) if isinstance(value, list) else value,
        }
        for key, value in found.items()
        if not isinstance(value, dict)
    ]
    rows += [
        {"what": f"did: {k}", "value": v} for k, v in found["disturbances"].items()
    ]
    title = ", ".join(found["wrong"]) or "all well"
    common.print_table(f"soak, {TIMEOUT:g} s timeout: {title}", rows)
    common.write_json(arguments.json, "service_soak", found)
    common.save_picture(arguments.picture, lambda: draw(course))
    if found["wrong"]:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
