"""Kinematics, distances, QP and gate of the core, without Python: see properties.cpp."""

from __future__ import annotations

from pathlib import Path

import pytest
from cpp_programs import CORE, compiled, run_counted
from marks import full

PROGRAM = CORE / "tests" / "properties.cpp"


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(PROGRAM, tmp_path_factory.mktemp("properties"))


@pytest.mark.parametrize("seed", [1, full(2)])
def test_parts_of_the_core_have_their_properties(seed: int, program: Path) -> None:
    assert run_counted(program, seed) > 100_000
