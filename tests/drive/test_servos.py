"""Servos by their makers' packages, against emulated motors on a pseudo-terminal."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from handmap_drive import DRIVERS
from handmap_drive.driver import Driver, DriverError, Health
from handmap_drive.emulator import Emulator
from handmap_drive.servos import Servos
from patience import wait_until

from handmap_qp.errors import InvalidInputError

pytest.importorskip("dynamixel_sdk", reason="needs the packages of examples/drive")
pytest.importorskip("scservo_sdk", reason="needs the packages of examples/drive")

JOINTS = tuple(map(str, range(16)))
"""Joints of the LEAP hand, as its URDF names them."""
START = 0.3
FULL = {"dynamixel": 2352, "feetech": 1000}
UNIT = 2.0 * np.pi / 4096
"""Resolution of the encoders [rad]."""


def table(folder: Path, kind: str, **changes: object) -> Path:
    """Write a table of two motors, one of which turns the other way and twice as far."""
    file = folder / "motors.yaml"
    fields = {
        "bus": kind,
        "baud": 1000000,
        "rate": 100.0,
        "speed": 8.0,
        "effort": 0.2,
        "full": FULL[kind],
        "motors": "[{joint: [a], id: 0, zero: 3.14159, range: [-1, 1]},"
        " {joint: [b], id: 1, zero: 3.74159, ratio: -2, range: [-1, 1]}]",
    } | changes
    file.write_text("".join(f"{name}: {value}\n" for name, value in fields.items()))
    return file


@contextmanager
def two(folder: Path, kind: str) -> Iterator[tuple[Emulator, Servos]]:
    """Emulate two motors, and connect to them."""
    with Emulator(kind, "--ids", "0-1") as emulator:
        servos = Servos("leap", emulator.port, ("x", "b", "a"), table(folder, kind))
        servos.connect()
        yield emulator, servos


def seen(servos: Driver) -> tuple[np.ndarray, np.ndarray, Health]:
    """Read the motors; on a busy machine the emulator may be late."""

    def read() -> tuple[np.ndarray, np.ndarray, Health] | None:
        with suppress(DriverError):
            return servos.read()
        return None

    return wait_until(read)


def follow(servos: Servos, q: np.ndarray, effort: float, seconds: float = 0.5) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        servos.write(q, effort)
        seen(servos)


@pytest.mark.parametrize("kind", FULL)
def test_joints_go_where_they_are_told(kind: str, tmp_path: Path) -> None:
    with two(tmp_path, kind) as (emulator, servos):
        assert servos.joint_names == ("a", "b")
        q, effort, health = seen(servos)
        # zero - ratio: (0.3 - 0.6) / -2 of the second.
        np.testing.assert_allclose(q, [START, 0.15], atol=UNIT)
        np.testing.assert_array_equal(effort, [0.0, 0.0])
        np.testing.assert_array_equal(health.temperature, [30, 30])
        assert not emulator.order()["torque"].any()
        goal = np.array([-0.4, 0.5])
        follow(servos, goal, 0.2)
        np.testing.assert_allclose(seen(servos)[0], goal, atol=2.0 * UNIT)
        state = emulator.order()
        np.testing.assert_allclose(state["angle"], [-0.4, -0.4], atol=2.0 * UNIT)
        np.testing.assert_allclose(state["limit"], 0.2, atol=1e-3)
        servos.stop()
        seen(servos)
        assert not emulator.order()["torque"].any()


@pytest.mark.parametrize("kind", FULL)
def test_a_joint_that_is_blocked_presses_with_the_limit(
    kind: str, tmp_path: Path
) -> None:
    with two(tmp_path, kind) as (emulator, servos):
        emulator.order(wall={"0": [0.2, 0.5], "1": [0.0, 0.5]})
        # The motors would press with more: 0.6 of the largest torque per rad.
        follow(servos, np.array([-0.9, -0.9]), 0.1)
        _, effort, _ = seen(servos)
        state = emulator.order()
        np.testing.assert_allclose(state["effort"], [-0.1, 0.1], atol=2e-3)
        # As torques of joints, the second of which turns the other way.
        np.testing.assert_allclose(effort, [-0.1, -0.1], atol=2e-3)


@pytest.mark.parametrize("kind", FULL)
def test_lost_and_damaged_messages_are_never_a_wrong_position(
    kind: str, tmp_path: Path
) -> None:
    with two(tmp_path, kind) as (emulator, servos):
        emulator.order(loss=0.03, damage=0.05)
        lost = 0
        for i in range(150):
            servos.write(np.full(2, 0.15 + 0.001 * i), 0.2)
            try:
                q, _, health = servos.read()
            except DriverError:
                lost += 1
                continue
            assert (np.abs(q - 0.22) < 0.2).all()
            assert (health.temperature == 30).all()
        assert 0 < lost < 75
        emulator.order(loss=0.0, damage=0.0)
        servos.stop()
        seen(servos)
        assert not emulator.order()["torque"].any()


@pytest.mark.parametrize("kind", FULL)
def test_faults_of_motors_are_named(kind: str, tmp_path: Path) -> None:
    with two(tmp_path, kind) as (emulator, servos):
        follow(servos, np.array([0.3, 0.15]), 0.2, 0.1)
        emulator.order(temperature={"1": 75.0})
        follow(servos, np.array([0.3, 0.15]), 0.2, 0.1)
        _, _, health = seen(servos)
        assert health.faults == ("b: overheating",)
        np.testing.assert_array_equal(health.temperature, [30, 75])
        assert emulator.order()["torque"].tolist() == [True, False]
        emulator.order(wall={"0": [0.0, 0.3]})
        # Pressing with all its torque for a second.
        for _ in range(30):
            follow(servos, np.array([9.0, 0.15]), 1.0, 0.1)
            if len(faults := seen(servos)[2].faults) > 1:
                break
        assert faults == ("a: overload", "b: overheating")


def test_a_missing_motor_and_a_missing_port_are_named(tmp_path: Path) -> None:
    with two(tmp_path, "dynamixel") as (emulator, servos):
        emulator.order(silent=[1])
        with pytest.raises(DriverError, match=r"^motor 1: .*no status packet"):
            servos.read()
        with pytest.raises(DriverError, match=r"^motor 1: "):
            Servos(
                "leap", emulator.port, ("a", "b"), tmp_path / "motors.yaml"
            ).connect()
        emulator.order(unplug=True)
        with pytest.raises(OSError, match=r"."):
            follow(servos, np.array([0.3, 0.15]), 0.2)


def test_the_watchdog_of_the_motors_stops_them_and_is_armed_again(
    tmp_path: Path,
) -> None:
    with two(tmp_path, "dynamixel") as (emulator, servos):
        follow(servos, np.array([0.3, 0.15]), 0.2, 0.1)
        # On its way when messages end.
        servos.write(np.array([-1.0, 0.9]), 0.03)
        state = wait_until(
            lambda: (now := emulator.order())["goal"][0] > -0.99 and now,
            "the motors go on without their computer",
        )
        np.testing.assert_allclose(state["goal"], state["angle"], atol=0.2)
        seen(servos)
        follow(servos, np.array([0.5, 0.1]), 0.2)
        np.testing.assert_allclose(seen(servos)[0], [0.5, 0.1], atol=2.0 * UNIT)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"motors": "[]"}, "length >= 1"),
        ({"bus": "canopen"}, "Invalid enum value 'canopen'"),
        ({"currant": 3}, "unknown field `currant`"),
        (
            {"motors": "[{joint: [c], id: 0, zero: 0, range: [-1, 1]}]"},
            "expected joints of the session, a, b, got c",
        ),
    ],
)
def test_a_wrong_table_is_refused(
    changes: dict[str, object], text: str, tmp_path: Path
) -> None:
    with pytest.raises(InvalidInputError, match=text) as raised:
        Servos("leap", "/dev/null", ("a", "b"), table(tmp_path, "dynamixel", **changes))
    assert raised.value.argument == "--motors"
    with pytest.raises(InvalidInputError, match=r"expected a table of the servos"):
        DRIVERS["servos"]("/dev/null", ("a", "b"), None)
    with pytest.raises(InvalidInputError, match=r"no\.yaml: No such file"):
        Servos("leap", "/dev/null", ("a", "b"), tmp_path / "no.yaml")


@pytest.mark.parametrize("prefix", ["", "name"])
def test_the_table_of_the_leap_hand_is_of_both_models(prefix: str) -> None:
    fingers = [
        f"{f}_{j}" for f in ("if", "mf", "rf") for j in ("mcp", "rot", "pip", "dip")
    ]
    thumb = ["th_cmc", "th_axl", "th_mcp", "th_ipl"]
    joints = tuple(fingers + thumb) if prefix else JOINTS
    with Emulator("dynamixel") as emulator:
        servos = DRIVERS["leap"](emulator.port, joints, None)
        servos.connect()
        q, _, _ = seen(servos)
        np.testing.assert_allclose(q, START, atol=UNIT)
        assert sorted(servos.joint_names) == sorted(joints)
        # Motor 1 bends the index finger, motor 0 spreads it: LEAP_Hand_API.
        if prefix:
            assert servos.joint_names[:4] == ("if_rot", "if_mcp", "if_pip", "if_dip")


@pytest.mark.parametrize("kind", FULL)
def test_no_torque_before_its_limit_has_arrived(kind: str, tmp_path: Path) -> None:
    with two(tmp_path, kind) as (emulator, servos):
        emulator.order(deaf=[{"dynamixel": 102, "feetech": 48}[kind]])
        follow(servos, np.array([0.5, 0.5]), 0.1, 0.1)
        state = emulator.order(deaf=[])
        np.testing.assert_array_equal(state["limit"], 1.0)
        assert not state["torque"].any()
        follow(servos, np.array([0.5, 0.5]), 0.1, 0.1)
        state = emulator.order()
        np.testing.assert_allclose(state["limit"], 0.1, atol=1e-3)
        assert state["torque"].all()
