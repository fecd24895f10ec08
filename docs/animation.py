"""Draw the README's animation: a person's hand, and robot hands that follow it.

Arguments are a recording and the file to write. Set HANDMAP_HANDS to the folder of the LEAP hand:
`python docs/animation.py leap110_free_right.npz docs/images/gesture.webp`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from handmap_qp import HandMapper, load_hand, read_recording
from handmap_qp.apps.drawing.contact_sheet import pose_pictures, sheet_rows
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.human.measure import scaled_human

ROBOTS = ("allegro_right", "benchmarks/hands/leap_right.yaml", "three_finger")
START, SECONDS, RATE = 4.0, 8.0, 12.0
FRONT = 0  # the view of the palm


def main(file: Path, out: Path) -> None:
    """Map the recording, draw some seconds of it, and write an animated WebP."""
    recording = read_recording(file)
    human = scaled_human(recording)
    robots = [load_hand(name) for name in ROBOTS]
    motions = [
        map_recording(HandMapper(human, robot), recording).columns["q"]
        for robot in robots
    ]
    since = recording.time - recording.time[0]
    frames = np.searchsorted(since, np.arange(START, START + SECONDS, 1.0 / RATE))
    frames = [i for i in frames if i < len(recording) and recording.valid[i]]
    rows = sheet_rows(recording, {str(i): int(i) for i in frames}, motions)
    columns = [(robot.name, robot) for robot in robots]
    pictures = pose_pictures(columns, rows, side=recording.side)[:, :, FRONT]
    # Columns side by side: (frames, height, columns x width, 3).
    pictures = np.concatenate(np.moveaxis(pictures, 1, 0), axis=2)
    images = [
        Image.fromarray((255.0 * picture).round().astype(np.uint8))
        for picture in pictures
    ]
    images[0].save(
        out,
        save_all=True,
        append_images=images[1:],
        duration=round(1000.0 / RATE),
        loop=0,
        quality=70,
        method=6,
    )
    print(f"wrote {out}: {len(images)} frames, {out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
