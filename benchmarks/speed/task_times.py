"""CPU time of an attempt of `handmap score --tasks`, by task and hand.

    python benchmarks task_times --tasks pick pour --hands leap_right --method teleoperation

Each row is the mean of some attempts on scenes of their own, and the wall time that 20 and 200 of
them would take on two cores that do nothing else. Models are made before and do not count.
"""

from __future__ import annotations

# isort: split
import argparse
import time
from collections.abc import Sequence

from handmap_score.tasks.attempt import attempt
from handmap_score.tasks.catalogue import CATALOGUE
from handmap_score.tasks.mapping import make_mapping
from handmap_score.tasks.table import HANDS

from handmap_qp.apps.tables import Row, print_result
from handmap_qp.errors import HandmapError, reason_of

CORES = 2
"""Cores of the machine that wall times are for."""
_FIRST_SEED = 900


def time_attempts(task_name: str, hand: str, method: str, count: int) -> Row:
    """Return the CPU time of attempts, as a row of the table.

    Args:
        task_name: Name of the task.
        hand: Name of the hand.
        method: Name of the mapping.
        count: Number of attempts.

    Raises:
        HandmapError: If the mapping cannot be used with the hand.
    """
    entry = CATALOGUE[task_name]
    task = entry.make(hand, ())
    operator = entry.operators[entry.usual[0]](task.robot)
    mapping = make_mapping(method, operator, task.robot, 0, task.other)
    seeds = range(_FIRST_SEED, _FIRST_SEED + count)
    started = time.process_time()
    done = [attempt(task, operator, mapping, seed) for seed in seeds]
    each = (time.process_time() - started) / count
    return {
        "task": task_name,
        "hand": hand,
        "mapping": method,
        "CPU s": round(each, 2),
        "simulated s": round(sum(one.time for one in done) / count, 1),
        "20 attempts, min": round(20 * each / CORES / 60.0, 1),
        "200 attempts, min": round(200 * each / CORES / 60.0, 1),
    }


def main(words: Sequence[str] | None = None) -> None:
    """Measure each task on each hand, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    on_table = [name for name, entry in CATALOGUE.items() if entry.describe is None]
    parser.add_argument("--tasks", nargs="+", default=on_table, choices=[*CATALOGUE])
    parser.add_argument("--hands", nargs="+", default=[*HANDS])
    parser.add_argument("--method", default="teleoperation")
    parser.add_argument("--attempts", type=int, default=2)
    given = parser.parse_args(words)
    rows = []
    for task in given.tasks:
        for hand in given.hands:
            try:
                rows.append(time_attempts(task, hand, given.method, given.attempts))
            except HandmapError as error:
                print(f"{task}, {hand}: {reason_of(error)}")
    print_result({}, {"CPU time of an attempt": rows}, [], as_json=False)


if __name__ == "__main__":
    main()
