"""In-hand motion with known truth: how much of the object motion that the human makes arrives?

The human's contacts move with a rigid object, his wrist stands still. The motion is mapped and
commanded to a robot hand that holds a cube in a planned grasp, with gravity. Printed for each
mapping and motion: what the object in the robot's hand did along it, and what it did besides.

`T` is the paper's motion of the contacts, all of it for the fingers. Other names are mappings of
`handmap compare`. These see the landmarks of a human hand whose joints carry its contacts with the
object, and what they change since the start is added to the planned grasp (`map_grasp`). The
robot's grasp is turned so that both palms have one orientation. `human` is what the object in the
human's own hand does, by his joints.

    python benchmarks simulated_in_hand --robot three_finger
    python benchmarks simulated_in_hand --robot allegro_right --methods human T object
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from arc import ArcOptions, Carried, carry, planned_scene
from mapped_grasps import map_grasp, with_equal_palms
from scipy.spatial.transform import Rotation
from section_four.experiment import HandMotion, Scene

from handmap_qp import HandMapper, IkOptions, MappingOptions
from handmap_qp.apps.simulation.commands import chosen_methods
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.tables import print_rows, progress
from handmap_qp.hands.library import load_hand
from handmap_qp.mapping.objects import Box
from handmap_qp.se3 import affine, transform_points

OWN = ("T", "human")
CUBE, MASS, STEPS, DURATION = Box((0.05, 0.05, 0.05)), 0.1, 60, 2.0
MOTIONS = {"shift": 0.006, "turn": float(np.radians(10.0))}


def mapped_by_contacts(
    scene: Scene, motions: list[np.ndarray], ridge: float
) -> HandMotion:
    """Map the human's contacts, moved by rigid motions, to the robot's joints."""
    human, robot = scene.human, scene.robot
    assert human.wrist_pose is not None
    assert robot.wrist_pose is not None
    options = MappingOptions(rigid_from="wrist", pivot="centroid", ridge=ridge)
    ik = IkOptions(
        wrist_position_weight=10.0,
        wrist_orientation_weight=10.0,
        has_velocity_limits=False,
    )
    mapper = HandMapper(scene.human_points, scene.robot_points, options, ik=ik, dt=0.02)
    mapper.reset(robot_q=robot.q, robot_wrist=robot.wrist_pose)
    q, wrist, points = [], [], []
    for motion in motions:
        step = mapper.map_points(
            transform_points(motion, human.points), human.wrist_pose
        )
        q.append(step.command.q.copy())
        wrist.append(step.command.wrist.copy())
        points.append(step.points.copy())
    return HandMotion(np.array(q), np.array(wrist), np.array(points))


def asked_motions(
    centre: np.ndarray, shift: np.ndarray, turn: np.ndarray
) -> list[np.ndarray]:
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


def human_joints(scene: Scene, motions: list[np.ndarray]) -> HandMotion:
    """Move the human's joints so that the contacts follow rigid motions (damped least squares)."""
    human, hand = scene.human, scene.human_points
    assert human.wrist_pose is not None
    q, joints = human.q.copy(), []
    for motion in motions:
        wanted = transform_points(motion, human.points)
        for _ in range(8):
            J = hand.point_jacobian(q, human.wrist_pose)
            error = (wanted - hand.points(q, human.wrist_pose)).ravel()
            q = q + J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(len(J)), error)
            q = np.clip(q, hand.lower_limits, hand.upper_limits)
        joints.append(q)
    wrist = np.tile(human.wrist_pose, (len(joints), 1, 1))
    points = np.array([hand.points(angles, human.wrist_pose) for angles in joints])
    return HandMotion(np.array(joints), wrist, points)


def row(
    name: str, carried: Carried, shift: np.ndarray, turn: np.ndarray
) -> dict[str, Any]:
    """Describe one motion: the share that arrives, and what else the object did."""
    rotation = Rotation.from_matrix(carried.rotation).as_rotvec()
    is_shift = bool(shift.any())
    asked, got = (shift, carried.displacement) if is_shift else (turn, rotation)
    share = float(got @ asked / (asked @ asked))
    return {
        "motion": name,
        "is_lost": carried.is_lost,
        "share": share,
        "besides mm": 1e3 * float(np.linalg.norm(carried.displacement - share * shift)),
        "besides deg": float(np.degrees(np.linalg.norm(rotation - share * turn))),
        "slip mm": 1e3 * float(carried.slip.max()),
    }


def summary(method: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Describe a mapping in one row: shares by axis (+ / -), and the worst of the rest."""
    found: dict[str, Any] = {"mapping": method}
    for kind in ("shift", "turn"):
        for axis in "xyz":
            pair = [
                row
                for row in rows
                if row["motion"] in (f"{kind} +{axis}", f"{kind} -{axis}")
            ]
            found[f"{kind} {axis} %"] = " / ".join(
                "lost" if row["is_lost"] else f"{100.0 * row['share']:.0f}"
                for row in pair
            )
    held = [row for row in rows if not row["is_lost"]]
    for name in ("besides mm", "besides deg", "slip mm"):
        found[name] = f"{max(row[name] for row in held):.1f}" if held else "-"
    return found


def main() -> None:
    """Simulate all motions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="three_finger")
    parser.add_argument(
        "--methods", nargs="+", default=["T"], help="T, human, or of handmap compare"
    )
    parser.add_argument(
        "--peers", type=Path, help="folder of outside methods, benchmarks/peers"
    )
    parser.add_argument(
        "--samples", type=int, default=60, help="palm poses tried for each hand"
    )
    parser.add_argument(
        "--squeeze", type=float, default=4.0, help="force at every contact [N]"
    )
    parser.add_argument("--ridge", type=float, default=0.01)
    parser.add_argument("--stiffness", type=float, default=3.0)
    arguments = parser.parse_args()
    robot = load_hand(arguments.robot)
    scene = with_equal_palms(planned_scene(robot, CUBE, samples=arguments.samples))
    physics = Physics(joint_stiffness=arguments.stiffness)
    options = ArcOptions(normal_force=arguments.squeeze, duration=DURATION)
    others = tuple(name for name in arguments.methods if name not in OWN)
    methods = {
        m.name: m for m in chosen_methods(others, arguments.peers, arguments.robot)
    }
    moves = [
        (kind, axis, sign)
        for kind in MOTIONS
        for axis in range(3)
        for sign in (1.0, -1.0)
    ]
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in arguments.methods}
    misses = []
    with progress("moving the object", len(moves) * len(found)) as advance:
        for done, (kind, axis, sign) in enumerate(moves):
            vector = sign * MOTIONS[kind] * np.eye(3)[axis]
            shift, turn = (vector, 0.0 * vector)[:: 1 if kind == "shift" else -1]
            motions = asked_motions(scene.human.centre, shift, turn)
            human = human_joints(scene, motions)
            wanted = transform_points(motions[-1], scene.human.points)
            misses.append(np.linalg.norm(human.points[-1] - wanted, axis=1).max())
            for k, name in enumerate(arguments.methods):
                grasp = scene.human if name == "human" else scene.robot
                if name == "human":
                    motion = human
                elif name == "T":
                    motion = mapped_by_contacts(scene, motions, arguments.ridge)
                else:
                    motion = map_grasp(methods[name], scene, human, DURATION)
                carried = carry(grasp, motion, MASS, physics, options)
                name_of = f"{kind} {'+' if sign > 0 else '-'}{'xyz'[axis]}"
                found[name].append(row(name_of, carried, shift, turn))
                advance(done * len(found) + k + 1)
    rows = [summary(name, moved) for name, moved in found.items()]
    print_rows(
        f"{arguments.robot}: 6 mm or 10 deg of in-hand motion; what arrives (+ / -)",
        rows,
    )
    print(
        f"the human's joints leave his contacts at most {1e3 * max(misses):.1f} mm off"
    )


if __name__ == "__main__":
    main()
