"""The packages of the tree: one version, bounds of the library, and what they may import."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import TypedDict

import pytest

import handmap_qp

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = sorted(file.parent for file in (ROOT / "packages").glob("*/pyproject.toml"))
# Those that are no packages of Python.
OTHERS = {ROOT / "packages" / "handmap-js", ROOT / "packages" / "ros2_cpp"}
# What a user reads: a module that is named here is public.
PAGES = [
    *(ROOT / "docs").rglob("*.md"),
    *(ROOT / "examples").glob("[0-9]*"),
    ROOT / "README.md",
]


class Contract(TypedDict):
    """A contract of import-linter."""

    name: str
    ignore_imports: list[str]


def metadata_of(package: Path) -> str:
    """Return the text that has a package's name, version and dependencies."""
    # That of ROS 2 is installed by colcon, too, which reads setup.py.
    files = [package / "setup.py", package / "pyproject.toml"]
    return next(file for file in files if file.is_file()).read_text("utf-8")


@cache
def imports() -> tuple[list[str], list[str]]:
    """Return the root packages of packages/imports.toml, and what its first contract ignores."""
    text = (ROOT / "packages" / "imports.toml").read_text("utf-8")
    settings = tomllib.loads(text)["tool"]["importlinter"]
    contract: Contract = settings["contracts"][0]
    assert contract["name"] == "Packages import public modules"
    return settings["root_packages"], contract["ignore_imports"]


def test_all_packages_are_found() -> None:
    folders = {file for file in (ROOT / "packages").iterdir() if file.is_dir()}
    assert {*PACKAGES} | OTHERS == folders
    assert not {*PACKAGES} & OTHERS


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_a_package_has_the_version_of_the_library_and_bounds_it(package: Path) -> None:
    text = metadata_of(package)
    version = handmap_qp.__version__
    assert re.findall(r'^ *version ?= ?"(.*?)"', text, re.MULTILINE) == [version]
    major, minor = map(int, version.split(".")[:2])
    # They import modules that a minor version may change before 1.0.
    bounds = f">={major}.{minor},<{major}.{minor + 1}"
    assert re.findall(r'"handmap-qp(?:\[[a-z,]*\])?(.*?)"', text) == [bounds]


def test_other_files_have_the_version_of_the_library() -> None:
    version = handmap_qp.__version__
    for name, expected in {
        "pyproject.toml": f'version = "{version}"',
        "CITATION.cff": f"version: {version}",
        "packages/ros2/package.xml": f"<version>{version}</version>",
        "packages/ros2_cpp/package.xml": f"<version>{version}</version>",
    }.items():
        assert f"{expected}\n" in (ROOT / name).read_text("utf-8"), name


def test_the_core_has_the_version_of_the_library_and_its_bounds() -> None:
    library, core = (
        tomllib.loads((ROOT / folder / "pyproject.toml").read_text("utf-8"))["project"]
        for folder in ("", "core")
    )
    assert core["version"] == library["version"]
    assert f"handmap-core=={core['version']}" in library["dependencies"]
    # A robot's computer may have an older numpy.
    (msgspec,) = (each for each in core["dependencies"] if each.startswith("msgspec"))
    assert msgspec in library["dependencies"]
    client = core["optional-dependencies"]["client"]
    assert {*client} <= {*library["optional-dependencies"]["service"]}


def test_all_folders_of_packages_that_are_named_exist() -> None:
    files = [*PAGES, *(ROOT / "handmap_qp").rglob("*.py")]
    files += [file for package in PACKAGES for file in package.rglob("*.py")]
    text = "\n".join(file.read_text("utf-8") for file in files)
    named = {*re.findall(r"(?<![\w./])((?:packages|examples)/[a-z][\w-]*)", text)}
    assert len(named) >= len(PACKAGES)
    for folder in named:
        assert (ROOT / folder).is_dir(), folder


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_the_page_of_installing_names_each_package(package: Path) -> None:
    page = (ROOT / "docs" / "install.md").read_text("utf-8")
    assert re.search(rf"^\| `packages/{package.name}(\[\w+\])?` \|", page, re.MULTILINE)


def test_imports_of_each_package_are_checked() -> None:
    roots, _ = imports()
    modules = {
        file.parent.name
        for package in PACKAGES
        for file in package.glob("*/__init__.py")
    }
    assert {*roots} == modules | {"handmap_qp"}


def test_public_modules_are_those_that_pages_and_examples_name() -> None:
    _, ignored = imports()
    pairs = [line.split(" -> ") for line in ignored]
    public = {module for importer, module in pairs if importer == "**"}
    private = {module for importer, module in pairs} - public
    text = "\n".join(page.read_text("utf-8") for page in PAGES)
    named = {*re.findall(r"\bhandmap_qp(?:\.[a-z]\w*)*", text)}
    assert public <= named
    assert not private & named
