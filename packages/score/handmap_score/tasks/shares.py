"""Statistics of attempts: intervals of shares, paired comparisons, and stable orders."""

import math
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest

from handmap_qp.errors import expect
from handmap_qp.hands import Names
from handmap_qp.se3 import Array

_QUANTILE = 1.959963984540054  # of the normal distribution, for 95 % on both sides
LEVEL = 0.05
"""Mappings are told apart if their difference is less likely by chance."""


class Share(NamedTuple):
    """A share with its 95 % interval.

    Attributes:
        successes: How many attempts succeeded.
        attempts: How many there were.
        low: Lower end, from 0 to 1.
        high: Upper end.
    """

    successes: int
    attempts: int
    low: float
    high: float

    @property
    def mean(self) -> float:
        """The share itself, from 0 to 1."""
        return self.successes / self.attempts

    def __str__(self) -> str:
        """Return such as `17/20, 64-95 %`."""
        low, high = 100.0 * self.low, 100.0 * self.high
        return f"{self.successes}/{self.attempts}, {low:.0f}-{high:.0f} %"


def wilson(successes: int, attempts: int) -> Share:
    """Return a share with its 95 % interval by Wilson's score, which also holds at 0 and 1.

    Args:
        successes: From 0 to `attempts`.
        attempts: At least 1.

    Raises:
        InvalidInputError: If the numbers are others.
    """
    expect(attempts > 0, "attempts", "at least one", value=attempts)
    is_right = 0 <= successes <= attempts
    expect(is_right, "successes", f"0 to {attempts}", value=successes)
    mean = successes / attempts
    spread = _QUANTILE**2 / attempts
    middle = (mean + 0.5 * spread) / (1.0 + spread)
    variance = mean * (1.0 - mean) / attempts + 0.25 * spread / attempts
    half = _QUANTILE * math.sqrt(variance) / (1.0 + spread)
    # Exact at the ends, where rounding leaves 1e-17.
    low = 0.0 if successes == 0 else middle - half
    high = 1.0 if successes == attempts else middle + half
    return Share(successes, attempts, low, high)


class Pair(NamedTuple):
    """Two mappings on the same scenes.

    Attributes:
        first: Name of one.
        second: Name of the other.
        first_only: Scenes in which the first one alone succeeded.
        second_only: Scenes in which the second one alone did.
        p: McNemar's exact probability of a split at least as uneven by chance, two-sided.
    """

    first: str
    second: str
    first_only: int
    second_only: int
    p: float

    @property
    def is_apart(self) -> bool:
        """Whether the two are told apart."""
        return self.p < LEVEL


def mcnemar(first: str, second: str, wins: Array, others: Array) -> Pair:
    """Compare two mappings over the same scenes.

    Args:
        first: Name of the one.
        second: Name of the other.
        wins: Whether the first one succeeded in each scene, shape (n,).
        others: The same of the second one, in the same order.
    """
    expect(wins.shape == others.shape, "others", f"{wins.shape} outcomes", value=others)
    first_only = int((wins & ~others).sum())
    second_only = int((others & ~wins).sum())
    split = first_only + second_only
    p = binomtest(first_only, split, 0.5).pvalue if split else 1.0
    return Pair(first, second, first_only, second_only, float(p))


class Order(NamedTuple):
    """Whether an order of mappings holds in each block of seeds.

    Attributes:
        names: Mappings, best first.
        apart: Pairs that are told apart over all blocks.
        reversed: Pairs of `apart` that turn round in a block, and how many blocks did so.
        blocks: How many blocks there are.
    """

    names: Names
    apart: Sequence[Pair]
    reversed: Sequence[tuple[Pair, int]]
    blocks: int

    @property
    def is_stable(self) -> bool:
        """Whether pairs are told apart, and none turns round in any of at least two blocks."""
        return self.blocks > 1 and bool(self.apart) and not self.reversed


def order_of(outcomes: dict[str, Array]) -> Order:
    """Return the order of mappings, and whether it is stable over the blocks.

    Args:
        outcomes: Whether each attempt succeeded by mapping, shape (blocks, attempts): the same
            scenes for all mappings.
    """
    shares = {name: float(wins.mean()) for name, wins in outcomes.items()}
    names = tuple(sorted(outcomes, key=shares.__getitem__, reverse=True))
    pairs = [
        mcnemar(better, worse, outcomes[better].ravel(), outcomes[worse].ravel())
        for better, worse in combinations(names, 2)
    ]
    apart = [pair for pair in pairs if pair.is_apart]
    turned = []
    for pair in apart:
        ahead = outcomes[pair.first].mean(axis=1) - outcomes[pair.second].mean(axis=1)
        if count := int((ahead < 0.0).sum()):
            turned.append((pair, count))
    blocks = len(next(iter(outcomes.values()))) if outcomes else 0
    return Order(names, apart, turned, blocks)


def contradictions(one: Order, other: Order) -> list[tuple[str, str]]:
    """Return pairs that two orders tell apart in opposite ways; of two operators, for example."""
    reverse = {(pair.second, pair.first) for pair in other.apart}
    return [
        (pair.first, pair.second)
        for pair in one.apart
        if (pair.first, pair.second) in reverse
    ]


def drawn(count: int, share: float, seed: int) -> Array:
    """Return the indices of a random share of `count` things, at least one if there are any."""
    number = min(count, max(1, math.ceil(share * count)))
    chosen = np.random.default_rng(seed).choice(count, number, replace=False)
    return np.sort(chosen)
