"""Benchmarks and judges are run by their names, and pages name those that are there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from named_scripts import find_scripts

ROOT = Path(__file__).resolve().parents[2]
JUDGES = ROOT / "tests" / "judges"
QUESTIONS = [
    ROOT / "benchmarks" / name for name in ("speed", "fidelity", "tasks", "paper")
]
FOLDERS = {"benchmarks": QUESTIONS, "tests/judges": [JUDGES]}
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(ROOT / "docs").rglob("*.md"),
    *(ROOT / "benchmarks").rglob("*.py"),
    *JUDGES.glob("*.py"),
]


def run(folder: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a folder of scripts, somewhere else."""
    command = [sys.executable, str(ROOT / folder), *words]
    return subprocess.run(
        command, cwd="/", capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.parametrize("folder", FOLDERS)
def test_pages_name_scripts_that_are_there(folder: str) -> None:
    text = "\n".join(page.read_text("utf-8") for page in PAGES)
    named = {*re.findall(rf"python {folder} ([a-z]\w+)", text)}
    assert len(named) > 5
    assert named <= find_scripts(FOLDERS[folder]).keys()


def test_pages_name_files_that_are_there() -> None:
    text = "\n".join(page.read_text("utf-8") for page in PAGES)
    for file in {*re.findall(r"\b(?:benchmarks|tests)/[\w/]+\.py\b", text)}:
        assert (ROOT / file).is_file(), file


def test_every_name_is_of_one_script() -> None:
    folders = [*QUESTIONS, JUDGES, ROOT / "benchmarks", ROOT / "tests" / "support"]
    modules = [file.stem for folder in folders for file in folder.glob("[a-z]*.py")]
    assert len(modules) == len({*modules})


@pytest.mark.parametrize("folder", FOLDERS)
@pytest.mark.parametrize("words", [(), ("no_such_script",)])
def test_without_a_name_that_is_there_all_names_are_printed(
    folder: str, words: tuple[str, ...]
) -> None:
    done = run(folder, *words)
    assert (done.returncode, done.stdout) == (2, "")
    for name in find_scripts(FOLDERS[folder]):
        assert f"\n  {name} " in done.stderr


def test_tests_import_nothing_from_the_benchmarks() -> None:
    scripts = (ROOT / "benchmarks").rglob("*.py")
    # Programs that run peers are in the wheel, and have a test.
    modules = {file.stem for file in scripts if file.parent.name != "peers"}
    for file in (ROOT / "tests").rglob("*.py"):
        text = file.read_text("utf-8")
        imported = re.findall(r"^ *(?:from|import) (\w+)", text, re.MULTILINE)
        assert not modules & {*imported}, file


@pytest.mark.slow
def test_a_script_finds_modules_of_other_folders() -> None:
    for folder, name in (("benchmarks", "bench_robots"), ("tests/judges", "slews")):
        done = run(folder, name, "--help")
        assert done.returncode == 0, done.stderr
        assert f"usage: {name}.py" in done.stdout
