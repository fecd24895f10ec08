"""Where an object is, with the uncertainty of that: what touches measure, and what they do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handmap_core.stream.object_place import ObjectPlace

CENTRE = np.array([0.1, -0.2, 0.3])
X = np.array([1.0, 0.0, 0.0])


def test_a_place_counts_less_the_less_certain_it_is() -> None:
    shares = [
        ObjectPlace.first(CENTRE, deviation).shares
        for deviation in (0.0, 0.005, 0.01, 1.0)
    ]
    np.testing.assert_allclose(shares[0], np.eye(3))
    diagonals = [share[0, 0] for share in shares]
    assert diagonals == sorted(diagonals, reverse=True)
    # As a measurement counts beside another one: by the inverse of the variances' sum.
    odds = [share / (1.0 - share) for share in diagonals[1:3]]
    assert odds[0] / odds[1] == pytest.approx(4.0)
    # Next to none where nothing is known.
    assert diagonals[3] < 0.002


def test_shares_beside_a_line_count_in_full_along_it_alone() -> None:
    place = ObjectPlace.first(CENTRE, 0.005).touched(CENTRE, X)
    line = np.array([0.6, 0.8, 0.0])
    across = np.cross(line, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(place.shares_beside(line, 1.0), place.shares)
    alone = place.shares_beside(line, 0.0)
    assert line @ alone @ line == pytest.approx(line @ place.shares @ line)
    np.testing.assert_allclose(alone @ across, 0.0, atol=1e-12)
    half = place.shares_beside(line, 0.5)
    np.testing.assert_allclose(
        across @ half @ across, across @ place.shares @ across / 4
    )


@pytest.mark.parametrize("deviation", [0.0, 0.005, 0.01])
def test_pads_that_press_on_an_object_are_around_it(deviation: float) -> None:
    place = ObjectPlace.first(CENTRE, deviation)
    # Three deviations of the place and of the touch together, along the line of the pads.
    farthest = 3.0 * np.hypot(deviation, 0.002)
    across = np.array([0.0, 0.1, -0.1])
    assert place.is_midway(CENTRE + 0.99 * farthest * X + across, X)
    assert not place.is_midway(CENTRE - 1.01 * farthest * X, X)


@given(
    st.floats(0.0, 0.02),
    st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3),
    st.floats(-0.02, 0.02),
)
def test_a_touch_measures_along_its_normal_alone(
    deviation: float, direction: list[float], missed: float
) -> None:
    normal = np.array(direction)
    normal = normal / np.linalg.norm(normal) if np.linalg.norm(normal) > 0.1 else X
    before = ObjectPlace.first(CENTRE, deviation)
    across = np.cross(normal, [0.3, -0.5, 0.7])
    after = before.touched(CENTRE + missed * normal + 0.05 * across, normal)
    moved = after.centre - CENTRE
    # By a part of the way, and nothing across.
    np.testing.assert_allclose(np.cross(moved, normal), 0.0, atol=1e-12)
    way = moved @ normal * np.sign(missed)
    assert -1e-12 <= way <= abs(missed) + 1e-12
    assert after.deviation_along(normal) <= deviation + 1e-12
    sideways = across / np.linalg.norm(across)
    assert after.deviation_along(sideways) == pytest.approx(deviation, abs=1e-9)


def test_touches_along_three_axes_correct_a_place() -> None:
    true = CENTRE + np.array([0.008, -0.006, 0.01])
    place = ObjectPlace.first(CENTRE, 0.01)
    for axis in np.eye(3):
        place = place.touched(true, axis)
    np.testing.assert_allclose(place.centre, true, atol=5e-4)
    for axis in np.eye(3):
        assert place.deviation_along(axis) < 0.002
    # Of a place that is exact, a touch corrects nothing.
    exact = ObjectPlace.first(CENTRE, 0.0).touched(true, X)
    np.testing.assert_array_equal(exact.centre, CENTRE)


def test_a_correction_stays_with_its_object() -> None:
    place = ObjectPlace.first(CENTRE, 0.01).touched(CENTRE + 0.01 * X, X)
    moved = place.at(CENTRE + 0.005 * X, 0.01)
    np.testing.assert_allclose(moved.centre - place.centre, 0.005 * X)
    assert moved.deviation_along(X) == place.deviation_along(X)
    # An object elsewhere is another one, and so is a place that is stated otherwise.
    another = place.at(CENTRE + 0.1 * X, 0.01)
    otherwise = place.at(CENTRE, 0.005)
    for each in (another, otherwise):
        np.testing.assert_array_equal(each.correction, np.zeros(3))


@pytest.mark.parametrize(
    ("deviation", "farthest"), [(0.0, 0.02), (0.005, 0.02), (0.01, 0.03)]
)
def test_a_place_beyond_20_mm_and_three_deviations_is_of_another_object(
    deviation: float, farthest: float
) -> None:
    correction = np.array([0.0, 0.002, -0.001])
    place = ObjectPlace.first(CENTRE, deviation)._replace(correction=correction)
    same = place.at(CENTRE + 0.99 * farthest * X, deviation)
    np.testing.assert_array_equal(same.correction, correction)
    another = place.at(CENTRE + 1.01 * farthest * X, deviation)
    np.testing.assert_array_equal(another.correction, np.zeros(3))
