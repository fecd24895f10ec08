"""What tests of several trackers share."""

from __future__ import annotations

import importlib
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def lies() -> ModuleType:
    """The mistakes of `benchmarks/fidelity/bench_lies.py`, which has the whole table."""
    return importlib.import_module("lies")
