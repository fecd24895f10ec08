"""Places of labels that do not lie on each other."""

import numpy as np

from handmap_core.se3 import Array


def spread_labels(points: Array, width: float, height: float) -> Array:
    """Return places near points at which labels of one size do not overlap.

    From the lowest point on, a label moves up until it is clear of those below it.

    Args:
        points: Where the labels would be, across and up, shape (n, 2).
        width: Width of a label, in the same unit.
        height: Its height.

    Returns:
        The places, shape (n, 2); points whose labels overlap no other one stay.
    """
    places = points.astype(float)
    done: list[int] = []
    for i in np.argsort(points[:, 1], kind="stable").tolist():
        near = [k for k in done if abs(places[k, 0] - places[i, 0]) < width]
        for k in sorted(near, key=lambda k: places[k, 1]):
            if abs(places[k, 1] - places[i, 1]) < height:
                places[i, 1] = places[k, 1] + height
        done.append(i)
    return places
