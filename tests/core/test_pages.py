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

import numpy as np
import pytest
from browser import Browser, find_chromium
from marks import rotated
from patience import PATIENCE
from service_tools import address_of, serving

import handmap_qp
from handmap_core.mapping.mapper import Mapper
from handmap_qp import cli, read_recording

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
WHOLE_PATHS = {"compare", "teleoperate", "data"}
MOTORS = {"first_motor"}
# The simulated robot needs a session; tests/simulation has its tests.
EXAMPLES = sorted(
    file
    for file in (ROOT / "examples").glob("*.py")
    if "simulated_robot" not in file.stem
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


# The page of the first motor has code for motors: see tests/drive. Whole paths are run as a whole:
# see test_whole_paths.py.
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if code_of(page) and page.stem not in MOTORS | WHOLE_PATHS],
    ids=lambda page: page.stem,
)
def test_python_code_runs(
    page: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Later blocks of a page may use names of earlier ones.
    code = "\n".join(code_of(page))
    monkeypatch.chdir(tmp_path)
    # The reader's own recording.
    recording = read_recording("demo", "right").part(slice(0, 60))
    np.savez("hand.npz", landmarks=recording.landmarks)
    with serving() if "Client()" in code else nullcontext() as server:
        if server is not None:
            client = f"Client({address_of(server)!r}, timeout={PATIENCE})"
            code = code.replace("Client()", client)
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
    rotated(EXAMPLES, 2),
    ids=lambda example: example.stem,
)
def test_examples_run(
    example: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments = ["0.3"] if example.stem == "01_loop_60hz" else []
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
    prose = re.sub(
        r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE
    )
    for link in re.findall(r"(?<!!)\[[^\]]*\]\(([^)#]+)[^)]*\)", prose):
        assert "://" in link or (page.parent / link).exists(), link


def test_examples_are_in_the_gallery() -> None:
    page = (ROOT / "docs" / "examples.md").read_text("utf-8")
    for example in (ROOT / "examples").glob("[0-9]*"):
        assert f"(#{example.stem})" in page
        assert f"{{ #{example.stem} }}" in page
        assert example.suffix != ".py" or f'--8<-- "examples/{example.name}"' in page


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built strictly."""
    pytest.importorskip("mkdocs")
    site = tmp_path_factory.mktemp("docs") / "site"
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
    return site


def test_the_site_is_complete_and_asks_no_other_host(site: Path) -> None:
    html = "".join(page.read_text("utf-8") for page in site.rglob("*.html"))
    assert not re.findall(r"<(?:script|img|iframe)[^>]+src=\"https?:[^\"]*", html)
    assert not re.findall(
        r"<link[^>]+rel=\"(?:stylesheet|preconnect)\"[^>]+https?:[^>]*", html
    )
    assert "<math" in html
    assert "$$" not in re.sub(r"<pre.*?</pre>", "", html, flags=re.DOTALL)
    assert not list(site.rglob("*.py"))
    described = set(re.findall(r'id="handmap_(?:qp|core)\.(?:\w+\.)*(\w+)"', html))
    assert {*handmap_qp.__all__} - {"__version__"} <= described
    # Those that a base class has belong to the reference, too.
    members = vars(Mapper) | vars(handmap_qp.HandMapper)
    for name, member in members.items():
        if not name.startswith("_") and callable(member):
            assert f'id="handmap_qp.HandMapper.{name}"' in html, name


def test_the_list_for_language_models_leads_to_pages(site: Path) -> None:
    text = (site / "llms.txt").read_text("utf-8")
    pages = re.findall(r"^- \[[^]]+\]\(([^)]+)\): \S", text, flags=re.MULTILINE)
    assert len(pages) == text.count("\n- ")
    assert {p.relative_to(ROOT / "docs").as_posix() for p in PAGES[1:]} <= {*pages}
    for page in pages:
        assert (site / page).is_file(), page


def test_the_search_works_in_a_site_opened_as_a_file(site: Path) -> None:
    if (program := find_chromium()) is None:
        pytest.skip("no Chromium, or name one in HANDMAP_CHROMIUM")
    with Browser(program) as browser:
        browser.open((site / "index.html").as_uri())
        browser.wait_for("document.readyState == 'complete'")
        browser.evaluate(
            "{ const input = document.querySelector('.md-search__input'); input.focus();"
            "input.value = 'emergency stop';"
            "input.dispatchEvent(new Event('keyup', {bubbles: true})); }"
        )
        browser.wait_for(
            "[...document.querySelectorAll('.md-search-result__link')]"
            ".some((link) => link.href.endsWith('safety.html#emergency-stop'))"
        )
        assert not browser.errors
