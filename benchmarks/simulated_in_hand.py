"""In-hand motion with known truth: how much of the object motion that the human makes arrives?

The human's contacts move with a rigid object, his wrist stands still. The motion is mapped with the
paper's T (all of it to the fingers) and commanded to a robot hand that holds a cube in a planned
grasp, with gravity. Printed for each motion: what was asked, what the object in the robot's hand
did along it, and what it did besides.

    python benchmarks/simulated_in_hand.py --robot three_finger
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp import HandMapper, IkOptions, MappingOptions
from handmap_qp.experiments.section_four import HandMotion, Scene
from handmap_qp.grasp.objects import Box
from handmap_qp.hands.library import load_hand
from handmap_qp.simulation.arc import ArcOptions, Carried, carry, planned_scene
from handmap_qp.simulation.physics import Physics
from handmap_qp.tables import print_rows, progress
from handmap_qp.transform import affine, transform_points

CUBE, MASS, STEPS = Box((0.05, 0.05, 0.05)), 0.1, 60
SHIFT, TURN = 0.006, np.radians(10.0)


def mapped(scene: Scene, motions: list[np.ndarray], ridge: float) -> HandMotion:
    """Map the human's contacts, moved by rigid motions, to the robot's joints."""
    human, robot = scene.human, scene.robot
    assert human.wrist_pose is not None
    assert robot.wrist_pose is not None
    options = MappingOptions(rigid_from="wrist", pivot="centroid", ridge=ridge)
    ik = IkOptions(
        wrist_position_weight=10.0, wrist_orientation_weight=10.0, has_velocity_limits=False
    )
    mapper = HandMapper(scene.human_points, scene.robot_points, options, ik=ik, dt=0.02)
    mapper.reset(robot_q=robot.q, robot_wrist=robot.wrist_pose)
    q, wrist, points = [], [], []
    for motion in motions:
        step = mapper.map_points(transform_points(motion, human.points), human.wrist_pose)
        q.append(step.command.q.copy())
        wrist.append(step.command.wrist.copy())
        points.append(step.points.copy())
    return HandMotion(np.array(q), np.array(wrist), np.array(points))


def asked_motions(centre: np.ndarray, shift: np.ndarray, turn: np.ndarray) -> list[np.ndarray]:
    """Rigid motions from none to a shift and a turn about the object's centre."""
    to_centre = affine(np.eye(3), centre)
    back = affine(np.eye(3), -centre)
    return [
        affine(np.eye(3), share * shift)
        @ to_centre
        @ affine(Rotation.from_rotvec(share * turn).as_matrix(), np.zeros(3))
        @ back
        for share in np.linspace(0.0, 1.0, STEPS)
    ]


def row(name: str, carried: Carried, shift: np.ndarray, turn: np.ndarray) -> dict[str, Any]:
    """Describe one motion: the share that arrives, and what else the object did."""
    rotation = Rotation.from_matrix(carried.rotation).as_rotvec()
    is_shift = bool(shift.any())
    asked, got = (shift, carried.displacement) if is_shift else (turn, rotation)
    share = float(got @ asked / (asked @ asked))
    return {
        "motion": name,
        "arrives %": "lost" if carried.is_lost else round(100.0 * share),
        "besides mm": round(1e3 * float(np.linalg.norm(carried.displacement - share * shift)), 1),
        "besides deg": round(float(np.degrees(np.linalg.norm(rotation - share * turn))), 1),
        "slip mm": round(1e3 * float(carried.slip.max()), 1),
    }


def main() -> None:
    """Simulate all motions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="three_finger")
    parser.add_argument("--samples", type=int, default=60, help="palm poses tried for each hand")
    parser.add_argument("--ridge", type=float, default=0.01)
    parser.add_argument("--stiffness", type=float, default=3.0)
    arguments = parser.parse_args()
    scene = planned_scene(load_hand(arguments.robot), CUBE, samples=arguments.samples)
    physics, rows = Physics(joint_stiffness=arguments.stiffness), []
    with progress("moving the object", 12) as advance:
        for kind, size in (("shift", SHIFT), ("turn", TURN)):
            for axis in range(3):
                for sign in (1.0, -1.0):
                    vector = sign * size * np.eye(3)[axis]
                    shift, turn = (vector, 0.0 * vector)[:: 1 if kind == "shift" else -1]
                    motions = asked_motions(scene.human.centre, shift, turn)
                    motion = mapped(scene, motions, arguments.ridge)
                    carried = carry(scene.robot, motion, MASS, physics, ArcOptions(duration=2.0))
                    name = f"{kind} {'+' if sign > 0 else '-'}{'xyz'[axis]}"
                    rows.append(row(name, carried, shift, turn))
                    advance(len(rows))
    print_rows(f"{arguments.robot}: 6 mm or 10 deg of in-hand motion", rows)


if __name__ == "__main__":
    main()
