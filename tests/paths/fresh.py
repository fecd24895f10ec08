"""Fresh environments for the paths of new users: made, measured and removed.

What a path does is done by the package as a user gets it: by its wheels, in an environment and a
folder of its own. Nothing of the checkout or of the shell around it is seen there.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

ROOT = Path(__file__).parents[2]
WHEELS = ROOT / "build" / "paths"
LIMIT = 1800.0
"""Longest time of one command [s]."""
# What each wheel is made of, by the folder that it is built from.
_SHARED = (".ci/addresses.py", ".ci/metadata.py")
_SOURCES = {
    ROOT / "core": ("core", *_SHARED),
    ROOT: ("handmap_qp", "urdf", "pyproject.toml", *_SHARED),
}
_SIZES = """
from importlib.metadata import distributions
sizes = {}
for each in distributions():
    files = {each.locate_file(file).resolve() for file in each.files or ()}
    sizes[each.name] = sum(file.stat().st_size for file in files if file.is_file())
largest = sorted(sizes, key=sizes.get, reverse=True)[:9]
print(", ".join(f"{name} {sizes[name] / 1e6:.0f}" for name in largest))
"""
_COMMANDS = """
import json
import sys
import time
from importlib import import_module

package, address, name = sys.argv[1:]
Client = import_module(f"{package}.client").Client
until = time.monotonic() + 60.0
with Client(address) as client:
    while True:
        try:
            client.watch(name)
            break
        except Exception:
            if time.monotonic() > until:
                raise
            time.sleep(0.1)
    found = []
    while len(found) < 60 and time.monotonic() < until:
        if command := client.latest(timeout=1.0):
            found.append(command)
moved = max(max(angles) - min(angles) for angles in zip(*(each.q for each in found)))
print(json.dumps({"joints": found[0].joint_names, "count": len(found), "moved": moved,
                  "status": sorted({each.status for each in found})}))
"""


def stop(problem: str) -> NoReturn:
    """End the path with one line."""
    print(f"path: {problem}", file=sys.stderr)
    raise SystemExit(1)


def find_uv() -> str:
    """Return the program that makes environments and installs into them."""
    beside = Path(sys.executable).parent
    return (
        shutil.which("uv", path=str(beside))
        or shutil.which("uv")
        or stop("uv is not installed")
    )


def wheels() -> tuple[Path, Path]:
    """Return wheels of the core and the library for this interpreter.

    Each is built if there is none of today's files.
    """
    python = f"cp{sys.version_info.major}{sys.version_info.minor}"
    core, library = (
        _wheel_of(source, WHEELS / python / name)
        for source, name in zip(_SOURCES, ("core", "library"), strict=True)
    )
    return core, library


def _wheel_of(source: Path, folder: Path) -> Path:
    """Return the wheel of a package in a folder of its own; build it if its files are newer."""
    files = [
        file
        for name in _SOURCES[source]
        for file in [ROOT / name, *(ROOT / name).rglob("*")]
    ]
    newest = max(
        file.stat().st_mtime
        for file in files
        if file.is_file()
        and not file.is_relative_to(ROOT / "core" / "build")
        and not file.name.endswith((".so", ".pyc"))
    )
    built = [*folder.glob("*.whl")]
    if not built or built[0].stat().st_mtime < newest:
        shutil.rmtree(folder, ignore_errors=True)
        build(source, folder)
        built = [*folder.glob("*.whl")]
    (wheel,) = built
    return wheel


def build(source: Path, folder: Path, python: str = sys.executable) -> None:
    """Build the wheel of a package's source for an interpreter, into a folder."""
    words = [find_uv(), "build", "--wheel", "--quiet", "--python", python]
    run([*words, "--out-dir", str(folder), str(source)], cwd=ROOT)


def run(words: list[str], worst: int = 0, **choices: Any) -> str:
    """Run a command and return its stdout; end with its last lines if its exit code is worse."""
    done = subprocess.run(
        words, capture_output=True, text=True, timeout=LIMIT, check=False, **choices
    )
    if not 0 <= done.returncode <= worst:
        lines = (done.stderr.strip() or done.stdout.strip()).splitlines()
        stop(
            "\n".join(
                [f"{' '.join(words)[:100]}: exit code {done.returncode}", *lines[-12:]]
            )
        )
    return done.stdout


class Fresh:
    """A fresh environment with the package, and an empty folder to work in; a context manager.

    Args:
        name: Name of the path.
        extras: Extras of the package.

    Attributes:
        began: Time at which the environment was begun, after the wheels were there [s, monotonic].
    """

    def __init__(self, name: str, *extras: str) -> None:
        self.name = name
        self.extras = extras
        self.began = time.monotonic()

    def __enter__(self) -> Fresh:
        """Make the environment and install the package's wheels into it."""
        self._started = time.monotonic()
        print(f"== {self.name}", flush=True)
        self.folder = Path(tempfile.mkdtemp(prefix="handmap-path-"))
        self.work = self.folder / "work"
        self.work.mkdir()
        self._bin = self.folder / "environment" / "bin"
        # No path, option or folder of the shell around counts; caches of hands are new, too.
        self._variables = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith(("PYTHON", "HANDMAP_", "VIRTUAL_ENV", "XDG_"))
        }
        self._variables["XDG_CACHE_HOME"] = str(self.folder / "cache")
        self._variables["PATH"] = f"{self._bin}{os.pathsep}{os.environ['PATH']}"
        try:
            with self.step("build the wheels, or take those of today's files"):
                core, library = wheels()
            self.began = time.monotonic()
            with self.step("make an empty environment"):
                words = [find_uv(), "venv", "--quiet", "--seed", "--python"]
                run([*words, sys.executable, str(self._bin.parent)])
            self.show_size()
            self.install(str(core), str(library), title="the wheels alone")
            extras = ",".join(self.extras)
            self.install(f"{library}[{extras}]", title=f"its extras {extras}")
        except BaseException:
            self._remove()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Remove everything, and say how long the whole path took."""
        self._remove()
        took = time.monotonic() - self._started
        word = "failed" if kind else "done"
        print(f"{took:7.1f} s  {self.name}: {word}\n", flush=True)

    def _remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    @contextlib.contextmanager
    def step(self, text: str) -> Iterator[None]:
        """Time a step of the path."""
        started = time.monotonic()
        yield
        print(f"{time.monotonic() - started:7.1f} s  {text}", flush=True)

    def note(self, text: str) -> None:
        """Print a line that belongs to the step before."""
        print(f"           {text}", flush=True)

    def leave_out(self, what: str, reason: str) -> None:
        """Say what was not tried, and why."""
        self.note(f"LEFT OUT: {what}: {reason}")

    def install(
        self, *requirements: str, title: str = "", has_dependencies: bool = True
    ) -> None:
        """Install packages, and print what the environment takes then."""
        words = [
            find_uv(),
            "pip",
            "install",
            "--quiet",
            "--python",
            str(self._bin / "python"),
        ]
        if not has_dependencies:
            words.append("--no-deps")
        with self.step(f"install {title or ' '.join(requirements)}"):
            run([*words, *requirements], env=self._variables, cwd=self.work)
        self.show_size()

    def uninstall(self, *names: str) -> None:
        """Remove packages, and print what the environment takes then."""
        words = [find_uv(), "pip", "uninstall", "--quiet", "--python"]
        run([*words, str(self._bin / "python"), *names], env=self._variables)
        self.show_size()

    def show_size(self) -> None:
        """Print the size of the environment and of its largest packages [MB]."""
        everything = self._bin.parent.rglob("*")
        size = sum(
            file.stat().st_size
            for file in everything
            if file.is_file() and not file.is_symlink()
        )
        self.note(f"{size / 1e6:.0f} MB: {self.python(_SIZES).strip()}")

    def handmap(self, *words: str, worst: int = 0) -> str:
        """Run `handmap` in the folder, and return what it prints; see `run`."""
        with self.step(f"handmap {' '.join(words)}"):
            command = [str(self._bin / "handmap"), *words]
            return run(command, worst, env=self._variables, cwd=self.work)

    def refusal(self, *words: str) -> str:
        """Return the last line of a `handmap` command that is refused; empty if it is not."""
        done = subprocess.run(
            [str(self._bin / "handmap"), *words],
            env=self._variables,
            cwd=self.work,
            capture_output=True,
            text=True,
            timeout=LIMIT,
            check=False,
        )
        return done.stderr.strip().splitlines()[-1] if done.returncode else ""

    def python(self, code: str, *words: str) -> str:
        """Run Python code in the environment, and return what it prints."""
        command = [str(self._bin / "python"), "-W", "ignore", "-c", code, *words]
        return run(command, env=self._variables, cwd=self.work)

    def running(
        self, *words: str
    ) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
        """Let a `handmap` command run in the background, until the end of the block."""
        return self.background([str(self._bin / "handmap"), *words], words[0])

    @contextlib.contextmanager
    def background(
        self, words: list[str], name: str
    ) -> Iterator[subprocess.Popen[str]]:
        """Let a program run in the background, until the end of the block.

        Args:
            words: The program and its words.
            name: Name of the file `NAME.log` in the folder that gets its stderr.

        Yields:
            The process, whose stdin and stdout are pipes.
        """
        log = (self.work / f"{name}.log").open("w", encoding="utf-8")
        with (
            log,
            subprocess.Popen(
                words,
                env=self._variables,
                cwd=self.work,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            ) as process,
        ):
            try:
                yield process
            finally:
                process.send_signal(signal.SIGINT)
                try:
                    process.wait(20.0)
                except subprocess.TimeoutExpired:
                    process.kill()

    def scripted(
        self, code: str, *words: str
    ) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
        """Let Python code run in the background, until the end of the block."""
        command = [str(self._bin / "python"), "-W", "ignore", "-c", code, *words]
        return self.background(command, "script")

    @contextlib.contextmanager
    def serving(self, *words: str) -> Iterator[dict[str, int]]:
        """Let the mapping service run on free ports, and give these by name."""
        ports = ("--port", "0", "--stream-port", "0", "--health-port", "-1")
        started = time.monotonic()
        with self.running("serve", *ports, *words) as process:
            assert process.stdout
            line = process.stdout.readline()
            if not line:
                stop(f"serve: {(self.work / 'serve.log').read_text(encoding='utf-8')}")
            took = time.monotonic() - started
            print(f"{took:7.1f} s  handmap serve {' '.join(words)}", flush=True)
            yield json.loads(line)["ports"]

    def watch(self, ports: dict[str, int], session: str, alone: str = "") -> list[str]:
        """Follow a session as a driver does; return its joints.

        Ends the path if no commands arrive, or the robot does not move.

        Args:
            ports: Ports of the service by name.
            session: Name of the session.
            alone: Python of an environment that has the core alone, for its client.
        """
        words = f"tcp://127.0.0.1:{ports['requests']}", session
        with self.step(f"a driver takes commands of the session {session}"):
            if alone:
                command = [alone, "-c", _COMMANDS, "handmap_core", *words]
                printed = run(command, env=self._variables, cwd=self.work)
            else:
                printed = self.python(_COMMANDS, "handmap_qp", *words)
            found = json.loads(printed)
        statuses = ", ".join(found["status"])
        self.note(
            f"{found['count']} commands of {len(found['joints'])} joints, the fastest moved "
            f"{found['moved']:.2f} rad; status {statuses}"
        )
        if found["count"] < 60 or found["moved"] < 0.05:
            stop(f"{session}: the robot does not follow")
        return found["joints"]
