"""Tables and progress bars of the commands."""

import contextlib
import csv
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import Any

Row = dict[str, Any]
"""A row of a table: values by the names of their columns."""
_PAIR = ("what", "value")
"""Columns of a table without a header."""
_PIPE_WIDTH = 1000  # characters


@contextlib.contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Any]:
    """Show a progress bar on stderr while the block runs, if stderr is a terminal.

    Args:
        what: Label of the bar.
        total: Number of samples; unknown if omitted.

    Yields:
        A function to call with the number of samples done, and a note if there is one.
    """
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(
        console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done, note="": bar.update(
            task, completed=done, description=f"{what} {note}".rstrip()
        )


def print_result(
    document: Any,
    tables: Mapping[str, list[Row] | Row],
    files: Iterable[Any] = (),
    *,
    as_json: bool,
) -> None:
    """Print a result as JSON, or its tables: as in `print_rows`; and files that were written."""
    if as_json:
        print(json.dumps(document, allow_nan=False))
        return
    for title, rows in tables.items():
        print_rows(title, rows)
    for file in files:
        print(f"wrote {file}")


def rows_of(columns: Mapping[str, Iterable[Any]]) -> list[Row]:
    """Return the rows of a table by its columns; short columns end with empty cells."""
    rows = zip_longest(*columns.values(), fillvalue="")
    return [dict(zip(columns, row, strict=True)) for row in rows]


def table_rows(values: Mapping[str, Any]) -> list[Row]:
    """Return labels and values as rows of a table without a header."""
    return [dict(zip(_PAIR, pair, strict=True)) for pair in values.items()]


def print_rows(title: str, rows: list[Row] | Row) -> None:
    """Print a table whose columns are the keys of its rows; nothing if there are no rows.

    Values by their labels are a table without a header.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    if isinstance(rows, dict):
        rows = table_rows(rows)
    if not rows:
        return
    table = Table(show_header=list(rows[0]) != list(_PAIR))
    # Text, because a plain string is markup, in which [mm] or [robots] is a style.
    for name, value in rows[0].items():
        table.add_column(
            Text(name),
            justify="right" if isinstance(value, int | float) else "left",
            overflow="fold",
        )
    for row in rows:
        table.add_row(*(Text(_as_text(value)) for value in row.values()))
    console = Console()
    if not console.is_terminal and "COLUMNS" not in os.environ:
        # Programs that read a pipe need whole rows.
        console.width = _PIPE_WIDTH
    console.print(Text(title), style="bold")
    console.print(table)


def markdown_table(rows: Sequence[Row]) -> str:
    """Format rows as a Markdown table; numbers have four significant digits."""
    rule = ["---:" if isinstance(v, int | float) else "---" for v in rows[0].values()]
    cells = [[_as_text(v).replace("|", "\\|") for v in row.values()] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in [rows[0], rule, *cells])


def _as_text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def csv_text(rows: Sequence[Row]) -> str:
    """Format rows with the same columns as CSV with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
