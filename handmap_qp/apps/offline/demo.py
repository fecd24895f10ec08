"""The command `handmap demo`: the recording of the package on a robot hand, with pictures."""

from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import arg

from handmap_core.errors import expect
from handmap_qp.apps.arguments import MappingArguments, hinted
from handmap_qp.apps.drawing import require_matplotlib, save_contact_sheet
from handmap_qp.apps.tables import print_rows, progress
from handmap_qp.hands import load_hand, sided_name
from handmap_qp.output_files import output_folder
from handmap_qp.stream import measure_person
from handmap_qp.trackers import DEMO, read_recording, save_npz
from .poses import find_poses
from .summary import summarise, table_rows
from .trajectory import Progress, Trajectory, map_hands

FILES = ("errors.png", "gestures.png", "joints.png", "trajectory.npz")
"""What the demo writes."""

_INK, _PALE, _JOINT = "#222831", "#8a929c", "#3f6fb5"
_MOST_POINTS = 5  # that are drawn: more would have the same colours
_STYLE = Path(__file__).with_suffix(".mplstyle")


@dataclass(frozen=True)
class Demo:
    """Map a human hand's motion to a robot hand; needs no data of your own.

    Maps the recording that comes with the package: a hand that opens, makes a fist, points, pinches
    with every finger, spreads and turns. It is made from the human model, with the noise of a
    headset.

    Writes the robot's trajectory (.npz), a picture of the gestures of both hands, and plots of the
    robot's errors and joints (.png). With --drive, motors follow instead: emulated ones, behind a
    service and `handmap drive`.

    Examples:
        handmap demo
        handmap demo --robot allegro_right
        handmap demo --drive
        handmap demo --robot my_hand.yaml --out results/demo
        handmap view demo --robot allegro_right

    Attributes:
        robot: Robot hand: a name of `handmap hands list`, or the path of its hand.yaml.
        out: Folder to write to; created if it does not exist.
        drive: Whether emulated motors follow; needs the package handmap-drive.
    """

    robot: Annotated[
        str | None, hinted("HAND", "(default: three_finger, or leap_right to drive)")
    ] = None
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("demo")
    drive: bool = False

    def run(self) -> None:
        """Run the demo, and print its errors and files."""
        if self.drive:
            # A function of the robot's name, none for its own, and the folder.
            found = entry_points(group="handmap_qp.demos", name="drive")
            expect(
                found,
                "--drive",
                "the package handmap-drive",
                advice="pip install packages/drive",
            )
            return found["drive"].load()(self.robot, self.out)
        with progress("mapping") as advance:
            trajectory = self.write(advance)
        title = f"the package's recording to {trajectory.robot.name}"
        print_rows(title, table_rows(summarise(trajectory)))
        for name in FILES:
            print(f"wrote {self.out / name}")

    def write(self, progress: Progress = None) -> Trajectory:
        """Map the recording that comes with the package, and write all of `FILES`, or none.

        The robot's side decides which of the two recorded hands leads.

        Args:
            progress: Called after each sample with the number of samples done.

        Raises:
            HandmapError: If the hand cannot be loaded, the folder cannot be written, or matplotlib
                or trimesh is not installed.
        """
        matplotlib = require_matplotlib()
        robot = load_hand(sided_name(self.robot or "three_finger", "right"))
        recording = read_recording(DEMO, robot.side)
        person = measure_person(recording)
        with output_folder(self.out) as folder:
            trajectory, *_ = map_hands(
                [recording], robot, person, MappingArguments(), progress
            )
            save_npz(folder / "trajectory.npz", trajectory.all_columns)
            columns = [(robot.name, robot, trajectory.q)]
            poses = find_poses(recording)
            save_contact_sheet(folder / "gestures.png", recording, poses, columns)
            with matplotlib.rc_context(fname=_STYLE):
                errors_figure(trajectory).savefig(folder / "errors.png")
                joints_figure(trajectory).savefig(folder / "joints.png")
        return trajectory


def errors_figure(trajectory: Trajectory) -> Any:
    """Return a matplotlib figure of the errors of points and wrist, and CPU times of steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 5.6), layout="constrained")
    points, wrist, step = figure.subplots(
        3, 1, sharex=True, height_ratios=(2.0, 1.0, 1.0)
    )
    time = trajectory.time
    cpu = 1e6 * trajectory.step_cpu
    names = [p.name.replace("_", " ") for p in trajectory.robot.reference_points]
    shown = slice(_MOST_POINTS)
    points.plot(time, 1e3 * trajectory.point_error[:, shown], label=names[shown])
    points.legend(loc="upper right", bbox_to_anchor=(1.0, 0.98))
    points.set(title="Reference points: distance from their targets", ylabel="mm")
    wrist.plot(time, 1e3 * trajectory.wrist_error, color=_INK)
    wrist.set(title="Wrist: distance from its target", ylabel="mm")
    for axes in (points, wrist):
        axes.set_ylim(bottom=0.0)
    step.plot(time, cpu, color=_PALE, linewidth=1.0)
    step.set(title="CPU time of a step", ylabel="µs", xlabel="time [s]")
    step.set_ylim(0.0, 2.0 * np.nanpercentile(cpu, 95))
    step.set_xlim(time[0], time[-1])
    return figure


def joints_figure(trajectory: Trajectory) -> Any:
    """Return a matplotlib figure of each joint of the robot over time, with its limits."""
    from matplotlib.figure import Figure

    robot = trajectory.robot
    time = trajectory.time
    rows = -(-len(robot.joint_names) // 4)
    figure = Figure(figsize=(9.5, 2.1 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, 4, sharex=True, squeeze=False)
    limits = np.degrees(robot.limits).T
    for axes, name, q, (lower, upper) in zip(
        grid.flat, robot.joint_names, np.degrees(trajectory.q).T, limits, strict=False
    ):
        room = 0.08 * (upper - lower)
        for start in (lower - room, upper):
            axes.axhspan(start, start + room, color="#f3d9d4", linewidth=0.0)
        axes.plot(time, q, color=_JOINT)
        axes.set(
            xlim=(time[0], time[-1]),
            ylim=(lower - room, upper + room),
            title=name.replace("_", " "),
        )
    for axes in grid.flat[len(robot.joint_names) :]:
        axes.set_axis_off()
    figure.supxlabel("time [s]")
    figure.supylabel("deg")
    return figure
