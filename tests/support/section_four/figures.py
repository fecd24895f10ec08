"""The paper's Sec. IV as figures, numbers and claims: `run_figures`.

`experiment` has the runs, `drawings` draws the figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from handmap_qp.apps.drawing.hands import require_matplotlib
from handmap_qp.apps.tables import csv_text, markdown_table
from handmap_qp.output_files import output_folder
from handmap_qp.reference.estimation import estimate_motion
from section_four.drawings import (
    STYLE,
    draw_first_step,
    draw_grasps,
    draw_sensitivity,
    draw_ways,
    selected,
)
from section_four.experiment import (
    UNIT,
    InHandStep,
    Setting,
    Stiffnesses,
    human_motion,
    in_hand_step,
    object_error,
    object_poses,
    paper_scene,
    rms,
    run_experiment,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GAMMAS = tuple(round(0.1 * k, 1) for k in range(1, 11))
"""The paper's range of gamma."""
STEPS = (2, 3, 5, 10, 20, 50, 100, 200)
"""Numbers of steps of the sweep."""
TABLE_GAMMAS = (0.1, 0.5, 1.0)
TABLE_STEPS = (5, 50, 200)
"""What the table of final errors has of them."""
SYNERGIES = (1, 2, 3)
MODELS: dict[str, Stiffnesses | None] = {"rigid": None, "quasi-static": UNIT}
"""Models of the object's motion in the hand, with the stiffnesses of the quasi-static one."""
_GAMMA_STEPS = 20
# Largest angle that counts as the paper's "quite comparable" directions [deg].
_COMPARABLE = 45.0

Row = dict[str, Any]


class FigureRecord(NamedTuple):
    """A figure with its numbers, text and claims.

    Attributes:
        name: Stem of its file names.
        title: Heading in the report.
        figure: The figure.
        rows: Its numbers; all rows have the same columns, with units in their names.
        text: Description of the result, as Markdown.
        claims: What the paper claims about it, what we find, and whether the claim holds.
    """

    name: str
    title: str
    figure: Figure
    rows: Sequence[Row]
    text: str
    claims: list[Row]

    def save(self, folder: Path) -> None:
        """Write NAME.png, NAME.svg and NAME.csv."""
        with require_matplotlib().rc_context(STYLE):
            self.figure.savefig(folder / f"{self.name}.png")
            # No date: the same numbers must give the same file.
            self.figure.savefig(folder / f"{self.name}.svg", metadata={"Date": None})
        write_csv(folder / f"{self.name}.csv", self.rows)


class FiguresResult(NamedTuple):
    """Result of `run_figures`.

    Attributes:
        claims: The table "what the paper claims, what we find".
        numbers: Object-centre errors of the sweeps of Fig. 7 [mm].
        files: Files written.
    """

    claims: list[Row]
    numbers: list[Row]
    files: tuple[Path, ...]


def run_figures(
    directory: Path | str = Path("figures"),
    *,
    progress: Callable[[], None] = lambda: None,
) -> FiguresResult:
    """Repeat the paper's numerical experiment (Sec. IV) and write figures, numbers and a report.

    Writes NAME.png, NAME.svg and NAME.csv for each figure, `claims.csv`, `final_errors.csv` and
    `report.md`: all of them, or none on failure.

    Args:
        directory: Folder to write to; created if it does not exist. Files of the same names are
            replaced.
        progress: Called after each figure.

    Returns:
        The tables and the files.

    Raises:
        InvalidInputError: If the folder cannot be written.
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    require_matplotlib()
    directory = Path(directory)
    made: list[FigureRecord] = []
    with output_folder(directory) as folder:
        for make in FIGURES.values():
            made.append(make())
            made[-1].save(folder)
            progress()
        claims = [claim for record in made for claim in record.claims]
        numbers = number_rows(made)
        write_csv(folder / "claims.csv", claims)
        write_csv(folder / "final_errors.csv", numbers)
        (folder / "report.md").write_text(
            _report(made, claims, numbers), encoding="utf-8"
        )
        files = sorted(path.name for path in folder.iterdir())
    return FiguresResult(claims, numbers, tuple(directory / name for name in files))


def figure_4_grasps() -> FigureRecord:
    """Draw both hands on the cube, and the contact points."""
    scene = paper_scene("ours")
    rows = [
        {
            "hand": hand,
            "contact": i,
            "finger": contact.finger,
            **_xyz(1e3 * point, suffix="_mm"),
        }
        for hand, grasp in (("human", scene.human), ("robot", scene.robot))
        for i, (contact, point) in enumerate(
            zip(grasp.contacts, grasp.points, strict=True), 1
        )
    ]
    human = len(scene.human.contacts)
    robot = len(scene.robot.contacts)
    text = (
        f"The human hand holds the 50 mm cube with {human} contacts and the three-fingered hand "
        f"with {robot}. These are the reference grasps of the package, computed with the paper's "
        "toolbox. That toolbox models fingers as lines, so the contacts lie on the bones' axes, "
        "and our fingers, which have thickness, penetrate the cube."
    )
    claim = _claim(
        "the grasp planner gives seven contacts on the human hand and three on the robot's",
        f"the figures take the toolbox's reference pair, with {human} and {robot}; "
        "`benchmarks/paper/beyond_the_paper.py` plans grasps",
    )
    return FigureRecord(
        "figure_4_grasps",
        "Figure 4: both hands on the cube",
        draw_grasps(scene),
        rows,
        text,
        [claim],
    )


def figure_5_object_paths(steps: int = 50) -> FigureRecord:
    """Draw the paths of the object's centre in both hands: first synergy, gamma = 1."""
    done = {
        name: run_experiment(paper_scene(name), Setting(steps=steps))
        for name in ("ours", "toolbox")
    }
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
    way = 1e3 * np.linalg.norm(np.diff(ways["ours", "rigid"][0], axis=0), axis=1).sum()
    rigid, soft = (
        row["distance_mm"] for row in selected(rows, geometry="ours", step=steps)
    )
    text = (
        f"The object's centre travels {way:.0f} mm in the human's hand. At the end the robot's is "
        f"{rigid:.1f} mm away from it if the object follows the contacts as a rigid body, and "
        f"{soft:.1f} mm by the quasi-static model at unit stiffness. In that model the object "
        "hardly moves in the compliant human hand, whereas T_rb still moves the robot's wrist."
    )
    # RMS residual of the human's contacts to T over the path at gamma = 1 [mm].
    paths = [
        human_motion(paper_scene("ours"), Setting(synergy=s)).points for s in SYNERGIES
    ]
    misses = [
        1e3 * rms(estimate_motion(path[0], path[-1]).residual_vectors) for path in paths
    ]
    claims = [
        _claim(
            "the reference points move by a linear transformation (eq. 5)",
            f"seven contacts miss their T by {listed(misses)} mm (RMS) over the path, "
            "synergies 1 to 3 at gamma = 1",
        ),
        _claim(
            "the robotic hand is able to follow the human hand's trajectory (Fig. 5)",
            f"over a path of {way:.0f} mm the objects' centres end {rigid:.1f} mm apart (rigid), "
            f"{soft:.1f} mm (quasi-static at unit stiffness)",
            soft < 0.05 * way,
        ),
    ]
    return FigureRecord(
        "figure_5_object_paths",
        "Figure 5: the object's way",
        draw_ways(done["ours"], ways),
        rows,
        text,
        claims,
    )


def figure_6_first_step(steps: int = 50) -> FigureRecord:
    """Draw the object's motion by the synergy alone, and the force changes, in the first step."""
    scene = paper_scene("ours")
    found = {
        model: [
            in_hand_step(scene, Setting(synergy=s, steps=steps), stiffnesses)
            for s in SYNERGIES
        ]
        for model, stiffnesses in MODELS.items()
    }
    rigid, soft = (
        [float(np.degrees(step.angle)) for step in steps] for steps in found.values()
    )
    lengths = [
        float(np.linalg.norm(step.robot_motion) / np.linalg.norm(step.human_motion))
        for step in found["quasi-static"]
    ]
    text = (
        "Without the wrist's own motion, the first step of synergies 1 to 3 moves the object's "
        f"centre in directions that are {listed(rigid, 0)} degrees apart in the two hands if the "
        f"object follows the contacts as a rigid body, and {listed(soft, 0)} degrees by the "
        "quasi-static model. The lengths agree less: at unit stiffness the robot's object moves "
        f"{listed(lengths)} times as far as the human's, because T_rb moves it with the wrist, "
        "which is not compliant. Force changes are in equilibrium on each hand. With 7 contacts on "
        "one hand and 3 on the other they cannot be compared one by one, as the paper says."
    )
    changes = [
        forces
        for step in found["quasi-static"]
        for forces in (step.human_forces, step.robot_forces)
    ]
    balance = max(np.abs(one.sum(axis=0)).max() / np.abs(one).max() for one in changes)
    human = len(scene.human.contacts)
    robot = len(scene.robot.contacts)
    claims = [
        _claim(
            "the directions of the object's in-hand motion are quite comparable (Fig. 6)",
            f"{listed(rigid, 0)} degrees apart for synergies 1 to 3 (rigid), "
            f"{listed(soft, 0)} (quasi-static)",
            max(rigid + soft) < _COMPARABLE,
        ),
        _claim(
            "contact force variations cannot simply be compared (Fig. 6)",
            f"{human} contacts against {robot}, at other places; the sums are zero on both hands "
            f"(within {balance:.0e} of the largest force)",
            True,
        ),
    ]
    return FigureRecord(
        "figure_6_first_step",
        "Figure 6: the first step",
        draw_first_step(scene, found),
        _first_step_rows(found),
        text,
        claims,
    )


def _first_step_rows(found: dict[str, list[InHandStep]]) -> list[Row]:
    """Return motions [mm] of contact 0, the object, and force changes [N] by the soft model."""
    rows: list[Row] = []
    for model, synergy in product(MODELS, SYNERGIES):
        step = found[model][synergy - 1]
        arrows = [
            ("object motion", "mm", "human", 0, 1e3 * step.human_motion),
            ("object motion", "mm", "robot", 0, 1e3 * step.robot_motion),
        ]
        hands = (("human", step.human_forces), ("robot", step.robot_forces))
        arrows += [
            ("force change", "N", hand, i, force)
            for hand, forces in hands
            for i, force in enumerate(forces, 1)
        ]
        rows += [
            {
                "quantity": quantity,
                "unit": unit,
                "synergy": synergy,
                "model": model,
                "hand": hand,
                "contact": contact,
                **_xyz(arrow),
            }
            for quantity, unit, hand, contact, arrow in arrows
        ]
    return rows


def figure_7_sensitivity() -> FigureRecord:
    """Draw the object-centre error by gamma and by number of steps."""
    cases = [("gamma", s, g, _GAMMA_STEPS) for s in SYNERGIES for g in GAMMAS]
    cases += [("steps", s, 1.0, n) for s in SYNERGIES for n in STEPS]
    rows: list[Row] = []
    for geometry, (sweep, synergy, gamma, steps) in product(("toolbox", "ours"), cases):
        run = run_experiment(paper_scene(geometry), Setting(synergy, gamma, steps))
        rows.append(
            {
                "geometry": geometry,
                "sweep": sweep,
                "synergy": synergy,
                "gamma": gamma,
                "steps": steps,
                **{f"error_{m}_mm": 1e3 * object_error(run, MODELS[m]) for m in MODELS},
                "point_rms_mm": 1e3 * run.point_rms,
            }
        )
    rigid, soft = (np.array(_curves(rows, "gamma", model)) for model in MODELS)
    growth = rigid[:, -1] / rigid[:, 0]
    ends = rigid[:, -1]
    ends_soft = soft[:, -1]
    change = _variations(rows, "rigid", 5)
    text = (
        f"From gamma 0.1 to 1 the error grows {listed(growth)}-fold for synergies 1 to 3, to "
        f"{listed(ends)} mm (the object follows the contacts as a rigid body). From 5 to 200 steps "
        f"it varies by {listed(change, 0)} % of its value at 200. Solid lines: the robot hand of "
        "the toolbox's planner, with fingers 50/3 mm farther out. Dashed lines: the correct hand."
    )
    settings = [Setting(synergy=s, start="first") for s in SYNERGIES]
    misses = [1e3 * run_experiment(paper_scene(), one).point_rms for one in settings]
    claims = [
        _claim(
            "the trajectory error is sensitive to gamma (Fig. 7, above)",
            f"it grows {listed(growth)}-fold from gamma 0.1 to 1, synergies 1 to 3",
            min(growth) > 2.0,
        ),
        _claim(
            "the sensitivity differs between the synergies (Fig. 7, above)",
            f"at gamma = 1 {listed(ends)} mm (rigid), {listed(ends_soft)} mm (quasi-static)",
            max(ends) > 1.2 * min(ends),
        ),
        _claim(
            "the error is much less sensitive to the size of the steps (Fig. 7, below)",
            f"from 5 to 200 steps it varies by {listed(change, 0)} % (rigid), from 20 on by "
            f"{listed(_variations(rows, 'rigid', 20), 0)} %; "
            f"{listed(_variations(rows, 'quasi-static', 5))} % (quasi-static, from 5)",
            max(change) < 100.0 * (min(growth) - 1.0),
        ),
        _claim(
            "the robot's kinematics keep it from reproducing the in-hand motion fully",
            "with T from the first configuration imposed on it, its contacts end "
            f"{listed(misses)} mm (RMS) from `T s` at gamma = 1",
            min(misses) > 0.5,
        ),
    ]
    return FigureRecord(
        "figure_7_sensitivity",
        "Figure 7: sensitivity to gamma and to the step",
        draw_sensitivity(rows),
        rows,
        text,
        claims,
    )


def _curves(
    rows: Sequence[Row], sweep: str, model: str, least: int = 0
) -> list[list[float]]:
    """Return the errors [mm] of each synergy with the toolbox's hand, from `least` steps on."""
    return [
        [
            row[f"error_{model}_mm"]
            for row in selected(rows, geometry="toolbox", sweep=sweep, synergy=synergy)
            if row["steps"] >= least
        ]
        for synergy in SYNERGIES
    ]


def _variations(rows: Sequence[Row], model: str, least: int) -> list[float]:
    """Return the range of each synergy's errors in percent of that at most steps."""
    curves = _curves(rows, "steps", model, least)
    return [100.0 * (max(curve) - min(curve)) / curve[-1] for curve in curves]


def _claim(claim: str, finding: str, holds: bool | None = None) -> Row:
    """Compare a claim of the paper with our finding; None for an assumption."""
    verdict = {None: "assumed", True: "yes", False: "no"}[holds]
    return {"the paper claims": claim, "we find": finding, "holds": verdict}


FIGURES: dict[str, Callable[[], FigureRecord]] = {
    make.__name__: make
    for make in (
        figure_4_grasps,
        figure_5_object_paths,
        figure_6_first_step,
        figure_7_sensitivity,
    )
}
"""The paper's figures by the stems of their files."""


def number_rows(made: Sequence[FigureRecord]) -> list[Row]:
    """Final object-centre errors [mm] by gamma (20 steps) and by number of steps (gamma = 1)."""
    rows = next(record.rows for record in made if record.name == "figure_7_sensitivity")
    table: list[Row] = []
    for geometry, model, synergy in product(("toolbox", "ours"), MODELS, SYNERGIES):
        errors = {
            (row["sweep"], row[row["sweep"]]): row[f"error_{model}_mm"]
            for row in selected(rows, geometry=geometry, synergy=synergy)
        }
        columns = {f"gamma {g:g}": errors["gamma", g] for g in TABLE_GAMMAS}
        columns |= {f"{steps} steps": errors["steps", steps] for steps in TABLE_STEPS}
        case = {"robot hand": geometry, "object motion": model, "synergy": synergy}
        table.append({**case, **columns})
    return table


def listed(values: Iterable[float], digits: int = 1) -> str:
    """Format numbers for a sentence: `1.0, 2.0 and 3.0`."""
    words = [f"{value:.{digits}f}" for value in values]
    return f"{', '.join(words[:-1])} and {words[-1]}" if len(words) > 1 else words[0]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows with the same columns to a CSV file; numbers have nine significant digits."""
    rounded = [
        {key: f"{v:.9g}" if isinstance(v, float) else v for key, v in row.items()}
        for row in rows
    ]
    path.write_text(csv_text(rounded), encoding="utf-8")


def _xyz(vector: np.ndarray, prefix: str = "", suffix: str = "") -> Row:
    return {
        f"{prefix}{axis}{suffix}": float(value)
        for axis, value in zip("xyz", vector, strict=True)
    }


def _report(made: Sequence[FigureRecord], claims: list[Row], numbers: list[Row]) -> str:
    parts = [
        "# The numerical experiment of Sec. IV",
        "Salvietti, Malvezzi, Gioioso and Prattichizzo, *On the Use of Homogeneous Transformations "
        "to Map Human Hand Movements onto Robotic Hands*, ICRA 2014. Both hands hold the same 50 "
        "mm cube, the human's wrist goes along an arc of 470 mm by 150 mm, and a synergy is "
        "activated on the way. The paper prints no values for its Figs. 5 to 7, no poses, no "
        "stiffnesses and no number of steps, so trends can be compared, but not curves. Each "
        "figure is written as PNG and SVG, and its numbers as CSV.",
        "Default modelling choices: T is estimated from step to step, in world axes. T_def acts "
        "about the centroid of the human's contacts, for both hands. The robot's wrist moves by "
        "T_rb, its fingers by eq. (8) without limits. The object follows the contacts as a rigid "
        "body (least squares), or by soft synergies at unit stiffness (1 N/mm at the contacts, "
        "1 N mm/rad at the joints, 1 N mm per unit of a synergy).",
        "## What the paper claims, what we find",
        markdown_table(claims),
        "## Distance between the objects' centres at the end [mm]",
        "By gamma with 20 steps, and by number of steps with gamma = 1. `toolbox`: the robot hand "
        "of the toolbox's planner, with fingers 50/3 mm too far out; `ours`: the correct hand, at "
        "the same contacts.",
        markdown_table(numbers),
    ]
    for record in made:
        parts += [
            f"## {record.title}",
            f"![{record.title}]({record.name}.png)",
            record.text,
        ]
    return "\n\n".join(parts) + "\n"
