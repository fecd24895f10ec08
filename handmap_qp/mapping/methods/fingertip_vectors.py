"""Wrist-to-tip vectors: each robot fingertip points from the palm as its human partner does.

The vector from the human's palm to a fingertip, in palm axes, times the ratio of the hands' sizes,
is the target of the robot's fingertip from its own palm. The robot's palm follows the human's wrist.
This is the usual mapping of the field; T is not needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs
from handmap_qp.mapping.method import HumanSample, RobotPosture, Targets
from handmap_qp.mapping.palm import PalmFollower, palm_of
from handmap_qp.mapping.reference import require_partners
from handmap_qp.transform import inverse_pose, transform_points


@dataclass(frozen=True)
class FingertipVectors:
    """Map wrist-to-tip vectors.

    Args:
        scale: Factor on the vectors; the ratio of the hands' sizes at rest if omitted.

    Raises:
        InvalidOptionsError: If the scale is not a finite number > 0.
    """

    scale: float | None = None

    def __post_init__(self) -> None:
        if self.scale is not None and not (0.0 < self.scale < np.inf):
            raise InvalidOptionsError(
                option="scale", expected="a finite number > 0", value=self.scale
            )

    def bind(self, human: Hand, robot: Hand) -> BoundFingertipVectors:
        """Find the partners of the robot's points; see `Method.bind`."""
        return BoundFingertipVectors(self, human, robot)


class FingertipVectorDiagnostics(msgspec.Struct, frozen=True, eq=False):
    """What was measured of one sample.

    Attributes:
        vectors: From the human's palm to its points with a partner, in palm axes [m], shape (p, 3).
        scale: Factor from the human's vectors to the robot's.
    """

    vectors: np.ndarray
    scale: float


class BoundFingertipVectors:
    """The method for two hands; see `BoundMethod`."""

    contacts: ShapePairs | None = None
    needs_wrist = "wrist-to-tip vectors"
    reference_needs_wrist = ""
    renews_reference = False

    def __init__(self, method: FingertipVectors, human: Hand, robot: Hand) -> None:
        self.human, self.robot = human, robot
        self.pairs = np.array(require_partners(human, robot, option="method")).T
        self.scale = method.scale or self._size(robot, self.pairs[0]) / self._size(
            human, self.pairs[1]
        )

    def start_palm(self, sample: HumanSample) -> np.ndarray:
        """Return the human's palm."""
        return palm_of(sample, self.human)

    def start(self, sample: HumanSample, robot: RobotPosture) -> FingertipVectorMap:
        """Count the palm's displacement from here; the fingers need no reference."""
        return FingertipVectorMap(self, sample, robot)

    def _size(self, hand: Hand, points: np.ndarray) -> float:
        palm = hand.wrist_to_palm[:3, 3]
        return float(np.linalg.norm(hand.points(hand.rest)[points] - palm, axis=1).mean())


class FingertipVectorMap:
    """From samples to targets; see `TargetMap`."""

    def __init__(
        self, method: BoundFingertipVectors, sample: HumanSample, robot: RobotPosture
    ) -> None:
        self.rest = method.robot.rest
        self._pairs, self._scale = method.pairs, method.scale
        self._follower = PalmFollower(method.human, method.robot, sample, robot)
        robot_palm = robot.wrist @ method.robot.wrist_to_palm
        self._in_palm = transform_points(inverse_pose(robot_palm), robot.points)

    def targets(self, sample: HumanSample) -> Targets:
        """Scale the vectors and lay them on the robot's palm."""
        robot_points, human_points = self._pairs
        human_palm, palm = self._follower.palms(sample)
        vectors = transform_points(inverse_pose(human_palm), sample.points)[human_points]
        # Points without a partner stay where they are in the palm.
        in_palm = self._in_palm.copy()
        in_palm[robot_points] = self._scale * vectors
        return Targets(
            transform_points(palm, in_palm),
            self._follower.wrist(palm),
            FingertipVectorDiagnostics(vectors, self._scale),
        )
