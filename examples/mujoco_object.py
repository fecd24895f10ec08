"""A hand holds a cube in MuJoCo: the paper's grasp takes its weight, and the cube stays.

python examples/mujoco_object.py
"""

import numpy as np

from handmap_qp.experiments.section_four import Setting, paper_scene, run_experiment
from handmap_qp.simulation.arc import ArcOptions, carry


def main() -> None:
    """Carry the cube of Sec. IV along the paper's arc, and print how far it slipped."""
    scene = paper_scene()
    run = run_experiment(scene, Setting())
    carried = carry(scene.robot, run.robot, mass=0.05, options=ArcOptions(duration=2.0))
    print(f"moved by {1e3 * np.linalg.norm(carried.displacement):.0f} mm", end=", ")
    print("lost" if carried.is_lost else f"slipped by {1e3 * carried.slip.max():.1f} mm")


if __name__ == "__main__":
    main()
