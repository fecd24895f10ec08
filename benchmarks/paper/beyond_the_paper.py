"""Runs of the paper's experiment (Sec. IV) beyond the paper, on its open questions.

| study | question |
|---|---|
| `limits` | inverse kinematics within joint limits about the start posture |
| `own_limits` | the same within the toolbox's limits and our hand's |
| `points` | errors of points and object, with moving and with frozen fingers |
| `subsets` | each subset of three or more of the seven human contacts as reference points |
| `placement` | sets of reference points of both hands; the contacts remain the same |
| `start` | pairs of planned grasps as start configurations |
| `allegro` | the Allegro hand beside the three-fingered one |
| `origin` | the scene away from the world's origin, with T_def about three pivots |
| `contacts` | number of contacts in planned grasps, here and of the toolbox |

The object follows the contacts as a rigid body. Prints a table of medians and largest values for
each study; --out writes every run as CSV and a picture of the table.

    python benchmarks beyond_the_paper
    python benchmarks beyond_the_paper --studies limits origin --out beyond
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import common
import numpy as np
from experiment_variants import (
    FingerMode,
    Pivot,
    Variant,
    largest_stretch,
    limit_excess,
    limited_hand,
    moved_scene,
)
from grasp_closing import default_preshape
from grasp_planning import PlannedGrasp, contact_counts, plan_grasps
from section_four.cube import REFERENCE_HANDS, reference_grasp
from section_four.experiment import (
    Scene,
    Setting,
    object_error,
    paper_scene,
)
from section_four.figures import (
    GAMMAS,
    SYNERGIES,
    Row,
    write_csv,
)

from handmap_qp.errors import DegeneratePointsError
from handmap_qp.hands.library import load_hand

STEPS = 20
COUNTS = (3, 4, 5, 6, 7)
"""Numbers of human contacts in a subset of the seven."""
RIDGE = 0.1
"""Ridge of eq. (6) for fewer than four points, or points near a plane; the library's default."""
PAIRS = 30
"""Number of pairs of planned grasps."""
MARGINS = (0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0)
"""Joint limits on either side of the start posture [deg]."""
DISTANCES = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Distances of the scene from the world's origin [m]."""
HUMAN_SETS = ("contacts", "fingertips", "fingertips_middle", "joints")
ROBOT_SETS = ("contacts", "fingertips", "fingertips_middle")
WAYS: tuple[FingerMode, ...] = ("pseudoinverse", "clipped", "damped", "qp")
MEASURES = ("object_error_mm", "point_rms_mm", "limit_excess_deg", "largest_stretch")
PLANS, SEED = 240, 1
"""Number of grasps planned for each hand, and their seed."""
_OPPOSITION = {"allegro_right": "joint_12.0"}
"""Joint of the thumb's opposition, by hand; closing does not move it."""


def measured(
    case: Row, scene: Scene, variant: Variant | None = None, **options: Any
) -> Row:
    """Run the experiment, and return the case with its errors, limit violation and stretch."""
    chosen = variant or Variant()
    run = chosen.run(scene, Setting(**options))
    values = (
        1e3 * object_error(run),
        1e3 * run.point_rms,
        float(np.degrees(limit_excess(run))),
        largest_stretch(run, chosen.ridge),
    )
    return {**case, **dict(zip(MEASURES, values, strict=True))}


def limits() -> Iterator[Row]:
    """Compare inverse kinematics within symmetric joint limits about the start posture."""
    base = paper_scene("ours")
    q = base.robot.q
    for margin in MARGINS:
        room = np.radians(max(margin, 1e-4))
        scene = replace(
            base, robot_points=limited_hand(base.robot_points, q, q - room, q + room)
        )
        for synergy, way in product(SYNERGIES, WAYS):
            case = {"margin_deg": margin, "fingers": way, "synergy": synergy}
            yield measured(case, scene, Variant(way), synergy=synergy, steps=STEPS)


def own_limits() -> Iterator[Row]:
    """Compare inverse kinematics within the toolbox's limits (0 to 90 degrees) and our hand's."""
    ours = paper_scene("ours")
    # The grasp may start slightly outside; widen the limits to include it.
    q = ours.robot.q
    lower, upper = np.minimum(0.0, q), np.maximum(0.5 * np.pi, q)
    toolbox = replace(
        ours, robot_points=limited_hand(ours.robot_points, q, lower, upper)
    )
    for (name, scene), way, synergy in product(
        (("toolbox", toolbox), ("ours", ours)), WAYS, SYNERGIES
    ):
        case = {"limits": name, "fingers": way, "synergy": synergy}
        yield measured(case, scene, Variant(way), synergy=synergy, steps=STEPS)


def points() -> Iterator[Row]:
    """Compare errors of points and object with moving and with frozen fingers."""
    ways: tuple[FingerMode, ...] = ("pseudoinverse", "qp", "frozen")
    for gamma, way, synergy in product(GAMMAS, ways, SYNERGIES):
        case = {"gamma": gamma, "fingers": way, "synergy": synergy}
        yield measured(
            case, paper_scene("ours"), Variant(way), synergy=synergy, gamma=gamma
        )


def subsets() -> Iterator[Row]:
    """Use each subset of three or more of the seven human contacts as reference points."""
    base = paper_scene("ours")
    chosen = (
        one
        for n in COUNTS
        for one in combinations(base.human_points.reference_points, n)
    )
    for some, ridge, synergy in product(chosen, (0.0, RIDGE), SYNERGIES):
        scene = replace(base, human_points=base.human.hand.with_points(some))
        names = " ".join(point.name.removeprefix("contact_") for point in some)
        case = {
            "points": len(some),
            "ridge": ridge,
            "contacts": names,
            "synergy": synergy,
        }
        # Without a ridge, three points or four in a plane do not determine T.
        try:
            yield measured(
                case, scene, Variant(ridge=ridge), synergy=synergy, steps=STEPS
            )
        except DegeneratePointsError:
            continue


def placement() -> Iterator[Row]:
    """Vary the sets of reference points of both hands; the contacts remain the same."""
    human, robot = load_hand("human"), load_hand("three_finger")
    for human_set, robot_set, synergy in product(HUMAN_SETS, ROBOT_SETS, SYNERGIES):
        scene = replace(
            paper_scene("ours"),
            human_points=human.with_points(human_set),
            robot_points=robot.with_points(robot_set),
        )
        case = {"human_set": human_set, "robot_set": robot_set, "synergy": synergy}
        yield measured(case, scene, Variant(ridge=RIDGE), synergy=synergy, steps=STEPS)


def start() -> Iterator[Row]:
    """Run the experiment from pairs of planned grasps.

    The n-th human grasp with force closure, in the order of trials, is paired with the robot's
    n-th, so pairs are random.
    """
    pools = [
        sorted(
            (one for one in plan(name) if one.quality > 0.0), key=lambda one: one.trial
        )
        for name in REFERENCE_HANDS
    ]
    for human, robot in list(zip(*pools, strict=False))[:PAIRS]:
        scene = Scene.at_contacts(human.grasp, robot.grasp)
        ways: tuple[FingerMode, ...] = ("pseudoinverse", "qp")
        for way, synergy in product(ways, SYNERGIES):
            case = {"fingers": way, "synergy": synergy}
            case |= {"human_trial": human.trial, "robot_trial": robot.trial}
            variant = Variant(way, ridge=RIDGE)
            yield measured(case, scene, variant, synergy=synergy, steps=STEPS)


def allegro() -> Iterator[Row]:
    """Compare the Allegro hand with the three-fingered one."""
    ours = paper_scene("ours")
    best = plan("allegro_right")[0].grasp
    scenes = {
        "three_finger": ours,
        "allegro_right": Scene.at_contacts(ours.human, best),
    }
    ways: tuple[FingerMode, ...] = ("pseudoinverse", "qp", "frozen")
    for (robot, scene), way, gamma, synergy in product(
        scenes.items(), ways, GAMMAS, SYNERGIES
    ):
        case = {"robot": robot, "fingers": way, "gamma": gamma, "synergy": synergy}
        yield measured(
            case, scene, Variant(way), synergy=synergy, gamma=gamma, steps=STEPS
        )


def origin() -> Iterator[Row]:
    """Move the scene away from the world's origin.

    14 directions for the pivot `origin`; three for the other pivots, which must not depend on it.
    Along x also 0.1 mm farther.
    """
    axes = [
        *np.eye(3),
        *-np.eye(3),
        *np.array(list(product((-1.0, 1.0), repeat=3))) / np.sqrt(3.0),
    ]
    pivots: tuple[Pivot, ...] = ("centroid", "palm", "origin")
    for distance, (number, direction) in product((*DISTANCES, 1.0001), enumerate(axes)):
        if distance not in DISTANCES and number:
            continue
        scene = moved_scene(paper_scene("ours"), distance * direction)
        for pivot, synergy in product(pivots if number < 3 else ("origin",), SYNERGIES):
            case = {"pivot": pivot, "distance_m": distance, "synergy": synergy}
            variant = Variant(pivot=pivot)
            yield measured(case, scene, variant, synergy=synergy, steps=STEPS)


def contacts() -> Iterator[Row]:
    """Count the contacts of planned grasps."""
    for hand in REFERENCE_HANDS:
        sources = {
            "here": contact_counts(plan(hand)),
            "toolbox": reference_grasp(hand).published_counts,
        }
        for source, counts in sources.items():
            for number, grasps in counts.items():
                share = 100.0 * grasps / sum(counts.values())
                yield {
                    "hand": hand,
                    "source": source,
                    "contacts": number,
                    "share_percent": share,
                }


class Study(NamedTuple):
    """One question.

    Attributes:
        rows: Computes its runs.
        by: Columns of the table, whose rows are medians over the other columns.
        values: What the table has the median and the largest value of.
    """

    rows: Callable[[], Iterable[Row]]
    by: tuple[str, ...]
    values: tuple[str, ...] = MEASURES[:2]


STUDIES = {
    "limits": Study(limits, ("margin_deg", "fingers"), MEASURES[:3]),
    "own_limits": Study(own_limits, ("limits", "fingers"), MEASURES[:3]),
    "points": Study(points, ("gamma", "fingers")),
    "subsets": Study(subsets, ("points", "ridge")),
    "placement": Study(placement, ("human_set", "robot_set")),
    "start": Study(start, ("fingers",)),
    "allegro": Study(allegro, ("robot", "fingers", "gamma")),
    "origin": Study(origin, ("pivot", "distance_m")),
    "contacts": Study(contacts, ("hand", "source", "contacts"), ("share_percent",)),
}


def main() -> None:
    """Run the studies, print their tables and write their files."""
    parser = common.make_parser(
        "Runs of the paper's experiment beyond the paper.", draws=False
    )
    parser.add_argument("--studies", nargs="+", default=list(STUDIES), choices=STUDIES)
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="write CSV files and pictures"
    )
    arguments = common.parse_arguments(parser)
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
    tables = {}
    with common.progress("running", len(arguments.studies)) as advance:
        for name in arguments.studies:
            study = STUDIES[name]
            rows = list(study.rows())
            tables[name] = summary(rows, study)
            if arguments.out is not None:
                write_csv(arguments.out / f"{name}.csv", rows)
                file = arguments.out / f"{name}.png"
                common.save_picture(
                    file, lambda name=name: draw(tables[name], STUDIES[name])
                )
            advance()
    for name, table in tables.items():
        common.print_table(name, table, to_stderr=arguments.json == "-")
    common.write_json(arguments.json, "beyond_the_paper", {"studies": tables})


def summary(rows: Sequence[Row], study: Study) -> list[Row]:
    """Return the median and the largest value for each combination of the study's columns."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[column] for column in study.by), []).append(row)
    table = []
    for key, members in sorted(groups.items()):
        line = dict(zip(study.by, key, strict=True))
        for value in study.values:
            found = [row[value] for row in members]
            line |= {value: float(np.median(found)), f"{value} most": max(found)}
        table.append(line)
    return table


def draw(table: list[Row], study: Study) -> Any:
    """Draw the medians as bars, with lines to the largest values."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0 * len(study.values) + 2.0, 1.2 + 0.2 * len(table)))
    grid = figure.subplots(1, len(study.values), sharey=True, squeeze=False)
    places = np.arange(len(table))
    for axes, value in zip(grid[0], study.values, strict=True):
        medians, most = (
            [row[key] for row in table] for key in (value, f"{value} most")
        )
        axes.barh(places, medians, color=common.PALETTE[1])
        axes.hlines(places, medians, most, color=common.PALETTE[0])
        axes.set_title(value)
    labels = [" ".join(str(row[column]) for column in study.by) for row in table]
    grid[0, 0].set_yticks(places, labels=labels)
    grid[0, 0].invert_yaxis()
    figure.tight_layout()
    return figure


def plan(name: str) -> list[PlannedGrasp]:
    """Plan grasps of the reference cube, best first."""
    cube, hand = paper_scene("ours").human, load_hand(name)
    if cube.shape is None:
        raise TypeError("the reference grasp has no shape")
    preshape = default_preshape(hand)
    if name in _OPPOSITION:
        # With the thumb at rest and the default clearance, this large hand never encloses the cube.
        joint, opened = hand.joint_names.index(_OPPOSITION[name]), preshape.start.copy()
        opened[joint] = hand.upper_limits[joint]
        preshape = replace(preshape, start=opened, clearance=0.0)
    return plan_grasps(
        hand,
        cube.shape,
        samples=PLANS,
        seed=SEED,
        object_pose=cube.object_pose,
        preshape=preshape,
    )


if __name__ == "__main__":
    main()
