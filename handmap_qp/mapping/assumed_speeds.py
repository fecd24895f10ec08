"""How often speed limits that are only assumed hold a robot: `AssumedSpeeds`.

A robot whose motors are faster than an assumed limit is held back for nothing. Its owner should
know, and give the true speeds.
"""

from collections import Counter
from itertools import compress
from typing import Protocol

from handmap_core.mapping.step import MapStep
from handmap_qp.hands import Hand, Names

ASSUMED_SHARE = 0.02
"""Share of samples held by an assumed speed limit from which people are told."""
# Fewer samples of a stream say little: at its start the robot goes to the person's posture.
_LEAST_SAMPLES = 100


def assumed_joints(robot: Hand) -> Names:
    """Return the joints of a robot hand or robot whose speed limits are assumed."""
    return tuple(name for hand in robot.hands for name in hand.spec.assumed_speeds)


class CountedSpeeds(Protocol):
    """What `assumed_note` needs: of an `AssumedSpeeds`, or of a message of the service."""

    @property
    def share(self) -> float:
        """Share of the samples in which an assumed speed limit held a joint."""
        ...

    @property
    def joint(self) -> str:
        """The joint that was held most often."""
        ...

    @property
    def is_often(self) -> bool:
        """Whether the share is large enough to tell people."""
        ...


def assumed_note(counted: CountedSpeeds) -> str:
    """Return a line for people who lead a robot; empty if assumed speeds hardly ever hold it."""
    if not counted.is_often:
        return ""
    return (
        f"Assumed speed limits held a joint in {100.0 * counted.share:.0f} % of the samples, most "
        f"often {counted.joint}: give the true ones by handmap hands init --speed."
    )


class AssumedSpeeds:
    """Counts the samples in which an assumed speed limit held a joint.

    Args:
        robot: The robot hand, or a robot.
    """

    def __init__(self, robot: Hand) -> None:
        assumed = {*assumed_joints(robot)}
        self._robot = robot
        self._is_assumed = [name in assumed for name in robot.joint_names]
        self._samples = 0
        self._held = 0
        self._joints = Counter[str]()

    @property
    def has_any(self) -> bool:
        """Whether any speed is assumed."""
        return any(self._is_assumed)

    @property
    def share(self) -> float:
        """Share of the samples in which an assumed speed limit held a joint; 0 without samples."""
        return self._held / max(1, self._samples)

    @property
    def joint(self) -> str:
        """The joint that was held most often; empty if none was."""
        return max(self._joints, key=lambda name: self._joints[name], default="")

    @property
    def is_often(self) -> bool:
        """Whether the share of enough samples is large enough to tell people: `ASSUMED_SHARE`."""
        return self._samples >= _LEAST_SAMPLES and self.share > ASSUMED_SHARE

    def add(self, step: MapStep) -> None:
        """Count a sample that the robot followed."""
        self._samples += 1
        is_bound = step.stages.summary.at_bound
        # Most samples end here, without an array.
        if not any(compress(is_bound, self._is_assumed)):
            return
        at_limit = self._robot.at_position_limit(step.command.q)
        names = self._robot.joint_names
        rows = zip(names, is_bound, at_limit, self._is_assumed, strict=True)
        held = [name for name, bound, limit, own in rows if own and bound and not limit]
        self._joints.update(held)
        self._held += bool(held)
