"""The parts of the core that need no Python, with hostile numbers, under the sanitizers.

Compiling them takes half a minute, so `make full` does it, and `make sanitize`, which so runs the
tests of the whole core.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from cpp_programs import CORE, compiled, run_counted

pytestmark = pytest.mark.full

PROGRAM = CORE / "tests" / "sanitized.cpp"
CHECKS = "address,undefined,float-cast-overflow"


def test_hostile_numbers_read_and_write_only_what_is_theirs(tmp_path: Path) -> None:
    program = compiled(PROGRAM, tmp_path, CHECKS)
    for seed in (1, 2):
        assert run_counted(program, seed) > 10_000
