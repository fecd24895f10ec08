"""The published method, in Python to read, beside the compiled core that moves robots.

Each function is in `handmap_qp/reference`. docs/theory.md has the formulas.

    python examples/11_published_method.py
"""

import numpy as np

from handmap_qp import (
    HandMapper,
    IkOptions,
    MappingOptions,
    PublishedMethod,
    decompose,
    estimate_motion,
    load_hand,
    read_recording,
)

TIPS = [4, 8, 12, 16, 20]
"""The fingertips among the 21 landmarks."""


def print_motion(before: np.ndarray, after: np.ndarray) -> None:
    """Print how a hand has moved, by its fingertips (n, 3) [m]: eqs. 2 to 6."""
    # Five fingertips are nearly in a plane: the ridge keeps noise from stretching the hand.
    estimate = estimate_motion(before, after, ridge=0.1)
    parts = decompose(estimate.motion, pivot=before.mean(axis=0))
    turn = np.degrees(np.arccos((np.trace(parts.rotation) - 1.0) / 2.0))
    print(f"rigid part: a turn by {turn:.0f} deg")
    print(f"deformation: stretches {np.round(parts.stretches, 2)}")
    print(f"not in T: {1e3 * estimate.residual_norms.mean():.0f} mm a fingertip")


def main() -> None:
    """Map a recorded hand by the published method, and by the core."""
    human = load_hand("human", points="landmarks")
    robot = load_hand("allegro_right")
    landmarks = read_recording("demo", "right").landmarks[:120:4]
    print_motion(landmarks[0, TIPS], landmarks[10, TIPS])
    paper = MappingOptions()
    # Targets by numpy (eq. 7); the QP by mink, over Pinocchio, solved by OSQP (in place of eq. 8).
    ik = IkOptions(formulation="mink", solver="osqp")
    published = HandMapper(human, robot, PublishedMethod(paper), ik=ik)
    compiled = HandMapper(human, robot, paper)
    steps = [published.map_landmarks(each, dt=1 / 15) for each in landmarks]
    commands = [compiled.map_landmarks(each, dt=1 / 15).command for each in landmarks]
    apart = max(
        np.abs(step.command.q - command.q).max()
        for step, command in zip(steps, commands, strict=True)
    )
    print(f"the core's joints differ by {apart:.0e} rad at most")


if __name__ == "__main__":
    main()
