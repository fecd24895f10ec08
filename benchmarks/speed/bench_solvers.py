"""Which QP solver, which limit handling, what each costs, and what fails.

`core` is the solver of the compiled core, which maps. The others are those that qpsolvers finds,
DAQP also called without qpsolvers. Limits are in the QP as bounds (*box*), in the QP as rows as
mink has them (*rows*; tasks and limits of mink through `mink.build_ik`), or *clipped*: the step is
found without limits, by one linear solve of the same cost or by the pseudoinverse of eq. (8), and
clipped to the box.

*Free* problems are those of mapping recordings to four hands by the paper's method. *Contacts* are
those of the same recordings and hands where links are kept apart, and the answer is pressed against
a row. All ways solve each problem in turns, where it was posed; `qp_ways.py` says what counts as
pose, wrapper and solver. *of core* is the median over the problems of wrapper and solver, over
those of the core on the same problem. *Broken* counts answers that break a limit or a row by more
than 1e-6 rad or m; *wrong* those that are more than 1e-3 rad or m from the optimum. The optimum is
certified (`qp_proof.reference_answer`).

The proof: on 100,000 problems the core's answer equals those of DAQP, ProxQP and OSQP, or has the
better objective. Its four sets: *recorded*, as *free*; *contacts*, those of teleoperation, with
rows that keep links apart; *hard*, random problems with targets out of reach, joints at and outside
their limits, singular (stretched) postures, and short and long time steps; *hostile*, those of
random targets up to 1e9 m away, options, times and margins (`hostile.py`). An answer that violates
a bound or row by more than 1e-9 of the largest step fails. Two that do not are equal if they, or
their objectives, differ by at most 1e-9; else the lower objective is better. The core's answer is
certified too: multipliers of its active constraints, found by non-negative least squares, bound the
optimum from below.

    python benchmarks bench_solvers --parts times --picture solvers.png --markdown solvers.md
    python benchmarks bench_solvers --json solvers.json
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import common
import synthetic
from qp_problems import (
    PosedProblem,
    Problem,
    hard_problems,
    has_active_row,
    hostile_problems,
    mapped_problems,
)
from qp_proof import QpSolver, prove, reference_answer
from qp_ways import installed_ways, measure, row_of

from handmap_qp.human import HumanMotion
from handmap_qp.reference.daqp_solver import solve_by_daqp
from handmap_qp.reference.solvers import make_solver

_MAPPED = ("allegro_right", "three_finger", "g1_right", "ur5_allegro")
_ROUNDS = 1000
"""How often the proof repeats a motion, at most."""
_REPEATS = 3
_PARTS = ("times", "proof")
_EXACT = 1e-4
"""An answer this near to the optimum is exact enough for a robot [rad or m]."""


def timed_sets(
    motions: Sequence[HumanMotion], count: int
) -> dict[str, list[PosedProblem]]:
    """Record the problems that are timed, by the name of their set.

    Args:
        motions: The motions.
        count: Most problems of a set.
    """
    contacts = mapped_problems(
        motions, _MAPPED, "paper", count, keeps_links_apart=True, keep=has_active_row
    )
    return {
        "free": mapped_problems(motions, _MAPPED, "paper", count),
        "contacts": contacts,
    }


def compare(problems: Sequence[PosedProblem], repeats: int) -> list[dict[str, Any]]:
    """Return a row of each way of solving problems.

    Args:
        problems: The problems.
        repeats: How often each way solves each problem.
    """
    posed = [each.problem for each in problems]
    optima = [reference_answer(each).x for each in posed]
    with (
        common.progress("times", len(problems)) as advance,
        installed_ways() as ways,
    ):
        found = measure(ways, problems, repeats, advance)
    return [row_of(each, found[0], posed, optima) for each in found]


def conclusion(name: str, rows: Sequence[dict[str, Any]], count: int) -> str:
    """Say in words what a table answers: which solver, what it costs, what fails.

    Args:
        name: Name of the set.
        rows: Rows of `compare`.
        count: Number of problems.
    """
    in_qp = [row for row in rows if row["limits"] != "clipped"]
    exact = sorted(filter(_is_exact, in_qp), key=lambda row: row["of core"])
    failing = [row for row in in_qp if not _is_exact(row)]
    lines = [
        f"{name}: exact on all {count} within {_EXACT:g} rad or m, by time over the core's: "
        + (", ".join(f"{_title(row)} {row['of core']:.3g}" for row in exact) or "none")
        + "."
    ]
    lines += [f"{name}: {_title(row)} fails: {_failures(row)}." for row in failing]
    lines += [
        f"{name}: {row['solver']}, clipped: {_failures(row)}."
        for row in rows
        if row["limits"] == "clipped"
    ]
    return "\n".join(lines)


def _is_exact(row: dict[str, Any]) -> bool:
    failures = ("no answer", "wrong", "limit broken", "contact broken")
    return not any(row[what] for what in failures) and row["off_max"] <= _EXACT


def _title(row: dict[str, Any]) -> str:
    return row["solver"] + (" by mink" if row["posed by"] == "mink" else "")


def _failures(row: dict[str, Any]) -> str:
    return (
        f"{row['no answer']} without an answer, {row['wrong']} wrong, "
        f"{row['limit broken']} break a limit, {row['contact broken']} a contact row, "
        f"off by up to {row['off_max']:.2g}"
    )


def verdict(row: dict[str, Any]) -> str:
    """Say in a few words what fails in a row of `compare`."""
    failures = {
        "without an answer": row["no answer"],
        "break a limit": row["limit broken"],
        "break a contact": row["contact broken"],
        "wrong": row["wrong"],
    }
    found = [f"{count} {what}" for what, count in failures.items() if count]
    if not found:
        return "exact" if _is_exact(row) else f"off by {row['off_max']:.1g}"
    return ", ".join(found)


def markdown(results: dict[str, list[dict[str, Any]]]) -> str:
    """Return one table of all sets for a page: a way a row.

    Args:
        results: Rows of `compare` by the name of the set, the same ways in each.
    """
    head = ["solver", "limits", "posed by, us"]
    for name in results:
        head += [f"{name}: of core", "solver + wrapper, us", "fails"]
    lines = [head, ["---"] * len(head)]
    for rows in zip(*results.values(), strict=True):
        first = rows[0]
        pose = f"{first['posed by']}, {first['pose_us']:.0f}"
        cells = [first["solver"], first["limits"], pose]
        for row in rows:
            times = f"{row['solver_us']:.0f} + {row['wrapper_us']:.0f}"
            cells += [f"{row['of core']:.3g}", times, verdict(row)]
        lines.append(cells)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def proof_sets(motions: Sequence[HumanMotion], count: int) -> dict[str, list[Problem]]:
    """Return the problems of the proof, by the name of their set.

    Args:
        motions: The motions.
        count: Number of problems of a set.
    """
    recorded = mapped_problems(motions, _MAPPED, "paper", count, rounds=_ROUNDS)
    contacts = mapped_problems(motions, _MAPPED, "teleoperation", count, rounds=_ROUNDS)
    return {
        "recorded": [posed.problem for posed in recorded],
        "hard": hard_problems(count),
        "contacts": [posed.problem for posed in contacts],
        "hostile": hostile_problems(count),
    }


def compared_solvers() -> dict[str, QpSolver]:
    """Return the solvers that the core is proved against, by name."""
    return {
        "daqp": solve_by_daqp,
        "osqp": make_solver("osqp"),
        "proxqp": make_solver("proxqp"),
    }


def draw(results: dict[str, list[dict[str, Any]]]) -> Any:
    """Draw solver and wrapper of each way as stacked bars, labelled with what fails."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 5.2), layout="constrained")
    panels = figure.subplots(1, len(results), sharey=True, squeeze=False)[0]
    for axes, (name, rows) in zip(panels, results.items(), strict=True):
        names = [f"{row['solver']}, {row['limits']}" for row in rows]
        inside = [row["solver_us"] for row in rows]
        outside = [row["wrapper_us"] for row in rows]
        axes.barh(names, inside, color=common.PALETTE[0], height=0.6, label="solver")
        axes.barh(
            names,
            outside,
            left=inside,
            color=common.PALETTE[1],
            height=0.6,
            label="wrapper",
        )
        for i, row in enumerate(rows):
            axes.text(
                1.15 * (inside[i] + outside[i]),
                i,
                f"{row['of core']:.3g} x core, {verdict(row)}",
                va="center",
                size=7.5,
            )
        axes.set(title=name, xscale="log", xlabel="median time [us]", xlim=(1.0, 1e6))
        axes.grid(axis="y", visible=False)
    panels[0].legend(loc="lower right")
    panels[0].invert_yaxis()
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser(
        "Which QP solver, which limit handling, what each costs, and what fails."
    )
    parser.add_argument(
        "--problems",
        type=int,
        default=100_000,
        help="number of problems of the proof (default: %(default)s)",
    )
    parser.add_argument(
        "--timed",
        type=int,
        default=300,
        help="number of problems of each set that are timed (default: %(default)s)",
    )
    parser.add_argument("--parts", nargs="+", choices=_PARTS, default=list(_PARTS))
    parser.add_argument(
        "--markdown", metavar="FILE", type=Path, help="write one table of all sets"
    )
    arguments = common.parse_arguments(parser, words)
    names = [file.stem for file in sorted(arguments.recordings.glob("*.npz"))]
    names = names[: 1 if arguments.quick else None]
    motions = [
        synthetic.motion_or_synergies(arguments.recordings, name)
        for name in (names or ["none"])
    ]
    to_stderr = arguments.json == "-"
    results: dict[str, list[dict[str, Any]]] = {}
    drawn: dict[str, list[dict[str, Any]]] = {}
    with warnings.catch_warnings():
        # Warnings of solvers show as failures or distances.
        warnings.simplefilter("ignore")
        if "times" in arguments.parts:
            timed = 20 if arguments.quick else arguments.timed
            for name, problems in timed_sets(motions, timed).items():
                if not problems:
                    continue
                rows = compare(problems, 1 if arguments.quick else _REPEATS)
                drawn[name] = rows
                title = f"{len(problems)} {name} problems"
                caption = conclusion(name, rows, len(problems))
                common.print_table(title, rows, to_stderr=to_stderr, caption=caption)
        if "proof" in arguments.parts:
            count = (80 if arguments.quick else arguments.problems) // 4
            for name, problems in proof_sets(motions, count).items():
                rows = prove(problems, compared_solvers())
                results[f"proof: {name}"] = rows
                title = f"Proof: {len(problems)} {name} problems"
                common.print_table(title, rows, to_stderr=to_stderr)
    common.write_json(arguments.json, "bench_solvers", drawn | results)
    if arguments.markdown:
        arguments.markdown.write_text(markdown(drawn), encoding="utf-8")
    common.save_picture(arguments.picture, lambda: draw(drawn))
    proofs = [row for rows in results.values() for row in rows]
    if any(row["core worse"] or row["core failed"] for row in proofs):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
