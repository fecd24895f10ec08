"""All figures and a report: `run_figures`, the command `handmap figures`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from handmap_qp.drawing.hands import require_matplotlib
from handmap_qp.experiments import beyond_figures, beyond_runs, paper_figures
from handmap_qp.experiments.contact_histogram import contact_histogram_figure
from handmap_qp.experiments.figure_record import FigureRecord, Row, markdown_table
from handmap_qp.experiments.output_folder import output_folder
from handmap_qp.experiments.paper_figures import listed
from handmap_qp.grasp.paper_cube import REFERENCE_HANDS, reference_grasp
from handmap_qp.grasp.planning import contact_counts
from handmap_qp.hands.library import load_hand

PAPER_FIGURES = (
    "planned_contacts",
    "figure_4_grasps",
    "figure_5_object_paths",
    "figure_6_first_step",
    "figure_7_sensitivity",
)
BEYOND_FIGURES = (
    "beyond_1_limits",
    "beyond_2_points",
    "beyond_3_reference_points",
    "beyond_4_start",
    "beyond_5_allegro",
    "beyond_6_origin",
)

# Largest angle that counts as the paper's "quite comparable" directions [deg].
_COMPARABLE = 45.0


@dataclass(frozen=True, slots=True, eq=False)
class FiguresResult:
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
    has_beyond: bool = True,
    progress: Callable[[str, int, int], None] | None = None,
) -> FiguresResult:
    """Repeat the paper's numerical experiment (Sec. IV) and write figures, numbers and a report.

    Writes NAME.png, NAME.svg and NAME.csv for each figure, `claims.csv`, `final_errors.csv` and
    `report.md`: all of them, or none on failure.

    Args:
        directory: Folder to write to; created if it does not exist. Files of the same names are
            replaced.
        has_beyond: Whether to make the figures that go beyond the paper.
        progress: Called with the present task, the number of tasks done and their total.

    Returns:
        The tables and the files.

    Raises:
        InvalidInputError: If the folder cannot be written.
        MissingExtraError: If matplotlib or trimesh is not installed, or the Allegro hand, which
            the figures beyond the paper need.
    """
    require_matplotlib()
    directory = Path(directory)
    hands = (*REFERENCE_HANDS, *(("allegro_right",) if has_beyond else ()))
    for hand in hands:
        load_hand(hand)
    names = PAPER_FIGURES + (BEYOND_FIGURES if has_beyond else ())
    total = len(hands) + len(names)

    def say(what: str, done: int) -> None:
        if progress is not None:
            progress(what, done, total)

    plans: beyond_runs.Plans = {}
    made: list[FigureRecord] = []
    with output_folder(directory) as folder:
        for i, hand in enumerate(hands):
            say(f"planning grasps of {hand}", i)
            plans[hand] = beyond_runs.plan(hand)
        for i, name in enumerate(names, len(hands)):
            say(name, i)
            made.append(_make(name, plans))
            made[-1].save(folder)
        claims, numbers = claim_rows(made), number_rows(made)
        FigureRecord.write_csv(folder / "claims.csv", claims)
        FigureRecord.write_csv(folder / "final_errors.csv", numbers)
        (folder / "report.md").write_text(_report(made, claims, numbers), encoding="utf-8")
        files = sorted(path.name for path in folder.iterdir())
    say("done", total)
    return FiguresResult(claims, numbers, tuple(directory / name for name in files))


def claim_rows(made: list[FigureRecord]) -> list[Row]:
    """Compare the paper's claims with our findings.

    Args:
        made: Figures, including all of the paper's.

    Returns:
        One row per claim.
    """
    facts: dict[str, Any] = {}
    for artwork in made:
        facts.update({f"{artwork.name}.{key}": value for key, value in artwork.facts.items()})
    most, angles = (
        facts["planned_contacts.most"],
        facts["figure_6_first_step.angles_rigid"] + facts["figure_6_first_step.angles_quasistatic"],
    )
    growth, change, by_gamma = (
        facts["figure_7_sensitivity.growth"],
        facts["figure_7_sensitivity.step_change"],
        facts["figure_7_sensitivity.by_gamma"],
    )
    ends, points = [values[-1] for values in by_gamma], facts["figure_7_sensitivity.point_rms"]
    return [
        _claim(
            "the grasp planner gives seven contacts on the human hand and three on the robot's",
            f"our planner, with fingers of finite thickness, most often gives {most['human']} and "
            f"{most['three_finger']} on the same "
            f"cube; the toolbox's reference pair has {facts['figure_4_grasps.human_contacts']} and "
            f"{facts['figure_4_grasps.robot_contacts']}",
            most == {"human": 7, "three_finger": 3},
        ),
        _claim(
            "the reference points move by a linear transformation (eq. 5)",
            "seven contacts miss their T by "
            f"{listed(facts['figure_5_object_paths.residual_rms'])} mm (RMS) over the path, "
            "synergies 1 to 3 at gamma = 1",
            None,
        ),
        _claim(
            "the robotic hand is able to follow the human hand's trajectory (Fig. 5)",
            f"over a path of {facts['figure_5_object_paths.way']:.0f} mm the objects' centres end "
            f"{facts['figure_5_object_paths.end_rigid']:.1f} mm apart "
            f"(rigid), {facts['figure_5_object_paths.end_quasistatic']:.1f} mm (quasi-static at "
            "unit stiffness)",
            facts["figure_5_object_paths.end_quasistatic"]
            < 0.05 * facts["figure_5_object_paths.way"],
        ),
        _claim(
            "the directions of the object's in-hand motion are quite comparable (Fig. 6)",
            f"{listed(facts['figure_6_first_step.angles_rigid'], 0)} degrees apart for synergies 1 "
            "to 3 (rigid), "
            f"{listed(facts['figure_6_first_step.angles_quasistatic'], 0)} (quasi-static)",
            max(angles) < _COMPARABLE,
        ),
        _claim(
            "contact force variations cannot simply be compared (Fig. 6)",
            f"{facts['figure_4_grasps.human_contacts']} contacts against "
            f"{facts['figure_4_grasps.robot_contacts']}, at other places; the sums "
            f"are zero on both hands (within {facts['figure_6_first_step.force_balance']:.0e} of "
            "the largest force)",
            True,
        ),
        _claim(
            "the trajectory error is sensitive to gamma (Fig. 7, above)",
            f"it grows {listed(growth)}-fold from gamma 0.1 to 1, synergies 1 to 3",
            min(growth) > 2.0,
        ),
        _claim(
            "the sensitivity differs between the synergies (Fig. 7, above)",
            f"at gamma = 1 {listed(ends)} mm (rigid), "
            f"{listed(facts['figure_7_sensitivity.ends_quasistatic'])} mm (quasi-static)",
            max(ends) > 1.2 * min(ends),
        ),
        _claim(
            "the error is much less sensitive to the size of the steps (Fig. 7, below)",
            f"from 5 to 200 steps it varies by {listed(change, 0)} % (rigid), from 20 on by "
            f"{listed(facts['figure_7_sensitivity.step_change_from_20'], 0)} %; "
            f"{listed(facts['figure_7_sensitivity.step_change_quasistatic'])} % "
            "(quasi-static, from 5)",
            max(change) < 100.0 * (min(growth) - 1.0),
        ),
        _claim(
            "the robot's kinematics keep it from reproducing the in-hand motion fully",
            f"with T from the first configuration imposed on it, its contacts end {listed(points)} "
            "mm (RMS) from `T s` at "
            "gamma = 1",
            min(points) > 0.5,
        ),
    ]


def number_rows(made: list[FigureRecord]) -> list[Row]:
    """Final object-centre errors [mm] by gamma (20 steps) and by number of steps (gamma = 1)."""
    rows = next(artwork for artwork in made if artwork.name == "figure_7_sensitivity").rows
    table: list[Row] = []
    for geometry in ("toolbox", "ours"):
        for model in paper_figures.MODELS:
            for synergy in paper_figures.SYNERGIES:
                chosen = [
                    row for row in rows if (row["geometry"], row["synergy"]) == (geometry, synergy)
                ]
                errors = {
                    (row["sweep"], row[row["sweep"]]): row[f"error_{model}_mm"] for row in chosen
                }
                columns = {f"gamma {gamma:g}": errors["gamma", gamma] for gamma in (0.1, 0.5, 1.0)}
                columns |= {f"{steps} steps": errors["steps", steps] for steps in (5, 50, 200)}
                table.append(
                    {"robot hand": geometry, "object motion": model, "synergy": synergy, **columns}
                )
    return table


def _make(name: str, plans: beyond_runs.Plans) -> FigureRecord:
    if name == "planned_contacts":
        return _grasps_figure(plans)
    if name in BEYOND_FIGURES:
        make = getattr(beyond_figures, f"{name.split('_', 2)[2]}_figure")
        return make(plans) if name in ("beyond_4_start", "beyond_5_allegro") else make()
    return getattr(paper_figures, name)()


def _grasps_figure(plans: beyond_runs.Plans) -> FigureRecord:
    """Histogram of the number of contacts in planned grasps of the cube."""
    counts = {hand: contact_counts(plans[hand]) for hand in REFERENCE_HANDS}
    published = {hand: reference_grasp(hand).published_counts for hand in REFERENCE_HANDS}
    rows = [
        {"hand": hand, "source": source, "contacts": number, "grasps": grasps}
        for source, table in (("here", counts), ("toolbox", published))
        for hand in REFERENCE_HANDS
        for number, grasps in table[hand].items()
    ]
    most = {
        hand: max(table, key=lambda number, table=table: table[number])
        for hand, table in counts.items()
    }
    theirs = {
        hand: max(table, key=lambda number, table=table: table[number])
        for hand, table in published.items()
    }
    text = (
        f"In {beyond_runs.PLANS} planned grasps of each hand (seed {beyond_runs.SEED}), the most "
        "frequent number of contacts "
        f"with the 50 mm cube is {most['human']} for the human hand and {most['three_finger']} for "
        "the three-fingered hand. "
        f"With the toolbox's planner, whose fingers are lines, it is {theirs['human']} and "
        f"{theirs['three_finger']}."
    )
    figure = contact_histogram_figure(counts, published)
    return FigureRecord(
        "planned_contacts", "Planned grasps of the cube", figure, rows, text, {"most": most}
    )


def _claim(claim: str, finding: str, holds: bool | None) -> Row:
    return {
        "the paper claims": claim,
        "we find": finding,
        "holds": "assumed" if holds is None else "yes" if holds else "no",
    }


def _report(made: list[FigureRecord], claims: list[Row], numbers: list[Row]) -> str:
    parts = [
        "# The numerical experiment of Sec. IV",
        "Salvietti, Malvezzi, Gioioso and Prattichizzo, *On the Use of Homogeneous Transformations "
        "to Map Human Hand Movements "
        "onto Robotic Hands*, ICRA 2014. Both hands hold the same 50 mm cube, the human's wrist "
        "goes along an arc of 470 mm by "
        "150 mm, and a synergy is activated on the way. The paper prints no values for its Figs. 5 "
        "to 7, no poses, no "
        "stiffnesses and no number of steps, so trends can be compared, but not curves. Each "
        "figure is written as PNG and SVG, "
        "and its numbers as CSV.",
        "Default modelling choices: T is estimated from step to step, in world axes. T_def acts "
        "about the centroid of the "
        "human's contacts, for both hands. The robot's wrist moves by T_rb, its fingers by eq. (8) "
        "without limits. The object "
        "follows the contacts as a rigid body (least squares), or by soft synergies at unit "
        "stiffness (1 N/mm at the contacts, "
        "1 N mm/rad at the joints, 1 N mm per unit of a synergy).",
        "## What the paper claims, what we find",
        markdown_table(claims),
        "## Distance between the objects' centres at the end [mm]",
        "By gamma with 20 steps, and by number of steps with gamma = 1. `toolbox`: the robot hand "
        "of the toolbox's planner, with "
        "fingers 50/3 mm too far out; `ours`: the correct hand, at the same contacts.",
        markdown_table(numbers),
    ]
    for artwork in made:
        if artwork.name == BEYOND_FIGURES[0]:
            parts.append("# Beyond the paper")
        parts += [f"## {artwork.title}", f"![{artwork.title}]({artwork.name}.png)", artwork.text]
    return "\n\n".join(parts) + "\n"
