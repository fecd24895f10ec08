"""Section IV with gravity: what the object does in the human's and in the robot's hand.

Both hands hold the same 50 mm cube of 100 g in planned grasps and carry it along the paper's arc
while the human activates a synergy. Printed for each grasp, synergy, activation, number of steps
and mapping: whether an object is lost, the largest slip at a contact, the sum of normal forces at
the end against the prediction of the statics, and how much the two objects' displacements and
rotations differ. With --summary, one row for each mapping.

Mappings are the inverse kinematics of `experiment_variants.py` (`pseudoinverse` is eq.
(8)), or of `handmap compare`, for a robot with the human's fingers; see `map_grasp`.

    python benchmarks simulated_arc --gammas -0.3 0.3
    python benchmarks simulated_arc --grasps 5 --gammas -1 -0.6 -0.3 0.3 0.6 1 --summary
    python benchmarks simulated_arc --robot allegro_right --mappings qp teleoperation --summary
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from arc import ArcOptions, ArcOutcome, carry, planned_scene, soft_synergy
from experiment_variants import FingerMode, Variant
from mapped_grasps import map_grasp, with_equal_palms
from section_four.contacts import Grasp
from section_four.experiment import HandMotion, Scene, Setting
from section_four.statics import Stiffness, quasistatic

from handmap_qp.apps.simulation.commands import chosen_methods
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.tables import print_rows, progress
from handmap_qp.hands.library import load_hand
from handmap_qp.mapping.objects import Box

CUBE, MASS = Box((0.05, 0.05, 0.05)), 0.1
FINGERS: tuple[FingerMode, ...] = get_args(FingerMode)
# Stiffness of contacts in the prediction by statics, far above the fingers' [N/m].
_RIGID = 1e5


class Case(NamedTuple):
    """One motion of the human, mapped and simulated.

    Attributes:
        grasp: Rank of the planned grasps.
        setting: Synergy, activation and number of steps.
        mapping: Name of the mapping.
        outcome: What became of both objects.
        wanted: Sum of the normal forces at the end by the statics, of human and robot [N].
    """

    grasp: int
    setting: Setting
    mapping: str
    outcome: ArcOutcome
    wanted: tuple[float, float]

    @property
    def is_lost(self) -> bool:
        """Whether one of the objects is lost."""
        return self.outcome.human.is_lost or self.outcome.robot.is_lost


def predicted_force(
    grasp: Grasp, motion: HandMotion, start: float, stiffness: Stiffness
) -> float:
    """Predict the sum of the normal forces at the end of a motion by the statics.

    Args:
        grasp: The grasp at the start.
        motion: Commands of the joints.
        start: Sum of the normal forces at the start [N].
        stiffness: Stiffness of the actuators [N m/rad], one number or shape (n, n).

    Returns:
        The sum at the end [N], by the linear model of `quasistatic` with rigid contacts.
    """
    change = motion.q[-1] - motion.q[0]
    response = quasistatic(
        grasp.jacobian,
        grasp.matrix,
        np.eye(len(change)),
        contact_stiffness=_RIGID,
        joint_stiffness=stiffness,
        synergy_stiffness=np.inf,
    )
    forces = (response.contact_forces @ change).reshape(-1, 3)
    return start + float(np.einsum("ci,ci->", forces, grasp.normals))


def simulate(
    scene: Scene,
    rank: int,
    setting: Setting,
    mappings: dict[str, Any],
    physics: Physics,
    options: ArcOptions,
    *,
    is_soft: bool = False,
) -> list[Case]:
    """Simulate the human once, perhaps with soft synergies, and the robot with every mapping."""
    soft = soft_synergy(setting.synergy, physics) if is_soft else None
    cases, human = [], None
    for name, method in mappings.items():
        fingers = next((mode for mode in FINGERS if mode == name), "frozen")
        run = Variant(fingers, ridge=0.1).run(scene, setting)
        if method is not None:
            run = run._replace(
                robot=map_grasp(method, scene, run.human, options.duration)
            )
        human = human or carry(scene.human, run.human, MASS, physics, options, soft)
        robot = carry(scene.robot, run.robot, MASS, physics, options)
        hands = ((human, scene.human, run.human), (robot, scene.robot, run.robot))
        wanted = [
            predicted_force(
                grasp,
                motion,
                float(carried.episode.at.normal_force[0]),
                carried.stiffness,
            )
            for carried, grasp, motion in hands
        ]
        outcome = ArcOutcome(run, human, robot)
        cases.append(Case(rank, setting, name, outcome, (wanted[0], wanted[1])))
    return cases


def row(case: Case) -> dict[str, Any]:
    """Describe one run."""
    outcome, setting = case.outcome, case.setting
    found: dict[str, Any] = {
        "grasp": case.grasp,
        "synergy": setting.synergy,
        "gamma": setting.gamma,
        "steps": setting.steps,
        "mapping": case.mapping,
    }
    hands = (("human", outcome.human), ("robot", outcome.robot))
    for (name, carried), wanted in zip(hands, case.wanted, strict=True):
        force = carried.episode.at.normal_force
        found[f"{name} slip mm"] = (
            "lost" if carried.is_lost else f"{1e3 * carried.slip.max():.1f}"
        )
        found[f"{name} force N"] = f"{force[0]:.1f} -> {force[-1]:.1f} ({wanted:.1f})"
    found["differs mm"] = (
        "-" if case.is_lost else f"{1e3 * outcome.translation_gap:.1f}"
    )
    found["differs deg"] = (
        "-" if case.is_lost else f"{np.degrees(outcome.rotation_gap):.1f}"
    )
    return found


def summary(name: str, cases: list[Case], frozen: dict[tuple, Case]) -> dict[str, Any]:
    """Describe all runs of one mapping: median and worst of those in which no object is lost."""
    robots = [case.outcome.robot for case in cases]
    held = [robot for robot in robots if not robot.is_lost]
    errors = [
        abs(case.outcome.robot.episode.at.normal_force[-1] - case.wanted[1])
        for case in cases
        if not case.outcome.robot.is_lost
    ]
    both = [case for case in cases if not case.is_lost]
    nearer = [
        case.outcome.translation_gap < frozen[_key(case)].outcome.translation_gap
        for case in both
        if _key(case) in frozen and not frozen[_key(case)].is_lost
    ]
    return {
        "mapping": name,
        "runs": len(cases),
        "human lost": sum(case.outcome.human.is_lost for case in cases),
        "robot lost": len(robots) - len(held),
        "robot slip mm": _spread([1e3 * robot.slip.max() for robot in held]),
        "force off statics N": _spread(errors),
        "differs mm": _spread([1e3 * case.outcome.translation_gap for case in both]),
        "differs deg": _spread(
            [np.degrees(case.outcome.rotation_gap) for case in both]
        ),
        "nearer than frozen": f"{sum(nearer)} of {len(nearer)}"
        if name != "frozen"
        else "-",
    }


def human_summary(cases: list[Case]) -> dict[str, Any]:
    """Describe the human's own object over all motions."""
    motions = {_key(case): case for case in cases}.values()
    held = [case for case in motions if not case.outcome.human.is_lost]
    errors = [
        abs(case.outcome.human.episode.at.normal_force[-1] - case.wanted[0])
        for case in held
    ]
    return {
        "motions": len(motions),
        "lost": len(motions) - len(held),
        "slip mm": _spread([1e3 * case.outcome.human.slip.max() for case in held]),
        "force off statics N": _spread(errors),
    }


def _key(case: Case) -> tuple:
    return case.grasp, case.setting.synergy, case.setting.gamma, case.setting.steps


def _spread(values: list[Any]) -> str:
    return f"{np.median(values):.1f} / {max(values):.1f}" if values else "-"


def main() -> None:
    """Run all combinations and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--grasps", type=int, default=1, help="best grasps of each hand"
    )
    parser.add_argument(
        "--samples", type=int, default=60, help="palm poses tried for each hand"
    )
    parser.add_argument("--synergies", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--gammas", type=float, nargs="+", default=[-0.3, 0.3])
    parser.add_argument(
        "--steps", type=int, nargs="+", default=[50], help="steps of the mapping"
    )
    parser.add_argument(
        "--mappings", nargs="+", default=["pseudoinverse", "qp", "frozen"]
    )
    parser.add_argument(
        "--peers", type=Path, help="folder of outside methods, benchmarks/peers"
    )
    parser.add_argument(
        "--soft", action="store_true", help="soft synergies of the human"
    )
    parser.add_argument(
        "--squeeze", type=float, default=4.0, help="force at every contact [N]"
    )
    parser.add_argument("--robot", default="three_finger")
    parser.add_argument(
        "--summary", action="store_true", help="one row for each mapping"
    )
    arguments = parser.parse_args()
    robot = load_hand(arguments.robot)
    others = tuple(name for name in arguments.mappings if name not in FINGERS)
    methods = {
        m.name: m for m in chosen_methods(others, arguments.peers, arguments.robot)
    }
    mappings = {name: methods.get(name) for name in arguments.mappings}
    settings = [
        Setting(synergy=synergy, gamma=gamma, steps=steps)
        for synergy in arguments.synergies
        for gamma in arguments.gammas
        for steps in arguments.steps
    ]
    options = ArcOptions(normal_force=arguments.squeeze)
    physics = Physics()
    cases: list[Case] = []
    with progress("carrying", arguments.grasps * len(settings)) as advance:
        for rank in range(arguments.grasps):
            scene = planned_scene(robot, CUBE, rank=rank, samples=arguments.samples)
            # Mappings of a whole hand turn the robot's palm as the human's.
            scene = with_equal_palms(scene) if others else scene
            for setting in settings:
                cases += simulate(
                    scene,
                    rank,
                    setting,
                    mappings,
                    physics,
                    options,
                    is_soft=arguments.soft,
                )
                advance(len(cases) // len(mappings))
    title = f"A 50 mm cube of 100 g on the arc, human and {robot.name}"
    if not arguments.summary:
        print_rows(f"{title}; in brackets: by statics", [row(case) for case in cases])
        return
    frozen = {_key(case): case for case in cases if case.mapping == "frozen"}
    of = {name: [case for case in cases if case.mapping == name] for name in mappings}
    print_rows(
        f"{title}; median / worst", [summary(name, of[name], frozen) for name in of]
    )
    print_rows("The human's own object; median / worst", [human_summary(cases)])


if __name__ == "__main__":
    main()
