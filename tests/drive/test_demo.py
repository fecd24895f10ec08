"""The chain of `handmap demo --drive`, and what is told of it."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE, wait_until

from handmap_qp import Recording, load_hand, read_recording
from handmap_qp.errors import HandmapError

for module in ("dynamixel_sdk", "pymodbus"):
    pytest.importorskip(module, reason="needs packages/drive and what it installs")

import handmap_drive  # noqa: E402
from handmap_drive.demo import PERIOD, Driven, slowed, started  # noqa: E402


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_recording("demo", "right")


def test_a_slowed_recording_is_the_same_motion(recording: Recording) -> None:
    slow = slowed(recording, 4.0)
    assert len(slow) == 4 * len(recording)
    assert np.ptp(slow.time) == pytest.approx(4.0 * np.ptp(recording.time))
    ends = [0, -1]
    np.testing.assert_array_equal(slow.landmarks[ends], recording.landmarks[ends])
    speed, before = (
        np.abs(np.diff(each.landmarks, axis=0)).max() for each in (slow, recording)
    )
    assert speed == pytest.approx(before / 4.0, rel=0.01)


def test_joints_are_compared_with_the_commands_at_their_delay(
    recording: Recording,
) -> None:
    robot = load_hand("three_finger")
    low, high = robot.limits

    def motion(time: np.ndarray) -> np.ndarray:
        return low + (high - low) * (0.5 - 0.5 * np.cos(time)[:, None])

    time = np.arange(0.0, 6.0, 1.0 / 60.0)
    log_time = np.arange(-1.0, 8.0, 0.004)
    angle = motion(log_time - 0.05)
    more: Any = {"summary": {}, "said": ""}
    torque = np.ones_like(angle)
    driven = Driven(
        robot, recording, time, motion(time), log_time, angle, torque, **more
    )
    assert driven.delay == pytest.approx(0.05)
    assert driven.rms < 1e-4
    assert driven.rms_at(0.0) > 0.01


@pytest.mark.slow
def test_emulated_motors_follow_a_person(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("handmap_drive.demo.APPROACH", 2.0)
    try:
        load_hand("leap_right")
    except HandmapError as error:
        pytest.skip(str(error))
    part = recording.part(slice(60, 120))
    # Emulated motors answer when the machine gives them a turn.
    own = Path(handmap_drive.__file__).with_name("leap.yaml").read_text()
    # Half as often as a robot: packages of 16 motors take their time on both sides of the port.
    seldom = own.replace("rate: 80.0", "rate: 40.0")
    assert seldom != own
    table = tmp_path / "leap.yaml"
    table.write_text(f"{seldom}\npatience: 5.0\n")
    servos = "dynamixel", table
    with started("leap_right", part, servos, timeout=PATIENCE) as chain:
        chain.approach()
        led = chain.lead()
        count = itertools.count(1)

        seen: list[str] = []

        def are_there() -> bool:
            """Send the last sample again. On a busy machine the motors are late."""
            ended = chain.drive.poll()
            assert ended is None, (
                f"drive ended with {ended}: {chain.drive.communicate()}"
            )
            # At the rate of a tracker: the motors need the processor, too.
            time.sleep(PERIOD)
            # Landmarks that repeat exactly would be frozen data.
            last = part.landmarks[-1] + 1e-7 * next(count)
            command = chain.client.step(landmarks=last)
            motors = chain.motors.order()
            away = np.abs(motors["angle"][chain.order] - command.q)
            seen[:] = [
                f"the motors do not go where they are commanded: {command.status}",
                f"flags {list(command.flags)}, torque {motors['torque'].tolist()}",
                f"away {away.round(3).tolist()}, after {len(led[0])} and {count} samples",
            ]
            return bool(away.max() < 0.05)

        wait_until(are_there, lambda: "; ".join(seen))
        driven = chain.end(*led)
    # Joints in another order would be some 0.5 rad away.
    assert driven.torque.max() == pytest.approx(0.149, abs=1e-3)
    assert driven.summary["turns"] > 60
