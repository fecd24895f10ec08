"""The clock of a robot's commands tells a pause from a stamp of another clock."""

from __future__ import annotations

import pytest

from handmap_core.ik import SHORTEST_DT, Instant
from handmap_core.stream.command_clock import CommandClock

PERIOD = 1.0 / 60.0
DAY = 86400.0


def after_pause(pause: float, arrival: float | None = None) -> tuple[Instant, float]:
    """Return the instant of a command behind a pause, and that of the command before."""
    clock = CommandClock()
    now = 0.0
    for k in range(60):
        time = k * PERIOD
        clock, instant = clock.advance(
            {"right": time}, now, None if arrival is None else time
        )
        now = instant.time
    last = 59 * PERIOD
    _, instant = clock.advance(
        {"right": last + pause}, now, None if arrival is None else last + arrival
    )
    return instant, now


@pytest.mark.parametrize(("pause", "is_still"), [(9.9, False), (10.1, True)])
def test_a_robot_stands_still_behind_a_pause_that_nothing_confirms(
    pause: float, is_still: bool
) -> None:
    instant, now = after_pause(pause)
    assert instant.time == pytest.approx(now + pause)
    assert (instant.longest == SHORTEST_DT) == is_still


def test_arrival_confirms_a_pause() -> None:
    instant, now = after_pause(10.1, arrival=10.1)
    assert instant.time == pytest.approx(now + 10.1)
    assert instant.longest > SHORTEST_DT


@pytest.mark.parametrize(
    ("pause", "arrival", "is_of_another_clock"),
    [
        (DAY - 1.0, None, False),
        (DAY + 1.0, None, True),
        (9.9, 0.1, False),
        (10.2, 0.1, True),
    ],
)
def test_a_stamp_that_is_too_late_is_of_another_clock(
    pause: float, arrival: float | None, is_of_another_clock: bool
) -> None:
    instant, now = after_pause(pause, arrival)
    waited = 0.0 if arrival is None else arrival
    if is_of_another_clock:
        assert instant.time == pytest.approx(now + waited, abs=1e-3)
    elif arrival is None:
        assert instant.time == pytest.approx(now + pause)
