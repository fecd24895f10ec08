"""The command `handmap demo`: the recording of the package on a robot hand, with pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from handmap_qp.apps.arguments import HandName, MappingArguments
from handmap_qp.apps.demo.figures import errors_figure, joints_figure
from handmap_qp.apps.drawing.contact_sheet import save_contact_sheet
from handmap_qp.apps.drawing.hands import require_matplotlib
from handmap_qp.apps.offline.look_ahead import map_hand
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.apps.offline.summary import summarise, table_rows
from handmap_qp.apps.offline.trajectory import Trajectory, save_npz
from handmap_qp.apps.tables import print_table, progress
from handmap_qp.hands.library import load_hand
from handmap_qp.output_files import output_folder
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats import DEMO, read_recording

FILES = ("errors.png", "gestures.png", "joints.png", "trajectory.npz")
"""What the demo writes."""


@dataclass(frozen=True)
class Demo:
    """Map a human hand's motion to a robot hand; needs no data of your own.

    Maps the recording that comes with the package: a hand that opens, makes a fist, points, pinches
    with every finger, spreads and turns. It is made from the human model, with the noise of a
    headset.

    Writes the robot's trajectory (.npz), a picture of the gestures of both hands, and plots of the
    robot's errors and joints (.png).

    Examples:
        handmap demo
        handmap demo --robot allegro_right
        handmap demo --robot my_hand.yaml --out results/demo
        handmap view demo --robot allegro_right

    Attributes:
        robot: Robot hand: a name of `handmap hands list`, or the path of its hand.yaml.
        out: Folder to write to; created if it does not exist.
    """

    robot: HandName = "three_finger"
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("demo")

    def run(self) -> None:
        """Run the demo, and print its errors and files."""
        with progress("mapping") as advance:
            trajectory = run_demo(self.robot, self.out, advance)
        title = f"the package's recording to {trajectory.robot.name}"
        print_table(title, table_rows(summarise(trajectory)))
        for name in FILES:
            print(f"wrote {self.out / name}")


def run_demo(
    name: str, directory: Path, progress: Callable[[int], None] | None = None
) -> Trajectory:
    """Map the recording that comes with the package, and write `FILES`: all of them, or none.

    Args:
        name: Robot hand, by name or by the path of its hand.yaml; its side decides which of the two
            recorded hands leads.
        directory: Folder to write to; created if it does not exist. Files of the same names are
            replaced.
        progress: Called after each sample with the number of samples done.

    Returns:
        The robot's trajectory.

    Raises:
        HandmapError: If the hand cannot be loaded, the folder cannot be written, or matplotlib or
            trimesh is not installed.
    """
    require_matplotlib()
    robot = load_hand(name)
    recording = read_recording(DEMO, robot.spec.side)
    person = measure_person(recording)
    with output_folder(directory) as folder:
        _, trajectory = map_hand(
            recording, robot, person, MappingArguments(), progress=progress
        )
        save_npz(folder / "trajectory.npz", trajectory.columns)
        columns = [(trajectory.robot.name, trajectory.robot, trajectory.q)]
        save_contact_sheet(
            folder / "gestures.png", recording, find_poses(recording), columns
        )
        errors_figure(trajectory).savefig(folder / "errors.png")
        joints_figure(trajectory).savefig(folder / "joints.png")
    return trajectory
