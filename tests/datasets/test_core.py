"""The core measures an episode as numpy and scipy do."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import people

from handmap_core.core import core
from handmap_core.human.recording import Recording
from handmap_qp import read_recording
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.offline.trajectory import map_hands
from handmap_qp.human.contact_gap import smallest_gap
from handmap_qp.stream.measurement import measure_person

DEMO = read_recording("demo", "right").part(slice(0, 90))


def test_an_episode_is_measured_as_by_numpy() -> None:
    robot = MappingArguments().load_robot("allegro_right")
    person = measure_person(DEMO)
    arguments = MappingArguments()
    for recording in (DEMO, with_gaps(DEMO), DEMO.part(slice(0, 2))):
        trajectory, *_ = map_hands([recording], robot, person, arguments)
        found = core.measure_episode(
            core.Samples(recording.time, recording.landmarks, recording.valid),
            trajectory.valid,
            trajectory.point_error,
            trajectory.at_limit,
            trajectory.at_speed_limit,
            trajectory.q,
        )
        expected = people.measure_episode(recording, trajectory)
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            np.testing.assert_allclose(
                found[key], value, rtol=1e-9, atol=1e-12, err_msg=key
            )


def with_gaps(recording: Recording) -> Recording:
    valid = recording.valid.copy()
    valid[[0, 1, 20, 40, 41, 42, -1]] = False
    return Recording(
        recording.name, recording.time, recording.landmarks, valid, recording.side
    )


@pytest.mark.parametrize("count", [1, 2, 3, 8, 89, 90])
def test_contact_gaps_are_measured_as_by_scipy(count: int) -> None:
    case = DEMO.time[:count], DEMO.landmarks[:count]
    assert smallest_gap(*case) == pytest.approx(people.smallest_gap(*case), abs=1e-12)
