"""Whether a robot's gestures can be read: `Reader` has seen people only, and names what it sees."""

from itertools import compress

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import cdist

from handmap_qp.apps.offline.hand_trace import MIDDLE, TIP, HandTrace, angles_between
from handmap_qp.hands import THUMB, Names, Side
from handmap_qp.se3 import Array, lengths, unit
from .gestures import Source, people, read_gestures

_ALIKE = 99.0
"""Gestures nearer than this percentile of one shown twice are the same gesture to the reader."""


def signs(hand: HandTrace) -> Array:
    """Return what a reader looks at of a hand with k fingers, shape (T, 9 k).

    In palm axes: the vectors from knuckle to tip and from the first finger's tip (the thumb's, if
    there is one) to every tip, both as a share of the straight finger's length, and the directions
    of the last bones.
    """
    knuckle, middle, tip = np.moveaxis(hand.local, 2, 0)
    reach = hand.reach[:, None]
    from_knuckle = (tip - knuckle) / reach
    from_first = (tip - tip[:, :1]) / reach
    seen = np.hstack([from_knuckle, from_first, unit(tip - middle)])
    return seen.reshape(len(tip), -1)


def constant_thumb_error(person: HandTrace, robot: HandTrace) -> float:
    """Return how far off the thumb's last bone is in all gestures together [deg].

    It is the angle between the means of both hands' directions, in palm axes: errors that differ
    from gesture to gesture cancel out, and what is left is the same in each.

    Args:
        person: The person's hand, a sample for each gesture.
        robot: The robot's, in the same samples.

    Returns:
        NaN if a hand has no thumb.
    """
    if not all(THUMB in hand.names for hand in (person, robot)):
        return np.nan
    one, other = (_last_bones(hand, THUMB).mean(axis=0) for hand in (person, robot))
    return float(angles_between(one, other))


def _last_bones(hand: HandTrace, finger: str) -> Array:
    """Return directions from a finger's middle joint to its tip in palm axes, shape (T, 3)."""
    points = hand.local[:, hand.names.index(finger)]
    return unit(points[:, TIP] - points[:, MIDDLE])


class Reader:
    """Names gestures by the nearest mean of people who showed them.

    It looks at the fingers that the robot has. Gestures that these fingers of people do not tell
    apart count as one: their means are nearer than 99 of 100 showings of one gesture are to each
    other (complete linkage). So do those of one label.

    Args:
        source: Where the n gestures are from.
        side: Which hand people show them with.
        fingers: Fingers to look at.

    Attributes:
        same: Whether two gestures count as one, shape (n, n).
        alike: The groups of gestures that do, by name.
    """

    def __init__(self, source: Source, side: Side, fingers: Names) -> None:
        self._names = names = read_gestures(source).names
        shown = people(source, side)
        seen = signs(shown.part(np.arange(len(shown.points)), fingers))
        rounds = seen.reshape(-1, len(names), seen.shape[1])
        self._means = rounds.mean(axis=0)
        changes = lengths(np.diff(rounds, axis=0))
        alike = np.percentile(changes, _ALIKE)
        groups = fcluster(linkage(self._means, "complete"), alike, "distance")
        # A left and a right hand's have one label.
        labels = [name.partition(" (")[0] for name in names]
        self.same = np.equal.outer(groups, groups) | np.equal.outer(labels, labels)
        found = {tuple(compress(names, same)) for same in self.same}
        self.alike = sorted(group for group in found if len(group) > 1)

    def read(self, hand: HandTrace, shown: Names) -> list[str]:
        """Name the gestures of a hand.

        Nothing that they have in common is overlooked: a thumb that is wrong in the same way in
        each of them is seen wrong in each. Every gesture is read by itself.

        Args:
            hand: The reader's fingers of a hand, a sample for each time that it shows one.
            shown: What it means to show in each.

        Returns:
            What each is taken for: the gesture itself if one that counts as the same.
        """
        wanted = [self._names.index(name) for name in shown]
        named = cdist(signs(hand), self._means).argmin(axis=1)
        is_right = self.same[wanted, named]
        return [self._names[i] for i in np.where(is_right, wanted, named)]
