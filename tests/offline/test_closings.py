"""Closings of fingers in recordings: how quickly people close their hands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handmap_core.human.recording import Recording
from handmap_qp import load_hand
from handmap_qp.apps.offline.closings import closing_times
from handmap_qp.human import mirrored, standard_postures
from handmap_qp.se3 import Array

HUMAN = load_hand("human", points="landmarks")
FLAT, FIST = (standard_postures(HUMAN)[name] for name in ("flat hand", "fist"))


def recording(shares: Array, rate: float) -> Recording:
    """Record a hand between flat (0) and fist (1)."""
    landmarks = [HUMAN.points(FLAT + share * (FIST - FLAT)) for share in shares]
    time = np.arange(len(shares)) / rate
    valid = np.ones(len(shares), dtype=bool)
    return Recording("closing", time, np.array(landmarks), valid, "right")


def closing(duration: float, rate: float = 120.0, *, count: int = 1) -> Recording:
    """Record a hand that closes at a constant speed, `count` times, with rests."""
    rest = np.zeros(int(0.5 * rate))
    way = np.linspace(0.0, 1.0, round(duration * rate) + 1)
    once = np.concatenate([rest, way, rest + 1.0, way[::-1]])
    return recording(np.tile(once, count), rate)


@pytest.mark.parametrize("duration", [0.2, 0.6, 1.2])
def test_a_closing_at_constant_speed_takes_its_time(duration: float) -> None:
    times = closing_times(closing(duration))
    assert times.shape == (4,)
    np.testing.assert_allclose(times, duration, rtol=0.02)


def test_every_closing_of_every_finger_counts_and_no_opening() -> None:
    times = closing_times(closing(0.3, count=3))
    assert times.shape == (12,)
    np.testing.assert_allclose(times, 0.3, rtol=0.02)


def test_rate_place_and_side_do_not_matter() -> None:
    usual = closing(0.4)
    times = closing_times(usual)
    np.testing.assert_allclose(closing_times(closing(0.4, rate=60.0)), times, rtol=0.03)
    np.testing.assert_allclose(closing_times(mirrored(usual)), times, rtol=1e-9)
    moved = replace(usual, landmarks=1.2 * usual.landmarks[:, :, [1, 2, 0]] + 0.3)
    np.testing.assert_allclose(closing_times(moved), times, rtol=1e-9)
    slowed = replace(usual, time=3.0 * usual.time)
    # The rests of 0.5 s are beside the way, which counts from 10 % to 90 %.
    np.testing.assert_allclose(closing_times(slowed), 3.0 * times, rtol=1e-6)


def test_a_hand_that_was_lost_while_it_closed_does_not_count() -> None:
    seen = closing(0.4, count=2)
    valid = seen.valid.copy()
    valid[60 + 15 : 60 + 30] = False
    assert closing_times(replace(seen, valid=valid)).shape == (4,)


def test_a_hand_that_stays_or_closes_by_half_has_no_closing() -> None:
    for most in (0.0, 0.5):
        shares = np.concatenate([np.linspace(0.0, most, 60), np.full(60, most)])
        assert closing_times(recording(shares, 60.0)).shape == (0,)


def test_landmarks_that_coincide_are_left_out() -> None:
    seen = closing(0.4)
    landmarks = seen.landmarks.copy()
    landmarks[20, 8] = landmarks[20, 7]
    times = closing_times(replace(seen, landmarks=landmarks))
    np.testing.assert_allclose(times, closing_times(seen))
