"""The commands and files of the page "In your own program" work as they are printed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from library_in_c import ROOT

PAGE = (ROOT / "docs" / "own_program.md").read_text("utf-8")
C_PART = PAGE[PAGE.index("## C and C++") : PAGE.index("## The service")]
COMMANDS = re.findall(r"^```bash\n(.*?)^```", C_PART, re.DOTALL | re.MULTILINE)
FILES = re.findall(
    r"`(my_program/[\w.]+)`:\n\n```\w+\n(.*?)^```", C_PART, re.DOTALL | re.MULTILINE
)


def test_the_page_has_files_and_commands() -> None:
    assert [name for name, _ in FILES] == [
        "my_program/CMakeLists.txt",
        "my_program/main.cpp",
    ]
    assert len(COMMANDS) == 4
    # Of the examples, too.
    assert all(name in PAGE for name in ("examples/cpp", "bench_library"))


@pytest.mark.slow
@pytest.mark.full
def test_commands_of_the_page_build_and_follow(tmp_path: Path) -> None:
    if shutil.which("c++") is None:
        pytest.skip("needs a C++ compiler")
    checkout, home = tmp_path / "checkout", tmp_path / "home"
    home.mkdir()
    ignored = shutil.ignore_patterns("build", "*.so", "__pycache__")
    shutil.copytree(ROOT / "core", checkout / "core", ignore=ignored)
    shutil.copytree(ROOT / "examples" / "cpp", checkout / "examples" / "cpp")
    for name, text in FILES:
        file = checkout / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(text, encoding="utf-8")
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-e", "-c", "".join(COMMANDS)],
        cwd=checkout,
        # CMake's own variables: without optimization, which takes most of the time.
        env=os.environ
        | {"HOME": str(home), "PATH": programs, "CMAKE_BUILD_TYPE": "None"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    lines = [
        line for line in done.stdout.splitlines() if re.match(r"\d\.\d+ s  ", line)
    ]
    # By CMake, and without it.
    assert len(lines) == 120
    assert lines[:60] == lines[60:]
    # The fingers bend, and no sample is held.
    assert not any("released" in line for line in lines[1:60])
    first, last = (line.split(":")[1].split() for line in (lines[0], lines[59]))
    assert len(first) == 16
    assert max(abs(float(a) - float(b)) for a, b in zip(first, last, strict=True)) > 0.1
    header, *rows = (
        (home / "handmap_examples" / "commands.csv").read_text().splitlines()
    )
    assert header.startswith("time,rule,held,")
    assert len(rows) > 400
