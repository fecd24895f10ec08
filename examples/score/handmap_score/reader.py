"""Whether a robot's gestures can be read: `Reader` has seen people only, and names what it sees."""

from collections.abc import Sequence

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import cdist

from handmap_qp.apps.offline.hand_trace import HandTrace
from handmap_qp.se3 import Array, lengths, unit

_ALIKE = 99.0
"""Gestures nearer than this percentile of one shown twice are the same gesture to the reader."""


def signs(hand: HandTrace, names: Sequence[str], samples: Array) -> Array:
    """Return what a reader looks at, of k fingers in n samples, shape (n, 9 k).

    In palm axes: the vectors from knuckle to tip and from the first finger's tip (the thumb's, if
    there is one) to every tip, both as a share of the straight finger's length, and the directions
    of the last bones.
    """
    fingers = hand.part(samples, names)
    knuckle, middle, tip = np.moveaxis(fingers.local, 2, 0)
    reach = fingers.reach[:, None]
    seen = [(tip - knuckle) / reach, (tip - tip[:, :1]) / reach, unit(tip - middle)]
    return np.concatenate(seen, axis=2).reshape(len(tip), -1)


class Reader:
    """Names gestures by the nearest mean of people who showed them.

    It looks at the fingers that the robot has. Gestures that these fingers of people do not tell
    apart count as one: their means are nearer than 99 of 100 showings of one gesture are to each
    other (complete linkage). So do those of one label.

    Args:
        people: A person who shows every gesture in turn, and then all of them again.
        labels: Label of each gesture.
        names: Fingers to look at.

    Attributes:
        same: Whether two gestures count as one, shape (n, n).
    """

    def __init__(
        self, people: HandTrace, labels: Sequence[str], names: Sequence[str]
    ) -> None:
        self._names = names
        count = len(labels)
        seen = signs(people, names, np.arange(len(people.palm))).reshape(
            -1, count, 9 * len(names)
        )
        self._means = seen.mean(axis=0)
        alike = np.percentile(lengths(np.diff(seen, axis=0)), _ALIKE)
        groups = fcluster(linkage(self._means, "complete"), alike, "distance")
        both = (groups, np.array(labels))
        self.same = np.any([each[:, None] == each for each in both], axis=0)

    def read(self, hand: HandTrace, samples: Array) -> Array:
        """Return the index of the gesture that each of k samples shows, shape (k,).

        What all of them have in common, such as a thumb that is set elsewhere, is overlooked: they
        must be of all gestures.
        """
        seen = signs(hand, self._names, samples)
        seen += (self._means - seen.mean(axis=0)).mean(axis=0)
        return cdist(seen, self._means).argmin(axis=1)
