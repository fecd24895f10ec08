"""Intervals and tests over people: small cases by hand, and what they promise over many studies."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats
from study_cases import SEED, as_results, made_people

from handmap_qp.apps.study.analysis import MEASURES, StudyResult, analyse
from handmap_qp.apps.study.pool import Pool
from handmap_qp.apps.study.statistics import (
    NOTHING,
    Interval,
    mean_interval,
    median_interval,
    order_effect,
    order_effect_p,
    sign_flip_p,
    sign_test_p,
    wilcoxon_p,
)

STUDIES = 400
PEOPLE = 16


def test_small_cases_by_hand() -> None:
    # Of 2^3 signs, only all + and all - are as far from 0.
    assert sign_flip_p([1.0, 1.0, 2.0]) == pytest.approx(2 / 8)
    # 3 - 1: sums of 4, 2, -2 and -4, all at least 2 away.
    assert sign_flip_p([3.0, -1.0]) == 1.0
    # |sum| = 5 of 1, 2, 4: reached by 7 and 5, with both signs.
    assert sign_flip_p([-1.0, 2.0, 4.0]) == pytest.approx(4 / 8)
    # People without a difference do not count.
    assert sign_flip_p([0.0, 1.0, 0.0, 1.0]) == pytest.approx(2 / 4)
    assert sign_flip_p([0.0, 0.0]) == 1.0
    # Six differences of one sign: 2 of 2^6.
    assert wilcoxon_p([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) == pytest.approx(2 / 64)
    assert wilcoxon_p([0.0, 1e-13]) == 1.0
    assert sign_test_p(5, 0) == pytest.approx(2 / 32)
    assert sign_test_p(0, 0) == 1.0
    # Student's t with two degrees of freedom: 4.3027; standard error 1 / sqrt(3).
    found = mean_interval([1.0, 2.0, 3.0], 0.0, 100.0)
    assert found.value == 2.0
    assert found.high == pytest.approx(2.0 + 4.302653 / math.sqrt(3.0), abs=1e-6)
    assert found.low == 0.0
    assert mean_interval([], 0.0, 1.0) == NOTHING
    assert mean_interval([0.5], 0.0, 1.0) == Interval(0.5, None, None)


def test_the_effect_of_the_order_is_apart_from_that_of_the_mapping() -> None:
    # B is 3 quicker and the second mapping 1 quicker, without noise.
    is_a_first = [True, True, True, False, False, False]
    differences = [-3.0 - 1.0 if first else -3.0 + 1.0 for first in is_a_first]
    assert order_effect(differences, is_a_first) == Interval(-1.0, -1.0, -1.0)
    # Of the 20 groups of three, two separate as far.
    assert order_effect_p(differences, is_a_first) == pytest.approx(2 / 20)
    assert order_effect([1.0, 2.0], [True, True]) == NOTHING
    assert order_effect_p([1.0, 2.0], [True, True]) is None
    welch = stats.ttest_ind([1.0, 4.0, 2.0], [5.0, 9.0], equal_var=False)
    interval = welch.confidence_interval()
    found = order_effect([1.0, 4.0, 2.0, 5.0, 9.0], [True] * 3 + [False] * 2)
    assert found.low == pytest.approx(0.5 * interval.low)
    assert found.high == pytest.approx(0.5 * interval.high)


def test_the_median_of_resampled_people_is_the_plain_one() -> None:
    values = [[3.0, 1.0], [], [5.0], [2.0, 2.0, 8.0]]
    counts = np.random.default_rng(17105).multinomial(4, [0.25] * 4, 4000)
    medians = []
    for drawn in counts:
        flat = [v for own, n in zip(values, drawn, strict=True) for v in own * int(n)]
        if flat:
            medians.append(np.median(flat))
    low, high = np.quantile(medians, [0.025, 0.975])
    found = median_interval(values)
    assert found.value == 2.5
    assert (found.low, found.high) == pytest.approx((low, high))
    assert median_interval([[], []]) == NOTHING
    assert median_interval([[4.0, 6.0]]) == Interval(5.0, None, None)


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.6])
def test_drawn_signs_and_groups_agree_with_all_of_them(shift: float) -> None:
    generator = np.random.default_rng([SEED, int(10 * shift)])
    many = generator.normal(shift, 1.0, 15)
    bits = np.arange(2**15)[:, None] >> np.arange(15)
    sums = np.abs((1.0 - 2.0 * (bits & 1)) @ many)
    exact = np.mean(sums >= abs(many.sum()) - 1e-9)
    assert sign_flip_p(many.tolist()) == pytest.approx(exact, abs=0.015)
    # 18 people: C(18, 9) groups are more than are drawn.
    values = generator.normal(0.0, 1.0, 18)
    values[:9] += shift
    is_first = np.arange(18) < 9
    result = stats.permutation_test(
        (values[:9], values[9:]),
        lambda a, b: a.mean() - b.mean(),
        n_resamples=50_000,
        rng=SEED,
    )
    p = order_effect_p(values.tolist(), is_first.tolist())
    assert p == pytest.approx(result.pvalue, abs=0.015)


@pytest.fixture(scope="module")
def alike() -> list[StudyResult]:
    """Many studies of two mappings that are alike, by people who differ and who practise."""
    return [
        analyse(Pool(as_results(made_people(PEOPLE, [SEED, i])), []))
        for i in range(STUDIES)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("index", range(len(MEASURES)), ids=lambda i: MEASURES[i].name)
def test_p_is_uniform_if_the_mappings_are_alike(
    alike: list[StudyResult], index: int
) -> None:
    families = {
        "permutation": [one.differences[index].p for one in alike],
        "order": [one.order_effects[index].p for one in alike],
    }
    if MEASURES[index].has_wilcoxon:
        families["Wilcoxon"] = [one.differences[index].p_wilcoxon for one in alike]
    for name, values in families.items():
        p = np.array(values, dtype=float)
        for level in (0.01, 0.05, 0.1, 0.2, 0.5):
            # Three standard deviations of a share of that many studies.
            slack = 3.0 * math.sqrt(level * (1.0 - level) / STUDIES)
            assert np.mean(p <= level) <= level + slack, (name, level)
        if MEASURES[index].has_wilcoxon:
            # Values without ties are uniform, not only large enough.
            assert stats.kstest(p, "uniform").pvalue > 0.001, name
    assert np.mean([one.preference.p <= 0.05 for one in alike]) <= 0.05 + 0.033


@pytest.mark.slow
def test_p_is_as_uniform_if_people_practise() -> None:
    results = [
        analyse(Pool(as_results(made_people(14, [SEED, 1, i], practice=3.0)), []))
        for i in range(200)
    ]
    p = np.array([one.differences[1].p for one in results], dtype=float)
    assert np.mean(p <= 0.05) <= 0.05 + 3.0 * math.sqrt(0.05 * 0.95 / 200)
    # Practice itself is seen.
    found = [one.order_effects[1] for one in results]
    values = [one.difference.value for one in found if one.difference.value is not None]
    assert np.mean(values) == pytest.approx(-3.0, abs=0.2)
    assert np.mean([one.p is not None and one.p < 0.05 for one in found]) > 0.6


def _covers(intervals: list[Interval], truth: float) -> float:
    """Return the share of intervals that contain the true value."""
    inside = [
        one.low is not None and one.high is not None and one.low <= truth <= one.high
        for one in intervals
    ]
    return float(np.mean(inside))


@pytest.mark.slow
def test_intervals_cover_the_truth_as_promised(alike: list[StudyResult]) -> None:
    generator = np.random.default_rng(SEED)
    chance = np.clip(0.7 + generator.normal(0.0, 0.15, 1_000_000), 0.02, 0.98).mean()
    loads = generator.normal(45.0, math.hypot(15.0, 12.0), 1_000_000)
    load = np.clip(loads, 0.0, 100.0).mean()
    firsts = [one.mappings[0] for one in alike]
    shares = {
        "success": _covers([one.success_by_person for one in firsts], chance),
        "workload": _covers([one.workload for one in firsts], load),
        "drops": _covers([one.drops for one in firsts], 0.6),
    }
    for index, measure in enumerate(MEASURES):
        shares[measure.name] = _covers(
            [one.differences[index].difference for one in alike], 0.0
        )
        shares[f"order, {measure.name}"] = _covers(
            [one.order_effects[index].difference for one in alike], 0.0
        )
    for name, share in shares.items():
        # 95 %, and three standard deviations of it over 400 studies.
        assert 0.917 <= share <= 0.985, (name, share)
    # Percentiles of a bootstrap of 16 people are a little too narrow.
    median = _covers([one.seconds for one in firsts], 15.0)
    assert 0.88 <= median <= 0.98


@pytest.mark.slow
def test_wilson_covers_the_truth_if_people_are_alike() -> None:
    results = [
        analyse(Pool(as_results(made_people(12, [SEED, 2, i], spread=0.0)), []))
        for i in range(STUDIES)
    ]
    # Of 60 trials, the counts near the ends of the interval are few: its true share is 0.93.
    assert 0.9 <= _covers([one.mappings[0].success for one in results], 0.7) <= 0.985


@pytest.mark.slow
def test_wilson_is_too_narrow_if_people_differ() -> None:
    """Which is why the interval by person is printed beside it."""
    results = [
        analyse(
            Pool(as_results(made_people(12, [SEED, 3, i], trials=20, spread=0.25)), [])
        )
        for i in range(150)
    ]
    generator = np.random.default_rng(SEED)
    chance = np.clip(0.7 + generator.normal(0.0, 0.25, 1_000_000), 0.02, 0.98).mean()
    firsts = [one.mappings[0] for one in results]
    assert _covers([one.success for one in firsts], chance) < 0.85
    assert _covers([one.success_by_person for one in firsts], chance) > 0.89
