"""Small recordings and methods for the tests of comparisons."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.hands.library import load_hand
from handmap_qp.se3 import affine, quat_wxyz_from_rotation, transform_points

RATE = 50.0


def closing_arrays(side: str = "right", seconds: float = 1.2) -> dict[str, np.ndarray]:
    """Record a hand that closes while its wrist turns; three samples are not valid."""
    human = load_hand("human" if side == "right" else "human_left", points="landmarks")
    count = round(seconds * RATE)
    time = np.arange(count) / RATE
    landmarks, wrists = np.empty((count, 21, 3)), np.empty((count, 7))
    for i, share in enumerate(np.linspace(0.0, 1.0, count)):
        flexed = np.array(
            [0.0 if "abduction" in name else 1.1 for name in human.joint_names]
        )
        q = np.clip(share * flexed, human.lower_limits, human.upper_limits)
        turn = Rotation.from_rotvec([0.3 * share, -0.2, 0.5 * share]).as_matrix()
        pose = affine(turn, np.array([0.2 * share, 1.0, -0.3]))
        landmarks[i] = transform_points(pose, human.points(q))
        wrists[i] = [*pose[:3, 3], *quat_wxyz_from_rotation(turn)]
    valid = np.ones(count, dtype=bool)
    valid[40:43] = False
    landmarks[40:43], wrists[40:43] = np.nan, np.nan
    return {
        "time": time,
        "landmarks": landmarks,
        "valid": valid,
        "handedness": np.array(side),
        "wrist_pose": wrists,
    }


def write_closing(
    folder: Path, name: str = "closing", side: str = "right", seconds: float = 1.2
) -> Path:
    """Write the recording to a file."""
    path = folder / f"{name}.npz"
    np.savez(path, allow_pickle=False, **closing_arrays(side, seconds))
    return path
