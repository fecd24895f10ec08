"""The structure of the project: its dependencies and the place of files; `make lint` has more."""

from __future__ import annotations

import importlib.metadata
import os
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

import handmap_qp

ROOT = Path(__file__).parents[2]
TOP_LEVEL = {
    "pyproject.toml",
    "handmap_qp",
    "urdf",
    "benchmarks",
    "tests",
    "docs",
    "examples",
    "README.md",
    "LICENSE",
    "CHANGELOG.md",
    "CITATION.cff",
    "Makefile",
    "uv.lock",
    "mkdocs.yml",
    "CONTRIBUTING.md",
}
# Packages that a plain import must not load.
SLOW_PACKAGES = (
    "scipy",
    "mujoco",
    "mink",
    "qpsolvers",
    "matplotlib",
    "yourdfpy",
    "trimesh",
)


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    """The content of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in command],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )


def test_top_level_holds_nothing_else() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    # In a container the checkout may belong to another user, which git otherwise rejects as an
    # attack.
    done = run("git", "-c", "safe.directory=*", "ls-files", "-z")
    assert done.returncode == 0, done.stderr
    entries = {name.split("/")[0] for name in done.stdout.split("\0") if name}
    assert not {entry for entry in entries - TOP_LEVEL if not entry.startswith(".")}


@pytest.mark.parametrize(
    "code",
    [
        pytest.param("import handmap_qp", id="import"),
        pytest.param(
            "sys.argv = ['handmap', '--help']\n"
            "from handmap_qp.cli import main\n"
            "try:\n"
            "    main()\n"
            "except SystemExit as stop:\n"
            "    assert not stop.code, stop.code\n",
            id="help",
        ),
    ],
)
def test_slow_packages_wait_until_used(code: str) -> None:
    loaded = f"print([name for name in {SLOW_PACKAGES!r} if name in sys.modules], file=sys.stderr)"
    done = run(sys.executable, "-c", f"import sys\n{code}\n{loaded}")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr.splitlines()[-1] == "[]", done.stderr


def test_versions_agree(project: dict[str, Any]) -> None:
    version = project["project"]["version"]
    assert importlib.metadata.version("handmap-qp") == version
    assert getattr(handmap_qp, "__version__", version) == version
    assert (
        yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"]
        == version
    )
    assert "## [Unreleased]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_public_names_exist() -> None:
    names = getattr(handmap_qp, "__all__", [])
    assert len(set(names)) == len(names)
    assert not [name for name in names if not hasattr(handmap_qp, name)]


def requirements(project: dict[str, Any]) -> list[Requirement]:
    """Return the requirements of .venv, without the package itself."""
    lines = [
        *project["project"]["dependencies"],
        *(
            line
            for extra in project["project"]["optional-dependencies"].values()
            for line in extra
        ),
        *project["dependency-groups"]["dev"],
    ]
    return [
        wanted
        for wanted in map(Requirement, lines)
        if wanted.name != project["project"]["name"]
    ]


def test_extra_all_is_all(project: dict[str, Any]) -> None:
    extras = dict(project["project"]["optional-dependencies"])
    (line,) = extras.pop("all")
    # Ray brings a cluster's worth of packages, so it is asked for by name.
    assert Requirement(line).extras == set(extras) - {"cluster"}


def test_constraints_fit_the_requirements(project: dict[str, Any]) -> None:
    # Otherwise `make lock` was forgotten, and a new machine gets versions that were not tested.
    text = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8")
    pins = dict(re.findall(r"^([\w.-]+)==(\S+)$", text, flags=re.MULTILINE))
    pins = {canonicalize_name(name): version for name, version in pins.items()}
    for wanted in requirements(project):
        version = pins.get(canonicalize_name(wanted.name))
        assert version is not None, f"{wanted.name} is not pinned: run make lock"
        assert wanted.specifier.contains(version), (
            f"{wanted} does not admit the pinned {version}: run make lock"
        )
    # The first Python 3.11 of `requires-python` is not the last: Debian 12 has 3.11.2.
    lowest = project["project"]["requires-python"].removeprefix(">=") + ".0"
    for each in importlib.metadata.distributions():
        if pins.get(canonicalize_name(each.name)) == each.version:
            pythons = SpecifierSet(each.metadata["Requires-Python"] or "")
            assert pythons.contains(lowest), f"{each.name} needs Python {pythons}"


def test_page_of_dependencies_is_current(project: dict[str, Any]) -> None:
    # Otherwise `python docs/dependencies.py` was forgotten.
    page = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8")
    found = set(
        re.findall(r"^\| ([\w-]+) \| .* \| `(.*)` \| \w", page, flags=re.MULTILINE)
    )
    own = project["project"]
    lines = [
        *own["dependencies"],
        *(e for es in own["optional-dependencies"].values() for e in es),
    ]
    wanted = {re.findall(r"^([\w-]+)[^<>=]*(.*)", line)[0] for line in lines}
    assert found == {row for row in wanted if row[0] != own["name"]}


def test_ci_scripts_can_be_run() -> None:
    assert all(os.access(ROOT / ".ci" / name, os.X_OK) for name in ("run", "wheel"))


def test_licences_are_found_with_their_texts() -> None:
    script = runpy.run_path(str(ROOT / ".ci" / "licences.py"))
    numpy = importlib.metadata.distribution("numpy")
    assert "BSD" in script["licence"](numpy)
    assert any("Redistributions of source code" in t for t in script["texts"](numpy))
