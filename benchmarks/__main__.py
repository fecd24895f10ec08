"""Run a benchmark: `python benchmarks NAME [options]`; without a name, list them by question."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
QUESTIONS = [HERE / name for name in ("speed", "fidelity", "tasks", "paper")]
TESTS = HERE.parent / "tests"
# Benchmarks take what they share with tests from there; tests take nothing from here.
sys.path[:0] = map(str, [*QUESTIONS, HERE, TESTS / "support", TESTS / "judges"])

from named_scripts import run_named  # noqa: E402

if __name__ == "__main__":
    run_named("python benchmarks", QUESTIONS, sys.argv[1:])
