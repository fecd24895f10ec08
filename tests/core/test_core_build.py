"""How the core is built: by each compiler, in parts, from any source, and only when it must be."""

from __future__ import annotations

import json
import os
import pty
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from email import message_from_string
from pathlib import Path

import nanobind
import pytest
from pyproject_hooks import BuildBackendHookCaller

ROOT = Path(__file__).parents[2]
CORE = ROOT / "core"
UNITS = sorted((CORE / "src").glob("*.cpp"))
LIBRARY = CORE / "library" / "handmap.cpp"
NANOBIND = Path(nanobind.include_dir())


def check_syntax(compiler: str, unit: Path) -> subprocess.CompletedProcess[str]:
    """Let a compiler check one translation unit, with warnings as errors."""
    headers = (
        NANOBIND,
        NANOBIND.parent / "ext" / "robin_map" / "include",
        Path(sysconfig.get_path("include")),
    )
    words = [compiler, "-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Werror"]
    words += ["-fvisibility=hidden", "-Wpedantic"]
    words += [f"-I{CORE / 'include'}", *(f"-isystem{folder}" for folder in headers)]
    words += ["-DNB_DOMAIN=handmap_core", '-DHANDMAP_SOURCES="none"']
    words += ['-DHANDMAP_VERSION="0.0.0"', str(unit)]
    return subprocess.run(words, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.full
@pytest.mark.parametrize("unit", [*UNITS, LIBRARY], ids=lambda unit: unit.stem)
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
def test_pip_reads_the_metadata_without_a_build(kind: str, tmp_path: Path) -> None:
    backend = BuildBackendHookCaller(
        str(CORE), "backend", backend_path=["backend"], python_executable=sys.executable
    )
    prepare = {
        "wheel": backend.prepare_metadata_for_build_wheel,
        "editable": backend.prepare_metadata_for_build_editable,
    }
    name = prepare[kind](str(tmp_path), _allow_fallback=False)
    metadata = message_from_string((tmp_path / name / "METADATA").read_text("utf-8"))
    assert metadata["Name"] == "handmap-core"
    assert f"handmap_core-{metadata['Version']}.dist-info" == name
    required = metadata.get_all("Requires-Dist") or []
    assert any(line.startswith("numpy") for line in required)
    assert "client" in (metadata.get_all("Provides-Extra") or [])


def required_by(path: str, **variables: str) -> list[str]:
    """Return the compilers that the backend asks for."""
    script = "import backend; print(*backend.get_requires_for_build_wheel())"
    environment = {name: value for name, value in os.environ.items() if name != "CXX"}
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=CORE,
        env=environment
        | {"PATH": path, "PYTHONPATH": str(CORE / "backend")}
        | variables,
        capture_output=True,
        text=True,
        check=True,
    )
    return [name for name in done.stdout.split() if name.startswith("ziglang")]


@pytest.mark.parametrize("name", ["c++", "g++", "clang++"])
def test_a_build_asks_for_a_compiler_where_there_is_none(
    name: str, tmp_path: Path
) -> None:
    assert len(required_by(str(tmp_path))) == 1
    assert required_by(str(tmp_path), CXX="/opt/own/c++") == []
    (tmp_path / name).write_text("#!/bin/sh\n")
    (tmp_path / name).chmod(0o755)
    assert required_by(str(tmp_path)) == []


@pytest.mark.parametrize(
    ("variables", "problem"),
    [
        ({"CXX": "/no/compiler"}, "CXX names /no/compiler, which is not there"),
        ({}, "no C++ compiler was found, and no package ziglang"),
    ],
)
def test_a_build_without_a_compiler_ends_with_one_line(
    variables: dict[str, str], problem: str, tmp_path: Path
) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "CXX"}
    done = subprocess.run(
        # Without packages, ziglang among them.
        [sys.executable, "-S", "-c", "import compilers; compilers.check_compiler()"],
        env=environment
        | {"PATH": str(tmp_path), "PYTHONPATH": str(CORE / "backend")}
        | variables,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert problem in done.stderr
    assert "g++" in done.stderr


@pytest.mark.slow
def test_where_compiling_fails_the_build_ends_and_says_how_to_go_on(
    tmp_path: Path,
) -> None:
    broken = {
        "CXX": shutil.which("false") or "",
        # In a folder of its own: CMake remembers a compiler that worked.
        "SKBUILD_BUILD_DIR": f"{tmp_path}/core",
    }
    words = ["-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, *words, str(CORE)],
        cwd=tmp_path,
        env=os.environ | broken,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert "handmap_core: compiling the core failed" in done.stderr + done.stdout
    assert not list(tmp_path.glob("*.whl"))


@pytest.fixture
def own_package(tmp_path: Path) -> Path:
    """Copy the core's package with its sources, which a test may break."""
    ignore = shutil.ignore_patterns("__pycache__", "build")
    copied = shutil.copytree(CORE, tmp_path / "core", ignore=ignore) / "handmap_core"
    if not list(copied.glob("_core.*.so")):
        pytest.skip("the core lies elsewhere")
    # Python imports it after all .pth files. One of them may have put the finder of an editable
    # install before PYTHONPATH.
    (copied.parent / "sitecustomize.py").write_text(
        "import sys\n"
        "sys.meta_path[:] = (\n"
        "    each for each in sys.meta_path\n"
        "    if not type(each).__module__.startswith('_editable_')\n"
        ")\n"
    )
    return copied


def make_older(package: Path) -> None:
    header = package.parent / "include" / "handmap" / "qp.hpp"
    with header.open("a", encoding="utf-8") as file:
        file.write("// another line\n")


def remove(package: Path) -> None:
    for file in package.glob("_core.*.so"):
        file.unlink()


def damage(package: Path) -> None:
    for file in package.glob("_core.*.so"):
        file.write_bytes(b"no library")


def run_in(package: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python with a copy of the package."""
    return subprocess.run(
        [sys.executable, *words],
        cwd=package.parent.parent,
        env=os.environ | {"PYTHONPATH": str(package.parent)},
        capture_output=True,
        text=True,
        check=False,
    )


IMPORTS = """
from handmap_qp.errors import MissingCoreError
try:
    from handmap_qp.mapping.hand_mapper import HandMapper
except MissingCoreError as error:
    assert isinstance(error, ImportError)
    assert error.problem in str(error) and error.command in str(error)
    print(error.problem, "|", error.command)
"""


@pytest.mark.parametrize(
    ("harm", "problem"),
    [
        (make_older, "is older than its sources"),
        (remove, "cannot be loaded (No module named"),
        (damage, "cannot be loaded ("),
    ],
)
def test_a_core_that_cannot_be_used_is_one_error_that_says_how_to_mend_it(
    own_package: Path, harm: Callable[[Path], None], problem: str
) -> None:
    harm(own_package)
    done = run_in(own_package, "-c", IMPORTS)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(problem)
    assert "| pip install " in done.stdout

    line = f"handmap: the compiled core {problem}"
    done = run_in(own_package, "-m", "handmap_qp.cli", "map", "demo")
    assert done.returncode == 2
    assert done.stderr.startswith(line)
    assert len(done.stderr.splitlines()) == 1
    assert "pip install" in done.stderr

    done = run_in(own_package, "-m", "handmap_qp.cli", "doctor", "--json")
    assert done.returncode == 0, done.stderr
    assert f"the compiled core {problem}" in json.loads(done.stdout)["versions"]["core"]


@pytest.fixture
def read_only_source(tmp_path: Path) -> Iterator[Path]:
    """Copy all that a build of the core reads, and remove the right to write."""
    ignore = shutil.ignore_patterns("__pycache__", "_core.*.so", "build")
    source = shutil.copytree(CORE, tmp_path / "source", ignore=ignore)
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
@pytest.mark.full
def test_a_read_only_source_gives_a_wheel_with_the_core(
    read_only_source: Path, tmp_path: Path
) -> None:
    before = sorted(read_only_source.rglob("*"))
    words = ["-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path)]
    done = subprocess.run(
        [*without_rights_of_root(), sys.executable, *words, str(read_only_source)],
        cwd=tmp_path,
        # Without optimization, which takes most of the time.
        env=os.environ | {"SKBUILD_CMAKE_BUILD_TYPE": "None"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Compiled the core" in done.stdout
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert any(name.startswith("handmap_core/_core.") for name in names)
    assert sorted(read_only_source.rglob("*")) == before


@pytest.mark.slow
@pytest.mark.full
def test_an_editable_install_has_the_library_in_the_checkout(tmp_path: Path) -> None:
    ignore = shutil.ignore_patterns("__pycache__", "_core.*.so", "build")
    source = shutil.copytree(CORE, tmp_path / "source", ignore=ignore)
    stale = source / "handmap_core" / "_core.stale.so"
    stale.touch()
    backend = BuildBackendHookCaller(
        str(source),
        "backend",
        backend_path=["backend"],
        python_executable=sys.executable,
    )
    # Without optimization, which takes most of the time.
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("SKBUILD_CMAKE_BUILD_TYPE", "None")
        prepared = tmp_path / backend.prepare_metadata_for_build_editable(str(tmp_path))
        name = backend.build_editable(str(tmp_path), metadata_directory=str(prepared))
    wheel = zipfile.ZipFile(tmp_path / name)
    (path,) = (name for name in wheel.namelist() if name.endswith(".pth"))
    assert str(source) in wheel.read(path).decode().splitlines()
    assert not any(name.startswith("handmap_core/") for name in wheel.namelist())
    assert not stale.exists()
    done = run_in(source / "handmap_core", "-c", "import handmap_core.core")
    assert done.returncode == 0, done.stderr


def told(is_kept: bool, **environment: str) -> str:
    """Return what a build's line puts on a terminal, where pip keeps the output or shows it."""
    script = "import terminal; terminal.tell('compiling')"
    child, end = pty.fork()
    if child == 0:
        output = os.open(os.devnull, os.O_WRONLY) if is_kept else 1
        os.dup2(output, 1)
        os.environ.pop("MAKELEVEL", None)
        os.environ.update(environment)
        os.chdir(CORE / "backend")
        os.execv(sys.executable, [sys.executable, "-c", script])
    shown = b""
    with suppress(OSError):  # how Linux says that the terminal has been closed
        while part := os.read(end, 1024):
            shown += part
    os.close(end)
    os.waitpid(child, 0)
    return shown.decode().strip()


def test_who_waits_for_a_build_is_told_what_it_does() -> None:
    assert told(is_kept=True) == "compiling"
    assert told(is_kept=False) == "compiling"
    # make shows the lines of a build itself.
    assert told(is_kept=True, MAKELEVEL="1") == ""
