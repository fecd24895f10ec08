"""A simulated robot that follows a session of a real service."""

from __future__ import annotations

import runpy
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE, wait_until
from service_tools import address_of, client_of, serving

from handmap_qp import InvalidInputError, load_hand
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.client import Client
from handmap_qp.mapping.objects import Sphere

EXAMPLE = Path(__file__).parents[2] / "examples" / "10_simulated_robot.py"
StandIn = runpy.run_path(str(EXAMPLE), run_name="simulated_robot")["StandIn"]

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow


def simulator(robot: str = "three_finger") -> Simulator:
    return Simulator(load_hand(robot), Sphere(0.02), Physics(mass=0.05))


def test_the_stand_in_goes_where_the_commands_say() -> None:
    with (
        serving() as server,
        client_of(server) as tracker,
        Client(address_of(server)) as driver,
    ):
        tracker.open("three_finger", name="lab", preset="paper", is_shared=True)
        stand_in = StandIn(simulator(), driver, "lab")
        reports: list[Any] = []
        arrived = threading.Event()

        def follow() -> None:
            # In turns, because nothing but its time ends a run.
            while not arrived.is_set():
                stand_in.run(1.1, reports.append)

        worker = threading.Thread(target=follow)
        worker.start()
        try:
            wrist = np.eye(4)
            for k in range(41):
                wrist[0, 3] = 0.002 * k
                tracker.step(q=np.full(20, 0.2), wrist=wrist)
                time.sleep(0.02)

            def has_arrived() -> bool:
                tracker.step(q=np.full(20, 0.2), wrist=wrist)
                time.sleep(0.02)
                return (
                    bool(reports)
                    and reports[-1].commands > 20
                    and reports[-1].wrist_error < 5e-3
                )

            wait_until(has_arrived, "the stand-in does not arrive")
        finally:
            arrived.set()
            worker.join()
        command = tracker.step(q=np.full(20, 0.2), wrist=wrist)
        np.testing.assert_allclose(stand_in.simulator.q, command.q, atol=0.02)
        # It has said where its joints are.
        assert len(command.following_error) == len(command.q)


def test_a_session_of_another_robot_is_refused() -> None:
    with (
        serving() as server,
        client_of(server) as tracker,
        Client(address_of(server)) as driver,
    ):
        tracker.open("three_finger", name="lab", preset="paper")
        stand_in = StandIn(simulator("allegro_right"), driver, "lab")
        worker = threading.Timer(
            0.1, lambda: tracker.step(q=np.full(20, 0.2), wrist=np.eye(4))
        )
        worker.start()
        with pytest.raises(InvalidInputError, match="the robot of the session"):
            stand_in.run(PATIENCE, print)
        worker.join()
