"""What fingers feel, from the motors to who subscribed: `handmap drive --haptics` as a process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from handmap_drive.processes import Emulator
from patience import kept_going, wait_until
from service_tools import address_of, client_of, connected, human_q, serving

from handmap_qp import load_hand
from handmap_qp.apps.service.haptics import finger_names, fingers_by_joint
from handmap_qp.apps.service.server import Server
from handmap_qp.client import Client
from handmap_qp.client.messages import Haptics
from handmap_qp.hands import load_robot

pytest.importorskip("dynamixel_sdk", reason="needs packages/drive and what it installs")
pytestmark = pytest.mark.slow

ALONE = ("f1_proximal", "f1_distal", "f3_proximal", "f3_distal", "f2_proximal")
"""Joints of thumb, index and middle finger of the hand with three fingers."""
OF_TWO = ("left_th_mcp", "left_if_mcp", "right_th_mcp", "right_if_mcp", "right_rf_mcp")
WORKERS: dict[str, Any] = {"workers": 2, "max_load": 1.0}


class Driven(NamedTuple):
    """A session whose motors are driven, with what they say.

    Attributes:
        reader: A client that has subscribed to what the fingers feel.
        emulator: The motors, one for each joint, numbered from 0.
        process: `handmap drive --haptics`.
    """

    reader: Client
    emulator: Emulator
    process: subprocess.Popen[str]

    def felt(self) -> Haptics | None:
        """Return what fingers feel now; None if nothing arrives."""
        assert self.process.poll() is None, self.process.stderr
        return self.reader.haptics(0.5)

    def wait_for_load(self, fingers: set[str]) -> Haptics:
        """Wait until exactly these fingers have a load that can be felt."""

        def loaded() -> Haptics | None:
            found = self.felt()
            if found is None:
                return None
            return found if {*over(found.efforts)} == fingers else None

        return wait_until(loaded, f"no load of {fingers}")


def over(efforts: Mapping[str, float], least: float = 0.08) -> list[str]:
    """Return the fingers whose load is more than that of joints that only move."""
    return [name for name, effort in efforts.items() if effort > least]


@contextmanager
def driven(server: Server, joints: tuple[str, ...], folder: Path) -> Iterator[Driven]:
    """Drive motors of some joints of the session `lab`."""
    motors = [
        {"joint": [name], "id": i, "zero": 3.14159, "range": [-3, 3]}
        for i, name in enumerate(joints)
    ]
    table: dict[str, Any] = {"bus": "dynamixel", "baud": 1000000, "motors": motors}
    table |= {"rate": 80.0, "speed": 8.0, "effort": 0.15, "full": 2352, "patience": 5.0}
    file = folder / "motors.yaml"
    file.write_text(json.dumps(table))
    last = str(len(joints) - 1)
    words = ["drive", "lab", "--driver", "servos", "--motors", str(file)]
    words += ["--from", address_of(server), "--no-deadman", "--haptics"]
    with (
        Emulator("dynamixel", "--ids", f"0-{last}", "--angle", "0.3") as emulator,
        client_of(server) as reader,
        subprocess.Popen(
            [sys.executable, "-m", "handmap_qp.cli", *words, "--port", emulator.port],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        ) as process,
    ):
        try:
            reader.watch("lab")
            wait_until(lambda: bool(emulator.order()["torque"].all()), "no torque")
            yield Driven(reader, emulator, process)
        finally:
            process.terminate()
            process.communicate()


@contextmanager
def one_hand(server: Server) -> Iterator[Client]:
    """Hold a hand with three fingers still."""
    with (
        connected(server, name="lab", is_shared=True) as owner,
        kept_going(lambda: owner.step(q=human_q(), wrist=np.eye(4)), 0.015),
    ):
        yield owner


@contextmanager
def two_hands(server: Server) -> Iterator[Client]:
    """Hold both hands of a robot still."""
    human = load_hand("human", points="landmarks")
    points = human.points(human.rest)
    random = np.random.default_rng(0)

    def hands() -> dict[str, dict[str, np.ndarray]]:
        # Landmarks that repeat exactly would be frozen data.
        return {
            side: {"landmarks": points + random.normal(0.0, 1e-5, points.shape)}
            for side in ("left", "right")
        }

    choices: dict[str, Any] = {"input": "landmarks", "preset": None, "is_shared": True}
    with (
        connected(server, "panda_pair", name="lab", **choices) as owner,
        kept_going(lambda: owner.step(hands=hands()), 0.03),
    ):
        yield owner


@pytest.mark.parametrize("settings", [{}, WORKERS], ids=["alone", "workers"])
def test_a_finger_that_meets_an_obstacle_is_felt(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    fingers = ["thumb", "thumb", "index", "index", "middle"]
    with (
        serving(**settings) as server,
        one_hand(server),
        driven(server, ALONE, tmp_path) as chain,
    ):
        found = chain.wait_for_load(set())
        # Every finger that has a motor, by the names of the hand.
        assert [*found.efforts] == list(dict.fromkeys(fingers))
        assert (found.name, found.forces) == ("lab", {})
        # Hold the distal joint of the index finger where it does not want to be.
        away = float(chain.emulator.order()["angle"][3]) - 0.4
        chain.emulator.order(wall={"3": [away - 0.01, away]})
        found = chain.wait_for_load({"index"})
        assert all(0.0 <= effort <= 1.0 for effort in found.efforts.values())
        chain.emulator.order(wall={"3": [-3.0, 3.0]})
        chain.wait_for_load(set())
        # A stop takes the torque away, and with it what is felt.
        chain.emulator.order(wall={"3": [away - 0.01, away]})
        chain.wait_for_load({"index"})
        chain.reader.stop("lab")
        chain.wait_for_load(set())


def test_each_hand_of_a_robot_with_two_is_felt_by_its_side(tmp_path: Path) -> None:
    with (
        serving() as server,
        two_hands(server),
        driven(server, OF_TWO, tmp_path) as chain,
    ):
        found = chain.wait_for_load(set())
        assert [*found.efforts] == [
            *("left.thumb", "left.index", "right.thumb", "right.index", "right.ring")
        ]
        away = float(chain.emulator.order()["angle"][3]) - 0.4
        chain.emulator.order(wall={"3": [away - 0.01, away]})
        chain.wait_for_load({"right.index"})


def test_a_session_that_takes_no_loads_is_named_once(tmp_path: Path) -> None:
    with (
        serving() as server,
        connected(server, name="lab") as owner,
        kept_going(lambda: owner.step(q=human_q(), wrist=np.eye(4)), 0.015),
        driven(server, ALONE, tmp_path) as chain,
    ):
        assert chain.process.stderr is not None
        line = next(each for each in chain.process.stderr if "fingers feel" in each)
        assert line.startswith("handmap: the session does not take what the fingers")
        assert chain.felt() is None


def test_motors_of_no_finger_are_refused_before_they_are_connected(
    tmp_path: Path,
) -> None:
    with serving() as server, two_hands(server), Emulator("dynamixel") as emulator:
        file = tmp_path / "arm.yaml"
        motor = {
            "joint": ["left_panda_joint1"],
            "id": 0,
            "zero": 3.14,
            "range": [-3, 3],
        }
        table = {"bus": "dynamixel", "baud": 1000000, "full": 2352, "motors": [motor]}
        file.write_text(json.dumps(table | {"rate": 80.0, "speed": 1, "effort": 0.1}))
        words = ["drive", "lab", "--driver", "servos", "--motors", str(file)]
        words += ["--from", address_of(server), "--port", emulator.port, "--haptics"]
        done = subprocess.run(
            [sys.executable, "-m", "handmap_qp.cli", *words, "--no-deadman"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 2
        assert "--haptics: expected motors of fingers" in done.stderr.splitlines()[-1]
        assert not emulator.order()["torque"].any()


@pytest.mark.parametrize("name", ["panda_pair", "three_finger"])
def test_a_session_says_the_fingers_of_its_joints(name: str) -> None:
    robot = load_robot(name) if name == "panda_pair" else load_hand(name)
    fingers = fingers_by_joint(robot)
    assert {*fingers.values()} == {*finger_names(robot)}
    assert {*fingers} <= {*robot.joint_names}
