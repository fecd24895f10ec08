"""Draw the pictures of docs/conventions.md: the palm frame, the thumb's joints, mistakes.

python docs/conventions_pictures.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from handmap_qp import load_hand, read_recording
from handmap_qp.apps.drawing.contact_sheet import SheetRow, pose_pictures, sheet_rows
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.apps.onboarding.picture import draw_hand

PICTURES = Path(__file__).with_name("images")
PALM_SIDE, THREE_QUARTER = 0, 1  # the views of `pose_pictures`
THUMB = ("TM_abduction", "TM_flexion", "MCP_flexion", "IP_flexion")


def mistakes(landmarks: np.ndarray) -> list[np.ndarray]:
    """Return one hand as it is, and as three mistakes show it; palm frame, shape (21, 3)."""
    # Little finger first, as some data sets have it.
    order = [0, *(k for first in (17, 13, 9, 5, 1) for k in range(first, first + 4))]
    mirrored = landmarks * (-1.0, 1.0, 1.0)
    other_end = landmarks[
        [0, *(k for f in range(5) for k in range(4 * f + 4, 4 * f, -1))]
    ]
    return [landmarks, landmarks[order], other_end, mirrored]


def thumb_postures() -> list[np.ndarray]:
    """Return the landmarks of a stretched thumb, and of each thumb joint flexed; shape (21, 3)."""
    human = load_hand("human", points="landmarks")
    # All joints at zero, or at the limit that is nearest to zero.
    straight = np.clip(0.0, human.lower_limits, human.upper_limits)
    postures = [human.points(straight)]
    for joint in THUMB:
        i = human.joint_names.index(f"thumb_{joint}")
        q = straight.copy()
        q[i] = human.upper_limits[i]
        postures.append(human.points(q))
    return postures


def draw(hands: list[np.ndarray], view: int, file: Path) -> None:
    """Draw hands side by side, given by their landmarks."""
    drawn = pose_pictures([], [SheetRow("", "", points, ()) for points in hands])
    sheet = np.concatenate(list(drawn[:, 0, view, 2:-2, 2:-2]), axis=1)
    Image.fromarray((255.0 * sheet).round().astype(np.uint8)).save(file, optimize=True)


def main() -> None:
    """Write the pictures."""
    draw_hand(load_hand("human", points="joints"), PICTURES / "palm_frame.png")
    with Image.open(PICTURES / "palm_frame.png") as picture:
        picture.convert("P", palette=Image.Palette.ADAPTIVE, colors=128).save(
            PICTURES / "palm_frame.png", optimize=True
        )
    recording = read_recording("demo", "right")
    (row,) = sheet_rows(recording, {"open": find_poses(recording)["open"]}, [])
    draw(mistakes(row.landmarks), PALM_SIDE, PICTURES / "mistakes.png")
    draw(thumb_postures(), THREE_QUARTER, PICTURES / "thumb_joints.png")


if __name__ == "__main__":
    main()
