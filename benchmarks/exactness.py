"""Stress test: a million random steps over every hand of the package, with hostile inputs.

    python benchmarks/exactness.py --steps 1000000 --json exactness.json

The run fails (exit code 1) on a position, speed or acceleration limit that `checker.py` finds
violated, on a result with a NaN or an infinity, and on an undocumented exception. Memory is
measured too. The tests run fewer of the same steps (`hostile.py`).
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hostile
import numpy as np

_STEPS_PER_RUN = 500


def measure(steps: int, seed: int) -> dict[str, Any]:
    """Run the steps, and measure time and memory.

    Args:
        steps: Number of steps.
        seed: Seed of the first run; it is incremented for each later run.

    Returns:
        The tally, times [s] and memory [MB] in plain values.
    """
    tally, memory, started = hostile.Tally(), [], time.perf_counter()
    with (
        common.progress("random steps", -(-steps // _STEPS_PER_RUN)) as advance,
        warnings.catch_warnings(),
    ):
        # An overflow or a division by zero counts as an undocumented exception.
        warnings.simplefilter("error")
        for tally in hostile.drive(hostile.hostile_runs(seed), steps, _STEPS_PER_RUN):
            memory.append((tally.steps, resident_memory()))
            advance()
    seconds = time.perf_counter() - started
    return {
        "is_exact": tally.is_exact,
        "steps": tally.steps,
        "violations": dict(tally.violations),
        "worst": tally.worst,
        "not_finite": tally.not_finite,
        "undocumented": tally.undocumented,
        "statuses": dict(tally.statuses.most_common()),
        "refused": dict(tally.refused.most_common()),
        "seconds": seconds,
        "steps_per_second": tally.steps / seconds,
        **memory_growth(np.array(memory, dtype=float)),
    }


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
    """Run the benchmark; return 1 if anything was violated, else 0."""
    parser = argparse.ArgumentParser(
        description="A million random steps over every hand: limits, numbers, exceptions, memory."
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
        help="seed of the random numbers (default: %(default)s)",
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
    results = measure(20_000 if arguments.quick else arguments.steps, arguments.seed)
    is_json = arguments.json == "-"
    rows = [
        {"what": what, "violations": results["violations"].get(what, 0), "worst": worst}
        for what, worst in results["worst"].items()
    ]
    caption = "position beyond its limit [rad]; speed and acceleration over theirs"
    common.print_table("Limits", rows, to_stderr=is_json, caption=caption)
    counts = {
        name: results[name] for name in ("steps", "steps_per_second", "not_finite")
    }
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
    for line in results["undocumented"]:
        print(line, file=sys.stderr)
    common.write_json(arguments.json, "exactness", results)
    return 0 if results["is_exact"] else 1


if __name__ == "__main__":
    sys.exit(main())
