"""A source of the user's own, as docs/sources.md has it: one file and an entry point."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from handmap_qp.trackers import read_recording

PAGE = Path(__file__).parents[2] / "docs" / "sources.md"
pytestmark = pytest.mark.slow
COMMANDS = """
from contextlib import suppress
from handmap_qp.cli import main

with suppress(SystemExit):
    main(["track", "--help"])
raise SystemExit(main("track mine --side left --record mine.npz --json".split()))
"""


def test_the_source_of_the_page_is_found_by_its_entry_point(tmp_path: Path) -> None:
    page = PAGE.read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(# my_glove\.py\n.*?)^```", page, re.S | re.M)
    (table,) = re.findall(r"^```toml\n(.*?)^```", page, re.S | re.M)
    (tmp_path / "my_glove.py").write_text(code)
    about = tmp_path / "my_glove-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-glove\n")
    groups = tomllib.loads(table)["project"]["entry-points"]
    lines = [
        line
        for group, points in groups.items()
        for line in (f"[{group}]", *(f"{name} = {at}" for name, at in points.items()))
    ]
    (about / "entry_points.txt").write_text("\n".join(lines))
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", COMMANDS],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert not done.returncode, done.stderr
    page, _, out = done.stdout.rpartition("\n{")
    assert re.search(r"track mine +Track a hand with my glove\.", page)
    summary = json.loads("{" + out)
    recording = read_recording(tmp_path / "mine.npz")
    assert len(recording) == summary["recorded"] > 100
    assert recording.side == "left"
    assert recording.upright == "+z up, +x forward"
