"""A mapping method of your own: the robot's joints mirror how far the human's hand is closed.

The three stages are those of `handmap_qp/mapping/method.py`.

    python examples/05_own_method.py
"""

from dataclasses import dataclass

import numpy as np

from handmap_qp import Hand, HandMapper, load_hand
from handmap_qp.mapping.method import HumanPose, RobotPosture, Targets


@dataclass(frozen=True)
class OpenAndClose:
    """Close all robot fingers as far as the human's fingertips come to the wrist.

    Args:
        closed: Posture of the closed robot hand, as a share of the upper joint limits.
    """

    closed: float = 0.7

    def bind(self, human: Hand, robot: Hand) -> "BoundOpenAndClose":
        """Check the method against two hands."""
        return BoundOpenAndClose(self, human, robot)


class BoundOpenAndClose:
    """The method for two hands."""

    contacts = None
    needs_wrist = "where the robot's wrist goes"
    reference_needs_wrist = ""
    renews_reference = False

    def __init__(self, choices: OpenAndClose, human: Hand, robot: Hand) -> None:
        self.robot = robot
        self.rest = robot.rest
        self.shut = robot.rest + choices.closed * (robot.upper_limits - robot.rest)
        self.span = tip_distance(human.points(human.rest), np.eye(4))

    def start_palm(self, sample: HumanPose) -> np.ndarray:
        """Put the robot's palm where the human's wrist is."""
        assert sample.wrist is not None, "the mapper checks needs_wrist"
        return sample.wrist

    def start(self, sample: HumanPose, robot: RobotPosture) -> "BoundOpenAndClose":
        """Take the reference; this method needs none."""
        return self

    def targets(self, sample: HumanPose) -> Targets:
        """Return the reference points of the robot at a posture between open and shut."""
        assert sample.wrist is not None
        share = 1.0 - np.clip(
            tip_distance(sample.points, sample.wrist) / self.span, 0.0, 1.0
        )
        q = self.rest + share * (self.shut - self.rest)
        return Targets(
            self.robot.points(q, sample.wrist), sample.wrist, {"share": np.array(share)}
        )


def tip_distance(points: np.ndarray, wrist: np.ndarray) -> float:
    """Return the mean distance of points from the wrist [m]."""
    return float(np.linalg.norm(points - wrist[:3, 3], axis=1).mean())


def main() -> None:
    """Map a closing hand by the method."""
    human = load_hand("human", points="fingertips")
    mapper = HandMapper(human, load_hand("allegro_right"), OpenAndClose(), dt=1 / 60)
    postures = human.rest + np.linspace(0.0, 0.8, 60)[:, None] * (
        human.upper_limits - human.rest
    )
    step = [mapper.map_step(q, np.eye(4)) for q in postures][-1]
    moved = np.abs(step.command.q - mapper.robot.rest).max()
    print(
        f"closed by {100 * step.diagnostics['share']:.0f} %, a joint moved by {moved:.2f} rad"
    )


if __name__ == "__main__":
    main()
