"""All attempts of a run: tasks, hands, operators and mappings, in blocks of seeds, in processes."""

import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy as np

from handmap_qp.errors import HandmapError, expect, reason_of
from handmap_qp.se3 import Array
from .attempt import Attempt, attempt
from .catalogue import CATALOGUE
from .mapping import make_mapping
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
    """One block of one cell.

    Attributes:
        cell: The cell.
        calibration: Seed of the person's calibration recording.
        seeds: Seeds of the attempts.
        kept: Seeds of the attempts whose record is kept.
    """

    cell: Cell
    calibration: int
    seeds: range
    kept: frozenset[int]


class Outcome(NamedTuple):
    """What came of a job.

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
) -> list[CellResult]:
    """Run all blocks of all cells.

    Args:
        cells: The cells; their hands are names of the package, or paths.
        blocks: Seeds.
        processes: Processes that run blocks; 1 runs them in this one.
        say: Called with the number of blocks done, and a note.
    """
    work = [job for cell in cells for job in jobs_of(cell, blocks)]
    outcomes: list[Outcome] = []
    for outcome in _all_of(work, processes):
        outcomes.append(outcome)
        say(len(outcomes), f"{len(outcomes)} of {len(work)} blocks")
    count = len(blocks.firsts)
    return [
        CellResult(cell, outcomes[i * count : (i + 1) * count])
        for i, cell in enumerate(cells)
    ]


def jobs_of(cell: Cell, blocks: Blocks) -> list[Job]:
    """Return the jobs of a cell; the first attempt and those to recount keep their records.

    The drawn attempts are the same for all cells, so that nobody chose them by their outcome.
    """
    every = [seed for i in range(len(blocks.firsts)) for seed in blocks.seeds(i)]
    judged = {every[i] for i in drawn(len(every), JUDGED, seed=every[0])}
    kept = frozenset(judged | {every[0]})
    return [
        Job(cell, first, blocks.seeds(i), kept & {*blocks.seeds(i)})
        for i, first in enumerate(blocks.firsts)
    ]


def run_job(job: Job) -> Outcome:
    """Run one block; a mapping that cannot be used is an outcome too."""
    cell = job.cell
    task = _task(cell.task, cell.hand)
    operator = _operator(cell.task, cell.hand, cell.operator)
    try:
        mapping = make_mapping(cell.method, operator, task.robot, job.calibration)
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


def _all_of(work: Sequence[Job], processes: int) -> Iterator[Outcome]:
    """Run jobs, and yield their outcomes in the same order."""
    if processes == 1:
        yield from map(run_job, work)
        return
    # A child that is forked would share locks and a drawing context with this process.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        yield from pool.map(run_job, work)


@cache
def _task(name: str, hand: str) -> Task:
    """Make a task once a process, because it takes longer than an attempt."""
    return CATALOGUE[name].make(hand)


@cache
def _operator(task: str, hand: str, name: str) -> Operator:
    """Make an operator once a process."""
    return CATALOGUE[task].operators[name](_task(task, hand).robot)


def cells_of(
    tasks: Iterable[str],
    hands: Callable[[str], Iterable[str]],
    operators: Callable[[str], Iterable[str]],
    methods: Callable[[str], Iterable[str]],
) -> list[Cell]:
    """Return all cells, tasks first.

    Args:
        tasks: Names of tasks.
        hands: Returns the hands of a task.
        operators: Returns the operators of a task.
        methods: Returns the mappings of a task.
    """
    return [
        Cell(task, hand, operator, method)
        for task in tasks
        for hand in hands(task)
        for operator in operators(task)
        for method in methods(task)
    ]
