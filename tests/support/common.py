"""Shared by all benchmarks: arguments, progress, tables, JSON, machine, CPU time, picture style.

A benchmark is a script, for example `python benchmarks bench_accuracy --json results.json
--picture results.png`. Results go to stdout, progress and errors to stderr. A usage error is one
line and exit code 2.
"""

# ruff: noqa: E402
from __future__ import annotations

import os

# Use one thread: for small matrices more threads cost time. Set this before numpy is imported.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

ROOT = Path(__file__).resolve().parents[2]
ROBOTS = ("allegro_right", "leap_right", "shadow_right")
"""Robots that hold objects, unless others are named."""
"""The checkout."""
PACKAGES = (
    "handmap-qp",
    "pin",
    "daqp",
    "proxsuite",
    "osqp",
    "qpsolvers",
    "mink",
    "mujoco",
    "numpy",
    "scipy",
)
"""Packages whose versions `facts` reports, if they are installed."""
COLOURS = {"three_finger": "#c8452f", "allegro": "#3f6fb5"}
"""Colours of the robots in every picture."""
PALETTE = ("#c8452f", "#3f6fb5", "#2f7d6b", "#c48a1d", "#7a56a6", "#6b7280")
"""Colours of all other curves and bars."""
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": "#8a929c",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e7eb",
    "grid.linewidth": 0.8,
    "xtick.color": "#8a929c",
    "ytick.color": "#8a929c",
    "xtick.labelcolor": "#222831",
    "ytick.labelcolor": "#222831",
    "text.color": "#222831",
    "axes.labelcolor": "#222831",
    "lines.linewidth": 1.8,
    "legend.frameon": False,
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "figure.facecolor": "white",
}
"""matplotlib settings of every picture."""


def make_parser(description: str, draws: bool = True) -> argparse.ArgumentParser:
    """Return a parser with the common arguments; a benchmark may add its own.

    Args:
        description: What the benchmark measures, in one sentence.
        draws: Whether it can draw its results, with `--picture`.

    Returns:
        The parser.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "--json",
        metavar="FILE",
        help="write all numbers as JSON to FILE, or to stdout with -",
    )
    if draws:
        parser.add_argument(
            "--picture",
            metavar="FILE",
            type=Path,
            help="draw the results into FILE (.png, .svg, .pdf)",
        )
    parser.add_argument(
        "--recordings",
        metavar="DIR",
        type=Path,
        default=Path(
            os.environ.get("HANDMAP_RECORDINGS")
            or ROOT.parent / "shared" / "recordings"
        ),
        help="folder of recordings of human hands "
        "(default: $HANDMAP_RECORDINGS, else ../shared/recordings)",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="few samples and settings: to test the script, not to measure",
    )
    return parser


def parse_arguments(
    parser: argparse.ArgumentParser, words: Sequence[str] | None = None
) -> argparse.Namespace:
    """Parse the command line, and reject output files in folders that do not exist.

    Args:
        parser: Result of `make_parser`.
        words: The command line; `sys.argv` if omitted.

    Returns:
        The arguments.
    """
    arguments = parser.parse_args(words)
    for option in ("json", "picture"):
        file = getattr(arguments, option, None)
        if file not in (None, "-") and not Path(file).absolute().parent.is_dir():
            stop(f"--{option} {file}: the folder does not exist")
    return arguments


def find_recordings(folder: Path) -> list[Path]:
    """Return the recordings of a folder, sorted by name; exit with code 2 if there are none."""
    files = sorted(folder.glob("*.npz"))
    if not files:
        stop(
            f"no recordings (*.npz) in {folder}: give --recordings DIR or HANDMAP_RECORDINGS"
        )
    return files


def stop(message: str) -> NoReturn:
    """Print a usage error to stderr and exit with code 2."""
    print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    raise SystemExit(2)


@contextmanager
def progress(what: str, total: int | None) -> Iterator[Callable[[], None]]:
    """Show a progress bar on stderr while the block runs.

    Args:
        what: Label of the bar.
        total: Number of work items; None if unknown.

    Yields:
        The function to call after each item.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)


def rows_by(
    found: Sequence[dict[str, Any]],
    keys: Sequence[str],
    row: Callable[[str, Sequence[dict[str, Any]]], dict[str, Any]],
) -> list[dict[str, Any]]:
    """Return a row of each group of results that agree in some keys.

    Args:
        found: The results.
        keys: The keys, whose values are text.
        row: Makes a row of a group's title and results.
    """
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for each in found:
        groups.setdefault(tuple(each[key] for key in keys), []).append(each)
    return [row(", ".join(group), own) for group, own in groups.items()]


def print_groups(
    found: Sequence[dict[str, Any]],
    keys: Sequence[Sequence[str]],
    row: Callable[[str, Sequence[dict[str, Any]]], dict[str, Any]],
    ending: str = "",
    *,
    to_stderr: bool = False,
) -> None:
    """Print a table of the rows of `rows_by` for each choice of keys; titles have an ending."""
    for chosen in keys:
        title = f"By {' and '.join(chosen)}{ending}"
        print_table(title, rows_by(found, chosen, row), to_stderr=to_stderr)


def print_table(
    title: str,
    rows: Sequence[dict[str, Any]],
    *,
    to_stderr: bool = False,
    caption: str | None = None,
) -> None:
    """Print rows as a table, text flush left and numbers flush right.

    Args:
        title: Heading.
        rows: Values by column, the same columns in each row; text is printed unchanged. An empty
            row is a separator line.
        to_stderr: Whether to print to stderr, because stdout carries JSON.
        caption: Text below the table.
    """
    columns = list(next(row for row in rows if row))
    table = Table(
        title=title, title_justify="left", caption=caption, caption_justify="left"
    )
    for column in columns:
        is_text = any(
            isinstance(row[column], str) and row[column][:1].isalpha()
            for row in rows
            if row
        )
        table.add_column(column, justify="left" if is_text else "right", no_wrap=True)
    for row in rows:
        if row:
            table.add_row(*(_cell(row[column]) for column in columns))
        else:
            table.add_section()
    # Print at full width: a narrow terminal wraps lines, whereas rich would truncate the numbers.
    natural = Console(width=10_000).measure(table).maximum
    Console(stderr=to_stderr, width=natural).print(table)


def write_json(target: str | None, name: str, results: dict[str, Any]) -> None:
    """Write results and `facts` as JSON; NaN and infinity become null.

    Args:
        target: The argument `--json`: a file, `-` for stdout, or None to write nothing.
        name: Name of the benchmark.
        results: Numbers, texts, and lists and dictionaries of them.
    """
    if target is None:
        return
    text = json.dumps(
        _plain({"benchmark": name, "facts": facts(), **results}),
        indent=1,
        allow_nan=False,
    )
    if target == "-":
        print(text)
    else:
        Path(target).write_text(text + "\n", encoding="utf-8")


def facts() -> dict[str, Any]:
    """Return what timings depend on: processor, cores, load, Python and package versions."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "threads": os.environ["OMP_NUM_THREADS"],
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "versions": versions,
    }


def cpu_times(call: Callable[[int], Any], count: int) -> np.ndarray:
    """Measure the CPU time of each call in this thread; other processes hardly affect it.

    Args:
        call: Function to measure, given the number of the call.
        count: Number of calls.

    Returns:
        Times [s], shape (count,). Reading the clock adds about 0.3 us to each; measure shorter
        calls with `mean_cpu_time`.
    """
    times = np.empty(count)
    for i in range(count):
        started = time.thread_time_ns()
        call(i)
        times[i] = 1e-9 * (time.thread_time_ns() - started)
    return times


def mean_cpu_time(call: Callable[[], Any], count: int) -> float:
    """Measure the mean CPU time of a call over a batch [s], which hides the cost of the clock."""
    started = time.thread_time_ns()
    for _ in range(count):
        call()
    return 1e-9 * (time.thread_time_ns() - started) / count


def save_picture(file: Path | None, draw: Callable[[], Any]) -> None:
    """Draw the results in the benchmarks' style.

    Args:
        file: The argument `--picture`; None draws nothing.
        draw: Returns the `matplotlib.figure.Figure`; called only if `file` is given.
    """
    if file is None:
        return
    try:
        import matplotlib
    except ImportError:
        stop("--picture needs matplotlib: pip install 'handmap-qp[plot]'")
    with matplotlib.rc_context(STYLE):
        draw().savefig(file)
    print(f"wrote {file}", file=sys.stderr)


def draw_shares(shares: dict[str, str], label: str) -> Any:
    """Draw a bar from 0 to 1 for each name.

    Args:
        shares: What is printed of each, by name; a dash and nothing count as 0.
        label: What the bars are.

    Returns:
        The `matplotlib.figure.Figure`.
    """
    from matplotlib.figure import Figure

    values = [0.0 if share in ("-", "") else float(share) for share in shares.values()]
    figure = Figure(figsize=(7, 0.3 * len(shares) + 1.2), layout="constrained")
    axes = figure.subplots()
    axes.barh([*shares], values, color="0.4")
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.0)
    axes.set_xlabel(label)
    return figure


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(
            line.partition(":")[2].strip()
            for line in lines
            if line.startswith("model name")
        )
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _plain(value: Any) -> Any:
    """Convert to plain Python values that JSON can hold."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
