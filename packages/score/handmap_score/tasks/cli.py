"""`handmap score --tasks`: from the words of the command line to the page."""

import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from handmap_qp.apps.offline.trajectory import package_versions
from handmap_qp.apps.tables import print_result, progress
from handmap_qp.errors import InvalidInputError, did_you_mean, warn
from handmap_qp.hands import Names
from handmap_qp.mapping import PRESETS
from handmap_qp.output_files import make_folder, replaced_file
from .benches import Blocks, Cell, CellResult, cells_of, run_cells
from .catalogue import CATALOGUE
from .film import FilmError, FilmJob, draw_films
from .journal import FILE, Kept
from .mapping import check_mapping
from .outside import LIMITS, peer_methods
from .page import tasks_page
from .report import (
    Check,
    Row,
    checks_of,
    groups_of,
    object_rows,
    pair_rows,
    problems_of,
    rows_of_results,
)
from .table import object_of

BLOCKS = (0, 1000, 2000, 3000, 4000)
"""First seeds of the blocks, unless --seeds says otherwise."""
ATTEMPTS = 4
"""Attempts of each block: 20 of each cell."""
FULL_ATTEMPTS = 40
"""The same with --full: 200 of each cell."""
_EVERY = 15.0
"""Time between two lines of progress where there is no terminal [s]."""


class TasksRequest(NamedTuple):
    """What is asked for.

    Attributes:
        tasks: Tasks of `CATALOGUE`; all if empty.
        out: Folder to write to.
        hands: Hands, by name or the path of their hand.yaml; the usual ones if empty.
        objects: Objects of the tasks that let choose; all if empty.
        operators: Operators; the usual ones of each task if empty.
        methods: Mappings besides the controls; all presets if empty.
        blocks: Seeds.
        processes: Processes that run attempts; as many as the machine has processors if 0.
        films: Whether to draw films.
        resume: Whether to go on with the attempts that the folder has.
        as_json: Whether to print JSON in place of tables.
        peers: Whether to add all peers that can run here, as published and within our limits.
    """

    tasks: Names
    out: Path
    hands: Names
    objects: Names
    operators: Names
    methods: Names
    blocks: Blocks
    processes: int
    films: bool
    resume: bool
    as_json: bool
    peers: bool = False


def score_tasks(request: TasksRequest) -> None:
    """Check everything, run all attempts, print and write.

    Raises:
        HandmapError: If a task, hand, operator, mapping, seed or folder cannot be used.
    """
    tasks = request.tasks or tuple(CATALOGUE)
    _check_names("--tasks", tasks, tuple(CATALOGUE))
    known = tuple({name: None for task in tasks for name in CATALOGUE[task].operators})
    _check_names("--operators", request.operators, known)
    things = tuple({name: None for task in tasks for name in CATALOGUE[task].objects})
    _check_names("--objects", request.objects, things)
    for method in request.methods:
        check_mapping(method)
    if request.peers:
        request = request._replace(methods=with_peers(request.methods))
    request.blocks.check()
    make_folder(request.out, "--out")
    # Before the attempts, because all that may fail comes first.
    about = {
        "command": shlex.join(["handmap", *sys.argv[1:]]),
        "first seeds of blocks": " ".join(map(str, request.blocks.firsts)),
        "attempts of each block": str(request.blocks.attempts),
        "versions": ", ".join(package_versions()),
    }
    journal = Kept(request.out / FILE, about["versions"], resume=request.resume)
    objects = {
        task: tuple(n for n in request.objects if n in CATALOGUE[task].objects)
        for task in tasks
    }
    with journal as kept, TemporaryDirectory(prefix="handmap-") as folder:
        cells, labels = _cells(request, tasks, Path(folder))
        processes = request.processes or os.cpu_count() or 1
        with _told("attempts:") as say:
            results = run_cells(
                cells, request.blocks, processes, say, kept, objects, labels
            )
        films: dict[str, bytes] = {}
        notes = []
        if request.films:
            with _told("films:") as say:
                try:
                    films = _films(results, labels, processes, say, objects)
                except FilmError as error:
                    notes.append(str(error))
    named = [_named(one, labels) for one in results]
    used = {task: names or CATALOGUE[task].objects for task, names in objects.items()}
    _write(request, named, used, films, notes, about)


def with_peers(methods: Names) -> Names:
    """Return mappings and all peers that can run here, as published and within our limits.

    Args:
        methods: Mappings that are asked for; all presets if empty.

    Raises:
        OutsideError: If no peer can run here.
    """
    found = peer_methods()
    both = [name + end for name in found for end in ("", LIMITS)]
    return tuple(dict.fromkeys((*(methods or PRESETS), *both)))


@contextmanager
def _told(what: str) -> Iterator[Callable[[int, str], None]]:
    """Yield a function that tells progress: a bar on a terminal, else a line now and then.

    Args:
        what: Label of the progress.
    """
    last = time.monotonic()
    with progress(what) as bar:

        def say(done: int, note: str) -> None:
            nonlocal last
            bar(done, note)
            if not sys.stderr.isatty() and time.monotonic() - last > _EVERY:
                last = time.monotonic()
                print(what, note, file=sys.stderr, flush=True)

        yield say


def _check_names(argument: str, names: Names, known: Names) -> None:
    for name in names:
        if name not in known:
            raise InvalidInputError(
                f"there is no {name!r}",
                argument=argument,
                value=name,
                advice=did_you_mean(name, known) or f"one of {', '.join(known)}",
            )


def _cells(
    request: TasksRequest, tasks: Names, folder: Path
) -> tuple[list[Cell], dict[str, str]]:
    """Return the cells, and the names of their hands by path.

    Args:
        request: What is asked for.
        tasks: Names of the tasks.
        folder: Folder for descriptions of hands that a task writes itself.
    """
    labels: dict[str, str] = {}

    def hands(task: str) -> list[str]:
        entry = CATALOGUE[task]
        found = []
        for name in request.hands or entry.hands:
            file = name
            if entry.describe and not name.endswith((".yaml", ".yml")):
                file = str(entry.describe(name, folder))
            labels[file] = name
            found.append(file)
        return found

    def operators(task: str) -> list[str]:
        entry = CATALOGUE[task]
        wanted = request.operators or entry.usual
        return [name for name in wanted if name in entry.operators]

    def methods(task: str, hand: str) -> Names:
        first = CATALOGUE[task].controls(labels[hand])
        others = request.methods or tuple(PRESETS)
        return tuple(dict.fromkeys((*first, *others)))

    return cells_of(tasks, hands, operators, methods), labels


def _named(result: CellResult, labels: dict[str, str]) -> CellResult:
    """Return a result whose hand has its short name."""
    hand = labels[result.cell.hand]
    return result._replace(cell=result.cell._replace(hand=hand))


def _films(
    results: Sequence[CellResult],
    labels: dict[str, str],
    processes: int,
    say: Callable[[int, str], None],
    objects: Mapping[str, Names],
) -> dict[str, bytes]:
    """Return the film of each cell's first attempt, by its caption.

    Raises:
        FilmError: If this machine cannot draw.
    """
    captions = []
    jobs = []
    for result in results:
        first = result.attempts[0] if result.attempts else None
        if first is None or first.record is None:
            continue
        cell = result.cell
        ending = "success" if first.is_success else first.cause
        hand = labels[cell.hand]
        captions.append(
            f"{cell.task}, {hand}, {cell.operator}, {cell.method}: {ending}"
        )
        jobs.append(FilmJob(cell.task, cell.hand, first.record, objects[cell.task]))
    films = []
    for film in draw_films(jobs, processes):
        films.append(film)
        say(len(films), f"{len(films)} of {len(jobs)}")
    return dict(zip(captions, films, strict=True))


def _write(
    request: TasksRequest,
    results: Sequence[CellResult],
    objects: Mapping[str, Names],
    films: dict[str, bytes],
    notes: list[str],
    about: dict[str, str],
) -> None:
    """Write tasks.json and tasks.html, and print the tables.

    All objects of a task make a table too long for a terminal, so that one is printed if some are
    chosen.
    """
    rows = rows_of_results(results)
    by_object = object_rows(results, objects)
    pairs = pair_rows(groups_of(results))
    checks = checks_of(results, CATALOGUE)
    notes = [*problems_of(results), *notes]
    document = {
        "about": about,
        "results": rows,
        "objects": by_object,
        "pairs": pairs,
        "soundness": [_check_row(check) for check in checks],
        "notes": notes,
        "attempts": [
            row
            for result in results
            for row in _attempt_rows(result, objects[result.cell.task])
        ],
    }
    pages = {
        "tasks.json": json.dumps(document, indent=1),
        "tasks.html": tasks_page(rows, by_object, pairs, checks, notes, films, about),
    }
    for name, text in pages.items():
        with replaced_file(request.out / name, "--out") as file:
            file.write(text.encode())
    tables = {
        "Tasks, shares with 95 % intervals": rows,
        "By object": by_object if request.objects else [],
        "Whether the judge is sound": [_check_row(check) for check in checks],
    }
    print_result(
        document, tables, map(request.out.joinpath, pages), as_json=request.as_json
    )
    for note in notes:
        warn(note)


def _check_row(check: Check) -> Row:
    return {
        "condition": check.what,
        "of": check.where,
        "met": "yes" if check.is_met else "no",
        "measured": check.text,
    }


def _attempt_rows(result: CellResult, objects: Names) -> list[Row]:
    """Return a row for each attempt, with its scene's seed.

    Args:
        result: The cell.
        objects: Objects that its task used; empty if it has none to choose.
    """
    cell = result.cell
    return [
        {
            "task": cell.task,
            "hand": cell.hand,
            "operator": cell.operator,
            "mapping": cell.method,
            "seed": one.seed,
            "object": object_of(one.seed, objects) if objects else "",
            "success": one.is_success,
            "time": round(one.time, 3),
            "tries": one.tries,
            "drops": one.drops,
            "force": round(one.force, 2),
            "cause": one.cause,
        }
        for one in result.attempts
    ]
