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


def code_of(page: str, name: str) -> str:
    """Return the Python that a page tells the user to write to a file."""
    text = (ROOT / page).read_text(encoding="utf-8")
    parts = text.partition(f"`{name}`:\n\n```python\n")[2].partition("```")
    return parts[0] or stop(f"{page} has no text of {name}")


class Newcomer(Fresh):
    """A fresh environment and a user who types; a context manager.

    Attributes:
        typed: The commands so far.
        hints: How often a refusal had to be followed.
    """

    def __enter__(self) -> Newcomer:
        """Install the package as the page of the installation says."""
        self.typed = [*_INSTALLING]
        self.hints = 0
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
        self,
        page: str,
        line: str,
        also: str = "",
        instead: Mapping[str, str] | None = None,
    ) -> list[str]:
        """Count a command, and return its words.

        Args:
            page: The page that prints it, as `docs/live.md`.
            line: The command as it is printed there.
            also: What is typed behind it, where this machine or the user's hand differs.
            instead: What is typed in place of words of the line, such as a port.
        """
        if line not in commands_of(page):
            stop(f"{page} does not print: {line}")
        words = [(instead or {}).get(word, word) for word in shlex.split(line)]
        words += shlex.split(also)
        self.typed.append(shlex.join(words))
        return words

    def enter(self, page: str, line: str, also: str = "", worst: int = 0) -> str:
        """Type a command, and return what it prints; see `words_of` and `run`."""
        words = self.words_of(page, line, also)
        # Packages are named by their folders in the checkout.
        cwd = ROOT if words[:2] == ["pip", "install"] else self.work
        with self.step(self.typed[-1]):
            return run(words, worst, env=self._variables, cwd=cwd)

    @contextlib.contextmanager
    def entering(
        self,
        page: str,
        line: str,
        also: str = "",
        instead: Mapping[str, str] | None = None,
    ) -> Iterator[subprocess.Popen[str]]:
        """Type a command into a terminal of its own, where it runs until the end of the block."""
        words = self.words_of(page, line, also, instead)
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

    def heed(self, page: str, line: str, hint: str, also: str = "") -> None:
        """Type a command that is refused, and see that the refusal says how to go on.

        Args:
            page: See `words_of`.
            line: See `words_of`.
            hint: What its last line must say.
            also: See `words_of`.
        """
        words = self.words_of(page, line, also)
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
        if hint not in said:
            stop(f"the refusal does not say: {hint}")
        self.hints += 1
