"""The paper's figures 4 to 7: each function returns one `FigureRecord`."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from handmap_qp.experiments.figure_record import FigureRecord, Row
from handmap_qp.experiments.held_object import (
    UNIT,
    Stiffnesses,
    in_hand_step,
    object_error,
    object_poses,
)
from handmap_qp.experiments.paper_drawings import (
    draw_first_step,
    draw_grasps,
    draw_sensitivity,
    draw_ways,
)
from handmap_qp.experiments.section_four import (
    Setting,
    human_motion,
    paper_scene,
    rms,
    run_experiment,
)
from handmap_qp.mapping.estimation import estimate_motion

GAMMAS = tuple(round(0.1 * k, 1) for k in range(1, 11))
"""The paper's range of gamma."""
STEPS = (2, 3, 5, 10, 20, 50, 100, 200)
"""Numbers of steps of the sweep."""
SYNERGIES = (1, 2, 3)
GAMMA_STEPS = 20
"""Number of steps of the gamma sweep."""
MODELS: dict[str, Stiffnesses | None] = {"rigid": None, "quasi-static": UNIT}
"""Models of the object's motion in the hand, with the stiffnesses of the quasi-static one."""


def figure_4_grasps() -> FigureRecord:
    """Draw both hands on the cube, and the contact points."""
    scene = paper_scene("ours")
    rows = [
        {"hand": hand, "contact": i, "finger": contact.finger, **_xyz(1e3 * point, suffix="_mm")}
        for hand, grasp in (("human", scene.human), ("robot", scene.robot))
        for i, (contact, point) in enumerate(zip(grasp.contacts, grasp.points, strict=True), 1)
    ]
    counts = len(scene.human.contacts), len(scene.robot.contacts)
    text = (
        f"The human hand holds the 50 mm cube with {counts[0]} contacts and the three-fingered "
        f"hand with {counts[1]}. These are "
        "the reference grasps of the package, computed with the paper's toolbox. That toolbox "
        "models fingers as lines, so the "
        "contacts lie on the bones' axes, and our fingers, which have thickness, penetrate the "
        "cube."
    )
    facts = {"human_contacts": counts[0], "robot_contacts": counts[1]}
    return FigureRecord(
        "figure_4_grasps", "Figure 4: both hands on the cube", draw_grasps(scene), rows, text, facts
    )


def figure_5_object_paths(steps: int = 50) -> FigureRecord:
    """Draw the paths of the object's centre in both hands: first synergy, gamma = 1."""
    setting = Setting(steps=steps)
    done = {name: run_experiment(paper_scene(name), setting) for name in ("ours", "toolbox")}
    ways = {
        (geometry, model): [poses[:, :3, 3] for poses in object_poses(run, stiffnesses)]
        for geometry, run in done.items()
        for model, stiffnesses in MODELS.items()
    }
    rows = [
        {
            "geometry": geometry,
            "object_motion": model,
            "step": k,
            **_xyz(1e3 * human[k], "human_", "_mm"),
            **_xyz(1e3 * robot[k], "robot_", "_mm"),
            "distance_mm": 1e3 * float(np.linalg.norm(human[k] - robot[k])),
        }
        for (geometry, model), (human, robot) in ways.items()
        for k in range(steps + 1)
    ]
    length = 1e3 * float(np.linalg.norm(np.diff(ways["ours", "rigid"][0], axis=0), axis=1).sum())
    ends = {
        model: 1e3 * float(np.linalg.norm(np.subtract(*ways["ours", model])[-1]))
        for model in MODELS
    }
    text = (
        f"The object's centre travels {length:.0f} mm in the human's hand. At the end the robot's "
        f"is {ends['rigid']:.1f} mm "
        "away from it if the object follows the contacts as a rigid body, and "
        f"{ends['quasi-static']:.1f} mm by the "
        "quasi-static model at unit stiffness. In that model the object hardly moves in the "
        "compliant human hand, whereas "
        "T_rb still moves the robot's wrist."
    )
    facts = {
        "way": length,
        "end_rigid": ends["rigid"],
        "end_quasistatic": ends["quasi-static"],
        "residual_rms": _residual_rms(),
    }
    return FigureRecord(
        "figure_5_object_paths",
        "Figure 5: the object's way",
        draw_ways(done["ours"], ways),
        rows,
        text,
        facts,
    )


def figure_6_first_step(steps: int = 50) -> FigureRecord:
    """Draw the object's motion by the synergy alone, and the force changes, in the first step."""
    scene = paper_scene("ours")
    found = {
        model: [
            in_hand_step(scene, Setting(synergy=s, steps=steps), is_rigid=stiffnesses is None)
            for s in SYNERGIES
        ]
        for model, stiffnesses in MODELS.items()
    }
    rows: list[Row] = []
    for model, by_synergy in found.items():
        for synergy, step in zip(SYNERGIES, by_synergy, strict=True):
            head = {"synergy": synergy, "model": model}
            for hand, motion in (("human", step.human_motion), ("robot", step.robot_motion)):
                rows.append(
                    {
                        "quantity": "object motion",
                        "unit": "mm",
                        **head,
                        "hand": hand,
                        "contact": 0,
                        **_xyz(1e3 * motion),
                    }
                )
            # The quasi-static model gives the forces for both models of the motion.
            forces = (
                (("human", step.human_forces), ("robot", step.robot_forces))
                if model == "quasi-static"
                else ()
            )
            rows += [
                {
                    "quantity": "force change",
                    "unit": "N",
                    **head,
                    "hand": hand,
                    "contact": i,
                    **_xyz(force),
                }
                for hand, changes in forces
                for i, force in enumerate(changes, 1)
            ]
    angles = {
        model: [float(np.degrees(step.angle)) for step in by_synergy]
        for model, by_synergy in found.items()
    }
    sizes = [
        float(np.linalg.norm(one.robot_motion) / np.linalg.norm(one.human_motion))
        for one in found["quasi-static"]
    ]
    text = (
        "Without the wrist's own motion, the first step of synergies 1 to 3 moves the object's "
        "centre in directions that are "
        f"{listed(angles['rigid'], 0)} degrees apart in the two hands if the object follows the "
        "contacts as a rigid body, and "
        f"{listed(angles['quasi-static'], 0)} degrees by the quasi-static model. The lengths agree "
        "less: at unit "
        f"stiffness the robot's object moves {listed(sizes)} times as far as the human's, because "
        "T_rb moves it with the wrist, "
        "which is not compliant. Force changes are in equilibrium on each hand. With 7 contacts on "
        "one hand and 3 on the other "
        "they cannot be compared one by one, as the paper says."
    )
    changes = [
        forces for one in found["quasi-static"] for forces in (one.human_forces, one.robot_forces)
    ]
    balance = max(
        float(np.abs(forces.sum(axis=0)).max() / np.abs(forces).max()) for forces in changes
    )
    facts = {
        "angles_rigid": angles["rigid"],
        "angles_quasistatic": angles["quasi-static"],
        "force_balance": balance,
    }
    return FigureRecord(
        "figure_6_first_step",
        "Figure 6: the first step",
        draw_first_step(scene, found),
        rows,
        text,
        facts,
    )


def figure_7_sensitivity() -> FigureRecord:
    """Draw the object-centre error by gamma and by number of steps."""
    cases = [
        ("gamma", Setting(synergy=s, gamma=g, steps=GAMMA_STEPS)) for s in SYNERGIES for g in GAMMAS
    ]
    cases += [("steps", Setting(synergy=s, steps=n)) for s in SYNERGIES for n in STEPS]
    rows: list[Row] = []
    for geometry in ("toolbox", "ours"):
        for sweep, setting in cases:
            run = run_experiment(paper_scene(geometry), setting)
            errors = {
                f"error_{model}_mm": 1e3 * object_error(run, stiffnesses)
                for model, stiffnesses in MODELS.items()
            }
            row = {
                "sweep": sweep,
                "synergy": setting.synergy,
                "gamma": setting.gamma,
                "steps": setting.steps,
            }
            rows.append(
                {"geometry": geometry, **row, **errors, "point_rms_mm": 1e3 * run.point_rms}
            )
    by_gamma = [_column(rows, "gamma", s, "error_rigid_mm") for s in SYNERGIES]
    growth = [values[-1] / values[0] for values in by_gamma]
    change, soft_change = (
        [_variation(_column(rows, "steps", s, f"error_{model}_mm", at_least=5)) for s in SYNERGIES]
        for model in MODELS
    )
    text = (
        f"From gamma 0.1 to 1 the error grows {listed(growth)}-fold for synergies 1 to 3, to "
        f"{listed([v[-1] for v in by_gamma])} mm (the object follows the contacts as a rigid "
        "body). From 5 to 200 steps it "
        f"varies by {listed(change, 0)} % of its value at 200. Solid lines: the robot hand of the "
        "toolbox's planner, with "
        "fingers 50/3 mm farther out. Dashed lines: the correct hand."
    )
    facts = {
        "by_gamma": by_gamma,
        "growth": growth,
        "step_change": change,
        "step_change_quasistatic": soft_change,
        "step_change_from_20": [
            _variation(_column(rows, "steps", s, "error_rigid_mm", at_least=20)) for s in SYNERGIES
        ],
        "ends_quasistatic": [
            _column(rows, "gamma", s, "error_quasi-static_mm")[-1] for s in SYNERGIES
        ],
        "point_rms": [
            1e3 * run_experiment(paper_scene(), Setting(synergy=s, start="first")).point_rms
            for s in SYNERGIES
        ],
    }
    return FigureRecord(
        "figure_7_sensitivity",
        "Figure 7: sensitivity to gamma and to the step",
        draw_sensitivity(rows),
        rows,
        text,
        facts,
    )


def listed(values: Iterable[float], digits: int = 1) -> str:
    """Format numbers for a sentence: `1.0, 2.0 and 3.0`."""
    words = [f"{value:.{digits}f}" for value in values]
    return f"{', '.join(words[:-1])} and {words[-1]}" if len(words) > 1 else words[0]


def _residual_rms() -> list[float]:
    """RMS residual of the human's contacts to T over the path at gamma = 1 [mm], by synergy."""
    scene = paper_scene("ours")
    ways = [human_motion(scene, Setting(synergy=synergy)).points for synergy in SYNERGIES]
    return [1e3 * rms(estimate_motion(points[0], points[-1]).residual_vectors) for points in ways]


def _xyz(vector: np.ndarray, prefix: str = "", suffix: str = "") -> Row:
    return {
        f"{prefix}{axis}{suffix}": float(value) for axis, value in zip("xyz", vector, strict=True)
    }


def _column(rows: list[Row], sweep: str, synergy: int, name: str, at_least: int = 0) -> list[float]:
    """One curve of the sensitivities, with the toolbox's geometry."""
    wanted = ("toolbox", sweep, synergy)
    return [
        row[name]
        for row in rows
        if (row["geometry"], row["sweep"], row["synergy"]) == wanted and row["steps"] >= at_least
    ]


def _variation(values: list[float]) -> float:
    """Range in percent of the last value."""
    return 100.0 * (max(values) - min(values)) / values[-1]
