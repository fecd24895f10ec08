"""The Python of `handmap_run` is that of the tree: where the two part, the build ends."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from run_cases import SOURCES, module_of


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        (
            "CHANGES",
            lambda old: (*old, ("np.vecdot(", "")),
            r"no file has 'np\.vecdot\('",
        ),
        ("CHANGES", lambda old: old[:1] + old[2:], "imports pinocchio"),
        ("TAKEN", lambda old: f"{old} ik/gone", "ik/gone.py any more"),
        ("TAKEN", lambda old: old.replace("stream/guard ", ""), "guard StreamGuard"),
    ],
)
def test_the_build_ends_where_the_tree_is_another(
    tmp_path: Path, name: str, change: Callable[[Any], Any], said: str
) -> None:
    taken = module_of(SOURCES / "taken.py")
    setattr(taken, name, change(getattr(taken, name)))
    with pytest.raises(SystemExit, match=rf"^taken\.py: .*{said}"):
        taken.write_package(tmp_path)
