"""Proof by hostile streams: ten hands and six robots with two, judged by their time stamps.

    python tests/judges exact_streams --steps 3000000 --json streams.json
    python tests/judges exact_streams --names g1 three_finger --seed 7 --steps 20000

Hands of a robot come together, in turns, at unequal rates, with gaps, with stamps that repeat or go
back; one is lost and comes back. Half of the followers know times of arrival (`streams.py`). The
run fails (exit code 1) on a position, speed or acceleration limit that is violated by the time
stamps of the commands (`checker.py`), on a number that is not finite, and on an undocumented
exception. A violation names its run: give its hand and seed to repeat it. Prints how many steps
each hand and each robot took.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import hostile
from exactness import HANDS
from streams import ROBOTS, StreamRun

from handmap_qp import Hand, MissingExtraError, hand_names, load_hand
from handmap_qp.errors import MissingPackageError
from handmap_qp.hands.library import hand_files
from handmap_qp.hands.robot import load_robot, robot_files

_STEPS_PER_RUN = 2000
_REPORTED = 10
_COUNT = 10


def installed() -> tuple[str, ...]:
    """Return ten hands and all robots with two, of those that are installed here."""
    hands = dict.fromkeys((*HANDS, *hand_names()))
    found = [name for name in hands if _is_installed(load_hand, name)]
    robots = dict.fromkeys((*ROBOTS, *robot_files()))
    return (
        *[name for name in found if not name.startswith("human")][:_COUNT],
        *[name for name in robots if _is_installed(load_robot, name)],
    )


def _is_installed(load: Callable[[str], Hand], name: str) -> bool:
    try:
        load(name)
    except (MissingExtraError, MissingPackageError):
        return False
    return True


def measure(
    names: Sequence[str], steps: int, seed: int
) -> tuple[hostile.Tally, Counter[str]]:
    """Take the steps of each hand and robot in turn.

    Args:
        names: Hands and robots.
        steps: Number of steps in all.
        seed: Seed of the first run; each later run has the next one.

    Returns:
        What was found, and the number of commands by hand or robot.
    """
    tally = hostile.Tally()
    commands = Counter[str]()
    per_run = min(_STEPS_PER_RUN, -(-steps // len(names)))
    with common.progress("steps", steps) as advance:
        while tally.steps < steps:
            name = names[seed % len(names)]
            run = StreamRun(name, seed)
            count = min(per_run, steps - tally.steps)
            before = len(tally.found)
            hostile.take(run, count, tally)
            commands[name] += run.checker.commands
            for line in tally.found[before:]:
                print(line, file=sys.stderr, flush=True)
            for _ in range(count):
                advance()
            seed += 1
            if seed % _REPORTED == 0:
                print(f"{tally.steps} steps, next seed {seed}", file=sys.stderr)
    return tally, commands


def main(words: Sequence[str] | None = None) -> int:
    """Run the judge; return 1 if anything was violated, else 0."""
    parser = argparse.ArgumentParser(description="Hostile streams of hands and robots.")
    parser.add_argument("--steps", type=int, default=300_000, help="number of steps")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first run")
    parser.add_argument(
        "--names", nargs="+", help="hands and robots; those installed if omitted"
    )
    parser.add_argument("--json", metavar="FILE", help="write all numbers to FILE or -")
    parser.add_argument("--quick", action="store_true", help="1600 steps")
    parser.set_defaults(picture=None)
    arguments = common.parse_arguments(parser, words)
    known = hand_files().keys() | robot_files().keys()
    names = arguments.names or installed()
    for name in set(names) - known:
        common.stop(f"--names {name}: expected a hand or a robot of the package")
    wanted = 1600 if arguments.quick else arguments.steps
    tally, commands = measure(names, wanted, arguments.seed)
    for line in tally.undocumented:
        print(line, file=sys.stderr)
    results: dict[str, Any] = {
        "is_exact": tally.is_exact,
        "steps": tally.steps,
        "violations": tally.violations.total(),
        "not_finite": tally.not_finite,
        "undocumented": len(tally.undocumented),
    }
    is_json = arguments.json == "-"
    rows = [{"name": name, "commands": count} for name, count in commands.items()]
    common.print_table("Steps of hostile streams", [results], to_stderr=is_json)
    common.print_table("Commands judged", rows, to_stderr=is_json)
    for title, numbers in (
        ("Violations", tally.violations),
        ("Worst", tally.worst),
        ("Statuses", tally.statuses),
    ):
        # A tally keeps no zeros.
        if numbers:
            common.print_table(title, [dict(numbers)], to_stderr=is_json)
    if arguments.json:
        results |= {
            "commands": dict(commands),
            "worst": tally.worst,
            "statuses": dict(tally.statuses),
            "refused": dict(tally.refused),
        }
        common.write_json(arguments.json, "exact_streams", results)
    return 0 if tally.is_exact else 1


if __name__ == "__main__":
    sys.exit(main())
