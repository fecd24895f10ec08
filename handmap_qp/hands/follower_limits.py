"""Limits of a joint that follows another one, against those of its leader.

A follower's own limits may be narrower than what its rule asks for. Where they leave the leader
most of its range, they bound the leader. Where they leave less, the leader keeps its range, and the
follower stays at its limit. The map from leaders to followers is linear, so the follower gets the
line through both clipped ends, `rule_within`: it keeps its limits, and is exact where the leader is
at either end.

MuJoCo's couplings and limits are soft. In a model of light links, a motor moves the leader on and
pulls the follower out of its limits; with rotors' inertia, the leader stops with the follower.
"""

from typing import NamedTuple

import numpy as np

from .spec import MimicSpec

LEAST_SHARE = 0.01
"""Limits of a follower that leave its leader less of its range contradict the rule."""
MOST_SHARE = 0.5
"""Limits of a follower bound its leader if they leave it at least this share of its range."""


class Interval(NamedTuple):
    """Limits of a joint [rad or m]; empty if `low` is not below `high`."""

    low: float
    high: float

    @property
    def width(self) -> float:
        """Its width, negative if it is empty, NaN with a limit that is NaN."""
        return self.high - self.low

    def clip(self, value: float) -> float:
        """Return the nearest position inside."""
        return float(np.clip(value, self.low, self.high))


def range_left(rule: MimicSpec, own: Interval, leader: Interval) -> Interval:
    """Return the part of a leader's range in which a follower keeps its own limits.

    Args:
        rule: The follower's rule; its multiplier is not zero.
        own: Limits of the follower.
        leader: Limits of the leader.
    """
    low, high = sorted((limit - rule.offset) / rule.multiplier for limit in own)
    return Interval(max(leader.low, low), min(leader.high, high))


def leaves(share: float, left: Interval, leader: Interval) -> bool:
    """Return whether more than a share of a leader's range is left; False with NaN limits."""
    return left.width > share * leader.width


def clipped_rule(rule: MimicSpec, own: Interval, leader: Interval) -> MimicSpec | None:
    """Return `rule_within` where a follower's limits would leave its leader too little range.

    None where they leave it most of the range, and where they contradict the rule.

    Args:
        rule: The rule.
        own: Limits of the follower, NaN without any.
        leader: Limits of the leader, NaN without any.
    """
    if rule.multiplier == 0.0:
        return None
    left = range_left(rule, own, leader)
    if not leaves(LEAST_SHARE, left, leader) or leaves(MOST_SHARE, left, leader):
        return None
    return rule_within(rule, own, leader)


def rule_within(rule: MimicSpec, own: Interval, leader: Interval) -> MimicSpec:
    """Return the line through the ends of a rule, each clipped to the follower's limits.

    Its multiplier is 0 where the limits contradict the rule in all of the leader's range.

    Args:
        rule: The rule.
        own: Limits of the follower, which the line keeps in all of the leader's range.
        leader: Limits of the leader, finite and not equal.
    """
    low, high = (own.clip(rule.multiplier * end + rule.offset) for end in leader)
    multiplier = (high - low) / leader.width
    return MimicSpec(rule.joint, multiplier, low - multiplier * leader.low)


def error_within(rule: MimicSpec, own: Interval, leader: Interval) -> float:
    """Return how far `rule_within` is from the clipped rule at most [rad or m].

    Both are straight between the places where the rule meets a limit, so it is at one of them.
    """
    line = rule_within(rule, own, leader)
    left = range_left(rule, own, leader)
    return max(
        abs(
            own.clip(rule.multiplier * place + rule.offset)
            - line.multiplier * place
            - line.offset
        )
        for place in left
    )
