"""Section IV with gravity: what the object does in the human's and in the robot's hand.

Both hands hold the same 50 mm cube of 100 g in planned grasps and carry it along the paper's arc
while the human activates a synergy. Printed for each grasp, synergy, activation and inverse
kinematics of the robot's fingers: whether an object is lost, the largest slip at a contact, the
sum of normal forces at the end against the prediction of the statics, and how much the two
objects' displacements and rotations differ.

    python benchmarks/simulated_arc.py --grasps 2 --gammas -0.3 0.3
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from handmap_qp.experiments.section_four import Setting, run_experiment
from handmap_qp.grasp.objects import Box
from handmap_qp.hands.library import load_hand
from handmap_qp.simulation.arc import ArcOutcome, carry, planned_scene, predicted_force
from handmap_qp.simulation.physics import Physics
from handmap_qp.tables import print_rows, progress

CUBE, MASS = Box((0.05, 0.05, 0.05)), 0.1
FINGERS = ("pseudoinverse", "qp", "frozen")


def row(outcome: ArcOutcome, rank: int, physics: Physics) -> dict[str, Any]:
    """Describe one run."""
    run = outcome.run
    found: dict[str, Any] = {
        "grasp": rank,
        "synergy": run.setting.synergy,
        "gamma": run.setting.gamma,
        "fingers": run.setting.fingers,
    }
    hands = (
        ("human", outcome.human, run.scene.human, run.human),
        ("robot", outcome.robot, run.scene.robot, run.robot),
    )
    for name, carried, grasp, motion in hands:
        force = carried.episode.force
        wanted = predicted_force(grasp, motion, float(force[0]), physics.joint_stiffness)
        found[f"{name} slip mm"] = "lost" if carried.is_lost else f"{1e3 * carried.slip.max():.1f}"
        found[f"{name} force N"] = f"{force[0]:.1f} -> {force[-1]:.1f} ({wanted:.1f})"
    if not (outcome.human.is_lost or outcome.robot.is_lost):
        found["differs mm"] = f"{1e3 * outcome.translation_gap:.1f}"
        found["differs deg"] = f"{np.degrees(outcome.rotation_gap):.1f}"
    else:
        found["differs mm"] = found["differs deg"] = "-"
    return found


def main() -> None:
    """Run all combinations and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--grasps", type=int, default=1, help="best grasps of each hand")
    parser.add_argument("--samples", type=int, default=60, help="palm poses tried for each hand")
    parser.add_argument("--synergies", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--gammas", type=float, nargs="+", default=[-0.3, 0.3])
    parser.add_argument("--robot", default="three_finger")
    arguments = parser.parse_args()
    physics, robot, rows = Physics(), load_hand(arguments.robot), []
    cases = [
        (rank, synergy, gamma)
        for rank in range(arguments.grasps)
        for synergy in arguments.synergies
        for gamma in arguments.gammas
    ]
    scenes = [
        planned_scene(robot, CUBE, rank=rank, samples=arguments.samples)
        for rank in range(arguments.grasps)
    ]
    with progress("carrying", len(cases) * len(FINGERS)) as advance:
        for rank, synergy, gamma in cases:
            human = None
            for fingers in FINGERS:
                setting = Setting(synergy=synergy, gamma=gamma, fingers=fingers, ridge=0.1)
                run = run_experiment(scenes[rank], setting)
                # The human does the same in each.
                human = human or carry(run.scene.human, run.human, MASS, physics)
                carried = carry(run.scene.robot, run.robot, MASS, physics)
                rows.append(row(ArcOutcome(run, human, carried), rank, physics))
                advance(len(rows))
    print_rows(
        f"A 50 mm cube of 100 g on the arc, human and {robot.name}; in brackets: by statics", rows
    )


if __name__ == "__main__":
    main()
