"""`handmap study`: from the files of participants to tables, JSON, CSV and a picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
from tyro.conf import Positional

from handmap_core.errors import warn
from handmap_qp.apps.arguments import hinted
from handmap_qp.apps.drawing import require_matplotlib
from handmap_qp.apps.tables import Row, csv_text, print_result
from handmap_qp.output_files import check_output, replaced_file, replaced_path
from .analysis import Difference, MappingResult, StudyResult, analyse
from .comparison import Verdict, compare_orders
from .pool import read_pool
from .result_file import StudyFile, schema_text
from .statistics import Interval

_PICTURES = (".png", ".svg", ".pdf")


@dataclass(frozen=True)
class Study:
    """Pool the results of a user study of two mappings.

    Each person does the same tasks with two mappings, answers NASA-TLX about both, says which one
    they prefer, and hands in one JSON file. docs/study.md explains how to run such a study.

    Prints for each mapping the success, the time of successful trials, the drops and the workload
    with 95 % intervals; then how they differ by person, the effect of the order, and what people
    prefer. p is the probability of a difference at least as large by chance: below 0.05 the
    mappings are told apart. Decide before the study which measure counts.

    The first file that cannot be used ends the command with exit code 2. --skip-bad leaves such
    files out, with a line for each. A person counts once.

    --simulated and --score show beside it which mapping simulated operators and the score prefer.
    Their files must have mappings of the same names.

    Examples:
        handmap study results/*.json
        handmap study results/*.json --picture study.png --csv trials.csv
        handmap study results/*.json --skip-bad --json
        handmap study results/*.json --score score/score.json

    Attributes:
        files: One file for each person.
        skip_bad: Leave out files that cannot be used.
        simulated: File of `handmap score --tasks`, score/tasks.json, or its --json output.
        score: File of `handmap score`, score/score.json, or its --json output.
        picture: Draw success, time and workload into this file, .png, .svg or .pdf (extra `plot`).
        csv: Write a row for each trial to this file.
        json: Print one JSON object instead of tables.
        schema: Print the JSON Schema of the files, and exit.
    """

    files: Positional[Annotated[tuple[Path, ...], hinted("FILE...", "(required)")]] = ()
    skip_bad: bool = False
    simulated: Annotated[Path | None, hinted("FILE.json")] = None
    score: Annotated[Path | None, hinted("FILE.json")] = None
    picture: Annotated[Path | None, hinted("FILE.png")] = None
    csv: Annotated[Path | None, hinted("FILE.csv")] = None
    json: bool = False
    schema: bool = False

    def run(self) -> None:
        """Check everything, compute, write and print.

        Raises:
            HandmapError: If a file cannot be used or written.
        """
        if self.schema:
            print(schema_text(), end="")
            return
        if self.picture:
            require_matplotlib()
            check_output("--picture", self.picture, _PICTURES)
        if self.csv:
            check_output("--csv", self.csv, (".csv",))
        pool = read_pool(self.files, skip_bad=self.skip_bad)
        for line in pool.skipped:
            warn(f"left out: {line}")
        result = analyse(pool)
        verdicts = []
        if self.simulated or self.score:
            verdicts = compare_orders(result, self.simulated, self.score)
        written = self._write(result, pool.results)
        document = msgspec.to_builtins(result)
        if verdicts:
            document["judges"] = msgspec.to_builtins(verdicts)
        print_result(document, _tables(result, verdicts), written, as_json=self.json)
        for note in result.notes:
            warn(note)

    def _write(self, result: StudyResult, people: Sequence[StudyFile]) -> list[Path]:
        """Write the files that were asked for, and return them."""
        written = []
        if self.csv:
            with replaced_file(self.csv, "--csv") as file:
                file.write(csv_text(trial_rows(people)).encode())
            written.append(self.csv)
        if self.picture:
            # matplotlib is an extra, and slow to import.
            from .picture import draw_study

            with replaced_path(self.picture, "--picture") as part:
                draw_study(part, result, people, self.picture.suffix[1:])
            written.append(self.picture)
        return written


def trial_rows(people: Sequence[StudyFile]) -> list[Row]:
    """Return a row for each trial of all people, in the order in which they did them."""
    return [
        {
            "participant": one.participant,
            "started": one.started.isoformat(),
            "hand": one.hand,
            "input": one.input,
            "library": one.library,
            "mapping": trial.mapping,
            "name": one.mappings.of(trial.mapping).name,
            "place": one.order.index(trial.mapping) + 1,
            "task": trial.task,
            "number": trial.number,
            "limit_s": trial.limit,
            "seconds": trial.seconds,
            "success": int(trial.is_success),
            "drops": trial.drops,
        }
        for one in people
        for trial in one.trials
    ]


def _tables(
    result: StudyResult, verdicts: Sequence[Verdict]
) -> dict[str, list[Row] | Row]:
    """Return what is printed, by titles."""
    a, b = result.mappings
    names = f"A: {a.name} ({a.kind}), B: {b.name} ({b.kind})"
    orders = ", ".join(f"{count} {order}" for order, count in result.orders.items())
    size = f"{result.people} people ({orders}), {result.trials} trials"
    return {
        f"{names}. {size}": [_mapping_row(a), _mapping_row(b)],
        "Workload by question (NASA-TLX, 0 to 100, means)": [
            {"mapping": one.label}
            | {name: round(value, 1) for name, value in one.scales.items()}
            for one in (a, b)
        ],
        "B minus A, paired by person": [
            _difference_row(one, "B minus A") for one in result.differences
        ],
        "Order: second minus first mapping": [
            _difference_row(one, "second minus first") for one in result.order_effects
        ],
        "Preference": _preference_rows(result),
        "Which mapping is better": [_verdict_row(one) for one in verdicts],
    }


def _mapping_row(one: MappingResult) -> Row:
    return {
        "mapping": one.label,
        "success": f"{one.successes}/{one.trials}",
        "share %": _number(one.success.value, 100.0),
        "95 % (trials)": _ends(one.success, 100.0),
        "95 % (people)": _ends(one.success_by_person, 100.0),
        "time [s]": _number(one.seconds.value),
        "95 % time": _ends(one.seconds),
        "drops": _number(one.drops.value),
        "95 % drops": _ends(one.drops),
        "workload": _number(one.workload.value),
        "95 % workload": _ends(one.workload),
    }


def _difference_row(one: Difference, what: str) -> Row:
    return {
        "measure": one.measure,
        "people": one.people,
        what: _number(one.difference.value),
        "95 %": _ends(one.difference),
        "p": _probability(one.p),
        "p (Wilcoxon)": _probability(one.p_wilcoxon),
    }


def _preference_rows(result: StudyResult) -> list[Row]:
    liked = result.preference
    counts = {"A": liked.A, "B": liked.B, "none": liked.none}
    return [
        {
            "prefers": answer,
            "people": count,
            "share %": _number(liked.shares[answer].value, 100.0),
            "95 %": _ends(liked.shares[answer], 100.0),
            "p (A against B)": _probability(liked.p) if answer == "A" else "",
        }
        for answer, count in counts.items()
    ]


def _verdict_row(one: Verdict) -> Row:
    words = {True: "yes", False: "no", None: "-"}
    return {
        "judge": one.judge,
        "of": one.scope,
        "A": _number(one.a),
        "B": _number(one.b),
        "better": one.better,
        "told apart": words[one.apart],
        "as people": words[one.same_as_people],
    }


def _number(value: float | None, factor: float = 1.0) -> str | float:
    return "-" if value is None else float(f"{factor * value:.3g}")


def _ends(interval: Interval, factor: float = 1.0) -> str:
    if interval.low is None or interval.high is None:
        return "-"
    return f"{factor * interval.low:.3g} to {factor * interval.high:.3g}"


def _probability(p: float | None) -> str:
    if p is None:
        return "-"
    return "<0.001" if p < 0.001 else f"{p:.3f}"
