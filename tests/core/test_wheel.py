"""The content of the wheel, and that it works outside the checkout."""

from __future__ import annotations

import os
import site
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# The build and the environment take several seconds, so the whole module is slow.
pytestmark = pytest.mark.slow


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command that must succeed, and return its output."""
    # A PYTHONPATH could make the checkout importable.
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTHONPATH"
    }
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, f"{command} exited {done.returncode}:\n{done.stdout}"
    return done.stdout


def files_under(folder: Path) -> set[str]:
    """Return the files of a folder as relative posix paths, without hidden files and bytecode."""
    relative = (
        path.relative_to(folder) for path in folder.rglob("*") if path.is_file()
    )
    return {
        path.as_posix()
        for path in relative
        if not any(part.startswith((".", "__pycache__")) for part in path.parts)
    }


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    # Build with the tools of this environment, so that nothing is downloaded.
    run(
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        folder,
        ROOT,
        cwd=folder,
    )
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create an environment with the wheel and the third-party packages of this environment."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder)
    pip = (
        sys.executable,
        "-m",
        "pip",
        "--disable-pip-version-check",
        "--python",
        folder / "bin" / "python",
    )
    run(*pip, "install", "--no-deps", "--no-index", wheel, cwd=folder)
    # Add the packages after the install, or pip would find the editable install. A line of a .pth
    # file adds a folder without reading the .pth files inside. So the editable install stays out,
    # and folders that such files add (Pinocchio's) must be listed.
    homes = tuple(site.getsitepackages())
    packages = [entry for entry in sys.path if entry.startswith(homes)]
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
    assert {name for name in names if ".dist-info/" not in name} == expected

    # Type checkers read the annotations of a package only where it has this marker.
    assert "handmap_qp/py.typed" in names
    for hand in ("human", "three_finger"):
        assert f"handmap_qp/urdf/{hand}/hand.yaml" in names
        assert any(
            name.startswith(f"handmap_qp/urdf/{hand}/") and name.endswith(".urdf")
            for name in names
        )
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


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
