"""The fault table in small: across every fault, the robot moves no faster than the human does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from injection import inject, parse_faults

from handmap_core.human.recording import sample_columns
from handmap_core.human.sample import HumanSample
from handmap_core.stream.rejoin import PALM_SPEED, TURN_SPEED
from handmap_qp import Hand, HandMapper, InvalidInputError, load_hand, read_recording
from handmap_qp.apps.offline.summary import find_holds, summarise
from handmap_qp.apps.offline.trajectory import Trajectory, trajectory_of
from handmap_qp.human.measure import scaled_human
from handmap_qp.mapping.presets import preset_choice
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.measurement import measure_person

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow


class Stage:
    """A real recording, and what maps it."""

    def __init__(self, file: Path) -> None:
        recording = read_recording(file)
        person = measure_person(recording)
        self.samples = [*sample_columns(recording)]
        self.period = float(np.median(np.diff(recording.time)))
        self.robot: Hand = load_hand("allegro_right")
        self._human = scaled_human(recording, lengths=person.lengths)
        self._choice = preset_choice("teleoperation", self._human)
        self.clean = self.run(self.samples)

    def run(self, samples: list[HumanSample]) -> Trajectory:
        choice = self._choice
        mapper = HandMapper(self._human, self.robot, choice.method, ik=choice.ik)
        time = np.array([sample.time for sample in samples])
        return trajectory_of(
            mapper.robot, time, map(Follower(mapper).map_sample, samples)
        )


@pytest.fixture(scope="module")
def stage(recordings: Path) -> Stage:
    return Stage(recordings / "leap_pinch_move_right.npz")


def speeds(trajectory: Trajectory, period: float) -> tuple[float, float, float]:
    """Return the largest joint speed, palm speed and palm turn, after the first half second."""
    start = int(np.searchsorted(trajectory.time, trajectory.time[0] + 0.5))
    q, wrist = trajectory.q[start:], trajectory.wrist[start:]
    # However long a hold lasted, the next command comes one period after the one before.
    dt = np.clip(np.diff(trajectory.time[start:]), 0.5 * period, 3.0 * period)
    turns = [
        np.linalg.norm(pin.log3(wrist[i, :3, :3].T @ wrist[i + 1, :3, :3]))
        for i in range(len(dt))
    ]
    travel = np.linalg.norm(np.diff(wrist[:, :3, 3], axis=0), axis=1)
    return (
        float((np.abs(np.diff(q, axis=0)) / dt[:, None]).max()),
        float((travel / dt).max()),
        float((turns / dt).max()),
    )


FAULTS = {
    "dropout@1.5+0.5": "missing",
    "silence@1.5+0.5": "gap",
    "jump@1.5+0.5:0.2": "jump",
    "flip@1.5+0.2": "flip",
    "outlier@1.5+0.1:0.1": "outlier",
}


@pytest.mark.parametrize(("fault", "rule"), FAULTS.items(), ids=FAULTS.keys())
def test_no_fault_makes_the_robot_snap(stage: Stage, fault: str, rule: str) -> None:
    faulty = stage.run(list(inject(stage.samples, parse_faults(fault))))
    assert rule in summarise(faulty)["rules"]
    clean, guarded = speeds(stage.clean, stage.period), speeds(faulty, stage.period)
    assert guarded[0] <= stage.robot.velocity_limits.max() * 1.01
    # The way back adds a little to the human's own motion. The wrist lies 0.1 m from the knuckles.
    assert guarded[1] <= clean[1] + PALM_SPEED + 0.1 * TURN_SPEED
    assert guarded[2] <= clean[2] + TURN_SPEED
    # Half a second after the fault and the way back, both robots do the same.
    np.testing.assert_allclose(faulty.q[-1], stage.clean.q[-1], atol=0.05)


def test_a_recording_without_a_sample_that_makes_sense_is_an_error_that_says_why(
    stage: Stage,
) -> None:
    zeros = list(inject(stage.samples[:20], parse_faults("zero@0+9")))
    with pytest.raises(
        InvalidInputError, match="none of 20; in 20, landmarks lie in one place"
    ):
        stage.run(zeros)


def test_holds_are_events_with_name_time_and_duration(stage: Stage) -> None:
    assert find_holds(stage.clean) == []
    faults = parse_faults("zero@1+0.2,dropout@2.5+0.3")
    holds = find_holds(stage.run(list(inject(stage.samples, faults))))
    assert [hold["rule"] for hold in holds] == ["zero", "missing"]
    np.testing.assert_allclose(
        [hold["start"] for hold in holds], [1.0, 2.5], atol=stage.period
    )
    # The settling time is part of a hold.
    np.testing.assert_allclose(
        [hold["duration"] for hold in holds], [0.3, 0.4], atol=0.05
    )
    assert all(hold["samples"] > 10 for hold in holds)
