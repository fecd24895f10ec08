"""Run the examples, and draw what their robots do for the gallery of docs/examples.md.

    python docs/example_pictures.py [PART_OF_A_NAME ...]

Pictures are of joint angles that the example itself commands, caught where they pass: the examples
have no code for it.
"""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq
from PIL import Image

from handmap_core.run import GrippingFollower
from handmap_qp import Hand, HandMapper, load_hand
from handmap_qp.apps.drawing.contact_sheet import VIEWS
from handmap_qp.apps.drawing.hands import UPRIGHT, load_shape
from handmap_qp.apps.drawing.raster import Camera, merged, render
from handmap_qp.apps.simulation.pictures import frames
from handmap_qp.apps.simulation.pinch import PinchScene
from handmap_qp.client import Client
from handmap_qp.se3 import inverse_pose

DOCS = Path(__file__).parent
EXAMPLES = DOCS.parent / "examples"
CELL = (240, 240)
COUNT = 4
"""Instants in a picture, side by side."""
Motion = tuple[Hand, list[np.ndarray]]
"""A robot, and its joint angles at every step [rad]."""


@contextmanager
def caught(owner: Any, name: str) -> Iterator[list[Any]]:
    """Collect what a function returns while the block runs, with its first argument."""
    found, original = [], getattr(owner, name)

    def catch(*words: Any, **named: Any) -> Any:
        result = original(*words, **named)
        found.append((words[0], result))
        return result

    with patch.object(owner, name, catch):
        yield found


def run(example: Path, *words: str) -> None:
    """Run an example as a program."""
    with patch.object(sys, "argv", [str(example), *words]):
        runpy.run_path(str(example), run_name="__main__")


def commanded(example: Path) -> list[Motion]:
    """Run an example, and return the commands of every mapper that it uses."""
    motions: dict[HandMapper, Motion] = {}
    with (
        caught(HandMapper, "map_step") as joints,
        caught(HandMapper, "map_landmarks") as landmarks,
    ):
        run(example)
    for mapper, step in joints + landmarks:
        motions.setdefault(mapper, (mapper.robot, []))[1].append(step.command.q)
    return [*motions.values()]


def mapped(example: Path) -> np.ndarray:
    """Draw the commands of an example's mappers."""
    return strip(commanded(example))


def described(example: Path) -> np.ndarray:
    """Draw the commands of the last mapper; those before check the description."""
    return strip(commanded(example)[-1:])


def stored(example: Path) -> np.ndarray:
    """Draw the actions of the data set that an example reads back, of two Allegro hands."""
    with caught(pq, "read_table") as tables:
        run(example)
    actions = np.array(tables[0][1]["action"].to_pylist())
    # Each hand has 16 joints, and the 7 numbers of its wrist's pose.
    starts = {"allegro_left": 0, "allegro_right": 23}
    return strip([(load_hand(n), [*actions[:, i : i + 16]]) for n, i in starts.items()])


def answered(example: Path) -> np.ndarray:
    """Draw what the service answers to an example's samples."""
    with caught(Client, "step") as answers:
        run(example)
    robot = load_hand("three_finger")
    return strip([(robot, [answer.q for _, answer in answers])])


def followed(example: Path) -> np.ndarray:
    """Draw the commands of a saved hand."""
    with caught(GrippingFollower, "map_sample") as steps:
        run(example)
    robot = load_hand("three_finger")
    return strip([(robot, [step.command.q for _, step in steps])])


def simulated(example: Path) -> np.ndarray:
    """Draw a simulated pick."""
    with caught(PinchScene, "run") as outcomes:
        run(example)
    episode = outcomes[0][1].episode
    chosen = spread(len(episode.at.time), COUNT)
    return joined(list(frames(episode, chosen, supersampling=2)))


def strip(motions: list[Motion]) -> np.ndarray:
    """Draw robots at instants spread over their motions, each at one scale."""
    cells = []
    for robot, motion in motions:
        shape = load_shape(robot).without_arm()
        solids = []
        for q in (motion[i] for i in spread(len(motion), COUNT // len(motions))):
            pose = UPRIGHT @ inverse_pose(robot.frame_pose("palm", q))
            solids.append(shape.triangles(q).moved(pose))
        azimuth, elevation = VIEWS[1]
        camera = Camera.framing(
            merged(solids).vertices.reshape(-1, 3),
            CELL,
            azimuth=180.0 - azimuth if robot.side == "left" else azimuth,
            elevation=elevation,
        )
        for image in (render(one, camera, supersampling=2) for one in solids):
            colour = 1.0 + image[..., 3:] * (image[..., :3] - 1.0)
            cells.append((255.0 * colour).round().astype(np.uint8))
    return joined(cells)


def plotted(notebook: Path) -> np.ndarray:
    """Return the figure that a notebook plots."""
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    exec(compile("\n".join(code), notebook.name, "exec"), names)
    names["figure"].set_size_inches(9.6, 3.2)
    names["figure"].tight_layout()
    names["figure"].canvas.draw()
    return np.asarray(names["figure"].canvas.buffer_rgba())[..., :3]


def spread(length: int, count: int) -> list[int]:
    """Return indices of instants that are spread over a motion."""
    return np.linspace(0, length - 1, count).round().astype(int).tolist()


def joined(cells: list[np.ndarray]) -> np.ndarray:
    """Put pictures side by side, all in the size of a cell."""
    sized = [Image.fromarray(cell) for cell in cells]
    height = CELL[1]
    sized = [one.resize((one.width * height // one.height, height)) for one in sized]
    return np.hstack([np.asarray(one) for one in sized])


DRAWN = {
    "00_tour": plotted,
    "04_onboarding": described,
    "07_recording_to_lerobot": stored,
    "08_tracker_service_driver": answered,
    "09_mujoco_object": simulated,
    "12_robot_computer": followed,
}
"""Examples that are not drawn as the commands of their mappers."""


def main(parts: list[str]) -> None:
    """Draw the examples whose names have one of these parts, or all."""
    for example in sorted(EXAMPLES.glob("[0-9]*")):
        # The simulated robot needs a session to follow.
        is_named = not parts or any(part in example.stem for part in parts)
        if not is_named or example.stem == "10_simulated_robot":
            continue
        picture = DRAWN.get(example.stem, mapped)(example)
        file = DOCS / "images" / "examples" / f"{example.stem}.webp"
        file.parent.mkdir(exist_ok=True)
        Image.fromarray(picture).save(file, quality=75, method=6)
        print(f"wrote {file}: {file.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
