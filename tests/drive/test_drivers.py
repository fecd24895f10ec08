"""Drivers by their packages, against emulated motors on a pseudo-terminal or on loopback."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import Mock, call, patch

import numpy as np
import pytest
from handmap_drive import DRIVERS, inspire
from handmap_drive.ability import FLAG, STATE, Ability, stuffed, unstuffed
from handmap_drive.driver import DriverError, Health
from handmap_drive.inspire import Inspire
from handmap_drive.motors import read_motors
from handmap_drive.servos import FAMILIES, Servos
from motor_threads import START, MotorThread
from patience import wait_until

from handmap_qp import load_hand
from handmap_qp.errors import HandmapError, InvalidInputError

for module in ("dynamixel_sdk", "scservo_sdk", "pymodbus"):
    pytest.importorskip(module, reason="needs packages/drive and what it installs")

PATIENCE = 5.0
"""Longest wait for an answer, where none is to be missed [s]."""
IMPATIENT = 0.05
"""Likewise in tests in which messages get lost: about that of the drivers themselves [s]."""
JOINTS = tuple(map(str, range(16)))
"""Joints of the LEAP hand, as its URDF names them."""
UNIT = 2.0 * np.pi / 4096
"""Resolution of the emulated motors [rad]; encoders are not coarser."""


class Kind(NamedTuple):
    """What differs between motors.

    Attributes:
        driver: Their driver.
        bus: Its name in a table.
        full: Units of the largest torque.
        places: Zero and ratio of two joints; the second turns the other way and twice as far.
        overload: What a motor says that presses for too long.
        overheating: What a motor says that is too hot.
        limit: Register of the limit of torque, if they have one.
    """

    driver: Any
    bus: str
    full: int
    places: list[tuple[float, float]]
    overload: str = "overload"
    overheating: str = "overheating"
    limit: int = 0


SERVO_PLACES = [(np.pi, 1.0), (np.pi + 0.6, -2.0)]
# 1000 units are 1.47 rad, and count down.
INSPIRE = Kind(
    Inspire,
    "inspire",
    1000,
    [(1000.0, -1000.0 / 1.47), (1000.0 - 600.0 / 1.47, 2000.0 / 1.47)],
    overload="locked rotor",
    limit=1498,
)
KINDS = {
    "dynamixel": Kind(Servos, "dynamixel", 2352, SERVO_PLACES, limit=102),
    "feetech": Kind(Servos, "feetech", 1000, SERVO_PLACES, limit=48),
    "inspire": INSPIRE,
    "inspire-tcp": INSPIRE,
    "ability": Kind(
        Ability,
        "ability",
        621,
        [(0.0, 1.0), (0.6, -2.0)],
        overload="too hot, or a collision",
        overheating="too hot, or a collision",
    ),
}
MOTORS = [name for name in KINDS if not name.endswith("-tcp")]
LIMITED = [name for name in MOTORS if KINDS[name].limit]


def table(folder: Path, kind: str, **changes: object) -> Path:
    """Write a table of two motors, one of which turns the other way and twice as far."""
    file = folder / "motors.yaml"
    bus = KINDS[kind]
    fields: dict[str, Any] = {
        "bus": bus.bus,
        "address": 80 if kind == "ability" else 1,
        "baud": 1000000,
        "rate": 100.0,
        "speed": 8.0,
        "effort": 0.2,
        "full": bus.full,
        # Emulated motors answer when the machine gives them a turn.
        "patience": PATIENCE,
        "motors": [
            {"joint": [name], "id": i, "zero": zero, "ratio": ratio, "range": [-1, 1]}
            for i, (name, (zero, ratio)) in enumerate(
                zip("ab", bus.places, strict=True)
            )
        ],
    }
    # JSON is YAML but for this.
    file.write_text(json.dumps(fields | changes).replace("NaN", ".nan"))
    return file


@contextmanager
def two(
    folder: Path, kind: str, patience: float = PATIENCE
) -> Iterator[tuple[MotorThread, Any]]:
    """Emulate motors, and connect to two of them."""
    file = table(folder, kind, patience=patience)
    with (
        MotorThread(kind) as emulator,
        connected(emulator, file, kind) as motors,
    ):
        yield emulator, motors


@contextmanager
def connected(emulator: MotorThread, file: Path, kind: str) -> Iterator[Any]:
    """Connect to two motors; where a driver is impatient, a busy machine may be late."""
    with made(emulator, file, kind) as motors:
        wait_until(lambda: is_connected(motors))
        yield motors


@contextmanager
def made(emulator: MotorThread, file: Path, kind: str) -> Iterator[Any]:
    """Make a driver of two motors, which is not connected yet."""
    motors = KINDS[kind].driver("", emulator.port, ("x", "b", "a"), file)
    try:
        yield motors
    finally:
        if isinstance(motors, Inspire):
            motors._client.close()


def is_connected(motors: Any) -> bool:
    """Connect, unless an answer is missing."""
    try:
        motors.connect()
    except DriverError:
        # The next attempt opens the port again, which has one driver.
        if isinstance(motors, Inspire):
            motors._client.close()
        elif isinstance(motors, Servos):
            motors._port.closePort()
        else:
            motors._port.close()
        return False
    return True


@pytest.mark.parametrize("kind", KINDS)
def test_a_driver_that_missed_an_answer_connects_again(
    kind: str, tmp_path: Path
) -> None:
    file = table(tmp_path, kind, patience=IMPATIENT)
    with MotorThread(kind) as emulator, made(emulator, file, kind) as own:
        emulator.order(silent=[1])
        assert not is_connected(own)
        emulator.order(silent=[])
        wait_until(lambda: is_connected(own))
        assert len(seen(own)[0]) == 2


def seen(motors: Any) -> tuple[np.ndarray, np.ndarray, Health]:
    """Read the motors; on a busy machine the emulator may be late."""

    def read() -> tuple[np.ndarray, np.ndarray, Health] | None:
        with suppress(DriverError):
            return motors.read()
        return None

    return wait_until(read)


def follow(
    motors: Any, q: np.ndarray, effort: float, is_over: Callable[[], object]
) -> None:
    """Write goals and read the motors until a condition holds."""

    def is_over_then() -> bool:
        motors.write(q, effort)
        seen(motors)
        return bool(is_over())

    wait_until(is_over_then, "the motors do not follow")


def arrive(motors: Any, q: np.ndarray, effort: float) -> None:
    """Write goals until the joints are there."""
    follow(motors, q, effort, lambda: np.allclose(seen(motors)[0], q, atol=2.0 * UNIT))


def get_torque(
    emulator: MotorThread, motors: Any, q: np.ndarray, effort: float
) -> None:
    """Write goals until both motors have torque, and the driver has seen it."""
    follow(
        motors,
        q,
        effort,
        lambda: all(pushing(emulator)) and not seen(motors)[2].unpowered,
    )


def pushing(emulator: MotorThread, **orders: Any) -> list[bool]:
    """Return which of the two motors can have a torque."""
    return emulator.order(**orders)["torque"][:2].tolist()


DYNAMIXEL = {
    "torque": "Torque Enable",
    "fault": "Hardware Error Status",
    "watchdog": "Bus Watchdog",
    "limit": "Goal Current",
    "goal": "Goal Position",
    "effort": "Present Current",
    "position": "Present Position",
    "temperature": "Present Temperature",
}
"""Names of registers in the maker's control table."""
FEETECH = {
    "torque": (40, 1),
    "goal": (42, 2),
    "limit": (48, 2),
    "position": (56, 2),
    "effort": (60, 2),
    "temperature": (63, 1),
    "fault": (65, 1),
}
"""Address and bytes in the memory table of the STS3215."""


def registers(family: str) -> dict[str, tuple[int, int]]:
    """Return address and bytes of each register, which drivers and emulated motors share."""
    fields = FAMILIES[family].layout.fields
    return {name: (at, form.itemsize) for name, (form, at) in fields.items()}


def test_registers_of_servos_are_those_of_the_makers() -> None:
    assert registers("feetech") == FEETECH
    try:
        package = resources.files("dynamixel_easy_sdk")
    except ModuleNotFoundError:
        pytest.skip("this dynamixel-sdk has no control tables")
    table = (package / "control_table/xc330_m288.model").read_text()
    rows = [line.split("\t") for line in table.splitlines() if line[:1].isdigit()]
    sizes = {name: (int(at), int(size)) for at, size, name in rows}
    own = registers("dynamixel")
    assert own == {name: sizes[theirs] for name, theirs in DYNAMIXEL.items()}
    assert sizes["Operating Mode"] == (11, 1)


def test_an_emulated_dynamixel_refuses_what_a_real_one_does() -> None:
    # It needs packages/drive and what it installs.
    from handmap_drive.emulated_servos import Dynamixel

    servos = Dynamixel(range(1), START)
    assert servos.write(0, 11, b"\x05") == 0
    assert servos.write(0, 102, (2353).to_bytes(2, "little")) == 6
    # Armed, and with torque.
    assert servos.write(0, 98, b"\x0a") == servos.write(0, 64, b"\x01") == 0
    servos.take()
    assert servos.write(0, 11, b"\x05") == 7
    # Goals are read-only after the watchdog, until it is cleared.
    servos.move(0.004, servos.heard + 0.19)
    assert servos.write(0, 116, bytes(4)) == 0
    servos.move(0.004, servos.heard + 0.21)
    assert servos.write(0, 116, bytes(4)) == servos.write(0, 102, bytes(2)) == 4
    assert servos.write(0, 98, b"\x00") == servos.write(0, 116, bytes(4)) == 0


def test_emulated_motors_that_had_no_turn_hear_what_came_meanwhile() -> None:
    # It needs packages/drive and what it installs.
    from handmap_drive.emulator import Bus

    bus = Bus("dynamixel", range(1), START)
    try:
        # As if this process had had no turn for a second.
        bus.then -= 1.0
        start = bus.motors.heard = bus.then
        bus.advance()
        assert bus.then - start < 0.03
        # It looks at the port between such steps, and they reach the present.
        for _ in range(200):
            bus.advance()
        assert bus.then - start > 0.9
    finally:
        bus.line.close()


def test_registers_of_an_inspire_hand_are_those_of_the_manual() -> None:
    assert (inspire.ANGLE_SET, inspire.FORCE_SET, inspire.SPEED_SET) == (
        1486,
        1498,
        1522,
    )
    words, data = {1522: "<i2", 1546: "<i2", 1582: "<i2"}, {1606: "u1", 1618: "u1"}
    assert words | data == inspire.FORMS
    assert inspire.HOLD == 0xFFFF


def test_messages_of_the_ability_hand_are_those_of_the_document() -> None:
    assert stuffed(b"\x50\xa2").hex() == "7e50a20e7e"
    # A flag becomes 7d 5e, an escape 7d 5d.
    assert stuffed(b"\x7e\x7d").hex() == "7e7d5e7d5d057e"
    assert unstuffed(b"\x7d\x5e\x7d\x5d\x05") == b"\x7e\x7d"
    answer = bytes(range(38))
    state = np.frombuffer(answer, STATE)[0]
    assert state["motor"]["position"][5] == int.from_bytes(answer[21:23], "little")
    assert state["motor"]["current"][5] == int.from_bytes(answer[23:25], "little")
    assert state["hot"] == 37


@pytest.mark.parametrize("kind", KINDS)
def test_joints_go_where_they_are_told(kind: str, tmp_path: Path) -> None:
    with two(tmp_path, kind) as (emulator, motors):
        assert motors.joint_names == ("a", "b")
        q, effort, health = seen(motors)
        # zero - ratio: (0.3 - 0.6) / -2 of the second.
        np.testing.assert_allclose(q, [START, 0.15], atol=UNIT)
        np.testing.assert_array_equal(effort, [0.0, 0.0])
        if kind != "ability":
            np.testing.assert_array_equal(health.temperature, [30, 30])
        assert not any(pushing(emulator))
        goal = np.array([0.9, -0.2])
        arrive(motors, goal, 0.2)
        # The second motor moves twice as far, and is a step later there.
        wait_until(
            lambda: np.allclose(
                emulator.order()["angle"][:2], [0.9, 1.0], atol=2.0 * UNIT
            )
        )
        state = emulator.order()
        if KINDS[kind].limit:
            np.testing.assert_allclose(state["limit"][:2], 0.2, atol=1e-3)
        motors.stop()
        seen(motors)
        assert not any(pushing(emulator))
        # And again, with the same limit.
        arrive(motors, np.array([0.3, 0.15]), 0.2)


@pytest.mark.parametrize("kind", MOTORS)
def test_motors_that_are_stopped_on_their_way_stay_there(
    kind: str, tmp_path: Path
) -> None:
    with two(tmp_path, kind) as (emulator, motors):

        def go(goal: list[float], is_there: Callable[[float], bool]) -> None:
            wait_until(
                lambda: (
                    motors.write(np.array(goal), 0.5) or is_there(seen(motors)[0][0])
                )
            )

        def is_stopped_on_its_way() -> bool:
            """Start and stop. On a busy machine the motor may arrive before it is stopped."""
            go([START, START], lambda angle: angle < 0.5)
            go([1.3, -0.3], lambda angle: angle > 0.5)
            motors.stop()
            # Only where a message was lost is it said again.
            wait_until(lambda: not any(pushing(emulator)) or motors.stop())
            return emulator.order()["angle"][0] < 1.2

        wait_until(is_stopped_on_its_way)
        state = emulator.order()
        before = state["angle"]
        # A hand without an order for no torque gets a goal where it is.
        if kind == "inspire":
            np.testing.assert_allclose(state["goal"], before, atol=2.0 * UNIT)
        time.sleep(0.1)
        np.testing.assert_allclose(emulator.order()["angle"], before, atol=2.0 * UNIT)


@pytest.mark.parametrize("kind", MOTORS)
def test_a_joint_that_is_blocked_presses_with_the_limit(
    kind: str, tmp_path: Path
) -> None:
    with two(tmp_path, kind) as (emulator, motors):
        # Farther than any of them can be told, and back.
        far, back = np.array([9.0, -9.0]), np.array([-0.3, 0.45])
        emulator.order(wall={"0": [0.3, 0.5], "1": [0.3, 0.5]})
        motors.write(far, 0.1)
        # The motors would press with more: 0.6 of the largest torque per rad.
        wait_until(lambda: (emulator.order()["goal"][:2] > 1.0).all())
        for goal, wall, side in ((far, [0.3, 0.5], 0.1), (back, [0.7, 0.9], -0.1)):
            emulator.order(wall={"0": wall, "1": wall})
            # As torques of joints, the second of which turns the other way.
            torques = [side, -side]
            follow(
                motors,
                goal,
                0.1,
                lambda side=side, torques=torques: (
                    np.allclose(emulator.order()["effort"][:2], side, atol=2e-3)
                    and np.allclose(seen(motors)[1], torques, atol=2e-3)
                ),
            )
            # It never presses with more.
            for _ in range(10):
                motors.write(goal, 0.1)
                seen(motors)
                pressed = emulator.order()["effort"][:2]
                assert (np.abs(pressed) < 0.1 + 2e-3).all()


@pytest.mark.parametrize("kind", KINDS)
def test_lost_and_damaged_messages_are_never_a_wrong_position(
    kind: str, tmp_path: Path
) -> None:
    with two(tmp_path, kind, IMPATIENT) as (emulator, motors):
        for orders in ({"loss": 0.06, "damage": 0.0}, {"loss": 0.0, "damage": 0.1}):
            emulator.order(**orders)
            lost = 0
            for i in range(25):
                motors.write(np.full(2, 0.15 + 0.004 * i), 0.2)
                try:
                    q, _, health = motors.read()
                except DriverError:
                    lost += 1
                    continue
                assert (np.abs(q - 0.22) < 0.2).all()
                if kind != "ability":
                    assert (health.temperature == 30).all()
                assert not health.faults
            # On a busy machine answers may be late, too.
            assert 0 < lost < 25
        emulator.order(damage=0.0)
        motors.stop()
        seen(motors)
        assert not any(pushing(emulator))


def test_a_damaged_message_of_the_ability_hand_is_none() -> None:
    body = bytes([0x12, *range(0x6C, 0x90), 0x20])
    message = stuffed(body)
    assert unstuffed(message[1:-1]) == body
    for i in range(1, len(message) - 1):
        for flip in (1, 0x41, 0x80):
            damaged = bytearray(message)
            damaged[i] ^= flip
            pieces = bytes(damaged).split(FLAG)
            assert len(body) not in [len(unstuffed(piece)) for piece in pieces]


def test_what_an_inspire_hand_refuses_is_an_error(tmp_path: Path) -> None:
    # That hand has forces up to 1000.
    file = table(tmp_path, "inspire", full=3000)
    with (
        MotorThread("inspire") as emulator,
        connected(emulator, file, "inspire") as motors,
    ):
        with pytest.raises(DriverError, match=r"register 1498: refused, code 3"):
            follow(motors, np.array([0.9, -0.2]), 0.5, lambda: False)
        assert not any(pushing(emulator))


@pytest.mark.parametrize("kind", MOTORS)
def test_late_answers_are_never_those_of_another_message(
    kind: str, tmp_path: Path
) -> None:
    with two(tmp_path, kind, IMPATIENT) as (emulator, motors):
        get_torque(emulator, motors, np.array([START, 0.15]), 0.2)
        emulator.order(latency=0.06)
        told = 0
        for _ in range(4):
            motors.write(np.array([START, 0.15]), 0.2)
            with suppress(DriverError):
                q, effort, health = motors.read()
                np.testing.assert_allclose(q, [START, 0.15], atol=0.01)
                np.testing.assert_allclose(effort, 0.0, atol=0.01)
                assert not health.faults
                told += 1
        # All answers of an Ability hand say the same.
        assert told < 4 or kind == "ability"
        # Pushed away in the meantime.
        emulator.order(latency=0.0, wall={"0": [0.5, 0.6]})
        wait_until(lambda: emulator.order()["angle"][0] == 0.5)
        np.testing.assert_allclose(seen(motors)[0], [0.5, 0.15], atol=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_a_driver_waits_as_long_as_its_table_says(kind: str, tmp_path: Path) -> None:
    # Several times what drivers wait by themselves.
    latency = {"latency": 0.15}
    with two(tmp_path, kind) as (emulator, motors):
        emulator.order(**latency)
        q, _, _ = motors.read()
        np.testing.assert_allclose(q, [START, 0.15], atol=UNIT)
    with two(tmp_path, kind, IMPATIENT) as (emulator, motors):
        emulator.order(**latency)
        with pytest.raises(DriverError):
            motors.read()


@pytest.mark.parametrize("kind", MOTORS)
def test_faults_of_motors_are_named(kind: str, tmp_path: Path) -> None:
    heat, load = (
        f": {text}" for text in (KINDS[kind].overheating, KINDS[kind].overload)
    )
    with two(tmp_path, kind) as (emulator, motors):
        here = np.array([0.3, 0.15])
        get_torque(emulator, motors, here, 0.2)
        emulator.order(temperature={"1": 75.0})
        follow(motors, here, 0.2, lambda: seen(motors)[2].faults == (f"b{heat}",))
        # A hand tells its temperatures every third time.
        healths = [seen(motors)[2] for _ in range(3)]
        health = healths[-1]
        if kind != "ability":
            np.testing.assert_array_equal(health.temperature, [30, 75])
        follow(motors, here, 0.2, lambda: pushing(emulator) == [True, False])
        emulator.order(wall={"0": [1.52, 1.6]})
        # Pressing with all its torque for a second: 0.6 of the largest per rad.
        both = (f"a{load}", f"b{heat}")
        pressing = np.array([0.0, 0.15])
        follow(motors, pressing, 1.0, lambda: seen(motors)[2].faults == both)


@pytest.mark.parametrize("kind", KINDS)
def test_motors_that_do_not_answer_and_a_missing_port_are_named(
    kind: str, tmp_path: Path
) -> None:
    is_servo = KINDS[kind].driver is Servos
    text = r"^motor 1: .*no status packet" if is_servo else "no answer|not answer"
    with MotorThread(kind) as emulator:
        emulator.order(silent=[1])
        file = table(tmp_path, kind, patience=1.0)
        with (
            pytest.raises(DriverError, match=r"^motor 1: " if is_servo else text),
            made(emulator, file, kind) as motors,
        ):
            motors.connect()
    with two(tmp_path, kind, 1.0) as (emulator, motors):
        emulator.order(silent=[1])
        with pytest.raises(DriverError, match=text):
            motors.read()
        emulator.order(silent=[])
        get_torque(emulator, motors, np.array([0.3, 0.15]), 0.2)
        # In mid-motion.
        motors.write(np.array([1.3, -0.3]), 0.2)
        emulator.order(unplug=True)
        with pytest.raises(OSError, match=r"."):
            follow(motors, np.array([0.3, 0.15]), 0.2, lambda: False)


def test_an_answer_to_another_message_is_none(tmp_path: Path) -> None:
    with two(tmp_path, "inspire", IMPATIENT) as (_, motors):
        late = Mock(registers=[], isError=lambda: False)
        with (
            patch.object(motors._client, "read_holding_registers", return_value=late),
            pytest.raises(DriverError, match="answer to another message"),
        ):
            motors.read()
        # The next message waits until no answer can be on its way.
        with patch.object(inspire.time, "sleep", wraps=time.sleep) as slept:
            seen(motors)
        assert slept.mock_calls[0] == call(IMPATIENT)
    with two(tmp_path, "dynamixel") as (_, motors):
        seen(motors)
        # Of a write: it has no data.
        with (
            patch.object(motors._packets, "readRx", return_value=([], 0, 0)),
            pytest.raises(DriverError, match="motor 0: Incorrect status packet"),
        ):
            motors.read()
        # Where nothing is sent, what was read before is not the present.
        motors.stop()
        seen(motors)
        with (
            patch.object(motors._packets, "syncReadTx", return_value=-1000),
            pytest.raises(DriverError, match="motor 0: Port is in use"),
        ):
            motors.read()


@pytest.mark.parametrize("kind", ["dynamixel", "ability"])
def test_the_watchdog_of_the_motors_stops_them_and_is_armed_again(
    kind: str, tmp_path: Path
) -> None:
    with two(tmp_path, kind) as (emulator, motors):
        get_torque(emulator, motors, np.array([0.3, 0.15]), 0.2)
        emulator.order(wall={"0": [0.0, 0.5], "1": [0.0, 0.5]})
        before = emulator.order()["goal"][0]
        # On its way when messages end; told 1 rad, it meets the wall at 0.5.
        motors.write(np.array([1.0, 0.05]), 0.5)

        def is_stopped() -> bool:
            now = emulator.order()
            is_held = np.allclose(now["goal"], now["angle"], atol=0.2)
            return bool(now["goal"][0] != before and is_held)

        wait_until(is_stopped, "the motors go on without their computer")
        seen(motors)
        arrive(motors, np.array([0.4, 0.1]), 0.2)


@pytest.mark.parametrize("kind", KINDS)
def test_a_driver_says_which_motors_were_reset(kind: str, tmp_path: Path) -> None:
    # Answers of an Ability hand show a start only by their absence.
    boot, patience = (0.1, IMPATIENT) if kind == "ability" else (0.0, PATIENCE)
    # Each servo starts by itself; a hand has one supply.
    expected = ("b",) if KINDS[kind].driver is Servos else ("a", "b")
    here = np.array([0.5, 0.3])
    with two(tmp_path, kind, patience) as (emulator, motors):

        def is_said() -> bool:
            """Reset a motor. On a busy machine the watchdog of the other one may act, too."""
            motors.stop()
            get_torque(emulator, motors, here, 0.2)
            emulator.order(reboot={"1": boot})
            wait_until(lambda: bool(seen(motors)[2].unpowered), "it is not said")
            return sorted(seen(motors)[2].unpowered) == [*expected]

        wait_until(is_said, "other motors are said to be reset")
        motors.stop()
        get_torque(emulator, motors, here, 0.2)
        limit = emulator.order()["limit"][:2]
        if KINDS[kind].limit:
            np.testing.assert_allclose(limit, 0.2, atol=1e-3)


def test_servos_get_their_set_up_again(tmp_path: Path) -> None:
    setup = [[84, 2, 600], [80, 2, 200], [11, 1, 5]]
    file = table(tmp_path, "dynamixel", setup=setup)
    here = np.array([0.5, 0.3])
    with (
        MotorThread("dynamixel") as emulator,
        connected(emulator, file, "dynamixel") as motors,
    ):
        get_torque(emulator, motors, here, 0.2)
        emulator.order(reboot={"0": 0.0})
        assert seen(motors)[2].unpowered == ("a",)
        gains = motors._packets.read2ByteTxRx(motors._port, 0, 84)[0]
        assert gains == 400
        motors.stop()
        # Motors have no torque before they were read with their set-up.
        motors.write(here, 0.2)
        assert not any(pushing(emulator))
        wait_until(lambda: motors.write(here, 0.2) or not seen(motors)[2].unpowered)
        assert motors._packets.read2ByteTxRx(motors._port, 0, 84)[0] == 600
        assert motors._packets.read2ByteTxRx(motors._port, 0, 80)[0] == 200


def test_a_hand_that_does_not_tell_its_speed_is_driven_with_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = table(tmp_path, "inspire")
    mark = Mock(return_value=np.array([1000, 1000]))
    with (
        MotorThread("inspire") as emulator,
        patch.object(Inspire, "_get", mark),
        connected(emulator, file, "inspire") as motors,
    ):
        assert "a reset of this hand cannot be seen" in capsys.readouterr().err
        assert motors._find_reset() == ()


WRONG_MOTORS: list[Any] = [
    ("at one joint of the session, a, b, got c", {"joint": ["c"], "id": 0}),
    # Two joints of the first motor are not those of two motors.
    ("got a/b, c", {"joint": ["a", "b"], "id": 0}, {"joint": ["c"], "id": 1}),
    ("got 0, 0", {"joint": ["a"], "id": 0}, {"joint": ["b"], "id": 0}),
    ("length >= 1", {"joint": [], "id": 0}),
    ("Expected `float` >= -", {"joint": ["a"], "id": 0, "range": [-1, np.nan]}),
    ("range: expected the least", {"joint": ["a"], "id": 0, "range": [1, -1]}),
    ("ratio: expected not 0", {"joint": ["a"], "id": 0, "ratio": 0}),
    # Negative places of these servos have another form.
    ("lead to 0 to 4095, got -652 to 652", {"joint": ["a"], "id": 0, "zero": 0}),
]


@pytest.mark.parametrize(
    ("kind", "changes", "text"),
    [
        ("dynamixel", {"motors": []}, "length >= 1"),
        ("dynamixel", {"bus": "canopen"}, "Invalid enum value 'canopen'"),
        ("dynamixel", {"currant": 3}, "unknown field `currant`"),
        ("dynamixel", {"bus": "inspire"}, "expected bus: dynamixel or feetech"),
        ("inspire", {"bus": "ability"}, "expected bus: inspire"),
        (
            "inspire",
            {"motors": [{"joint": ["a"], "id": 6, "zero": 0, "range": [-1, 1]}]},
            "expected each id once, in 0 to 5, got 6",
        ),
        *[
            (
                "feetech",
                {"motors": [{"zero": np.pi, "range": [-1, 1]} | m for m in motors]},
                text,
            )
            for text, *motors in WRONG_MOTORS
        ],
        ("dynamixel", {"rate": 0}, r"Expected `float` >= 5.0 - at `\$\.rate`"),
        ("dynamixel", {"rate": 1e6}, r"Expected `float` <= 1000.0 - at `\$\.rate`"),
        ("dynamixel", {"patience": 0.0}, r"`float` >= 0.001 - at `\$\.patience`"),
        ("dynamixel", {"speed": -8.0}, r"Expected `float` > 0.0 - at `\$\.speed`"),
        ("dynamixel", {"speed": 1e9}, r"Expected `float` <= 100.0 - at `\$\.speed`"),
        ("dynamixel", {"effort": 1.5}, r"Expected `float` <= 1.0 - at `\$\.effort`"),
        ("dynamixel", {"full": 0}, r"Expected `int` >= 1 - at `\$\.full`"),
        (
            "dynamixel",
            {"setup": [[84, 2, 65536]]},
            "setup: expected a value of 2 bytes",
        ),
    ],
)
def test_a_wrong_table_is_refused(
    kind: str, changes: dict[str, object], text: str, tmp_path: Path
) -> None:
    make = KINDS[kind].driver
    with pytest.raises(InvalidInputError, match=text) as raised:
        make("leap", "/dev/null", ("a", "b"), table(tmp_path, kind, **changes))
    assert raised.value.argument == "--motors"
    # The driver's own table is of another hand.
    with pytest.raises(InvalidInputError, match=r"^--driver: .*, a, b, got if_rot/0"):
        DRIVERS["leap"]("/dev/null", ("a", "b"), None)
    with pytest.raises(InvalidInputError, match=r"expected a table of the servos"):
        DRIVERS["servos"]("/dev/null", ("a", "b"), None)
    with pytest.raises(InvalidInputError, match=r"no\.yaml: No such file"):
        make("leap", "/dev/null", ("a", "b"), tmp_path / "no.yaml")


@pytest.mark.parametrize(
    ("port", "text"),
    [
        ("127.0.0.1:http", r"^--port: expected HOST:PORT"),
        ("127.0.0.1:1", r"127\.0\.0\.1:1 is gone, or cannot be opened"),
        ("/dev/none:1", r"/dev/none:1 is gone, or cannot be opened"),
    ],
)
def test_a_wrong_port_of_a_hand_is_refused(
    port: str, text: str, tmp_path: Path
) -> None:
    motors = Inspire("", port, ("a", "b"), table(tmp_path, "inspire"))
    with pytest.raises((InvalidInputError, OSError), match=text):
        motors.connect()


@pytest.mark.parametrize("kind", MOTORS)
def test_a_port_has_one_driver(kind: str, tmp_path: Path) -> None:
    with two(tmp_path, kind) as (emulator, motors):
        second = KINDS[kind].driver(
            "", emulator.port, ("a", "b"), table(tmp_path, kind)
        )
        with pytest.raises(OSError, match=r"lock|cannot be opened"):
            second.connect()
        seen(motors)


@pytest.mark.parametrize("kind", ["dynamixel", "feetech"])
def test_a_baud_that_servos_do_not_have_is_refused(kind: str, tmp_path: Path) -> None:
    file = table(tmp_path, kind, baud=123)
    servos = Servos("", "/dev/null", ("a", "b"), file)
    with pytest.raises(InvalidInputError, match=r"--motors: expected a baud of .*-sdk"):
        servos.connect()


@pytest.mark.parametrize("prefix", ["", "name"])
def test_the_table_of_the_leap_hand_is_of_both_models(prefix: str) -> None:
    fingers = [
        f"{f}_{j}" for f in ("if", "mf", "rf") for j in ("mcp", "rot", "pip", "dip")
    ]
    thumb = ["th_cmc", "th_axl", "th_mcp", "th_ipl"]
    joints = tuple(fingers + thumb) if prefix else JOINTS
    with MotorThread("dynamixel", 16) as emulator:
        servos = DRIVERS["leap"](emulator.port, joints, None)
        wait_until(lambda: is_connected(servos))
        q, _, _ = seen(servos)
        np.testing.assert_allclose(q, START, atol=UNIT)
        assert sorted(servos.joint_names) == sorted(joints)
        # Motor 1 bends the index finger, motor 0 spreads it: LEAP_Hand_API.
        if prefix:
            assert servos.joint_names[:4] == ("if_rot", "if_mcp", "if_pip", "if_dip")


@pytest.mark.parametrize(
    ("driver", "hand"),
    [
        ("inspire_right", "inspire_right"),
        ("inspire_left", "inspire_left"),
        ("ability", "ability_right"),
        ("ability", "ability_left"),
    ],
)
def test_the_tables_of_hands_are_those_of_their_descriptions(
    driver: str, hand: str
) -> None:
    try:
        robot = load_hand(hand)
    except HandmapError as error:
        pytest.skip(str(error))
    motors = DRIVERS[driver]("", robot.joint_names, None)
    assert sorted(motors.joint_names) == sorted(robot.joint_names)
    order = [robot.joint_names.index(name) for name in motors.joint_names]
    lower, upper = robot.limits[:, order]
    assert (motors.range[0] >= lower - 1e-3).all()
    assert (motors.range[1] <= upper + 1e-3).all()
    # A finger closes towards the palm: its farther limit is the closed one.
    if driver != "ability":
        np.testing.assert_allclose(motors.range, [lower, upper], atol=1e-3)
    assert motors.speed <= robot.velocity_limits.max()


@pytest.mark.parametrize("own", ["inspire_right", "inspire_left"])
def test_an_angle_of_1000_is_open_and_0_is_closed(own: str) -> None:
    import handmap_drive

    file = Path(handmap_drive.__file__).with_name(f"{own}.yaml")
    for motor in read_motors(file).motors:
        at = motor.zero + motor.ratio * np.array(motor.range)
        # Joints are open at 0.
        is_open = np.abs(motor.range) == 0.0
        np.testing.assert_allclose(at[is_open], 1000.0, atol=0.5)
        np.testing.assert_allclose(at[~is_open], 0.0, atol=0.5)


@pytest.mark.parametrize("kind", LIMITED)
def test_no_torque_before_its_limit_has_arrived(kind: str, tmp_path: Path) -> None:
    with two(tmp_path, kind, IMPATIENT) as (emulator, motors):
        emulator.order(deaf=[KINDS[kind].limit])
        goal = np.array([0.5, 0.5])
        turns = iter(range(10))
        follow(motors, goal, 0.1, lambda: next(turns, None) is None)
        assert not any(pushing(emulator, deaf=[]))
        np.testing.assert_allclose(emulator.order()["angle"][:2], START, atol=UNIT)
        get_torque(emulator, motors, goal, 0.1)
        np.testing.assert_allclose(emulator.order()["limit"][:2], 0.1, atol=1e-3)


@pytest.mark.parametrize(
    ("bus", "own", "robot"),
    [
        ("dynamixel", "leap", "leap_right"),
        ("inspire", "inspire_right", "inspire_right"),
        ("ability", "ability", "ability_right"),
    ],
)
def test_the_lines_of_the_page_find_the_motors(
    bus: str, own: str, robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (Path(__file__).parents[2] / "docs" / "first_motor.md").read_text("utf-8")
    _, _, rest = text.partition("```python\n")
    lines, _, _ = rest.partition("```")
    assert '"leap", "leap_right"' in lines
    lines = lines.replace('"leap", "leap_right"', f'"{own}", "{robot}"')
    with MotorThread(bus, 16) as emulator:
        try:
            exec(lines.replace("/dev/ttyUSB0", emulator.port), names := {})
        except HandmapError as error:
            pytest.skip(str(error))
        assert not emulator.order()["torque"].any()
    assert names["q"][0] == pytest.approx(START, abs=UNIT)
    assert names["motors"].joint_names[0] in capsys.readouterr().out
