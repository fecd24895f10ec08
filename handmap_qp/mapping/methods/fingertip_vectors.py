"""Fingertip vectors: each robot fingertip lies from its origin as its human partner does.

The vector from an origin on the human's palm to a fingertip, in palm axes, is scaled and laid on
the same origin of the robot. The robot's palm follows the human's wrist; T is not needed.

With the palm as origin these are the wrist-to-tip vectors of the field, scaled by the ratio of the
hands' sizes. They are at the same time its fingertip positions: a position in the palm frame is the
vector from that frame's origin. So there is no other method for positions.

With each finger's knuckle as origin, every finger is scaled by its own ratio of reaches. A straight
finger stays straight then, however the hands are built. What gets lost is where fingertips are to
each other: knuckles lie elsewhere on each hand, and pinches open. With the palm as origin pinches
stay closed where the scale lets all tips arrive, but on a hand with other proportions no finger is
quite straight when the human's is.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from handmap_core.errors import InvalidOptionsError
from handmap_core.options import Positive
from handmap_core.se3 import Array, lengths
from handmap_qp.hands import Hand
from handmap_qp.mapping import (
    FOLLOWING,
    KNUCKLES,
    AlignedOptions,
    HumanPose,
    PalmMap,
    PalmMethod,
    Preset,
    Targets,
    bone_lengths,
    points_in_palm,
    require_partners,
    require_points,
    robot_fingers,
)


class FingertipVectorMap(PalmMap):
    """From samples to targets; see `TargetMap`."""

    _method: BoundFingertipVectors

    def targets(self, sample: HumanPose) -> Targets:
        """Scale the vectors and lay them on the robot's origins."""
        method = self._method
        robot_points, human_points = method.pairs
        _, palm, now = self.follow(sample)
        origins = 0.0 if method.human_origins is None else now[method.human_origins]
        vectors = now[human_points] - origins
        # Points without a partner stay where they are in the palm.
        points = self.robot_points.copy()
        points[robot_points] = method.robot_origins + method.scales[:, None] * vectors
        diagnostics = {"vectors": vectors, "scales": method.scales.copy()}
        return Targets(*self.placed(palm, points), diagnostics)


class BoundFingertipVectors(PalmMethod):
    """The method for two hands; see `BoundMethod`."""

    needs_wrist = "vectors in palm axes"
    map_type = FingertipVectorMap

    def __init__(self, method: FingertipVectors, human: Hand, robot: Hand) -> None:
        super().__init__(method, human, robot)
        pairs = require_partners(human, robot, option="method")
        if method.origin == "knuckle":
            pairs = [pair for pair in pairs if robot.reference_points[pair[0]].finger]
        self.pairs = np.array(pairs, dtype=int).reshape(-1, 2).T
        # Human points that the vectors begin at, and places of the robot in its palm.
        self.human_origins: Array | None = None
        self.robot_origins: Array | float = 0.0
        if method.origin == "palm":
            robot_size, human_size = (
                lengths(points_in_palm(hand, hand.rest)[points]).mean()
                for hand, points in zip((robot, human), self.pairs, strict=True)
            )
            ratios = robot_size / human_size
        else:
            ratios = self._begin_at_knuckles()
        self.scales = np.full(
            len(pairs), ratios if method.scale is None else method.scale
        )

    def _begin_at_knuckles(self) -> Array:
        """Take both hands' knuckles for origins; return the ratio of reaches of each finger."""
        human = self.human
        robot = self.robot
        chains = robot_fingers(robot).chains
        led = [str(robot.reference_points[j].finger) for j in self.pairs[0]]
        leading = [str(human.reference_points[k].finger) for k in self.pairs[1]]
        if not led:
            raise InvalidOptionsError(
                f"'knuckle' needs named fingers, and {robot.name} has none",
                option="origin",
                value="knuckle",
                advice="add `finger` to the points of its hand.yaml",
            )
        knuckles = [KNUCKLES[finger] for finger in leading]
        self.human_origins = require_points(human, knuckles, "origin=knuckle")
        places = [chains[finger].knuckle for finger in led]
        self.robot_origins = points_in_palm(robot, robot.rest, places)
        reaches = np.array([chains[finger].reach for finger in led])
        return reaches / bone_lengths(human, leading)


class FingertipVectors(AlignedOptions, frozen=True):
    """Map vectors to the fingertips.

    Attributes:
        scale: Factor on the vectors. If omitted, the ratio of the hands' sizes at rest for vectors
            from the palm, and of each finger's reaches for those from its knuckle.
        origin: Where the vectors begin: at the palm, or at each finger's own knuckle.
    """

    bound_type = BoundFingertipVectors
    scale: Positive | None = None
    origin: Literal["palm", "knuckle"] = "palm"


_WEAKNESS = "no T: the motion of a grasped object is not imposed; links may overlap"
PRESETS = {
    "fingertip-vectors": Preset(
        FingertipVectors(),
        FOLLOWING,
        "to compare: vectors from the palm to the fingertips, scaled by the hands' sizes",
        _WEAKNESS,
    ),
    "finger-vectors": Preset(
        FingertipVectors(origin="knuckle"),
        FOLLOWING,
        "to compare: vectors along each finger, scaled by its own reach; straight stays straight",
        f"pinches open; {_WEAKNESS}",
    ),
}
