"""Intervals and tests over people, for studies in which each person uses both mappings.

A person is the unit of all of them, because trials of one person are alike. Random numbers have a
fixed seed, and values are sorted first, so that neither the order of people nor the labels of the
mappings change a result.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations

import msgspec
import numpy as np
from scipy import stats

from handmap_qp.se3 import Array

LEVEL = 0.95
"""Probability with which intervals cover the true value."""
_SEED = 17105
_DRAWS = 20_000
_MOST_SIGNED = 14
"""People up to whom all 2^n signs are tried; more are drawn at random."""
_RESAMPLES = 4000
_TIE = 1e-9
"""Relative difference up to which two sums count as equal: they are rounded."""


class Interval(msgspec.Struct, frozen=True):
    """A value with its 95 % interval.

    Attributes:
        value: The value; None if there is none.
        low: Lower end; None if there are too few people.
        high: Upper end, likewise.
    """

    value: float | None
    low: float | None
    high: float | None


NOTHING = Interval(None, None, None)
"""A value of no people."""


def mean_interval(values: Sequence[float], low: float, high: float) -> Interval:
    """Return the mean over people, with its interval by Student's t.

    Args:
        values: A value for each person.
        low: Smallest possible mean, at which the interval is cut.
        high: Largest possible mean.
    """
    if not values:
        return NOTHING
    mean = math.fsum(values) / len(values)
    if len(values) < 2:
        return Interval(mean, None, None)
    error = float(np.std(sorted(values), ddof=1)) / math.sqrt(len(values))
    half = _t_quantile(len(values) - 1) * error
    return Interval(mean, max(low, mean - half), min(high, mean + half))


def _t_quantile(freedom: float) -> float:
    return float(stats.t.ppf(0.5 + 0.5 * LEVEL, freedom))


def median_interval(values: Sequence[Sequence[float]]) -> Interval:
    """Return the median of all values, with its bootstrap interval by person (percentiles).

    Args:
        values: The values of each person, who may have none. The order of the people selects the
            random draws.
    """
    people = np.repeat(np.arange(len(values)), [len(own) for own in values])
    flat = np.array([value for own in values for value in own], dtype=float)
    if not len(flat):
        return NOTHING
    median = float(np.median(flat))
    if len(values) < 2:
        return Interval(median, None, None)
    order = np.argsort(flat, kind="stable")
    flat, people = flat[order], people[order]
    shares = np.full(len(values), 1.0 / len(values))
    counts = np.random.default_rng(_SEED).multinomial(len(values), shares, _RESAMPLES)
    # How often each value is in a resample; the median is where half of them are below.
    below = np.cumsum(counts[:, people], axis=1)
    total = below[:, -1:]
    has_values = total[:, 0] > 0
    lower = np.argmax(2 * below >= total, axis=1)
    upper = np.argmax(2 * below > total, axis=1)
    medians = 0.5 * (flat[lower] + flat[upper])[has_values]
    ends = np.quantile(medians, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return Interval(median, float(ends[0]), float(ends[1]))


def sign_flip_p(differences: Sequence[float]) -> float:
    """Return the two-sided p of the permutation test of paired differences.

    If the mappings are alike, each person's difference could as well have the other sign. The
    statistic is the mean difference. All signs are tried for up to 14 people that have one, and
    20,000 random ones for more.

    Args:
        differences: The difference of each person; 1.0 is returned if there is none.
    """
    sizes = np.array(sorted(abs(d) for d in differences if d != 0.0))
    if not len(sizes):
        return 1.0
    observed = abs(math.fsum(differences))
    sums = np.abs(_signs(len(sizes)) @ sizes)
    return _share_beyond(sums, observed, is_exact=len(sizes) <= _MOST_SIGNED)


@lru_cache(maxsize=32)
def _signs(count: int) -> Array:
    """Return the signs to try, shape (draws, count)."""
    if count <= _MOST_SIGNED:
        bits = np.arange(2**count)[:, None] >> np.arange(count)
        return 1.0 - 2.0 * (bits & 1)
    return np.random.default_rng(_SEED).choice([-1.0, 1.0], (_DRAWS, count))


def _share_beyond(drawn: Array, observed: float, *, is_exact: bool) -> float:
    """Return the share of statistics that are at least as far from 0 as the observed one."""
    count = int(np.sum(drawn >= observed - _TIE * max(1.0, observed)))
    # Of random draws, the observed one counts as one of them: so p is never 0.
    return count / len(drawn) if is_exact else (count + 1) / (len(drawn) + 1)


def wilcoxon_p(differences: Sequence[float]) -> float:
    """Return the two-sided p of Wilcoxon's signed-rank test; 1.0 if no difference is left.

    Differences of 0 are left out.
    """
    # Rounded, because sums of equal answers may differ in their last digits.
    kept = [d for d in np.round(sorted(differences), 9) if d != 0.0]
    return float(stats.wilcoxon(kept).pvalue) if kept else 1.0


def sign_test_p(one: int, other: int) -> float:
    """Return the two-sided p of the sign test; 1.0 if nobody prefers either."""
    both = one + other
    return float(stats.binomtest(one, both, 0.5).pvalue) if both else 1.0


def order_effect(differences: Sequence[float], is_a_first: Sequence[bool]) -> Interval:
    """Return by how much the second mapping differs from the first one, whichever it is.

    Half of the difference between the people who began with A and those who began with B, which
    the difference between the mappings does not change. The interval is Welch's.

    Args:
        differences: B minus A of each person.
        is_a_first: Whether the person began with A.
    """
    pairs = list(zip(differences, is_a_first, strict=True))
    groups = [sorted(d for d, first in pairs if first is a) for a in (True, False)]
    if not all(groups):
        return NOTHING
    means = [math.fsum(group) / len(group) for group in groups]
    value = 0.5 * (means[0] - means[1])
    if min(map(len, groups)) < 2:
        return Interval(value, None, None)
    parts = [float(np.var(group, ddof=1)) / len(group) for group in groups]
    if not sum(parts):
        return Interval(value, value, value)
    freedoms = (p**2 / (len(g) - 1) for p, g in zip(parts, groups, strict=True))
    half = _t_quantile(sum(parts) ** 2 / sum(freedoms)) * 0.5 * math.sqrt(sum(parts))
    return Interval(value, value - half, value + half)


def order_effect_p(
    differences: Sequence[float], is_a_first: Sequence[bool]
) -> float | None:
    """Return the two-sided p of `order_effect` by permutation of who began with which mapping.

    Args:
        differences: B minus A of each person.
        is_a_first: Whether the person began with A.

    Returns:
        p; None if all people began with the same mapping.
    """
    pairs = list(zip(differences, is_a_first, strict=True))
    mirrored = [(-d, not first) for d, first in pairs]
    # The same draws with exchanged labels.
    ordered = max(sorted(pairs), sorted(mirrored))
    values = np.array([d for d, _ in ordered])
    is_first = np.array([first for _, first in ordered])
    count = int(is_first.sum())
    if not 0 < count < len(values):
        return None
    masks = _groupings(len(values), count)
    # The sum of one group determines the other's.
    spread = masks @ values - values.sum() * count / len(values)
    observed = float(values[is_first].sum() - values.sum() * count / len(values))
    is_exact = math.comb(len(values), count) <= _DRAWS
    return _share_beyond(np.abs(spread), abs(observed), is_exact=is_exact)


@lru_cache(maxsize=32)
def _groupings(people: int, count: int) -> Array:
    """Return who is in the first group, 0 or 1, shape (draws, people)."""
    if math.comb(people, count) > _DRAWS:
        generator = np.random.default_rng(_SEED)
        return np.argsort(generator.random((_DRAWS, people)), axis=1) < float(count)
    chosen = np.array(list(combinations(range(people), count)))
    masks = np.zeros((len(chosen), people))
    np.put_along_axis(masks, chosen, 1.0, axis=1)
    return masks
