"""Repeat the paper's numerical experiment (Sec. IV) and draw its Figs. 4 to 7.

Two hands hold the same cube. The human's wrist moves along an arc while a synergy is activated, and
the robot follows. Each figure is written as PNG, SVG and CSV, and report.md holds the table "what
the paper claims, what we find", which is printed too.

    python benchmarks paper_figures
    python benchmarks paper_figures --out results/figures
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import common
from section_four.figures import FIGURES, run_figures

from handmap_qp.apps.tables import print_rows
from handmap_qp.errors import HandmapError


def main(words: Sequence[str] | None = None) -> None:
    """Make the figures and print the table."""
    parser = argparse.ArgumentParser(
        description="Repeat the paper's experiment (Sec. IV) and draw its figures."
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        default=Path("figures"),
        help="folder to write to; created if it does not exist (default: figures)",
    )
    out = parser.parse_args(words).out
    try:
        with common.progress("figures", len(FIGURES)) as advance:
            result = run_figures(out, progress=advance)
    except HandmapError as error:
        common.stop(str(error))
    print_rows("What the paper claims, what we find", result.claims)
    print(f"wrote {len(result.files)} files to {out}; start with {out / 'report.md'}")


if __name__ == "__main__":
    main()
