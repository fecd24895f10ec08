"""The frame loop of the views, on a simulated clock."""

from __future__ import annotations

import pytest

from handmap_qp.apps.viewer import serving
from handmap_qp.apps.viewer.serving import FRAME_PERIOD, run_frames


class Clock:
    """A clock that advances only in `sleep`, or by `now`."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    simulated = Clock()
    monkeypatch.setattr(serving, "time", simulated)
    return simulated


def test_frames_keep_their_period_and_steps_are_bounded(clock: Clock) -> None:
    starts: list[float] = []
    steps: list[float] = []

    def draw(step: float) -> None:
        starts.append(clock.now)
        steps.append(step)
        # The third frame takes three seconds: a long recording is mapped.
        clock.now += 3.0 if len(steps) == 3 else 0.01

    run_frames(draw, lambda: len(steps) == 5)
    period = FRAME_PERIOD
    assert starts == pytest.approx(
        [0, period, 2 * period, 2 * period + 3, 3 * period + 3]
    )
    assert steps == pytest.approx([0, period, period, 0.2, period])


def test_a_frame_lost_to_visers_race_is_drawn_again_and_other_errors_end_the_loop(
    clock: Clock,
) -> None:
    messages = ["deque mutated during iteration", "", "another mistake"]
    drawn: list[str] = []

    def draw(_: float) -> None:
        drawn.append(messages[len(drawn)])
        if drawn[-1]:
            raise RuntimeError(drawn[-1])

    with pytest.raises(RuntimeError, match="another mistake"):
        run_frames(draw)
    assert drawn == messages
