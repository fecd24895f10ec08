"""Runs beyond the paper, on its open questions; `beyond_figures` draws them.

Each function returns the rows of one table. The object follows the contacts as a rigid body, and
lengths are in millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from handmap_qp.errors import DegeneratePointsError
from handmap_qp.experiments.figure_record import Row
from handmap_qp.experiments.followers import FingerMode
from handmap_qp.experiments.held_object import object_error
from handmap_qp.experiments.section_four import (
    Pivot,
    Run,
    Scene,
    Setting,
    limited_hand,
    paper_scene,
    run_experiment,
)
from handmap_qp.grasp.planning import PlannedGrasp, plan_grasps
from handmap_qp.grasp.preshape import default_preshape
from handmap_qp.hands.library import load_hand

SYNERGIES = (1, 2, 3)
STEPS = 20
COUNTS = (3, 4, 5, 6, 7)
"""Numbers of human contacts in a subset of the seven."""
RIDGE = 0.1
"""Ridge of eq. (6) for fewer than four points, or points near a plane; the library's default."""
PLANS = 240
"""Number of grasps planned for each hand."""
SEED = 1
PAIRS = 30
"""Number of pairs of planned grasps."""
MARGINS = (0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0)
"""Joint limits on either side of the start posture [deg]."""
DISTANCES = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Distances of the scene from the world's origin [m]."""
_OPPOSITION = {"allegro_right": "joint_12.0"}
"""Joint of the thumb's opposition, by hand; closing does not move it."""
HUMAN_SETS = ("contacts", "fingertips", "fingertips_middle", "joints")
ROBOT_SETS = ("contacts", "fingertips", "fingertips_middle")


def limit_rows() -> list[Row]:
    """Compare inverse kinematics within symmetric joint limits about the start posture."""
    base = paper_scene("ours")
    rows: list[Row] = []
    for synergy in SYNERGIES:
        for margin in MARGINS:
            q, room = base.robot.q, np.radians(max(margin, 1e-4))
            hand = limited_hand(base.robot_points, q, q - room, q + room)
            scene = replace(base, robot_points=hand)
            for fingers in ("pseudoinverse", "clipped", "damped", "qp"):
                run = run_experiment(scene, Setting(synergy=synergy, steps=STEPS, fingers=fingers))
                rows.append(
                    {"synergy": synergy, "margin_deg": margin, "fingers": fingers, **_measures(run)}
                )
    return rows


def own_limit_rows() -> list[Row]:
    """Compare inverse kinematics within the toolbox's limits (0 to 90 degrees) and our hand's."""
    rows: list[Row] = []
    for name in ("toolbox", "ours"):
        base = paper_scene("ours")
        hand = base.robot_points
        if name == "toolbox":
            # The grasp may start slightly outside; widen the limits to include it.
            lower, upper = np.minimum(0.0, base.robot.q), np.maximum(0.5 * np.pi, base.robot.q)
            hand = limited_hand(hand, base.robot.q, lower, upper)
        for synergy, fingers in product(SYNERGIES, ("pseudoinverse", "clipped", "damped", "qp")):
            run = run_experiment(
                replace(base, robot_points=hand),
                Setting(synergy=synergy, steps=STEPS, fingers=fingers),
            )
            rows.append({"limits": name, "synergy": synergy, "fingers": fingers, **_measures(run)})
    return rows


def point_rows(gammas: Sequence[float]) -> list[Row]:
    """Compare errors of points and object with moving and with frozen fingers."""
    cases: list[tuple[FingerMode, int, float]] = list(
        product(("pseudoinverse", "qp", "frozen"), SYNERGIES, gammas)
    )
    return [
        {
            "synergy": synergy,
            "gamma": gamma,
            "fingers": fingers,
            **_measures(
                run_experiment(
                    paper_scene("ours"), Setting(synergy=synergy, gamma=gamma, fingers=fingers)
                )
            ),
        }
        for fingers, synergy, gamma in cases
    ]


def subset_rows() -> list[Row]:
    """Use each subset of three or more of the seven human contacts as reference points."""
    base = paper_scene("ours")
    rows: list[Row] = []
    for count in COUNTS:
        for chosen in combinations(base.human.point_specs, count):
            scene = replace(base, human_points=base.human.hand.with_points(chosen))
            for ridge, synergy in product((0.0, RIDGE), SYNERGIES):
                # Without a ridge, three points or four in a plane do not determine T.
                try:
                    measures = _measures(
                        run_experiment(scene, Setting(synergy=synergy, steps=STEPS, ridge=ridge))
                    )
                except DegeneratePointsError:
                    continue
                names = " ".join(point.name.removeprefix("contact_") for point in chosen)
                head = {"points": count, "contacts": names, "ridge": ridge, "synergy": synergy}
                rows.append({**head, **measures})
    return rows


def placement_rows() -> list[Row]:
    """Vary the sets of reference points of both hands; the contacts remain the same."""
    base = paper_scene("ours")
    human, robot = load_hand("human"), load_hand("three_finger")
    rows: list[Row] = []
    for human_set, robot_set, synergy in product(HUMAN_SETS, ROBOT_SETS, SYNERGIES):
        scene = replace(
            base,
            human_points=human.with_points(human_set),
            robot_points=robot.with_points(robot_set),
        )
        run = run_experiment(scene, Setting(synergy=synergy, steps=STEPS, ridge=RIDGE))
        counts = {
            "human_points": len(scene.human_points.reference_points),
            "robot_points": len(scene.robot_points.reference_points),
        }
        rows.append(
            {
                "human_set": human_set,
                "robot_set": robot_set,
                **counts,
                "synergy": synergy,
                **_measures(run),
            }
        )
    return rows


Plans = dict[str, list[PlannedGrasp]]


def plan(hand: str, progress: Callable[[int], None] | None = None) -> list[PlannedGrasp]:
    """Plan grasps of the reference cube.

    Args:
        hand: Name of the hand.
        progress: Called after each grasp with the number of grasps done.

    Returns:
        The grasps, best first.
    """
    cube, model = paper_scene("ours").human, load_hand(hand)
    if cube.shape is None:
        raise TypeError("the reference grasp has no shape")
    preshape = default_preshape(model)
    if hand in _OPPOSITION:
        # With the thumb at rest and the default clearance, this large hand never encloses the cube.
        joint, start = model.joint_names.index(_OPPOSITION[hand]), preshape.start.copy()
        start[joint] = model.upper_limits[joint]
        preshape = replace(preshape, start=start, clearance=0.0)
    return plan_grasps(
        model,
        cube.shape,
        samples=PLANS,
        seed=SEED,
        object_pose=cube.object_pose,
        preshape=preshape,
        progress=progress,
    )


def start_rows(plans: Plans) -> list[Row]:
    """Run the experiment from pairs of planned grasps.

    The n-th human grasp with force closure, in the order of trials, is paired with the robot's
    n-th, so pairs are random.
    """
    pools = {
        name: [one for one in sorted(plans[name], key=lambda one: one.trial) if one.quality > 0.0]
        for name in plans
    }
    rows: list[Row] = []
    for human, robot in list(zip(pools["human"], pools["three_finger"], strict=False))[:PAIRS]:
        scene = Scene.at_contacts(human.grasp, robot.grasp)
        for fingers, synergy in product(("pseudoinverse", "qp"), SYNERGIES):
            run = run_experiment(
                scene, Setting(synergy=synergy, steps=STEPS, ridge=RIDGE, fingers=fingers)
            )
            trials = {"human_trial": human.trial, "robot_trial": robot.trial}
            counts = {
                "human_contacts": len(human.grasp.contacts),
                "robot_contacts": len(robot.grasp.contacts),
            }
            rows.append(
                {**trials, **counts, "fingers": fingers, "synergy": synergy, **_measures(run)}
            )
    return rows


def allegro_scene(plans: Plans) -> Scene:
    """Return the scene of the human's reference grasp and the Allegro hand's best planned one."""
    return Scene.at_contacts(paper_scene("ours").human, plans["allegro_right"][0].grasp)


def allegro_rows(plans: Plans, gammas: Sequence[float]) -> list[Row]:
    """Compare the Allegro hand with the three-fingered one."""
    scenes = {"three_finger": paper_scene("ours"), "allegro_right": allegro_scene(plans)}
    cases: list[tuple[str, FingerMode, int, float]] = list(
        product(scenes, ("pseudoinverse", "qp", "frozen"), SYNERGIES, gammas)
    )
    return [
        {
            "robot": robot,
            "fingers": fingers,
            "synergy": synergy,
            "gamma": gamma,
            **_measures(
                run_experiment(
                    scenes[robot],
                    Setting(synergy=synergy, gamma=gamma, steps=STEPS, fingers=fingers),
                )
            ),
        }
        for robot, fingers, synergy, gamma in cases
    ]


def origin_rows() -> list[Row]:
    """Move the scene away from the world's origin.

    14 directions for the pivot `origin`; three for the other pivots, which must not depend on it.
    """
    axes = np.vstack(
        [np.eye(3), -np.eye(3), np.array(list(product((-1.0, 1.0), repeat=3))) / np.sqrt(3.0)]
    )
    pivots: tuple[Pivot, ...] = ("centroid", "palm", "origin")
    rows: list[Row] = []
    for distance, (number, direction) in product(DISTANCES, enumerate(axes)):
        scene = paper_scene("ours").moved(distance * direction)
        where = {
            f"{axis}_m": float(value)
            for axis, value in zip("xyz", distance * direction, strict=True)
        }
        for pivot, synergy in product(pivots if number < 3 else ("origin",), SYNERGIES):
            measures = _measures(
                run_experiment(scene, Setting(synergy=synergy, steps=STEPS, pivot=pivot))
            )
            rows.append(
                {"distance_m": distance, **where, "pivot": pivot, "synergy": synergy, **measures}
            )
    return rows


def nudged_rows() -> list[Row]:
    """Place the scene 1 m from the origin along x, and 0.1 mm farther, with the pivot `origin`."""
    rows: list[Row] = []
    for nudge, synergy in product((0.0, 1e-4), SYNERGIES):
        scene = paper_scene("ours").moved(np.array([1.0 + nudge, 0.0, 0.0]))
        measures = _measures(
            run_experiment(scene, Setting(synergy=synergy, steps=STEPS, pivot="origin"))
        )
        rows.append({"nudge_m": nudge, "synergy": synergy, **measures})
    return rows


def _measures(run: Run) -> Row:
    """Columns of all tables: errors of object and points, limit violation, largest stretch."""
    return {
        "object_error_mm": 1e3 * object_error(run),
        "point_rms_mm": 1e3 * run.point_rms,
        "limit_excess_deg": float(np.degrees(run.limit_excess)),
        "largest_stretch": float(np.abs(run.stretches).max()),
    }
