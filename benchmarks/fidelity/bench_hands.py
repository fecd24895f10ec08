"""How well each hand of the package shows a person's gestures: one row of `handmap compare` each.

    python benchmarks bench_hands --page docs/hands.md

Every hand is mapped by its default method (`teleoperation` where its fingers have names). LEAP and
SVH are those of `shared_hands.py`. A hand whose model lies in a package that is not installed is
left out, with a line that says what to install.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import shared_hands

from handmap_qp import load_hand
from handmap_qp.apps.offline.comparison import (
    Run,
    Take,
    compare_methods,
    own_method,
    prepare_take,
)
from handmap_qp.apps.offline.metrics import METRICS, Metric
from handmap_qp.apps.onboarding.findings import HandReport
from handmap_qp.apps.onboarding.measure import check_pinches
from handmap_qp.errors import HandmapError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import HUMAN_HANDS, hand_files
from handmap_qp.mapping.presets import default_preset
from handmap_qp.trackers.formats import read_recording

_SHOWN = (
    "extension_correlation",
    "thumb_extension_correlation",
    "finger_direction_deg",
    "tip_error_knuckles_mm",
    "pinch_closed",
    "pinch_order",
    "self_penetration",
    "jerk_ratio",
)
_FEW_SAMPLES = 120
_BEGIN, _END = (
    "<!-- table: benchmarks/fidelity/bench_hands.py -->",
    "<!-- end of the table -->",
)


def main(words: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Run the benchmark, and return the rows of the table."""
    parser = common.make_parser(
        "The hands of the package, by the gestures that they show."
    )
    parser.add_argument(
        "--page", type=Path, help="Markdown page whose table is to be replaced"
    )
    arguments = common.parse_arguments(parser, words)
    files = common.find_recordings(arguments.recordings)[
        : 1 if arguments.quick else None
    ]
    recordings = [read_recording(file) for file in files]
    if arguments.quick:
        recordings = [recording.part(slice(_FEW_SAMPLES)) for recording in recordings]
    hands, notes = load_hands(2 if arguments.quick else None)
    takes: dict[str, list[Take]] = {}
    rows = []
    with common.progress("mapping", len(hands)) as advance:
        for hand in hands:
            if hand.side not in takes:
                takes[hand.side] = [
                    prepare_take(one, hand.spec.side) for one in recordings
                ]
            rows.append(measure(hand, takes[hand.side]))
            advance()
    title = f"{len(rows)} hands, means over {len(recordings)} recordings"
    common.print_table(
        title, rows, to_stderr=arguments.json == "-", caption="\n".join(notes)
    )
    common.write_json(arguments.json, "bench_hands", {"hands": rows, "notes": notes})
    common.save_picture(arguments.picture, lambda: draw(rows))
    if arguments.page is not None:
        write_page(arguments.page, rows, [file.stem for file in files])
    return rows


def load_hands(count: int | None = None) -> tuple[list[Hand], list[str]]:
    """Load the robot hands that are here, and say which are not."""
    folder = shared_hands.shared_hands_folder()
    if folder is not None:
        os.environ.setdefault("HANDMAP_HANDS", str(folder))
    hands, notes = [], []
    names = [name for name in hand_files() if name not in HUMAN_HANDS]
    for name in names[:count]:
        try:
            hand = load_hand(name)
        except HandmapError as error:
            notes.append(f"{name}: {error}")
            continue
        if any(point.finger for point in hand.spec.points):
            hands.append(hand)
    present = {hand.name for hand in hands}
    for name in () if folder is None or count is not None else shared_hands.NAMES:
        if name not in present:
            hands.append(load_hand(shared_hands.shared_hand_spec(name)))
    return hands, notes


def measure(hand: Hand, takes: list[Take]) -> dict[str, Any]:
    """Map all takes to one hand, and return its row."""
    method = default_preset(load_hand("human", points="landmarks"), hand)
    comparison = compare_methods(takes, hand, [own_method(method)])
    overall = comparison.overall[comparison.methods[0]]
    failed = [run for run in comparison.runs if run.problem]
    report = HandReport(hand.name)
    report.add(check_pinches(hand))
    pinches = report.measured.get("Pinches", [])
    touched = [pinch["thumb and"] for pinch in pinches if pinch["touch"] == "yes"]
    return {
        "hand": hand.name,
        "joints": len(hand.joint_names),
        "method": comparison.methods[0],
        "thumb touches": ", ".join(touched) or "-",
        **{_heading(metric): _number(metric, overall) for metric in _metrics()},
        "problem": _problem(failed),
    }


def _metrics() -> list[Metric]:
    return [next(metric for metric in METRICS if metric.key == key) for key in _SHOWN]


def _heading(metric: Metric) -> str:
    has_unit = metric.unit and "[" not in metric.label
    return f"{metric.label} [{metric.unit}]" if has_unit else metric.label


def _number(metric: Metric, overall: dict[str, float]) -> str:
    return metric.text(overall[metric.key])


def _problem(runs: list[Run]) -> str:
    return "" if not runs else f"{len(runs)} failed: {runs[0].problem}"


def draw(rows: list[dict[str, Any]]) -> Any:
    """Draw the correlation of the fingers' extension, a bar each hand."""
    heading = _heading(_metrics()[0])
    shares = {row["hand"]: row[heading] for row in rows}
    label = "correlation of the fingers' extension with the human's"
    return common.draw_shares(shares, label)


def write_page(page: Path, rows: list[dict[str, Any]], recordings: list[str]) -> None:
    """Replace the table between the marks of a Markdown page."""
    text = page.read_text(encoding="utf-8")
    before, _, rest = text.partition(_BEGIN)
    _, _, after = rest.partition(_END)
    columns = [
        column
        for column in rows[0]
        if column != "problem" or any(r[column] for r in rows)
    ]
    lines = [
        f"Means over {len(recordings)} recordings: {', '.join(recordings)}.",
        "",
        f"| {' | '.join(columns)} |",
        f"|{'---|' * len(columns)}",
        *(f"| {' | '.join(str(row[column]) for column in columns)} |" for row in rows),
    ]
    page.write_text(
        f"{before}{_BEGIN}\n" + "\n".join(lines) + f"\n{_END}{after}", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
