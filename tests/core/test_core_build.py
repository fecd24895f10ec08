"""How the core is built: by each compiler, in parts, from any source, and only when it must be."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Iterator
from email import message_from_string
from pathlib import Path

import nanobind
import pytest
from pyproject_hooks import BuildBackendHookCaller

ROOT = Path(__file__).parents[2]
CORE = ROOT / "handmap_qp" / "core"
UNITS = sorted(CORE.glob("*.cpp"))
NANOBIND = Path(nanobind.include_dir())
# What a build of the package reads.
SOURCES = ("handmap_qp", "urdf", ".ci", "pyproject.toml", "README.md", "LICENSE")


def check_syntax(compiler: str, unit: Path) -> subprocess.CompletedProcess[str]:
    """Let a compiler check one translation unit, with warnings as errors."""
    headers = (
        NANOBIND,
        NANOBIND.parent / "ext" / "robin_map" / "include",
        Path(sysconfig.get_path("include")),
    )
    words = [compiler, "-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Werror"]
    words += ["-fvisibility=hidden"]
    words += [f"-isystem{folder}" for folder in headers]
    words += ["-DNB_DOMAIN=handmap_qp", '-DHANDMAP_SOURCES="none"', str(unit)]
    return subprocess.run(words, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_each_compiler_takes_each_part_without_a_warning(
    compiler: str, unit: Path
) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    done = check_syntax(compiler, unit)
    assert done.returncode == 0, done.stderr


def test_the_core_compiles_in_several_parts() -> None:
    lengths = {unit.stem: len(unit.read_text().splitlines()) for unit in UNITS}
    assert len(lengths) >= 6
    # No part has most of the work, so that parts compile beside each other.
    assert max(lengths.values()) < 0.5 * sum(lengths.values())


@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_pip_reads_the_metadata_without_a_build(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # By this variable hatchling knows pip, for which it has no hooks for metadata.
    monkeypatch.setenv("PIP_BUILD_TRACKER", str(tmp_path))
    backend = BuildBackendHookCaller(
        str(ROOT), "backend", backend_path=[".ci"], python_executable=sys.executable
    )
    prepare = {
        "wheel": backend.prepare_metadata_for_build_wheel,
        "editable": backend.prepare_metadata_for_build_editable,
    }
    name = prepare[kind](str(tmp_path), _allow_fallback=False)
    metadata = message_from_string((tmp_path / name / "METADATA").read_text("utf-8"))
    assert metadata["Name"] == "handmap-qp"
    assert f"handmap_qp-{metadata['Version']}.dist-info" == name
    required = metadata.get_all("Requires-Dist") or []
    assert any(line.startswith("numpy") for line in required)
    assert "service" in (metadata.get_all("Provides-Extra") or [])


@pytest.fixture
def read_only_source(tmp_path: Path) -> Iterator[Path]:
    """Copy all that a build reads, and remove the right to write."""
    source = tmp_path / "source"
    source.mkdir()
    ignore = shutil.ignore_patterns("__pycache__", "_core.*")
    for name in SOURCES:
        at = ROOT / name
        if at.is_dir():
            shutil.copytree(at, source / name, ignore=ignore)
        else:
            shutil.copy2(at, source / name)
    places = [source, *source.rglob("*")]
    for place in places:
        place.chmod(place.stat().st_mode & ~0o222)
    yield source
    for place in places:
        place.chmod(place.stat().st_mode | 0o200)


def without_rights_of_root() -> list[str]:
    """Return the words before a command that let permissions hold for root, too."""
    if os.geteuid() != 0:
        return []
    if shutil.which("setpriv") is None:
        pytest.skip("root may write everywhere, and there is no setpriv to prevent it")
    return ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("c++", "g++"))), reason="no compiler")
def test_a_read_only_source_gives_a_wheel_with_the_core(
    read_only_source: Path, tmp_path: Path
) -> None:
    before = sorted(read_only_source.rglob("*"))
    words = ["-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path)]
    done = subprocess.run(
        [*without_rights_of_root(), sys.executable, *words, str(read_only_source)],
        cwd=tmp_path,
        # Without optimization, which takes most of the time.
        env=os.environ | {"HANDMAP_PURE": "", "SKBUILD_CMAKE_BUILD_TYPE": "None"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Compiled the core" in done.stdout
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert any(name.startswith("handmap_qp/_core.") for name in names)
    assert sorted(read_only_source.rglob("*")) == before
