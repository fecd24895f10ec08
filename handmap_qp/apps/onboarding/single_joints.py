"""Fingers with one flexing joint each: whether they are jaws, and where they are straight.

Such a finger has the same length everywhere, so it shows no curling. Either it is a finger, which
is straight at zero, or it is a jaw, which closes towards the other tips and is open at one end of
its range. Both readings of a hand stand in the table of `hypotheses`.
"""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from handmap_core.se3 import Array, unit
from handmap_qp.hands import PARALLEL, THUMB, Finger, Hand, PalmKinematics
from .vectors import across_ways

FingerKind = Literal["fingers", "jaws"]
"""What fingers with one flexing joint each are; of other fingers it says nothing."""
# So many fingers are parallel at zero where there are two beside each other, and where no gripper
# has them.
_PAIR = 2
_ROW = 3
# What a pair says, where a row says 1 and single fingers say -1.
_PAIR_VALUE = 0.3
# Confidence in the flexion from zero of parallel fingers, and of one beside them.
_UNFOLDED = 0.95
_BESIDE = 0.7
# They are beside each other if the cosine between their bases and the motion of a tip is smaller.
_BESIDE_EACH_OTHER = 0.5
# Fingers oppose each other if the cosine between the motions of their tips is smaller.
_OPPOSED = -0.5


class SingleJoints(NamedTuple):
    """The fingers of a hand that have one flexing joint, if there are any.

    Attributes:
        straight: Confidence in their flexion from zero if they are fingers, 0 of all others, shape
            (F,).
        values: What each kind of evidence says for fingers and against jaws, from -1 to 1.
    """

    straight: Array
    values: Mapping[str, float]

    @property
    def is_ambiguous(self) -> bool:
        """Whether any finger can be a jaw, or a finger that is straight at zero."""
        return bool(self.straight.any())


def find_single_joints(
    robot: Hand, fingers: Sequence[Finger], labels: Sequence[str | None]
) -> SingleJoints:
    """Find the fingers with one flexing joint, and what speaks for fingers or for jaws.

    Args:
        robot: The robot, or a hand.
        fingers: Fingers of it.
        labels: The anatomical name in the names of each finger.
    """
    count = len(fingers)
    view = PalmKinematics(robot)
    lower, upper = robot.limits
    # Share of each range beyond zero: 0 where zero is an end, 0.5 in the middle.
    beyond = np.minimum(np.abs(lower), np.abs(upper)) / (upper - lower)
    beyond[lower * upper >= 0.0] = 0.0
    lines = np.zeros((count, 3))
    ways = np.zeros((count, 3))
    shares = np.full(count, 0.5)
    is_known = np.zeros(count, bool)
    tips = view.points(robot.zero, [finger.tip for finger in fingers])
    for i, group in enumerate(finger.flexion for finger in fingers):
        if group is None or group.curls:
            continue
        (joints,) = np.nonzero(group.signs)
        if len(joints) == 1:
            shares[i] = beyond[joints[0]]
            is_known[i] = group.sense != 0.0
            lines[i] = tips[i] - group.knuckle
            ways[i] = (group.sense or 1.0) * np.cross(group.axis, lines[i])
    lines = unit(lines)
    ways = unit(ways)
    _, roots = view.axes(
        robot.zero, [(each.joints or fingers[0].joints)[0] for each in fingers]
    )
    # Equal ranges to both sides do not tell the way: fingers are then beside each other, and not
    # opposite to each other.
    apart = unit(roots[:, None] - roots)
    is_beside = np.abs(np.vecdot(apart, ways[:, None])) < _BESIDE_EACH_OTHER
    cosines = ways @ ways.T
    is_parallel = np.where(
        is_known & is_known[:, None],
        cosines > PARALLEL,
        (np.abs(cosines) > PARALLEL) & is_beside,
    )
    is_alike = (lines @ lines.T > PARALLEL) & is_parallel
    alike = is_alike[is_alike.sum(axis=1).argmax()]
    size = int(alike.sum())
    if not size:
        return SingleJoints(np.zeros(count), {})
    # Two fingers beside each other are a gripper's whole hand.
    parallel = -1.0
    if count > _PAIR and size >= _PAIR:
        parallel = 1.0 if size >= _ROW else _PAIR_VALUE
    values = {
        "parallel": parallel,
        "range": 1.0 - 4.0 * float(shares[alike].max()),
        "apart": -1.0 if _part(alike, ways * is_known[:, None], lines, roots) else 0.0,
        "thumb and finger": 1.0 if count <= _PAIR and THUMB in labels else 0.0,
    }
    beside = _BESIDE * ways.any(axis=1)
    straight = np.where(alike & (size >= _PAIR) & (count > _PAIR), _UNFOLDED, beside)
    return SingleJoints(straight, values)


def _part(alike: Array, ways: Array, lines: Array, roots: Array) -> bool:
    """Return whether some fingers and the others go apart from zero, as jaws that open.

    Args:
        alike: Which fingers are parallel, shape (F,).
        ways: Unit direction of each tip's motion from zero; zero if not known, shape (F, 3).
        lines: Unit direction of each finger at zero, shape (F, 3).
        roots: Origin of each finger's first joint [m], shape (F, 3).
    """
    if alike.all():
        return False
    ways = across_ways(ways, lines, np.flatnonzero(alike))
    way = unit(ways[alike].sum(axis=0))
    apart = roots[alike].mean(axis=0) - roots[~alike].mean(axis=0)
    is_opposed = ways[~alike] @ way < _OPPOSED
    return bool(is_opposed.any() and apart @ way > 0.0)
