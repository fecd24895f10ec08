"""How long a robot hand takes to close: `fist_time`.

A hand whose joints are slow follows late, whatever maps to it. People should know by how much.
"""

from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from handmap_core.se3 import Array, frozen
from handmap_qp.hands import FINGERS, Hand
from handmap_qp.human import standard_postures
from .hand_mapper import HandMapper
from .hand_pair import finger_landmarks

PERSON_FIST_TIME = 1.0
"""People close a finger within this time, in 95 % of the closings of recordings [s].

`python benchmarks bench_closings` measures it: a 95th percentile of 0.96 s, and a median of 0.30 s.
"""
# Steps from the flat hand to the fist, and most steps until a posture is settled.
_STEPS = 45
_MOST_STEPS = 40
# A posture is settled when no joint moves farther in a step [rad or m].
_SETTLED = 1e-4


class FistTime(NamedTuple):
    """Time that a robot hand takes from a flat hand to a fist.

    Attributes:
        time: Time of the joint that takes longest [s]; 0 if none moves.
        joint: Its name; the first joint's if none moves.
        joint_times: Time of each joint [s], shape (n,), in the order of `Hand.joint_names`; 0 of
            joints that move the wrist.
        is_assumed: Whether speeds are assumed (`HandSpec.speeds`), and so this time is.
    """

    time: float
    joint: str
    joint_times: Array
    is_assumed: bool

    @property
    def is_slow(self) -> bool:
        """Whether people close their fingers in less time: `PERSON_FIST_TIME`."""
        return self.time > PERSON_FIST_TIME


class KnownFist(Protocol):
    """What `slow_note` needs of a fist: of a `FistTime`, or of a message of the service."""

    @property
    def time(self) -> float:
        """Time from a flat hand to a fist [s]."""
        ...

    @property
    def is_slow(self) -> bool:
        """Whether people are faster."""
        ...

    @property
    def is_assumed(self) -> bool:
        """Whether the speeds are assumed."""
        ...


def slow_note(fist: KnownFist) -> str:
    """Return a line for people who lead a slow hand; empty if it is not slow."""
    if not fist.is_slow:
        return ""
    speeds = " by assumed speeds" if fist.is_assumed else ""
    return f"This hand needs {fist.time:.1f} s for a fist{speeds}: a person is faster."


def fist_time(human: Hand, robot: Hand) -> FistTime:
    """Compute how long a robot hand takes from a flat hand to a fist at its joints' speed limits.

    The postures are those that the robot's default preset maps a person's flat hand and fist to
    without speed limits (`standard_postures`), the fist gradually from the flat hand. The time of a
    joint is

        |q_fist - q_flat| / v,

    with its speed limit v (`Hand.velocity_limits`), which already keeps its followers within
    theirs. The joints move at once, so the slowest one decides. It is the least time: a joint that
    has to go a detour takes longer. Locked joints and those of an arm do not count. The time does
    not depend on a person's measures: a scaled human hand counts as the one that was scaled.

    Args:
        human: The human hand, or the hands of a person as one (`joined`).
        robot: The robot hand, or a robot; of several hands, each joint's longest time counts.

    Returns:
        The time, found once for each pair of hands.

    Raises:
        InvalidOptionsError: If the hands cannot be mapped by the default preset.
        DegeneratePointsError: If the reference points do not determine the motion.
    """
    humans = {hand.side: hand for hand in human.hands}
    found = [
        _joint_times(_standard(humans.get(hand.side, human.hands[0])), hand)
        for hand in robot.hands
    ]
    times = np.max(found, axis=0)
    worst = int(np.argmax(times))
    is_assumed = any(hand.spec.speeds == "assumed" for hand in robot.hands)
    return FistTime(
        float(times[worst]), robot.joint_names[worst], frozen(times), is_assumed
    )


@lru_cache(maxsize=16)
def _standard(human: Hand) -> Hand:
    """Return a human hand of the package's size that has the fingers' landmarks as points."""
    usual = human.unscaled or human
    names = {point.name for point in usual.reference_points}
    has_all = names.issuperset(finger_landmarks(FINGERS))
    return usual if has_all else usual.with_points("landmarks")


@lru_cache(maxsize=64)
def _joint_times(human: Hand, robot: Hand) -> Array:
    """Return the time of each joint of one robot hand [s], shape (n,); see `fist_time`."""
    mapper = HandMapper(human, robot)
    mapper.configure(ik=mapper.ik.replaced(has_velocity_limits=False))
    postures = standard_postures(human)
    flat = postures["flat hand"]
    fist = postures["fist"]
    start = _settle(mapper, flat)
    for share in np.linspace(0.0, 1.0, _STEPS)[1:]:
        mapper.map_step(flat + share * (fist - flat), np.eye(4))
    end = _settle(mapper, fist)
    travel = np.where(robot.moves_wrist, 0.0, np.abs(end - start))
    return frozen(travel / robot.velocity_limits)


def _settle(mapper: HandMapper, posture: Array) -> Array:
    """Map a posture of the person until the robot is at rest, and return its joints, shape (n,)."""
    before = np.full(len(mapper.robot.joint_names), np.inf)
    q = before
    for _ in range(_MOST_STEPS):
        q = mapper.map_step(posture, np.eye(4)).command.q
        if np.abs(q - before).max() < _SETTLED:
            break
        before = q
    return q
