"""The content of the wheels, and that they work outside the checkout."""

from __future__ import annotations

import json
import os
import site
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from readme_steps import count_steps, environment_of, run_steps

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(file.parent for file in (ROOT / "packages").glob("*/pyproject.toml"))
# Commands of packages, as entry points name them.
ADDED = (
    "drive",
    "hands save",
    "ros2",
    "score",
    "track avp",
    "track datagrams",
    "tune",
    "videos",
)
# The builds compile the core and take minutes, so `make full` runs the whole module.
pytestmark = [pytest.mark.slow, pytest.mark.full]


def run(*command: str | Path, cwd: Path, **more: str) -> str:
    """Run a command that must succeed, with more in its environment, and return its output."""
    # A PYTHONPATH could make the checkout importable.
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTHONPATH"
    }
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=environment | more,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, f"{command} exited {done.returncode}:\n{done.stdout}"
    return done.stdout


def files_under(folder: Path) -> set[str]:
    """Return the files of a folder as relative posix paths.

    Without hidden files, bytecode, and what the core is made of.
    """
    relative = (
        path.relative_to(folder) for path in folder.rglob("*") if path.is_file()
    )
    return {
        path.as_posix()
        for path in relative
        if not any(part.startswith((".", "__pycache__")) for part in path.parts)
        and path.suffix != ".so"
    }


def build(source: Path, folder: Path) -> Path:
    """Build the wheel of a source."""
    # With the tools of this environment, so that nothing is downloaded.
    options = ("--wheel", "--no-isolation", "--outdir", folder)
    command = (sys.executable, "-m", "build", *options, source)
    run(*command, cwd=folder)
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(ROOT, tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def core_wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(ROOT / "core", tmp_path_factory.mktemp("core"))


@pytest.fixture(scope="module")
def package_wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Build the wheels of all packages of the tree, by the name of their distribution."""
    folder = tmp_path_factory.mktemp("packages")
    tools = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    command = (ROOT / ".ci" / "packages", folder, "--no-isolation")
    run(*command, cwd=folder, PATH=tools)
    return {wheel.name.split("-")[0]: wheel for wheel in folder.glob("*.whl")}


@pytest.fixture(scope="module")
def environment(
    core_wheel: Path, wheel: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Create an environment with both wheels and the third-party packages of this environment."""
    return environment_with([core_wheel, wheel], tmp_path_factory.mktemp("environment"))


def environment_with(wheels: list[Path], folder: Path) -> Path:
    """Create an environment with wheels and the third-party packages of this environment."""
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder)
    pip = (
        sys.executable,
        "-m",
        "pip",
        "--disable-pip-version-check",
        "--python",
        folder / "bin" / "python",
    )
    run(*pip, "install", "--no-deps", "--no-index", *wheels, cwd=folder)
    # Add the packages after the install, or pip would find the editable install. A line of a .pth
    # file adds a folder without reading the .pth files inside. So the editable install stays out,
    # and folders that such files add (Pinocchio's) must be listed.
    homes = {Path(home).name for home in site.getsitepackages()}
    packages = [entry for entry in sys.path if homes & {*Path(entry).parts}]
    (site_packages,) = folder.glob("lib/python*/site-packages")
    (site_packages / "third_party.pth").write_text("\n".join(packages) + "\n")
    return folder


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    """Create a folder from which the checkout cannot be imported."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    return folder


def test_wheel_holds_the_package_and_the_hands(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())

    expected = {f"handmap_qp/{name}" for name in files_under(ROOT / "handmap_qp")}
    expected |= {f"handmap_qp/urdf/{name}" for name in files_under(ROOT / "urdf")}
    # Programs that run peers, so that they can be compared with where there is no checkout.
    peers = files_under(ROOT / "benchmarks" / "peers")
    expected |= {f"handmap_qp/outside/peers/{name}" for name in peers}
    assert {name for name in names if ".dist-info/" not in name} == expected
    assert wheel.name.endswith("-py3-none-any.whl")
    assert wheel.stat().st_size < 3e6

    # Type checkers read the annotations of a package only where it has this marker.
    assert "handmap_qp/py.typed" in names
    for hand in ("human", "three_finger"):
        assert f"handmap_qp/urdf/{hand}/hand.yaml" in names
        assert any(
            name.startswith(f"handmap_qp/urdf/{hand}/") and name.endswith(".urdf")
            for name in names
        )
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_the_wheel_of_the_core_has_the_library_and_its_python(
    core_wheel: Path, environment: Path, elsewhere: Path
) -> None:
    names = set(zipfile.ZipFile(core_wheel).namelist())
    files = files_under(ROOT / "core" / "handmap_core")
    found = {name for name in names if ".dist-info/" not in name}
    (library,) = found - {f"handmap_core/{name}" for name in files}
    assert library.startswith("handmap_core/_core.")
    assert library.endswith(".so")
    assert {"handmap_core/_core.pyi", "handmap_core/py.typed"} <= found
    for licence in ("LICENSE", "LICENSES.txt"):
        assert any(name.endswith(f".dist-info/licenses/{licence}") for name in names)
    assert not core_wheel.name.endswith("none-any.whl")
    assert core_wheel.stat().st_size < 3e6
    said = run(environment / "bin" / "handmap", "doctor", "--json", cwd=elsewhere)
    assert json.loads(said)["versions"]["core"] == "compiled core"


@pytest.mark.parametrize(
    ("source", "core"), [(ROOT / "core", ""), (ROOT, "core/")], ids=["core", "library"]
)
def test_wheels_are_built_of_sdists_that_have_the_core(
    source: Path, core: str, tmp_path: Path
) -> None:
    # The wheel is made of what the sdist has: without optimization, which takes most of the time.
    options = ("--no-isolation", "--outdir", tmp_path)
    quick = {"SKBUILD_CMAKE_BUILD_TYPE": "None"}
    run(sys.executable, "-m", "build", *options, source, cwd=tmp_path, **quick)
    assert len([*tmp_path.glob("*.whl")]) == 1
    (sdist,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (tree,) = (tmp_path / "source").iterdir()
    expected = {name for name in files_under(ROOT / "core") if name[:6] != "build/"}
    # The licence of the core is a link in the tree, which must not lead out of the sdist.
    assert expected <= files_under(tree / core)
    assert not [*tree.rglob("*.so")]


def test_package_is_imported_from_the_wheel(environment: Path, elsewhere: Path) -> None:
    where = run(
        environment / "bin" / "python",
        "-c",
        "import handmap_qp; print(handmap_qp.__file__)",
        cwd=elsewhere,
    )
    assert Path(where.strip()).is_relative_to(environment)


def test_wheel_lists_its_hands(environment: Path, elsewhere: Path) -> None:
    listing = run(environment / "bin" / "handmap", "hands", "list", cwd=elsewhere)
    assert {"human", "three_finger", "allegro_right", "allegro_left"} <= set(
        listing.split()
    )


def test_demo_runs_from_the_wheel(
    environment: Path, elsewhere: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run(environment / "bin" / "handmap", "demo", "--out", out, cwd=elsewhere)

    assert list(out.rglob("*.npz")), "no trajectory"
    pictures = list(out.rglob("*.png"))
    assert pictures, "no picture"
    for picture in pictures:
        assert picture.read_bytes().startswith(b"\x89PNG"), picture
    assert not list(elsewhere.iterdir()), (
        "the demo wrote outside of the folder it was given"
    )


def test_each_package_has_a_wheel_with_all_its_files(
    package_wheels: dict[str, Path],
) -> None:
    modules = {file.parent for each in PACKAGES for file in each.glob("*/__init__.py")}
    assert {*package_wheels} == {each.name for each in modules}
    for module in modules:
        wheel = package_wheels[module.name]
        names = set(zipfile.ZipFile(wheel).namelist())
        assert {f"{module.name}/{file}" for file in files_under(module)} <= names
        assert wheel.stat().st_size < 1e6


def test_the_readme_works_where_all_wheels_are_installed(
    core_wheel: Path,
    wheel: Path,
    package_wheels: dict[str, Path],
    elsewhere: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("all")
    environment_with([core_wheel, wheel, *package_wheels.values()], folder)
    assert run_steps(elsewhere, environment_of(folder)) == count_steps()
    handmap = folder / "bin" / "handmap"
    for command in ADDED:
        printed = run(handmap, *command.split(), "--help", cwd=elsewhere)
        assert f"handmap {command}" in printed
    run(handmap, "hands", "save", "three_finger", "--out", "my.hand", cwd=elsewhere)
    script = (
        "from handmap_core.run import load; print(load('my.hand').mapper.robot.name)"
    )
    name = run(folder / "bin" / "python", "-c", script, cwd=elsewhere)
    assert name.strip() == "three_finger"
