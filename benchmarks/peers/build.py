"""Where the peers are: in environments that `make peers` builds, or in this one.

Each environment is made from the requirements file of its name beside this script, and lies in
`.peers/` of the checkout, or in the folder that `HANDMAP_PEERS` names. `.peers/data` gets the
peers' own configuration files (from dex-retargeting) and robot descriptions (from dexi-rs), which
both peers are then run with.

A peer without such an environment is run by this interpreter, if it is installed here, as by
`pip install 'handmap-qp[peers]'`. The wheel has this folder as `handmap_qp/outside/peers`.

The script needs the standard library only. It leaves finished environments alone; after a change of
a requirements file it builds that environment again.
"""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

HERE = Path(__file__).resolve().parent
PYTHON_VERSIONS = ((3, 10), (3, 12))
"""First and last Python that both peers' wheels are for."""
_OTHER_PYTHONS = ("python3.12", "python3.11", "python3.10")
_STAMP = ".installed"


@dataclass(frozen=True, slots=True)
class Peer:
    """A peer and its environment.

    Attributes:
        name: Name of the distribution, of its requirements file and of its environment.
        module: The module to import.
        data: What it ships for both peers: a folder inside its module, and the name of that folder
            in `.peers/data`.
        megabytes: Size of its environment, measured on Linux x86-64 [MB].
        needs: Modules that it imports and its distribution does not ask for.
    """

    name: str
    module: str
    data: tuple[str, str]
    megabytes: int
    needs: tuple[str, ...] = ()

    @property
    def is_here(self) -> bool:
        """Whether this interpreter can run it."""
        modules = (self.module, *self.needs)
        return all(find_spec(name) for name in modules) and _is_data_here()

    @property
    def requirements(self) -> Path:
        """The requirements file."""
        return HERE / f"{self.name}.txt"


PEERS = (
    Peer(
        "dex-retargeting",
        "dex_retargeting",
        ("configs", "configs"),
        1600,
        ("torch", "six"),
    ),
    Peer("dexi-rs", "dexi_rs", ("resources/assets/robots/hands", "hands"), 140),
)


def peers_folder() -> Path:
    """The folder of all environments: `HANDMAP_PEERS`, or `.peers` of the checkout.

    Of an installed package, it is a folder of the user's cache.
    """
    if named := os.environ.get("HANDMAP_PEERS"):
        return Path(named).resolve()
    if is_checkout():
        return HERE.parents[1] / ".peers"
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "handmap_qp" / "peers"


def is_checkout() -> bool:
    """Whether this file is that of a checkout, not of an installed package."""
    return (HERE.parents[1] / "pyproject.toml").is_file()


def data_folder() -> Path:
    """The folder of the peers' own configuration files and robot descriptions.

    Where none is built, it links to what is installed beside this interpreter.
    """
    built = peers_folder() / "data"
    if built.is_dir() or not _is_data_here():
        return built
    linked = peers_folder() / "installed"
    linked.mkdir(parents=True, exist_ok=True)
    for peer in PEERS:
        inside, name = peer.data
        link, target = linked / name, _package_folder(peer) / inside
        if link.resolve() != target.resolve():
            link.unlink(missing_ok=True)
            link.symlink_to(target, target_is_directory=True)
    return linked


def _package_folder(peer: Peer) -> Path:
    """The folder of a peer's module, which is not imported."""
    spec = find_spec(peer.module)
    assert spec is not None
    return Path((spec.submodule_search_locations or [""])[0])


def _is_data_here() -> bool:
    """Whether the configurations and descriptions are installed beside this interpreter."""
    return all(find_spec(peer.module) for peer in PEERS)


def environment_python(name: str) -> Path:
    """The interpreter of a peer's environment, whether built or not."""
    return peers_folder() / name / "bin" / "python"


def python_of(name: str) -> str:
    """The interpreter that runs a peer: of its environment, or this one."""
    peer = next(peer for peer in PEERS if peer.name == name)
    if not _is_built(peer) and peer.is_here:
        return sys.executable
    return str(environment_python(name))


def version_of(name: str) -> str:
    """What a peer's results depend on: its requirements, or the version beside this interpreter."""
    peer = next(peer for peer in PEERS if peer.name == name)
    if not _is_built(peer) and peer.is_here:
        return importlib.metadata.version(name)
    return peer.requirements.read_text(encoding="utf-8")


def missing_peers() -> list[str]:
    """Names of the peers that can run nowhere.

    They are not installed beside this interpreter, and their environment is not built, or not from
    today's requirements.
    """
    return [peer.name for peer in PEERS if not (_is_built(peer) or peer.is_here)]


def why_missing(names: list[str]) -> str:
    """Say in one line what to do about peers that are missing."""
    what = ", ".join(names)
    if is_checkout():
        return (
            f"{what}: not built in {peers_folder()}, nor installed here: "
            "pip install 'handmap-qp[peers]', or run make peers"
        )
    return (
        f"{what}: not installed: pip install 'handmap-qp[peers]', on Python 3.11 or 3.12; "
        "dex-retargeting needs torch and six too"
    )


def _is_built(peer: Peer) -> bool:
    stamp = peers_folder() / peer.name / _STAMP
    is_there = stamp.is_file() and environment_python(peer.name).exists()
    wanted = peer.requirements.read_text(encoding="utf-8")
    return (
        is_there
        and stamp.read_text(encoding="utf-8") == wanted
        and (data_folder() / peer.data[1]).is_dir()
    )


def _build(peer: Peer, python: str) -> None:
    folder = peers_folder() / peer.name
    print(f"{peer.name}: making {folder} (about {peer.megabytes} MB)", flush=True)
    _run(
        peer,
        [python, "-m", "venv", "--clear", str(folder)],
        "its environment cannot be made",
    )
    print(f"{peer.name}: installing {peer.requirements.name}", flush=True)
    pip = [
        str(environment_python(peer.name)),
        "-m",
        "pip",
        "--disable-pip-version-check",
    ]
    _run(
        peer,
        [*pip, "install", "--quiet", "-r", str(peer.requirements)],
        "pip cannot install it",
    )
    find = f"import {peer.module}; print({peer.module}.__path__[0])"
    where = _run(
        peer, [str(environment_python(peer.name)), "-c", find], "it cannot be imported"
    )
    inside, name = peer.data
    target = data_folder() / name
    shutil.rmtree(target, ignore_errors=True)
    # Kinematics is all that the peers read: meshes stay where they are.
    shutil.copytree(
        Path(where.splitlines()[-1]) / inside,
        target,
        ignore=shutil.ignore_patterns("meshes", "__pycache__", "__init__.py"),
    )
    wanted = peer.requirements.read_text(encoding="utf-8")
    (folder / _STAMP).write_text(wanted, encoding="utf-8")


def _run(peer: Peer, command: list[str], problem: str) -> str:
    """Run a command and return its stdout; end with one line if it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        _stop(f"{peer.name}: {problem}: {error}")
    if done.returncode:
        lines = (
            done.stderr.strip() or done.stdout.strip() or "no message"
        ).splitlines()
        errors = [line for line in lines if line.startswith("ERROR:")]
        _stop(f"{peer.name}: {problem}: {(errors or lines)[-1]}")
    return done.stdout


def _find_python() -> str:
    """An interpreter that both peers have wheels for: this one, or another on the path."""
    low, high = PYTHON_VERSIONS
    if low <= sys.version_info[:2] <= high:
        return sys.executable
    for name in _OTHER_PYTHONS:
        if shutil.which(name):
            return name
    _stop(
        f"expected Python {low[0]}.{low[1]} to {high[0]}.{high[1]} for the peers, got "
        f"{sys.version_info[0]}.{sys.version_info[1]} and none of {', '.join(_OTHER_PYTHONS)}"
    )


def _stop(message: str) -> NoReturn:
    print(f"make peers: {message}", file=sys.stderr)
    raise SystemExit(1)


def main() -> None:
    """Build what is missing, and say what is there."""
    for peer in PEERS:
        if not _is_built(peer):
            _build(peer, _find_python())
        else:
            print(f"{peer.name}: built already in {peers_folder() / peer.name}")
    print(f"The peers are ready in {peers_folder()}.")


if __name__ == "__main__":
    main()
