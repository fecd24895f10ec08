"""Tracker, mapping service and robot driver as three parties on one machine.

In use they are three processes, and the service is started by `handmap serve`. Tracker and driver
need nothing but a copy of the folder `core/handmap_core/client`.

    python examples/08_tracker_service_driver.py
"""

import json
import subprocess
import sys

import numpy as np

from handmap_qp.client import Client

COMMAND = ["-m", "handmap_qp.cli", "serve"]
PORTS = ["--port", "0", "--stream-port", "0", "--health-port", "-1"]


def main() -> None:
    """Start the service, send samples, and read commands as a driver does."""
    command = [sys.executable, *COMMAND, *PORTS]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as service:
        try:
            assert service.stdout is not None
            ready = json.loads(service.stdout.readline())
            # A client learns the port of the stream from the service.
            talk(f"tcp://127.0.0.1:{ready['ports']['requests']}")
        finally:
            service.terminate()


def talk(address: str) -> None:
    """Send samples as a tracker does, and receive commands as a driver does."""
    with Client(address) as tracker, Client(address) as driver:
        tracker.open("three_finger", name="lab")
        driver.watch("lab")
        shares = np.linspace(0.0, 0.5, 30)
        answers = [
            tracker.step(q=np.full(20, share), wrist=np.eye(4)) for share in shares
        ]
        print(f"the tracker's last sample was answered: {answers[-1].status}")
        received = driver.latest(timeout=2.0)
        assert received is not None
        print(f"the driver moves {len(received.q)} joints, epoch {received.epoch}")


if __name__ == "__main__":
    main()
