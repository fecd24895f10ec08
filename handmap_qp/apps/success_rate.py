"""The success rate of trials, with its interval."""

import math
from statistics import NormalDist


def success_rate(held: int, count: int) -> tuple[float, float, float]:
    """Return a success rate with its 95 % interval (Wilson 1927).

    SciPy has the same in `scipy.stats`, which takes a second to import.

    Args:
        held: Number of successes.
        count: Number of trials, at least 1.

    Returns:
        Rate, lower and upper end.
    """
    rate = held / count
    z = NormalDist().inv_cdf(0.975)
    middle = rate + z**2 / (2.0 * count)
    reach = z * math.sqrt((rate * (1.0 - rate) + z**2 / (4.0 * count)) / count)
    low, high = ((middle + sign * reach) / (1.0 + z**2 / count) for sign in (-1, 1))
    # Rounding must not leave these ends.
    return rate, low if held else 0.0, high if held < count else 1.0
