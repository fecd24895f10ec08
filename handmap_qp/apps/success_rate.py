"""The success rate of trials, with its interval."""

from scipy.stats import binomtest


def success_rate(held: int, count: int) -> tuple[float, float, float]:
    """Return a success rate with its 95 % interval (Wilson).

    Args:
        held: Number of successes.
        count: Number of trials, at least 1.

    Returns:
        Rate, lower and upper end.
    """
    found = binomtest(held, count)
    interval = found.proportion_ci(method="wilson")
    return found.statistic, interval.low, interval.high
