"""`Follower.map_samples`: a whole recording gives the steps of a live stream."""

from __future__ import annotations

import numpy as np
import pytest
from faulty_recordings import DEMO, faulty
from marks import slow

from handmap_qp import (
    Follower,
    HandMapper,
    InvalidInputError,
    Method,
    Teleoperation,
    load_hand,
)
from handmap_qp.human.recording import Recording, recording_samples

HUMAN = load_hand("human", points="landmarks")
# Lost, then elsewhere, then one landmark off.
FAULTS = "dropout@0.3+0.3,jump@0.8+0.2,outlier@1.3+0.05"


@pytest.mark.parametrize(
    "robot", ["three_finger", *map(slow, ["allegro_right", "panda_gripper"])]
)
@pytest.mark.parametrize(
    "method",
    [
        "teleoperation",
        "paper",
        pytest.param(Teleoperation(scale=0.5), id="half_scale", marks=pytest.mark.slow),
    ],
)
def test_a_recording_gives_the_steps_of_its_stream(
    robot: str, method: Method | str
) -> None:
    samples, hand = recording_samples(faulty(FAULTS)), load_hand(robot)
    live = Follower(HandMapper(HUMAN, hand, method))
    expected = [live.map_sample(sample) for sample in samples]
    found = list(Follower(HandMapper(HUMAN, hand, method)).map_samples(samples))
    assert [step.status for step in found] == [step.status for step in expected]
    assert {"held", "gliding"} < {step.status for step in found}
    for step, other in zip(found, expected, strict=True):
        assert (step.rule, step.confidence) == (other.rule, other.confidence)
        np.testing.assert_allclose(step.command.q, other.command.q, atol=1e-9)
        np.testing.assert_allclose(step.command.wrist, other.command.wrist, atol=1e-9)
        np.testing.assert_allclose(step.targets, other.targets, atol=1e-12)
        margins, others = step.asked.margins, other.asked.margins
        assert (margins is None) == (others is None)
        if margins is not None and others is not None:
            np.testing.assert_allclose(margins, others, atol=1e-12)
        if method != "paper" and not step.is_held:
            for name in ("palm", "gaps", "pinching", "extensions"):
                one, two = (s.diagnostics[name] for s in (step, other))
                np.testing.assert_allclose(one, two, atol=1e-12)
            np.testing.assert_allclose(step.motion, other.motion, atol=1e-12)


def test_a_clutch_between_samples_counts() -> None:
    """Targets known from the reference before are not used after a clutch."""
    samples = recording_samples(DEMO.part(slice(0, 40)))
    hand = load_hand("three_finger")
    live, follower = (
        Follower(HandMapper(HUMAN, hand)),
        Follower(HandMapper(HUMAN, hand)),
    )
    steps = follower.map_samples(samples)
    for i, sample in enumerate(samples):
        if i == 20:
            live.mapper.clutch()
            follower.mapper.clutch()
        step, other = next(steps), live.map_sample(sample)
        np.testing.assert_allclose(step.command.wrist, other.command.wrist, atol=1e-9)


def test_coordinates_that_are_far_away_are_refused() -> None:
    far = DEMO.part(slice(0, 20))
    far = Recording(far.name, far.time, far.landmarks + 1e9, far.valid, far.side)
    follower = Follower(HandMapper(HUMAN, load_hand("three_finger")))
    with pytest.raises(InvalidInputError, match="coordinates within"):
        list(follower.map_samples(recording_samples(far)))
