"""All attempts of a run: tasks, hands, operators and mappings, in blocks of seeds, in processes."""

import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, lru_cache
from hashlib import sha256
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from handmap_qp.errors import HandmapError, expect, reason_of
from handmap_qp.hands import Hand, Names
from handmap_qp.se3 import Array
from .attempt import Attempt, attempt
from .catalogue import CATALOGUE
from .handing import NoOtherHandError
from .journal import Kept, Line
from .mapping import Mapping as HandMapping
from .mapping import file_of, make_mapping
from .operator import Operator
from .shares import Share, drawn, wilson
from .task import Task

JUDGED = 0.05
"""Share of the attempts of a cell whose outcome is recounted."""


class Cell(NamedTuple):
    """What is measured together.

    Attributes:
        task: Name of the task in `CATALOGUE`.
        hand: The robot hand, as name or path of its hand.yaml.
        operator: Name of the operator.
        method: Name of the mapping.
    """

    task: str
    hand: str
    operator: str
    method: str


class Blocks(NamedTuple):
    """Seeds of the attempts of each cell.

    A block is one person and several scenes: its first seed is the seed of the person's calibration
    recording, and that of the first attempt. The others follow.

    Attributes:
        firsts: First seed of each block.
        attempts: Attempts of each block.
    """

    firsts: tuple[int, ...]
    attempts: int

    def seeds(self, block: int) -> range:
        """Return the seeds of a block."""
        return range(self.firsts[block], self.firsts[block] + self.attempts)

    def check(self) -> None:
        """Reject blocks that overlap.

        Raises:
            InvalidInputError: If they do, or a number is negative, or there is nothing to do.
        """
        expect(self.attempts > 0, "--attempts", "at least 1", value=self.attempts)
        expect(self.firsts, "--seeds", "at least one", got="none")
        is_right = min(self.firsts) >= 0
        expect(is_right, "--seeds", "numbers from 0", value=self.firsts)
        seeds = [seed for i in range(len(self.firsts)) for seed in self.seeds(i)]
        apart = f"first seeds of blocks, at least {self.attempts} apart (--attempts)"
        expect(len({*seeds}) == len(seeds), "--seeds", apart, value=self.firsts)


class Job(NamedTuple):
    """Attempts of one cell with one calibration.

    Attributes:
        cell: The cell.
        calibration: Seed of the person's calibration recording.
        seeds: Seeds of the attempts.
        kept: Seeds of the attempts whose record is kept.
        objects: Objects of the task by name; all if empty.
    """

    cell: Cell
    calibration: int
    seeds: range
    kept: frozenset[int]
    objects: Names = ()

    def key(self, hand: str) -> str:
        """Return all that its outcome depends on, as text; of a file of a user its contents too.

        Args:
            hand: Name of the hand; the path in `cell` may differ from run to run.
        """
        file = file_of(self.cell.method)
        digest = sha256(file.read_bytes()).hexdigest()[:16] if file else ""
        seeds = f"{self.seeds.start}-{self.seeds.stop}"
        cell = self.cell._replace(hand=hand)
        about = (*cell, str(self.calibration), seeds, *self.objects, digest)
        return " | ".join(about)


class Outcome(NamedTuple):
    """What came of a job, or of several.

    Attributes:
        attempts: The attempts in the order of the seeds; empty if the mapping could not be used.
        problem: Why it could not; empty if it could.
        recounted: How many outcomes the second judge recounted.
        contradicted: Seeds of the outcomes that it saw otherwise.
    """

    attempts: Sequence[Attempt]
    problem: str = ""
    recounted: int = 0
    contradicted: tuple[int, ...] = ()

    @classmethod
    def joined(cls, parts: Sequence["Outcome"]) -> "Outcome":
        """Return the outcomes of one block in one; a problem of one part is that of all."""
        problem = next((part.problem for part in parts if part.problem), "")
        return cls(
            [] if problem else [one for part in parts for one in part.attempts],
            problem,
            sum(part.recounted for part in parts),
            tuple(seed for part in parts for seed in part.contradicted),
        )


class CellResult(NamedTuple):
    """All blocks of a cell.

    Attributes:
        cell: The cell.
        blocks: Outcomes in the order of the blocks.
    """

    cell: Cell
    blocks: Sequence[Outcome]

    @property
    def problem(self) -> str:
        """Why the cell has no attempts; empty if it has."""
        return next((block.problem for block in self.blocks if block.problem), "")

    @property
    def attempts(self) -> list[Attempt]:
        """All attempts, block after block."""
        return [one for block in self.blocks for one in block.attempts]

    @property
    def wins(self) -> Array:
        """Whether each attempt succeeded, shape (blocks, attempts)."""
        return np.array(
            [[one.is_success for one in block.attempts] for block in self.blocks],
            dtype=bool,
        )

    @property
    def share(self) -> Share:
        """The share of successes."""
        attempts = self.attempts
        return wilson(sum(one.is_success for one in attempts), len(attempts))


def run_cells(
    cells: Sequence[Cell],
    blocks: Blocks,
    processes: int,
    say: Callable[[int, str], None],
    kept: Kept | None = None,
    objects: Mapping[str, Names] = MappingProxyType({}),
    labels: Mapping[str, str] = MappingProxyType({}),
) -> list[CellResult]:
    """Run all blocks of all cells.

    Args:
        cells: The cells; their hands are names of the package, or paths.
        blocks: Seeds.
        processes: Processes that run attempts; 1 runs them in this one.
        say: Called with the number of attempts done, and a note.
        kept: Journal of the run; attempts in it are not made again.
        objects: Objects by task; all of those that are not named.
        labels: Names of hands by their paths, for the journal.
    """
    work = [
        job
        for cell in cells
        for job in jobs_of(cell, blocks, objects.get(cell.task, ()))
    ]
    keys = tuple(job.key(labels.get(job.cell.hand, job.cell.hand)) for job in work)
    outcomes: list[Outcome] = []
    wins = 0
    made = _all_of(work, keys, processes, kept)
    for job, outcome in zip(work, made, strict=True):
        outcomes.append(outcome)
        wins += sum(one.is_success for one in outcome.attempts)
        cell = ", ".join(job.cell)
        say(len(outcomes), f"{len(outcomes)} of {len(work)}, {wins} succeeded; {cell}")
    size, count = blocks.attempts, len(blocks.firsts)
    joined = [
        Outcome.joined(outcomes[i : i + size]) for i in range(0, len(outcomes), size)
    ]
    return [
        CellResult(cell, joined[i * count : (i + 1) * count])
        for i, cell in enumerate(cells)
    ]


def jobs_of(cell: Cell, blocks: Blocks, objects: Names = ()) -> list[Job]:
    """Return the jobs of a cell, an attempt each.

    The first attempt and those to recount keep their records. The drawn attempts are the same for
    all cells, so that nobody chose them by their outcome.
    """
    every = [seed for i in range(len(blocks.firsts)) for seed in blocks.seeds(i)]
    judged = {every[i] for i in drawn(len(every), JUDGED, seed=every[0])}
    kept = frozenset(judged | {every[0]})
    return [
        Job(cell, first, range(seed, seed + 1), kept & {seed}, objects)
        for i, first in enumerate(blocks.firsts)
        for seed in blocks.seeds(i)
    ]


def run_job(job: Job) -> Outcome:
    """Run one job; a mapping that cannot be used is an outcome too."""
    cell = job.cell
    try:
        task = _task(cell.task, cell.hand, job.objects)
    except NoOtherHandError as error:
        return Outcome((), problem=reason_of(error))
    operator = _operator(cell.task, cell.hand, cell.operator)
    try:
        mapping = _mapping(cell, job.calibration)
        attempts = [attempt(task, operator, mapping, seed) for seed in job.seeds]
    except HandmapError as error:
        return Outcome((), problem=reason_of(error))
    recount = CATALOGUE[cell.task].recount()
    kept = [one for one in attempts if one.seed in job.kept and one.record]
    contradicted = tuple(
        one.seed for one in kept if one.record and recount(one.record) != one.is_success
    )
    light = [
        one if one.seed in job.kept else one._replace(record=None) for one in attempts
    ]
    return Outcome(light, recounted=len(kept), contradicted=contradicted)


def _all_of(
    work: Sequence[Job], keys: Names, processes: int, kept: Kept | None
) -> Iterator[Outcome]:
    """Yield the outcomes of jobs in their order; run those that are not in the journal."""
    known = [kept.get(key) if kept else None for key in keys]
    left = [job for job, line in zip(work, known, strict=True) if line is None]
    made = _made(left, processes)
    for key, line in zip(keys, known, strict=True):
        if line is not None:
            yield _outcome_of(line)
            continue
        outcome = next(made)
        # A mapping that failed is tried again when the run goes on.
        if kept is not None and not outcome.problem:
            kept.add(_line_of(key, outcome))
        yield outcome


def _made(work: Sequence[Job], processes: int) -> Iterator[Outcome]:
    """Run jobs, and yield their outcomes in the same order."""
    if processes == 1 or not work:
        yield from map(run_job, work)
        return
    # A child that is forked would share locks and a drawing context with this process.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        try:
            yield from pool.map(run_job, work)
        finally:
            pool.shutdown(cancel_futures=True)


def _line_of(key: str, outcome: Outcome) -> Line:
    """Return the outcome of one attempt as a line of the journal."""
    (one,) = outcome.attempts
    return Line.of(
        key,
        one,
        is_recounted=outcome.recounted > 0,
        is_contradicted=bool(outcome.contradicted),
    )


def _outcome_of(line: Line) -> Outcome:
    one = line.attempt
    contradicted = (one.seed,) if line.is_contradicted else ()
    return Outcome([one], "", int(line.is_recounted), contradicted)


@cache
def _task(name: str, hand: str, objects: Names) -> Task:
    """Make a task once a process, because it takes longer than an attempt."""
    return CATALOGUE[name].make(hand, objects)


@cache
def _operator(task: str, hand: str, name: str) -> Operator:
    """Make an operator once a process."""
    return CATALOGUE[task].operators[name](_robot(task, hand))


@cache
def _robot(task: str, hand: str) -> Hand:
    return _task(task, hand, ()).robot


@lru_cache(maxsize=4)
def _mapping(cell: Cell, calibration: int) -> HandMapping:
    """Make a mapping once for the attempts of a block, which follow one another."""
    operator = _operator(cell.task, cell.hand, cell.operator)
    task = _task(cell.task, cell.hand, ())
    return make_mapping(cell.method, operator, task.robot, calibration, task.other)


def cells_of(
    tasks: Iterable[str],
    hands: Callable[[str], Iterable[str]],
    operators: Callable[[str], Iterable[str]],
    methods: Callable[[str, str], Iterable[str]],
) -> list[Cell]:
    """Return all cells, tasks first.

    Args:
        tasks: Names of tasks.
        hands: Returns the hands of a task.
        operators: Returns the operators of a task.
        methods: Returns the mappings of a task and hand.
    """
    return [
        Cell(task, hand, operator, method)
        for task in tasks
        for hand in hands(task)
        for operator in operators(task)
        for method in methods(task, hand)
    ]
