"""Kinematics, distances, QP and gate of the core, without Python: see properties.cpp."""

from __future__ import annotations

from pathlib import Path

from cpp_programs import CORE, compiled, run_counted

PROGRAM = CORE / "tests" / "properties.cpp"


def test_parts_of_the_core_have_their_properties(tmp_path: Path) -> None:
    program = compiled(PROGRAM, tmp_path)
    for seed in (1, 2):
        assert run_counted(program, seed) > 100_000
