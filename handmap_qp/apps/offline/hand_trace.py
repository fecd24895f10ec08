"""What fidelity is measured on: palm, knuckles, middle joints and fingertips over time.

A human's come from raw landmarks, a robot's from its model, its joint angles and its wrist poses,
whatever mapping found those. So every mapping is measured in the same way.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import (
    Array,
    affine,
    inverse_pose,
    nearest_rotation,
    rigid_fit,
    transform_points,
)
from handmap_core.se3 import lengths as norms
from handmap_qp.hands import (
    FINGERS,
    THUMB,
    Hand,
    HumanLengths,
    Names,
    PalmKinematics,
    Side,
    find_fingers,
)
from handmap_qp.human import FIRST_JOINTS, PALM, TIPS, palm_fit_weights

MIDDLES = np.array([3, 6, 10, 14, 18])
"""Landmarks of the middle joints: the thumb's IP and the other fingers' PIP."""
KNUCKLE, MIDDLE, TIP = range(3)
"""Indices of a finger's points: the thumb's CMC or MCP, its IP or PIP, and its tip."""
ByFinger = dict[str, Array]
"""Arrays by the anatomical names of fingers."""


class HandTrace(NamedTuple):
    """A hand over time.

    Attributes:
        names: Anatomical names of its k fingers, as in `FINGERS`.
        points: Knuckle, middle joint and tip of each finger in the world [m], shape (T, k, 3, 3).
        reach: Largest distance from knuckle to tip that each finger can have [m], shape (k,).
        palm: Palm poses in the world: origin at the wrist, +y distal, +z dorsal, shape (T, 4, 4).
        size: From the palm's origin over the middle of the knuckles to the stretched fingertips,
            mean over the fingers without the thumb [m].
    """

    names: Names
    points: Array
    reach: Array
    palm: Array
    size: float

    @property
    def local(self) -> Array:
        """The points in the palm frame [m], shape (T, k, 3, 3)."""
        return transform_points(inverse_pose(self.palm)[:, None], self.points)

    @property
    def extension(self) -> Array:
        """Distance from knuckle to tip as a share of the reach, shape (T, k)."""
        knuckles, _, tips = np.moveaxis(self.points, 2, 0)
        return norms(tips - knuckles) / self.reach

    def part(self, samples: Array, names: Sequence[str]) -> "HandTrace":
        """Return some of the samples, by index or mask, and some of the fingers."""
        chosen = [self.names.index(name) for name in names]
        points = self.points[samples][:, chosen]
        palm = self.palm[samples]
        return HandTrace(tuple(names), points, self.reach[chosen], palm, self.size)


def angles_between(a: Array, b: Array) -> Array:
    """Angles between vectors of shape (..., 3) [deg], shape (...)."""
    return np.degrees(np.arctan2(norms(np.cross(a, b)), np.vecdot(a, b)))


def trace_human(
    landmarks: Array,
    lengths: HumanLengths,
    side: Side = "right",
    wrist_poses: Array | None = None,
) -> HandTrace:
    """Describe a human's motion by its raw landmarks.

    Args:
        landmarks: Measured landmarks [m], shape (T, 21, 3), finite.
        lengths: The person's lengths, as a right hand (`measure_hand`).
        side: Which hand.
        wrist_poses: Wrist poses of the tracker, shape (T, 4, 4). The palm then moves with them; its
            mean pose on the wrist comes from the landmarks. If omitted, the palm is the rigid fit
            (Kabsch 1976) of landmarks 0, 5, 9, 13 and 17 in every sample.
    """
    weights = palm_fit_weights(lengths.palm_weights)
    palm = rigid_fit(lengths.palm(side), landmarks[:, PALM], weights)
    if wrist_poses is not None:
        on_wrist = inverse_pose(wrist_poses) @ palm
        rotation = nearest_rotation(on_wrist[:, :3, :3].mean(axis=0))
        palm = wrist_poses @ affine(rotation, np.median(on_wrist[:, :3, 3], axis=0))
    points = landmarks[:, np.column_stack([FIRST_JOINTS, MIDDLES, TIPS])]
    reach = lengths.segments.sum(axis=1)
    size = norms(lengths.bases[1:].mean(axis=0)) + reach[1:].mean()
    return HandTrace(FINGERS, points, reach, palm, size)


def trace_robot(hand: Hand, q: Array, wrist: Array | None = None) -> HandTrace:
    """Describe a robot's motion by its joint angles and wrist poses.

    Args:
        hand: The robot hand.
        q: Joint angles in the order of `hand.joint_names` [rad], shape (T, n).
        wrist: Wrist poses in the world, shape (T, 4, 4); omitted for a fixed hand.
    """
    chains = find_fingers(hand)
    if wrist is None:
        palm = np.array([hand.frame_pose("palm", each) for each in q])
    else:
        palm = wrist @ hand.wrist_to_palm
    fingers = chains.values()
    places = [place for one in fingers for place in (one.knuckle, one.middle, one.tip)]
    local = PalmKinematics(hand).points(np.vstack([hand.zero, q]), places)
    local = local.reshape(1 + len(q), -1, 3, 3)
    points = transform_points(palm[:, None], local[1:])
    reach = np.array([one.reach for one in fingers])
    # The size of a thumb alone is that of the thumb.
    others = [i for i, name in enumerate(chains) if name != THUMB] or [0]
    size = norms(local[0, others, KNUCKLE].mean(axis=0)) + reach[others].mean()
    return HandTrace(tuple(chains), points, reach, palm, size)
