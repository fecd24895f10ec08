"""The command `handmap figures`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Figures:
    """Repeat the paper's numerical experiment (Sec. IV) and draw its figures.

    Two hands hold the same cube. The human's wrist moves along an arc while a synergy is activated,
    and the robot follows. Each figure is written as PNG, SVG and CSV, and report.md holds the table
    "what the paper claims, what we find".

    Attributes:
        out: Folder to write to; created if it does not exist.
        beyond: Also make the figures that go beyond the paper; they need the Allegro hand.
    """

    out: Path = Path("figures")
    beyond: bool = True

    def run(self) -> None:
        """Make the figures and print the table."""
        from rich.console import Console
        from rich.progress import Progress
        from rich.table import Table

        from handmap_qp.experiments.report import run_figures

        stderr = Console(stderr=True)
        with Progress(console=stderr, transient=True, disable=not stderr.is_terminal) as progress:
            task = progress.add_task("figures", total=None)
            result = run_figures(
                self.out,
                has_beyond=self.beyond,
                progress=lambda what, done, total: progress.update(
                    task, description=what, completed=done, total=total
                ),
            )
        table = Table(show_lines=True)
        for name in result.claims[0]:
            table.add_column(name)
        for row in result.claims:
            table.add_row(*map(str, row.values()))
        Console().print(table)
        print(f"wrote {len(result.files)} files to {self.out}; start with {self.out / 'report.md'}")
