"""A figure, its numbers and a paragraph about them, ready to be written to files."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class FigureRecord:
    """A figure with its numbers and text.

    Attributes:
        name: Stem of its file names.
        title: Heading in the report.
        figure: The figure.
        rows: Its numbers; all rows have the same columns, with units in their names.
        text: Description of the result, as Markdown.
        facts: Numbers for the table of claims, by name.
    """

    name: str
    title: str
    figure: Figure
    rows: Sequence[Row]
    text: str
    facts: dict[str, Any] = field(default_factory=dict)

    def save(self, folder: Path) -> None:
        """Write NAME.png, NAME.svg and NAME.csv."""
        from handmap_qp.drawing.hands import require_matplotlib
        from handmap_qp.experiments.style import STYLE

        with require_matplotlib().rc_context(STYLE):
            self.figure.savefig(folder / f"{self.name}.png")
            # No date: the same numbers must give the same file.
            self.figure.savefig(folder / f"{self.name}.svg", metadata={"Date": None})
        self.write_csv(folder / f"{self.name}.csv", self.rows)

    @staticmethod
    def write_csv(path: Path, rows: Sequence[Row]) -> None:
        """Write rows with the same columns to a CSV file."""
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows({key: _text(value) for key, value in row.items()} for row in rows)


def markdown_table(rows: Sequence[Row]) -> str:
    """Format rows as a Markdown table; numbers have four significant digits."""
    lines = [list(rows[0]), *([_short(value) for value in row.values()] for row in rows)]
    rule = ["---:" if isinstance(value, int | float) else "---" for value in rows[0].values()]
    return "\n".join("| " + " | ".join(line) + " |" for line in [lines[0], rule, *lines[1:]])


def _text(value: Any) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value).replace("|", "/")
