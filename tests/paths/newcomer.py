"""A new user who types what the documentation prints: each command is looked up there, and counted.

At the end, the figures of the path are printed: minutes, commands, and hints that had to be
followed because the page alone was not enough.
"""

from __future__ import annotations

import contextlib
import re
import shlex
import subprocess
import time
from collections.abc import Iterator, Mapping
from types import TracebackType

from paths.fresh import ROOT, Fresh, run, stop

PROMISED = 10
"""Time that a path may take [min]. Only printed, because a machine may be busy."""
_INSTALLING = ("python3 -m venv .venv", ". .venv/bin/activate", "pip install")
"""What a user types in place of `Fresh.__enter__`: see `docs/install.md`."""


def commands_of(page: str) -> set[str]:
    """Return the lines of a page as they are typed: without comments and the `&` of a shell.

    Code inside of a sentence is one, too.

    Args:
        page: Its path below the root.
    """
    text = (ROOT / page).read_text(encoding="utf-8").replace("\\\n", " ")
    code = [*text.splitlines(), *re.findall(r"`([^`\n]+)`", text)]
    lines = (line.split(" #")[0].strip() for line in code)
    return {" ".join(line.removesuffix("&").split()) for line in lines}


def is_printed(line: str, page: str) -> bool:
    """Tell whether a page prints a command."""
    return line in commands_of(page)


def code_of(page: str, name: str) -> str:
    """Return the Python that a page tells the user to write to a file."""
    text = (ROOT / page).read_text(encoding="utf-8")
    parts = text.partition(f"`{name}`:\n\n```python\n")[2].partition("```")
    return parts[0] or stop(f"{page} has no text of {name}")


class Newcomer(Fresh):
    """A fresh environment and a user who types; a context manager.

    Args:
        name: See `Fresh`.
        extras: See `Fresh`.
        commands: The commands that the user types, each with the page that prints it.

    Attributes:
        typed: The commands so far.
        hints: How often a refusal had to be followed.
    """

    def __init__(self, name: str, *extras: str, commands: Mapping[str, str]) -> None:
        super().__init__(name, *extras)
        self._commands = commands
        self.typed = [*_INSTALLING]
        self.hints = 0

    def __enter__(self) -> Newcomer:
        """Install the package as the page of the installation says."""
        super().__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Print the figures of a path that reached its end."""
        if not kind:
            minutes = (time.monotonic() - self.began) / 60.0
            print(
                f"{minutes:7.1f} min from an empty environment ({PROMISED} are promised), "
                f"{len(self.typed)} commands typed, {self.hints} hints followed"
            )
        super().__exit__(kind, error, trace)

    def words_of(
        self, line: str, also: str = "", instead: Mapping[str, str] | None = None
    ) -> list[str]:
        """Count a command, and return its words.

        Args:
            line: The command as its page prints it.
            also: What is typed behind it, where this machine or the user's hand differs.
            instead: What is typed in place of words of the line, such as a port.
        """
        if not is_printed(line, self._commands[line]):
            stop(f"{self._commands[line]} does not print: {line}")
        words = [(instead or {}).get(word, word) for word in shlex.split(line)]
        words += shlex.split(also)
        self.typed.append(shlex.join(words))
        return words

    def enter(self, line: str, also: str = "", worst: int = 0) -> str:
        """Type a command, and return what it prints; see `words_of` and `run`."""
        words = self.words_of(line, also)
        # Packages are named by their folders in the checkout.
        cwd = ROOT if words[:2] == ["pip", "install"] else self.work
        with self.step(self.typed[-1]):
            return run(words, worst, env=self._variables, cwd=cwd)

    @contextlib.contextmanager
    def entering(
        self, line: str, also: str = "", instead: Mapping[str, str] | None = None
    ) -> Iterator[subprocess.Popen[str]]:
        """Type a command into a terminal of its own, where it runs until the end of the block."""
        words = self.words_of(line, also, instead)
        self.note(f"in a terminal: {self.typed[-1]}")
        name = f"terminal{len(self.typed)}"
        with self.background(words, name) as process:
            try:
                yield process
            except BaseException:
                said = (self.work / f"{name}.log").read_text(encoding="utf-8")
                for line in said.splitlines()[-6:]:
                    self.note(f"{words[1]}: {line}")
                raise

    def heed(self, line: str, also: str = "") -> None:
        """Type a command that is refused, and then the command that its last line names."""
        words = self.words_of(line, also)
        with self.step(f"{self.typed[-1]} (refused)"):
            done = subprocess.run(
                words,
                env=self._variables,
                cwd=self.work,
                capture_output=True,
                text=True,
                check=False,
            )
        if not done.returncode:
            stop(f"{line}: expected a refusal")
        said = done.stderr.strip().splitlines()[-1]
        self.note(said)
        hint = said.rpartition(": ")[2]
        self.typed.append(hint)
        self.hints += 1
        with self.step(hint):
            run(shlex.split(hint), env=self._variables, cwd=self.work)
