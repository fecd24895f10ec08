"""What `handmap compare` does, from the words of the command line to tables and files."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import handmap_qp
from handmap_qp.arguments import InputArguments
from handmap_qp.errors import InvalidInputError
from handmap_qp.experiments.comparison_report import as_json, markdown, notes_of, overall_rows
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.human.person import Person, read_person
from handmap_qp.offline.compared_methods import (
    LOOK_AHEAD,
    SMOOTH,
    outside_methods,
    own_method,
    own_methods,
)
from handmap_qp.offline.comparison import ComparedMethod, Comparison, compare_methods
from handmap_qp.offline.metrics import GROUPS
from handmap_qp.offline.takes import Take, prepare_take
from handmap_qp.output_files import make_folder, writing

FILES = ("table.md", "results.json", "metrics.png", "poses.png")
"""Files that are written."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class ComparisonRequest:
    """What to compare.

    Attributes:
        recordings: Files of recordings.
        robot: Robot hand, name or path.
        methods: Names of methods, own and of peers.
        has_peers: Whether to run peers.
        peers_from: Folder of the program that runs the peers; that of the checkout if None.
        out: Folder to write to; None to write nothing.
        inputs: How the recordings are to be read.
        person: File of the person's hand; measured in each recording if None.
    """

    recordings: tuple[Path, ...]
    robot: str
    methods: tuple[str, ...]
    has_peers: bool = False
    peers_from: Path | None = None
    out: Path | None = None
    inputs: InputArguments = field(default_factory=InputArguments)
    person: Path | None = None


def run_comparison(request: ComparisonRequest, *, prints_json: bool) -> None:
    """Compare, print the result and write the files.

    Raises:
        HandmapError: If a recording, hand, method or folder cannot be used; before any mapping.
    """
    if not request.recordings:
        raise InvalidInputError(argument="RECORDING", expected="at least one file", got="none")
    robot = load_hand(request.robot)
    person = None if request.person is None else read_person(request.person)
    methods = _methods(request)
    out = None if request.out is None else _folder(request.out)
    with _progress() as advance:
        takes = _takes(request.recordings, robot, request.inputs, person, advance)
        comparison = compare_methods(takes, robot, methods, advance)
        written = [] if out is None else _write(out, comparison, advance)
    if prints_json:
        print(json.dumps(as_json(comparison), allow_nan=False))
        return
    for group in GROUPS:
        _print_overall(f"{group}, {robot.name}", overall_rows(comparison, group))
    for note in notes_of(comparison):
        print(f"- {note}")
    for file in written:
        print(f"wrote {file}")


def _methods(request: ComparisonRequest) -> list[ComparedMethod]:
    """Return the methods by their names, peers last unless they are named."""
    outside = {}
    if request.has_peers:
        folder = request.peers_from or Path(handmap_qp.__file__).parents[1] / "benchmarks" / "peers"
        outside = {method.name: method for method in outside_methods(folder, request.robot)}
    named = [name for name in request.methods if name in outside]
    endings = ("", SMOOTH, LOOK_AHEAD)
    own = [name + ending for name in own_methods() for ending in endings]
    unknown = [name for name in request.methods if name not in outside and name not in own]
    if unknown:
        known = ", ".join([*own_methods(), *outside])
        raise InvalidInputError(
            argument="--methods",
            expected=f"some of {known}, or one of ours with {SMOOTH} or {LOOK_AHEAD}",
            got=unknown[0],
            advice="" if request.has_peers else "peers need --peers",
        )
    chosen: list[ComparedMethod] = [
        outside[name] if name in outside else own_method(name) for name in request.methods
    ]
    return chosen if named else [*chosen, *outside.values()]


def _takes(
    files: tuple[Path, ...],
    robot: Hand,
    inputs: InputArguments,
    person: Person | None,
    advance: Progress,
) -> list[Take]:
    """Read all recordings before any is prepared."""
    recordings = [inputs.read(file, robot.spec.side) for file in files]
    names = [recording.name for recording in recordings]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InvalidInputError(
            argument="RECORDING", expected="files of different names", got=f"{twice} twice"
        )
    turned = [recording.name for recording in recordings if recording.side != robot.spec.side]
    if turned:
        print(
            f"handmap: mirrored, because {robot.name} is a {robot.spec.side} hand: "
            + ", ".join(turned),
            file=sys.stderr,
        )
    takes = []
    for i, recording in enumerate(recordings):
        advance(f"measuring the hand of {recording.name}", i, len(recordings))
        takes.append(prepare_take(recording, robot.spec.side, person=person))
    return takes


def _print_overall(title: str, rows: list[dict[str, str]]) -> None:
    """Print a table of methods, whose names are not broken."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, header_style="bold")
    for name in rows[0]:
        is_method = name == "method"
        table.add_column(name, justify="left" if is_method else "right", no_wrap=is_method)
    for row in rows:
        table.add_row(*row.values())
    console = Console()
    console.print(title, style="bold")
    console.print(table)
    console.print()


def _folder(out: Path) -> Path:
    """Make the folder, and check that pictures can be drawn."""
    from handmap_qp.drawing.hands import require_matplotlib

    require_matplotlib()
    make_folder(out, "--out")
    return out


def _write(out: Path, comparison: Comparison, advance: Progress) -> list[Path]:
    """Write all files, and return those that were written."""
    from handmap_qp.experiments.comparison_pictures import draw_metrics, draw_poses

    table, results, metrics, poses = (out / name for name in FILES)
    with writing(out, "--out"):
        table.write_text(markdown(comparison), encoding="utf-8")
        text = json.dumps(as_json(comparison), indent=1, allow_nan=False)
        results.write_text(text + "\n", encoding="utf-8")
        advance("drawing metrics", 0, 2)
        draw_metrics(metrics, comparison)
        advance("drawing poses", 1, 2)
        sheet, missing = draw_poses(poses, comparison)
        advance("drawn", 2, 2)
    if sheet is None:
        poses.unlink(missing_ok=True)
        print(f"handmap: no contact sheet; not shown: {', '.join(missing)}", file=sys.stderr)
        return [table, results, metrics]
    return [table, results, metrics, sheet]


@contextmanager
def _progress() -> Iterator[Progress]:
    """Show a bar on stderr for each stage, if stderr is a terminal."""
    from rich.console import Console
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    with Bar(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda what, done, total: bar.update(
            task, description=what, completed=done, total=total
        )
