"""Code, commands and pictures on all pages work, and the site is built from them."""

import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import sysconfig
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest
from service_tools import address_of, serving

from handmap_qp import cli

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
# The simulated robot needs a session; tests/simulation has its tests.
EXAMPLES = sorted(
    file for file in (ROOT / "examples").glob("*.py") if file.stem != "simulated_robot"
)
SLOW = (
    *("onboarding", "tracker_service_driver", "compare_methods", "two_hands"),
    *("recording_to_lerobot", "mujoco_object"),
)
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


def code_of(page: Path) -> list[str]:
    """Return the Python blocks of a page."""
    return re.findall(
        r"^```python\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE
    )


def commands_of(page: Path) -> list[str]:
    """Return the words after `handmap` of every command on a page."""
    lines = re.findall(r"^    +handmap (.+?)$", page.read_text("utf-8"), re.MULTILINE)
    return [re.split(r"\s#|\s>|\s\|", line)[0].strip() for line in lines]


@pytest.mark.parametrize("page", [p for p in PAGES if code_of(p)], ids=lambda p: p.stem)
def test_python_code_runs(
    page: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Later blocks of a page may use names of earlier ones.
    code = "\n".join(code_of(page))
    monkeypatch.chdir(tmp_path)
    with serving() if "Client()" in code else nullcontext() as server:
        if server is not None:
            code = code.replace("Client()", f"Client({address_of(server)!r})")
        exec(compile(code, page.name, "exec"), {"__name__": page.stem})
    assert capsys.readouterr().out or "print(" not in code


@pytest.mark.parametrize(
    ("page", "line"),
    [(page, line) for page in PAGES for line in commands_of(page)],
    ids=lambda value: value.stem if isinstance(value, Path) else value,
)
def test_commands_are_understood(page: Path, line: str) -> None:
    # Help, version and completions end the program after printing.
    with suppress(SystemExit):
        assert cli.parse(shlex.split(line))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_pictures_exist(page: Path) -> None:
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", page.read_text("utf-8")):
        assert (page.parent / picture).is_file(), picture


@pytest.mark.parametrize(
    "example",
    [
        pytest.param(example, marks=pytest.mark.slow if example.stem in SLOW else ())
        for example in EXAMPLES
    ],
    ids=lambda example: example.stem,
)
def test_examples_run(
    example: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments = ["0.3"] if example.stem == "loop_60hz" else []
    monkeypatch.setattr(sys, "argv", [str(example), *arguments])
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(example), run_name="__main__")
    assert capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_notebooks_run(
    notebook: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    pyplot = pytest.importorskip("matplotlib.pyplot")
    try:
        exec(compile("\n".join(code), notebook.name, "exec"), {})
    finally:
        pyplot.close("all")
    assert capsys.readouterr().out


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_to_files_lead_somewhere(page: Path) -> None:
    for link in re.findall(
        r"(?<!!)\[[^\]]*\]\(([^)#]+)[^)]*\)", page.read_text("utf-8")
    ):
        assert "://" in link or (page.parent / link).exists(), link


@pytest.mark.slow
def test_the_site_is_complete_and_asks_no_other_host(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    site = tmp_path / "site"
    done = subprocess.run(
        [
            Path(sysconfig.get_path("scripts")) / "mkdocs",
            "build",
            "--strict",
            "--site-dir",
            site,
        ],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT / "docs"), "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "not included in the" not in done.stderr, (
        "a page is missing in nav of mkdocs.yml"
    )
    html = "".join(page.read_text("utf-8") for page in site.rglob("*.html"))
    assert not re.findall(r"<(?:script|img|iframe)[^>]+src=\"https?:[^\"]*", html)
    assert not re.findall(
        r"<link[^>]+rel=\"(?:stylesheet|preconnect)\"[^>]+https?:[^>]*", html
    )
    assert "<math" in html
    assert "$$" not in re.sub(r"<pre.*?</pre>", "", html, flags=re.DOTALL)
