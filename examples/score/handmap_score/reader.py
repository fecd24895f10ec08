"""Whether a robot's gestures can be read: `Reader` has seen people only, and names what it sees."""

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import cdist

from handmap_qp.apps.offline.hand_trace import HandTrace
from handmap_qp.hands import Names, Side
from handmap_qp.se3 import Array, lengths, unit
from .gestures import Source, people, read_gestures

_ALIKE = 99.0
"""Gestures nearer than this percentile of one shown twice are the same gesture to the reader."""


def signs(hand: HandTrace, fingers: Names) -> Array:
    """Return what a reader looks at of k fingers, shape (T, 9 k).

    In palm axes: the vectors from knuckle to tip and from the first finger's tip (the thumb's, if
    there is one) to every tip, both as a share of the straight finger's length, and the directions
    of the last bones.
    """
    chosen = [hand.names.index(name) for name in fingers]
    knuckle, middle, tip = np.moveaxis(hand.local[:, chosen], 2, 0)
    reach = hand.reach[chosen, None]
    pointing = (tip - knuckle) / reach
    from_thumb = (tip - tip[:, :1]) / reach
    last = unit(tip - middle)
    seen = np.concatenate([pointing, from_thumb, last], axis=2)
    return seen.reshape(len(tip), -1)


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
        self._names = names = np.array(read_gestures(source).names)
        self._fingers = fingers
        seen = signs(people(source, side), fingers)
        rounds = seen.reshape(-1, len(names), seen.shape[1])
        self._means = rounds.mean(axis=0)
        changes = lengths(np.diff(rounds, axis=0))
        alike = np.percentile(changes, _ALIKE)
        tree = linkage(self._means, "complete")
        groups = fcluster(tree, alike, "distance")
        # A left and a right hand's have one label.
        labels = [name.partition(" (")[0] for name in names]
        is_label = np.equal.outer(labels, labels)
        self.same = np.equal.outer(groups, groups) | is_label
        found = {tuple(names[same].tolist()) for same in self.same}
        self.alike = sorted(group for group in found if len(group) > 1)

    def read(self, hand: HandTrace) -> tuple[Array, list[str]]:
        """Name the gestures of a hand that shows each of them in turn.

        What all of them have in common, such as a thumb that is set elsewhere, is overlooked.

        Returns:
            Whether each is named right, shape (n,); and in words, what was taken for what.
        """
        seen = signs(hand, self._fingers)
        seen += (self._means - seen.mean(axis=0)).mean(axis=0)
        named = cdist(seen, self._means).argmin(axis=1)
        is_right = self.same[:, named].diagonal()
        wrong = np.stack([self._names, self._names[named]], axis=1)[~is_right]
        return is_right, [" for ".join(pair) for pair in wrong]
