"""How far a robot leans: the joints that carry another limb too, such as a waist or a torso."""

from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array
from handmap_qp.hands import Hand, Names, Values, are_prismatic


class Leaning(NamedTuple):
    """What the k joints of a robot that carry another limb do in T samples.

    Attributes:
        joints: Their names; none if the robot cannot lean.
        away: How far each is from rest [rad or m], shape (T, k).
        at_limit: Whether each is at a position limit, shape (T, k).
        is_angle: Whether each turns, shape (k,); others slide.
    """

    joints: Names
    away: Array
    at_limit: Array
    is_angle: Array

    @property
    def rows(self) -> list[Values]:
        """How far each joint goes (`most`) [rad or m], and the share of samples at a limit."""
        return [
            {
                "joint": joint,
                "most": self.away[:, i].max(),
                "at_limit_share": self.at_limit[:, i].mean(),
                "is_angle": self.is_angle[i],
            }
            for i, joint in enumerate(self.joints)
        ]

    @property
    def median(self) -> float:
        """How far the joint that is farthest from rest is there, in the median; NaN without any.

        In degrees, or in millimetres if all of them slide.
        """
        if not self.joints:
            return np.nan
        # A slide beside joints that turn is not compared with them.
        farthest = self.away[:, self.is_angle == self.is_angle.any()].max(axis=1)
        unit = np.degrees(1.0) if self.is_angle.any() else 1e3
        return float(unit * np.median(farthest))

    @property
    def bent_share(self) -> float:
        """Share of the samples in which any joint is at a limit; NaN without any."""
        return float(self.at_limit.any(axis=1).mean()) if self.joints else np.nan


def measure_leaning(
    robot: Hand,
    q: Array,
    at_limit: Array | None = None,
    *,
    samples: Array | slice = slice(None),
) -> Leaning:
    """Measure how far a robot leans.

    Args:
        robot: The robot hand, or the hands of a robot as one.
        q: Joint positions in the order of `robot.joint_names` [rad or m], shape (T, n).
        at_limit: Whether each joint is at a position limit, shape (T, n); found if omitted.
        samples: Those that count: flags, shape (T,); all if omitted.
    """
    if at_limit is None:
        at_limit = robot.at_position_limit(q)
    carries = np.flatnonzero(robot.carries_limbs)
    return Leaning(
        joints=tuple(robot.joint_names[i] for i in carries),
        away=np.abs(q[:, carries][samples] - robot.rest[carries]),
        at_limit=at_limit[:, carries][samples],
        is_angle=~are_prismatic(robot)[carries],
    )
