"""Proof by hostile steps: many random steps of ten hands, each judged.

    python tests/judges exactness --steps 100000000 --json exactness.json
    python tests/judges exactness --hands shadow_right --seed 7 --steps 20000

The compiled core takes the steps, hundreds a call; `checker.py`, which shares no code with it,
judges each. The run fails (exit code 1) on a position, speed or acceleration limit that is
violated, on an overlap of links, on a result with a NaN or an infinity, and on an undocumented
exception. One step in a hundred goes through the whole mapping, with samples of a human hand, some
of them invalid (`hostile.py`). Memory is measured too.

Seven runs in ten keep all pairs of links apart that may collide. There every step is judged at its
end, and one in ten every 0.04 rad on the way there too. Each run has a hand, a seed and options of
its own. A violation names its run: give its hand and seed to repeat it. The tests take fewer of the
same steps.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
import multiprocessing
import os
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import hostile
import numpy as np
import shared_hands

from handmap_qp import HandmapError, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs, all_pairs

HANDS = (
    *("allegro_right", "leap_right", "svh_right", "shadow_right", "inspire_right"),
    *("ability_right", "g1_right", "hey5", "three_finger", "romeo_right"),
)
ACCELERATIONS = (None, 0.5, 5.0, 20.0, 100.0, 1000.0)
"""Acceleration limits that a run changes between [rad/s^2, m/s^2]."""
_STEPS_PER_RUN = 20_000
_PATHS = 10
_SHARE_APART = 0.7
_STEPS_PER_MAPPED = 100
_REPORTED = 20


class Job(NamedTuple):
    """One run: its hand, seed and steps, and whether the steps go through the whole mapping."""

    hand: str
    seed: int
    steps: int
    is_mapped: bool


def jobs(hands: Sequence[str], steps: int, seed: int) -> Iterator[Job]:
    """Yield the runs: the hands in turn, each run with the next seed."""
    per_run = min(_STEPS_PER_RUN, -(-steps // len(hands)))
    taken = 0
    while taken < steps:
        hand, count = hands[seed % len(hands)], min(per_run, steps - taken)
        mapped = count // _STEPS_PER_MAPPED
        yield Job(hand, seed, count - mapped, is_mapped=False)
        if mapped:
            yield Job(hand, seed, mapped, is_mapped=True)
        taken += count
        seed += 1


def run(job: Job) -> tuple[hostile.Tally, float, float]:
    """Take the steps of one run.

    Returns:
        What was found, the CPU time [s], and the memory of this process [bytes].
    """
    tally, started = hostile.Tally(), time.process_time()
    rng = np.random.default_rng(job.seed)
    hand = _hand(job.hand, is_fixed=rng.random() < 0.3)
    with warnings.catch_warnings():
        # An overflow or a division by zero counts as an undocumented exception.
        warnings.simplefilter("error")
        if job.is_mapped:
            has_contacts = rng.random() < _SHARE_APART
            mapping = hostile.MAPPINGS[rng.integers(len(hostile.MAPPINGS))]
            taken = hostile.mapper_run(
                hand,
                "teleoperation" if has_contacts else mapping,
                job.seed,
                _pairs(hand) if has_contacts else None,
                _PATHS,
            )
        else:
            taken = hostile.IkRun(
                hand,
                hostile.wild_options(rng),
                job.seed,
                _pairs(hand) if rng.random() < _SHARE_APART else None,
                paths=_PATHS,
                limits=ACCELERATIONS,
            )
        hostile.take(taken, job.steps, tally)
    return tally, time.process_time() - started, resident_memory()


def measure(
    hands: Sequence[str], steps: int, seed: int, processes: int
) -> dict[str, Any]:
    """Take the steps in several processes, and measure time and memory.

    Args:
        hands: Names of the hands.
        steps: Number of steps.
        seed: Seed of the first run; it is incremented for each later run.
        processes: Number of processes.

    Returns:
        The tally, times [s] and memory [MB] in plain values.
    """
    tally, memory, started = hostile.Tally(), [], time.perf_counter()
    cpu = 0.0
    by_kind = {False: 0, True: 0}
    todo = list(jobs(hands, steps, seed))
    context = multiprocessing.get_context("spawn")
    with (
        common.progress("runs", len(todo)) as advance,
        ProcessPoolExecutor(processes, mp_context=context) as pool,
    ):
        results = pool.map(run, todo)
        for job, (found, spent, used) in zip(todo, results, strict=True):
            tally.merge(found)
            cpu += spent
            by_kind[job.is_mapped] += found.steps
            memory.append((tally.steps, used))
            for line in (*found.found, *found.undocumented):
                print(line, file=sys.stderr, flush=True)
            if len(memory) % _REPORTED == 0:
                rate = tally.steps / (time.perf_counter() - started)
                print(f"{tally.steps} steps, {rate:.0f} a second", file=sys.stderr)
            advance()
    seconds = time.perf_counter() - started
    return {
        "is_exact": tally.is_exact,
        "hands": list(hands),
        "seed": seed,
        "steps": tally.steps,
        "steps_ik": by_kind[False],
        "steps_mapped": by_kind[True],
        "postures_examined": tally.postures,
        "violations": dict(tally.violations),
        "worst": tally.worst,
        "found": tally.found,
        "not_finite": tally.not_finite,
        "undocumented": tally.undocumented,
        "statuses": dict(tally.statuses.most_common()),
        "refused": dict(tally.refused.most_common()),
        "seconds": seconds,
        "cpu_us_per_step": 1e6 * cpu / tally.steps,
        "steps_per_second": tally.steps / seconds,
        **memory_growth(np.array(memory, dtype=float)),
    }


@cache
def _hand(name: str, *, is_fixed: bool) -> Hand:
    spec = shared_hands.shared_hand_spec(name) if name in shared_hands.NAMES else name
    return load_hand(spec, mount="fixed" if is_fixed else None)


def _is_there(name: str) -> bool:
    """Whether a hand can be loaded here; if not, say why."""
    try:
        _hand(name, is_fixed=False)
    except (FileNotFoundError, HandmapError) as error:
        print(f"{name} is left out: {error}", file=sys.stderr)
        return False
    return True


@cache
def _pairs(hand: Hand) -> ShapePairs:
    return all_pairs(hand)


def memory_growth(samples: np.ndarray) -> dict[str, float]:
    """Growth of the resident memory, without the first tenth of the steps (imports, caches).

    Args:
        samples: Steps and bytes, shape (n, 2).

    Returns:
        Megabytes at the start, after a tenth and at the end; slope of a straight line fit in
        megabytes per million steps.
    """
    settled = samples[samples[:, 0] >= 0.1 * samples[-1, 0]]
    slope = (
        float(np.polyfit(settled[:, 0], settled[:, 1], 1)[0])
        if len(settled) > 1
        else float("nan")
    )
    return {
        "memory_first_mb": samples[0, 1] / 1e6,
        "memory_tenth_mb": settled[0, 1] / 1e6,
        "memory_last_mb": samples[-1, 1] / 1e6,
        "memory_growth_mb_per_million": slope,
    }


def resident_memory() -> float:
    """Resident memory of this process [bytes]; NaN if the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return float("nan")
    import resource

    return float(pages * resource.getpagesize())


def main(words: Sequence[str] | None = None) -> int:
    """Run the judge; return 1 if anything was violated, else 0."""
    parser = argparse.ArgumentParser(
        description="Random steps of ten hands: limits, overlaps, numbers, exceptions, memory."
    )
    parser.add_argument(
        "--steps",
        type=int,
        default=1_000_000,
        help="number of steps (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="seed of the first run (default: %(default)s)",
    )
    parser.add_argument(
        "--hands", nargs="+", default=list(HANDS), help="hands (default: all ten)"
    )
    parser.add_argument(
        "--processes",
        type=int,
        default=min(2, os.cpu_count() or 1),
        help="number of processes (default: %(default)s)",
    )
    parser.add_argument(
        "--json",
        metavar="FILE",
        help="write all numbers as JSON to FILE, or to stdout with -",
    )
    parser.add_argument(
        "--quick", action="store_true", help="20,000 steps: to test the script"
    )
    parser.set_defaults(picture=None)
    arguments = common.parse_arguments(parser, words)
    if arguments.steps < 1:
        common.stop(f"--steps {arguments.steps}: expected at least 1")
    hands = list(filter(_is_there, arguments.hands))
    if not hands:
        common.stop("none of the hands is there")
    results = measure(
        hands,
        20_000 if arguments.quick else arguments.steps,
        arguments.seed,
        arguments.processes,
    )
    is_json = arguments.json == "-"
    rows = [
        {"what": what, "violations": results["violations"].get(what, 0), "worst": worst}
        for what, worst in results["worst"].items()
    ]
    caption = (
        "position beyond its limit (rad or m); speed and acceleration over theirs; "
        "overlap (m)"
    )
    common.print_table("Limits", rows, to_stderr=is_json, caption=caption)
    counted = ("steps", "steps_mapped", "postures_examined", "not_finite")
    rates = ("steps_per_second", "cpu_us_per_step")
    counts = {name: results[name] for name in (*counted, *rates)}
    common.print_table(
        "Steps",
        [{**counts, "undocumented": len(results["undocumented"])}],
        to_stderr=is_json,
    )
    for name in ("statuses", "refused"):
        if results[name]:
            common.print_table(name.capitalize(), [results[name]], to_stderr=is_json)
    common.print_table(
        "Memory",
        [{name: value for name, value in results.items() if name.startswith("memory")}],
        to_stderr=is_json,
    )
    common.write_json(arguments.json, "exactness", results)
    return 0 if results["is_exact"] else 1


if __name__ == "__main__":
    sys.exit(main())
