"""What commands share: tables, progress bars, and the check of an output file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from handmap_qp.errors import InvalidInputError

_PAIR = ("what", "value")
"""Columns of a table without a header."""


@contextlib.contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Any]:
    """Show a progress bar on stderr while the block runs, if stderr is a terminal.

    Args:
        what: Label of the bar.
        total: Number of samples; unknown if omitted.

    Yields:
        A function to call with the number of samples done.
    """
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.update(task, completed=done)


def print_table(title: str, values: dict[str, Any]) -> None:
    """Print labels and values as rows under a title."""
    print_rows(title, [dict(zip(_PAIR, pair, strict=True)) for pair in values.items()])


def print_rows(title: str, rows: list[dict[str, Any]]) -> None:
    """Print a table whose columns are the keys of its rows; nothing if there are no rows."""
    from rich.console import Console
    from rich.table import Table

    if not rows:
        return
    table = Table(show_header=list(rows[0]) != list(_PAIR))
    for name, value in rows[0].items():
        table.add_column(
            name, justify="right" if isinstance(value, int | float) else "left", overflow="fold"
        )
    for row in rows:
        table.add_row(
            *(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values())
        )
    console = Console()
    console.print(title, style="bold")
    console.print(table)


def check_output(argument: str, path: Path, suffixes: tuple[str, ...]) -> Path:
    """Check that a file can be written, before any work is done.

    Args:
        argument: The command-line option that names it, such as `--out`.
        path: The file.
        suffixes: Allowed suffixes, the usual one first.

    Returns:
        The same path.

    Raises:
        InvalidInputError: If the suffix is another, the folder does not exist, or the path is a
            folder.
    """
    if path.suffix not in suffixes:
        raise InvalidInputError(
            argument=argument, expected=f"a file that ends in {suffixes[0]}", value=str(path)
        )
    if not path.parent.is_dir():
        raise InvalidInputError(
            argument=argument, problem=f"there is no folder {path.parent}", value=str(path)
        )
    if path.is_dir():
        raise InvalidInputError(argument=argument, problem=f"{path} is a folder", value=str(path))
    return path
