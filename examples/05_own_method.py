"""A mapping of your own: a method, and a function from landmarks to joint angles.

Run them, compare them on a recording, and score them on public gestures:

    python examples/05_own_method.py
    handmap compare demo --robot allegro_right --methods teleoperation \
        examples/05_own_method.py:OpenAndClose examples/05_own_method.py:allegro_joints
    handmap score examples/05_own_method.py --hands allegro_right --seeds 0
"""

import numpy as np

from handmap_qp import CustomMethod, HandMapper, load_hand, read_recording, scaled_human
from handmap_qp.mapping.method import HumanPose, Targets


class OpenAndClose(CustomMethod):
    """Close all robot fingers as far as the human's fingertips come to the palm.

    Args:
        closed: Posture of the closed robot hand, as a share of the upper joint limits.
    """

    human_points = "fingertips"

    def __init__(self, closed: float = 0.7) -> None:
        self.closed = closed

    def prepare(self) -> None:
        """Compute what depends on the two hands alone."""
        robot, human = self.robot, self.human
        self.shut = robot.rest + self.closed * (robot.upper_limits - robot.rest)
        self.open_span = self.span(HumanPose(human.points(human.rest), np.eye(4)))

    def span(self, sample: HumanPose) -> float:
        """Return the mean distance of the human's fingertips from the palm [m]."""
        return float(np.linalg.norm(self.in_palm(sample), axis=1).mean())

    def targets(self, sample: HumanPose) -> Targets:
        """Return a posture between open and shut; the palm follows the human's."""
        share = 1.0 - np.clip(self.span(sample) / self.open_span, 0.0, 1.0)
        q = self.robot.rest + share * (self.shut - self.robot.rest)
        return self.place_joints(sample, q, {"share": np.array(share)})


def allegro_joints(landmarks: np.ndarray) -> dict[str, float]:
    """Return the angles between the human's bones as joints of the Allegro hand.

    Args:
        landmarks: In MediaPipe's order [m], shape (21, 3).

    Returns:
        Joint angles by name [rad]; an array in the order of `robot.joint_names` would do, too.
    """
    thumb, index, middle, ring = (bends(landmarks, finger) for finger in range(4))
    q = np.zeros((4, 4))
    q[:3, 1:] = index, middle, ring
    q[3] = 1.2, 0.4, *thumb[1:]
    return {f"joint_{i}.0": float(angle) for i, angle in enumerate(q.ravel())}


def bends(landmarks: np.ndarray, finger: int) -> np.ndarray:
    """Return the angles between the bones of a finger, from the wrist outwards [rad]."""
    first = 1 + 4 * finger
    bones = np.diff(landmarks[[0, *range(first, first + 4)]], axis=0)
    bones /= np.linalg.norm(bones, axis=1, keepdims=True)
    return np.arccos(np.clip(np.sum(bones[1:] * bones[:-1], axis=1), -1.0, 1.0))


def main() -> None:
    """Map the recording of the package by both."""
    recording = read_recording("demo", "right")
    robot = load_hand("allegro_right")
    for method, points in (
        (OpenAndClose(), "fingertips"),
        (allegro_joints, "landmarks"),
    ):
        human = scaled_human(recording, points=points)
        mapper = HandMapper(human, robot, method)
        steps = [
            mapper.map_landmarks(sample.landmarks, time=sample.time)
            for sample in recording
        ]
        moved = np.ptp([step.command.q for step in steps], axis=0).max()
        print(f"{type(mapper.method).__name__}: a joint moves by {moved:.2f} rad")


if __name__ == "__main__":
    main()
