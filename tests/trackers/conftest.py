"""What tests of several trackers share."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def lies() -> Iterator[ModuleType]:
    """The mistakes of `benchmarks/bench_lies.py`, which has the whole table."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield importlib.import_module("lies")
    finally:
        sys.path.remove(str(BENCHMARKS))
