"""The demo: map the paper's wrist arc with the first synergy to the three-fingered hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.drawing.hands import require_matplotlib
from handmap_qp.errors import InvalidInputError
from handmap_qp.experiments.demo_figures import errors_figure, hands_figure, joints_figure
from handmap_qp.experiments.output_folder import output_folder
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.human.recording import HumanMotion
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.methods.homogeneous import Homogeneous
from handmap_qp.offline.trajectory import Trajectory, map_motion, save_npz
from handmap_qp.se3 import affine, transform_points

ARC_LENGTH = 0.47
"""Length of the wrist's arc along x [m]."""
ARC_HEIGHT = 0.15
"""Height of the wrist's arc along z [m]."""
RATE = 60.0
"""Samples per second."""

_START_HEIGHT = 0.15
_OPEN, _CLOSED = 1.0, -0.4
_POINT_ERRORS = ("mean", "p95", "max")
# Back of the hand up, fingers along -y of the world: the arc is perpendicular to the fingers.
_WRIST_ROTATION = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class DemoResult:
    """Result of the demo.

    Attributes:
        motion: The human motion.
        trajectory: The robot's trajectory.
        files: Files written.
    """

    motion: HumanMotion
    trajectory: Trajectory
    files: tuple[Path, ...]

    def summary(self) -> dict[str, Any]:
        """Summary numbers by name, with units in the names."""
        trajectory = self.trajectory
        points = 1e3 * trajectory.point_error
        return {
            "robot": trajectory.robot.name,
            "samples": len(trajectory.time),
            "point_error_mm_mean": float(points.mean()),
            "point_error_mm_p95": float(np.percentile(points, 95)),
            "point_error_mm_max": float(points.max()),
            "wrist_error_mm_mean": 1e3 * float(trajectory.wrist_error.mean()),
            "wrist_error_mm_max": 1e3 * float(trajectory.wrist_error.max()),
            "samples_at_limit": int(trajectory.at_limit.any(axis=1).sum()),
            "limit_violation_max": trajectory.limit_violation,
            "step_cpu_us_median": 1e6 * float(np.median(trajectory.step_cpu)),
        }

    def table(self) -> dict[str, str]:
        """The summary in words."""
        found = self.summary()
        points = [f"{found[f'point_error_mm_{name}']:.2f} mm {name}" for name in _POINT_ERRORS]
        wrist = [f"{found[f'wrist_error_mm_{name}']:.2f} mm {name}" for name in ("mean", "max")]
        return {
            "samples": str(found["samples"]),
            "step, CPU time": f"{found['step_cpu_us_median']:.0f} us median",
            "point error": ", ".join(points),
            "wrist error": ", ".join(wrist),
            "samples at a limit": str(found["samples_at_limit"]),
            "largest limit violation": f"{found['limit_violation_max']:.1e} rad",
        }


def run_demo(
    directory: Path | str = Path("demo"),
    *,
    samples: int = 241,
    progress: Callable[[int], None] | None = None,
) -> DemoResult:
    """Map the demo's motion and write trajectory and pictures.

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
    directory = Path(directory)
    motion = arc_motion(samples)
    with output_folder(directory) as folder:
        mapper = HandMapper(motion.human, load_hand("three_finger"), Homogeneous(), dt=1.0 / RATE)
        trajectory = map_motion(mapper, motion, progress)
        _save(folder / "trajectory.npz", motion, trajectory)
        hands_figure(motion, trajectory).savefig(folder / "hands.png")
        errors_figure(trajectory).savefig(folder / "errors.png")
        joints_figure(trajectory).savefig(folder / "joints.png")
        names = sorted(path.name for path in folder.iterdir())
    return DemoResult(motion, trajectory, tuple(directory / name for name in names))


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
        raise InvalidInputError(argument="samples", expected="an integer >= 3", value=samples)
    human = load_hand("human", points="fingertips")
    progress = np.linspace(0.0, 1.0, samples)
    way = progress**3 * (10.0 - 15.0 * progress + 6.0 * progress**2)
    wrist = np.tile(affine(_WRIST_ROTATION, np.zeros(3)), (samples, 1, 1))
    wrist[:, 0, 3] = ARC_LENGTH * way
    wrist[:, 2, 3] = _START_HEIGHT + ARC_HEIGHT * np.cos(np.pi * (way - 0.5))
    synergies = load_synergies()
    z_1 = 0.5 * (_OPEN + _CLOSED) + 0.5 * (_OPEN - _CLOSED) * np.cos(2.0 * np.pi * progress)
    return HumanMotion(
        human=human,
        time=np.arange(samples) / RATE,
        dt=np.full(samples, 1.0 / RATE),
        q=np.array([synergies.posture([z]) for z in z_1]),
        wrist=wrist,
        valid=np.ones(samples, dtype=bool),
        fit_error=np.zeros((samples, len(human.reference_points))),
    )


def human_points(motion: HumanMotion) -> np.ndarray:
    """Reference points of the human in its world [m], shape (T, m, 3)."""
    local = [motion.human.points(q) for q in motion.q]
    return np.array(
        [transform_points(wrist, points) for wrist, points in zip(motion.wrist, local, strict=True)]
    )


def _save(path: Path, motion: HumanMotion, trajectory: Trajectory) -> None:
    """Write the columns of the trajectory and of the human motion."""
    human = {
        "human_joint_names": np.array(motion.human.joint_names),
        "human_q": motion.q,
        "human_wrist": motion.wrist,
        "human_points": human_points(motion),
    }
    save_npz(path, {**trajectory.columns, **human})
