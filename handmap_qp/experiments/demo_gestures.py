"""The demo on the recording that comes with the package: all gestures, on any robot hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from handmap_qp.drawing.contact_sheet import save_contact_sheet
from handmap_qp.drawing.hands import require_matplotlib
from handmap_qp.experiments.demo_figures import errors_figure, joints_figure
from handmap_qp.experiments.output_folder import output_folder
from handmap_qp.hands.library import load_hand
from handmap_qp.human.landmarks import scaled_human
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.presets import default_preset, preset_choice
from handmap_qp.offline.poses import find_poses
from handmap_qp.offline.trajectory import Trajectory, map_recording, save_npz
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats import DEMO, read_recording


def run_gestures(
    name: str, directory: Path, progress: Callable[[int], None] | None = None
) -> tuple[Trajectory, tuple[Path, ...]]:
    """Map the recording that comes with the package, and write trajectory and pictures.

    Writes `trajectory.npz`, `gestures.png` (human and robot in each gesture), `errors.png` and
    `joints.png`: all of them, or none on failure.

    Args:
        name: Robot hand, by name or by the path of its hand.yaml; its side decides which of the two
            recorded hands leads.
        directory: Folder to write to; created if it does not exist.
        progress: Called after each sample with the number of samples done.

    Returns:
        The trajectory, and the files.

    Raises:
        HandmapError: If the hand cannot be loaded, or the folder cannot be written.
    """
    require_matplotlib()
    robot = load_hand(name)
    recording = read_recording(DEMO, robot.spec.side)
    person = measure_person(recording)
    human = scaled_human(recording, lengths=person.lengths)
    choice = preset_choice(default_preset(human, robot), person.contact_gap)
    with output_folder(directory) as folder:
        mapper = HandMapper(human, robot, choice.method, ik=choice.ik)
        trajectory = map_recording(mapper, recording, progress)
        save_npz(folder / "trajectory.npz", trajectory.columns)
        columns = [(trajectory.robot.name, trajectory.robot, trajectory.q)]
        save_contact_sheet(folder / "gestures.png", recording, find_poses(recording), columns)
        errors_figure(trajectory).savefig(folder / "errors.png")
        joints_figure(trajectory).savefig(folder / "joints.png")
        names = sorted(path.name for path in folder.iterdir())
    return trajectory, tuple(directory / file for file in names)
