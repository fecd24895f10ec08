"""Measure `handmap drive` from a recording to the joints of emulated motors.

The motors are `handmap_drive.emulator`: a LEAP hand with Dynamixel or Feetech servos, an Inspire
and an Ability hand, whose joints lag by 30 ms. Prints the tables of docs/measurements.md:
following and pinches on a bus that is good, slow or bad, and how long a stop takes to reach the
motors. All processes share one machine, with what else runs on it.

    python benchmarks drive_motors
    python benchmarks drive_motors --motors dynamixel --stops 20
"""

from __future__ import annotations

import argparse
import os
import signal
import threading
import time
from contextlib import AbstractContextManager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import handmap_drive
import msgspec
import numpy as np
from handmap_drive.demo import Chain, Driven, started
from handmap_drive.drive import HOLDING

from handmap_qp import read_recording
from handmap_qp.apps.tables import markdown_table
from handmap_qp.client import Client

MOTORS = {
    "dynamixel": "leap_right",
    "feetech": "leap_right",
    "inspire": "inspire_right",
    "ability": "ability_right",
}
"""Robot hand of each kind of motors."""
BUSES: dict[str, dict[str, float]] = {
    "good": {},
    "0.1 % lost, 0.1 % damaged": {"loss": 0.001, "damage": 0.001},
    "answers 0.5 ms late": {"latency": 0.0005},
}
PAUSE = 1.5
"""Time between two stops, in which motors drive again [s]."""


def chain_of(kind: str, folder: Path, **orders: float) -> AbstractContextManager[Chain]:
    """Return the chain of a kind of motors, to be started."""
    recording, servos = read_recording("demo", "right"), None
    if kind == "feetech":
        own = Path(handmap_drive.__file__).with_name("leap.yaml")
        table = msgspec.yaml.decode(own.read_bytes())
        table |= {"bus": kind, "baud": 1000000, "full": 1000, "setup": []}
        servos = (kind, folder / "feetech.yaml")
        servos[1].write_bytes(msgspec.yaml.encode(table))
    return started(MOTORS[kind], recording, servos, **orders)


def following(kind: str, bus: str, driven: Driven) -> dict[str, Any]:
    """Return a row about following."""
    count, share = driven.pinches()
    said = driven.summary
    return {
        "motors": kind,
        "bus": bus,
        "rate [Hz]": said["rate [Hz]"],
        "age of commands, p50 / p95 [ms]": f"{said['age of commands, median [ms]']:.1f} / "
        f"{said['age of commands, 95 % [ms]']:.1f}",
        "joints behind commands [ms]": 1e3 * driven.delay,
        "error then, RMS [rad]": driven.rms,
        "pinches closed": f"{share:.2f} of {count}",
        "answers lost": said["answers lost"],
        "stops": said["stops"],
    }


def stops(chain: Chain, count: int) -> tuple[Driven, dict[str, list[float]]]:
    """Stop in different ways while the hand moves; return what happened, and when."""
    over = threading.Event()
    rows = []

    def lead() -> None:
        while not over.is_set():
            rows.append(chain.lead())

    leading = threading.Thread(target=lead)
    leading.start()
    times: dict[str, list[float]] = {"message": [], "frozen": []}
    with Client(chain.client.address, timeout=10.0) as page:
        page.watch("demo")
        for _ in range(count):
            time.sleep(PAUSE)
            times["message"].append(time.monotonic())
            page.stop()
            time.sleep(PAUSE)
            page.clear(page.status().stop)
            page.clutch()
            time.sleep(PAUSE)
            times["frozen"].append(time.monotonic())
            chain.service.send_signal(signal.SIGSTOP)
            time.sleep(PAUSE)
            chain.service.send_signal(signal.SIGCONT)
    over.set()
    leading.join()
    return chain.end(*rows[0]), times


def reached(driven: Driven, starts: list[float], limit: float) -> list[float]:
    """Return the time from each start until no motor has more torque than a limit [s]."""
    times, largest = driven.log_time, driven.torque.max(axis=1)
    found = []
    for start in starts:
        after = (times >= start) & (largest <= limit)
        found.append(times[after][0] - start if after.any() else np.inf)
    return found


def stopping(kind: str, driven: Driven, times: dict[str, list[float]]) -> list[Any]:
    """Return rows about stops."""
    largest = driven.torque.max(axis=1)
    held = HOLDING * largest.max() + 1e-3
    found = {
        "`client.stop()` to no torque": reached(driven, times["message"], 0.0),
        "SIGSTOP of the service to no torque": reached(driven, times["frozen"], 0.0),
    }
    # An Ability hand has no limit of torque to read.
    if ((largest > 0.0) & (largest <= held)).any():
        less = reached(driven, times["frozen"], held)
        found["SIGSTOP of the service to a third of the torque"] = less
    return [
        {
            "motors": kind,
            "stop": name,
            "median [ms]": 1e3 * np.median(ms),
            "largest [ms]": 1e3 * max(ms),
        }
        for name, ms in found.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="Motors by `handmap drive`.")
    parser.add_argument("--motors", nargs="+", default=[*MOTORS], choices=MOTORS)
    parser.add_argument("--stops", type=int, default=10)
    given = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n", flush=True)
    follows, stopped = [], []
    with TemporaryDirectory() as name:
        for kind in given.motors:
            for bus, orders in BUSES.items():
                with chain_of(kind, Path(name), **orders) as chain:
                    chain.approach()
                    driven = chain.end(*chain.lead())
                follows.append(following(kind, bus, driven))
            with chain_of(kind, Path(name)) as chain:
                chain.approach()
                stopped += stopping(kind, *stops(chain, given.stops))
    print(markdown_table(follows), "\n")
    print(markdown_table(stopped))


if __name__ == "__main__":
    main()
