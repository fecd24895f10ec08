"""The demo: a hand's motion mapped to a robot hand, as a trajectory and pictures.

`run_demo` maps the paper's wrist arc with the first synergy to the three-fingered hand;
`run_gestures` maps the recording that comes with the package to any robot hand.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.drawing.contact_sheet import save_contact_sheet
from handmap_qp.apps.drawing.hands import require_matplotlib
from handmap_qp.apps.experiments.demo_figures import (
    errors_figure,
    hands_figure,
    human_points,
    joints_figure,
)
from handmap_qp.apps.experiments.output_folder import output_folder
from handmap_qp.apps.experiments.section_four import ARC_HEIGHT, ARC_LENGTH
from handmap_qp.apps.offline.look_ahead import map_hand
from handmap_qp.apps.offline.poses import find_poses
from handmap_qp.apps.offline.trajectory import (
    Trajectory,
    map_motion,
    save_npz,
)
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.human.recording import HumanMotion
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.methods.homogeneous import Homogeneous
from handmap_qp.se3 import affine
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats import DEMO, read_recording

RATE = 60.0
"""Samples per second of the arc."""

_START_HEIGHT = 0.15
_OPEN, _CLOSED = 1.0, -0.4
# Back of the hand up, fingers along -y of the world: the arc is perpendicular to the fingers.
_WRIST_ROTATION = np.diag([-1.0, -1.0, 1.0])


class DemoResult(NamedTuple):
    """Result of the demo.

    Attributes:
        trajectory: The robot's trajectory.
        files: Files written.
    """

    trajectory: Trajectory
    files: tuple[Path, ...]


def run_demo(
    directory: Path | str = Path("demo"),
    *,
    samples: int = 241,
    progress: Callable[[int], None] | None = None,
) -> DemoResult:
    """Map the paper's arc with the first synergy, and write trajectory and pictures.

    Writes `trajectory.npz`, `hands.png`, `errors.png` and `joints.png`: all of them, or none on
    failure.

    Args:
        directory: Folder to write to; created if it does not exist. Files of the same names are
            replaced.
        samples: Number of samples, at 60 Hz.
        progress: Called after each sample with the number of samples done.

    Returns:
        The result.

    Raises:
        InvalidInputError: If the folder cannot be written, or there are too few samples.
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    require_matplotlib()
    motion = arc_motion(samples)
    mapper = HandMapper(
        motion.human, load_hand("three_finger"), Homogeneous(), dt=1.0 / RATE
    )
    human = {
        "human_joint_names": np.array(motion.human.joint_names),
        "human_q": motion.q,
        "human_wrist": motion.wrist,
        "human_points": human_points(motion),
    }

    def make(folder: Path) -> Trajectory:
        trajectory = map_motion(mapper, motion, progress)
        save_npz(folder / "trajectory.npz", {**trajectory.columns, **human})
        hands_figure(motion, trajectory).savefig(folder / "hands.png")
        return trajectory

    return _written(Path(directory), make)


def run_gestures(
    name: str, directory: Path, progress: Callable[[int], None] | None = None
) -> DemoResult:
    """Map the recording that comes with the package, and write trajectory and pictures.

    Writes `trajectory.npz`, `gestures.png` (human and robot in each gesture), `errors.png` and
    `joints.png`: all of them, or none on failure.

    Args:
        name: Robot hand, by name or by the path of its hand.yaml; its side decides which of the two
            recorded hands leads.
        directory: Folder to write to; created if it does not exist.
        progress: Called after each sample with the number of samples done.

    Returns:
        The result.

    Raises:
        HandmapError: If the hand cannot be loaded, or the folder cannot be written.
    """
    require_matplotlib()
    robot = load_hand(name)
    recording = read_recording(DEMO, robot.spec.side)
    person = measure_person(recording)

    def make(folder: Path) -> Trajectory:
        _, trajectory = map_hand(
            recording, robot, person, MappingArguments(), progress=progress
        )
        save_npz(folder / "trajectory.npz", trajectory.columns)
        columns = [(trajectory.robot.name, trajectory.robot, trajectory.q)]
        save_contact_sheet(
            folder / "gestures.png", recording, find_poses(recording), columns
        )
        return trajectory

    return _written(directory, make)


def arc_motion(samples: int) -> HumanMotion:
    """Human motion: the paper's wrist arc, while the hand closes and opens along the first synergy.

    The paper gives "a cosine arc whose length was 470 mm in the x direction and whose height in the
    z direction was 150 mm". This is read as half a wave, highest in the middle:
    `z = 150 mm * cos(pi * (x / 470 mm - 1/2))`. `x` is a minimum-jerk function of time, and the
    wrist does not rotate. The joints are `q = q_m + S z`. `z_1` is a cosine from open (1.0) to
    closed (-0.4) and back, inside the joint limits.

    Args:
        samples: Number of samples T, at 60 Hz.

    Returns:
        The motion of the human hand, with the five fingertips as reference points.

    Raises:
        InvalidInputError: If `samples` is not an integer >= 3.
    """
    if not isinstance(samples, int | np.integer) or samples < 3:
        raise InvalidInputError(
            argument="samples", expected="an integer >= 3", value=samples
        )
    human = load_hand("human", points="fingertips")
    progress = np.linspace(0.0, 1.0, samples)
    path = progress**3 * (10.0 - 15.0 * progress + 6.0 * progress**2)
    wrist = np.tile(affine(_WRIST_ROTATION, np.zeros(3)), (samples, 1, 1))
    wrist[:, 0, 3] = ARC_LENGTH * path
    wrist[:, 2, 3] = _START_HEIGHT + ARC_HEIGHT * np.cos(np.pi * (path - 0.5))
    synergies = load_synergies()
    share = 0.5 + 0.5 * np.cos(2.0 * np.pi * progress)
    z_1 = _CLOSED + (_OPEN - _CLOSED) * share
    return HumanMotion(
        human=human,
        time=np.arange(samples) / RATE,
        dt=np.full(samples, 1.0 / RATE),
        q=np.array([synergies.posture([z]) for z in z_1]),
        wrist=wrist,
        valid=np.ones(samples, dtype=bool),
        fit_error=np.zeros((samples, len(human.reference_points))),
    )


def _written(directory: Path, make: Callable[[Path], Trajectory]) -> DemoResult:
    """Write what `make` writes and the pictures of errors and joints: all of them, or none."""
    with output_folder(directory) as folder:
        trajectory = make(folder)
        errors_figure(trajectory).savefig(folder / "errors.png")
        joints_figure(trajectory).savefig(folder / "joints.png")
        names = sorted(path.name for path in folder.iterdir())
    return DemoResult(trajectory, tuple(directory / name for name in names))
