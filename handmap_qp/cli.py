"""The command `handmap`: find the command, parse its arguments, run it, and report errors.

A user error is one line on stderr and exit code 2. Ctrl-C is exit code 130, but 0 for `view` and
`serve`, which end that way. Results go to stdout, progress to stderr.
"""

import contextlib
import inspect
import io
import os
import re
import shutil
import sys
import textwrap
from collections import defaultdict
from collections.abc import Sequence
from functools import cache, reduce
from importlib.metadata import EntryPoint, entry_points
from operator import or_
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn, Protocol

import handmap_qp
from handmap_core.errors import (
    DiskFullError,
    HandmapError,
    InvalidInputError,
    InvalidOptionsError,
    did_you_mean,
    expect,
    warn,
)


class Command(Protocol):
    """A subcommand: its fields are its arguments."""

    def run(self) -> None:
        """Run the command; raise `HandmapError` on a user error."""
        ...


class _Place(NamedTuple):
    """A command, by the module and class of its entry point."""

    point: EntryPoint

    def load(self) -> Any:
        """Import the class."""
        return self.point.load()

    @property
    def about(self) -> str:
        """The first line of the class's own explanation, or why there is none."""
        place = self.point.module.replace(".", "/")
        names = f"{place}.py", f"{place}/__init__.py"
        files = (Path(folder, name) for folder in sys.path for name in names)
        line = rf'^class {self.point.attr}\b[^:]*:\s+"""(.*?)(?:"""|$)'
        # Read the file, because an import takes longer. A class may be defined elsewhere.
        with contextlib.suppress(StopIteration, IndexError):
            text = next(filter(Path.is_file, files)).read_text(encoding="utf-8")
            return re.findall(line, text, re.MULTILINE)[0]
        try:
            return (inspect.getdoc(self.load()) or "").partition("\n")[0]
        except HandmapError as error:
            return str(error)


class _Added(_Place):
    """A command of another package."""

    def load(self) -> Any:
        """Import the class; raise `HandmapError` if that is not possible."""
        try:
            return super().load()
        except Exception as error:
            problem = f"the command {self.point.name} of {self.point.value}"
            raise HandmapError(f"{problem} cannot be loaded: {error}") from error


_GROUP = "handmap_qp.commands"
"""Entry points of commands."""

# Modules are imported when their command is called, so that `handmap --help` is immediate.
_MODULES = {
    "demo": "offline.demo",
    "retarget": "offline.cli",
    "align": "offline.cli",
    "calibrate": "offline.cli",
    "convert": "datasets.convert",
    "batch": "datasets.batch",
    "report": "datasets.report",
    "compare": "offline.compare",
    "study": "study.cli",
    "view": "viewer.cli",
    "hands list": "onboarding.cli",
    "hands show": "onboarding.cli",
    "hands init": "onboarding.cli",
    "hands migrate": "onboarding.cli",
    "hands check": "onboarding.cli",
    "hands match": "onboarding.cli",
    "hands pack": "onboarding.cli",
    "hands edit": "onboarding.editor",
    "hands save": "saving.cli",
    "robots list": "onboarding.cli",
    "robots show": "onboarding.cli",
    "robots check": "onboarding.cli",
    "layouts": "offline.layouts_cli",
    "simulate": "simulation.cli",
    "live": "live.together",
    "serve": "service.cli",
    "keys": "service.cli",
    "track replay": "live.cli",
    "track mediapipe": "live.cli",
    "track record": "live.cli",
    "doctor": "doctor",
}
"""Module below `handmap_qp.apps` of each command, in the order of the list of `handmap --help`."""
COMMANDS: dict[str, Any] = {
    name: _Place(EntryPoint(name, f"handmap_qp.apps.{module}:{kind}", _GROUP))
    for name, module in _MODULES.items()
    for kind in [name.title().replace(" ", "")]
}
"""Commands of the package by name, in that order."""
_FORMER_NAMES = {"map": "retarget", "tune": "calibrate-actuators"}
"""Former names of commands that still work, and the names that they have now."""


def _by_both_names(commands: dict[str, Any]) -> dict[str, Any]:
    """Add the other name of each command that has a former one."""
    pairs = [
        *_FORMER_NAMES.items(),
        *((new, old) for old, new in _FORMER_NAMES.items()),
    ]
    return commands | {
        other: commands[name]
        for other, name in pairs
        if name in commands and other not in commands
    }


COMMANDS = _by_both_names(COMMANDS)


@cache
def all_commands() -> dict[str, Any]:
    """Return ours, then those of other packages, which takes 30 ms to look up."""
    others = entry_points(group=_GROUP)
    added = {
        point.name: _Added(point) for point in others if point.name not in COMMANDS
    }
    return _by_both_names(COMMANDS | added)


_GROUPS = {
    "hands": "List, describe, write and check descriptions of robot hands.",
    "robots": "List, describe and check robots with two hands; `hands init` describes one.",
    "track": "Send live samples of a human hand to the mapping service, or record them.",
}
"""First words of commands of two words, and what these commands are for."""

_FOLDERS = {
    "calibrate-actuators": "packages/drive",
    "drive": "packages/drive",
    "ros2": "packages/ros2[dds]",
    "score": "packages/score",
    "track avp": "packages/sources",
    "track datagrams": "packages/sources",
    "tune": "packages/drive",
    "videos": "packages/videos",
}
"""What pip installs, in a checkout, for commands that come with packages of their own."""

_OPTIONS = {"--help", "--version", "--completion"}
"""Options without a command."""
_SYSTEM_PACKAGES = {"libgomp": "libgomp1", "libGL.": "libgl1", "libEGL": "libegl1"}
"""Debian's packages of system libraries that slim images lack, by how their file names begin."""

_ABOUT = """Map the motion of a human hand onto a robotic hand.

Lengths are in metres, angles in radians and times in seconds unless a unit is
given. `handmap COMMAND --help` explains a command and its options.
`handmap --version` prints the version.
`handmap --completion bash` (or zsh, tcsh) prints completions for a shell.

Examples:
    handmap demo
    handmap hands list
    handmap retarget demo --robot allegro_right
    handmap compare recording.npz --robot allegro_right
    handmap view demo --robot allegro_right
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Words after `handmap`; those of the process if omitted.

    Returns:
        Exit code: 0; 1 if the disk is full; 2 after a user error. A command that ends with another
        one raises `SystemExit`.
    """
    words = sys.argv[1:] if arguments is None else arguments
    _replace_unknown_characters()
    try:
        parse(words).run()
    except SystemExit as end:
        if end.code != 2:  # after which tyro has said what is wrong
            raise
        return 2
    except HandmapError as error:
        if isinstance(error, InvalidInputError | InvalidOptionsError):
            error = in_words_of_the_command_line(error, words)
        warn(" ".join(str(error).split()))
        return 1 if isinstance(error, DiskFullError) else 2
    except ImportError as error:
        if not (problem := _missing_library(error)):
            raise
        warn(problem)
        return 2
    except BrokenPipeError:
        # The reader closed stdout (`| head`): end quietly, also when Python flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        warn("interrupted, nothing was written")
        return 130
    return 0


def _replace_unknown_characters() -> None:
    """Print a question mark for what a terminal's character set lacks, as lines of tables."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def in_words_of_the_command_line(
    error: InvalidInputError | InvalidOptionsError, words: Sequence[str]
) -> InvalidInputError | InvalidOptionsError:
    """Name an option as it was given: `--ik.damping` in place of `damping`.

    Args:
        error: An error of the library, which knows options by their Python names.
        words: The words given to the command.
    """
    name = error.argument or error.option
    options = {word.partition("=")[0] for word in words if word.startswith("--")}
    given = [o for o in options if o[2:].replace("-", "_").rpartition(".")[2] == name]
    if len(given) == 1:
        error.argument = given[0]
    elif name == "out":
        # It has a default, so that it need not be among the words.
        error.argument = "--out"
    return error


def _missing_library(error: ImportError) -> str:
    """Say which system library a compiled package did not find, or what a package asks for.

    Empty where a module is missing, which its error names.
    """
    # The dynamic linker gives its name in the message only.
    library, found, _ = str(error).partition(": cannot open shared object file")
    advice = "".join(
        f": apt-get install {package}"
        for name, package in _SYSTEM_PACKAGES.items()
        if library.startswith(name)
    )
    if found:
        return f"the system library {library} is missing{advice}"
    return "" if error.name else library


def parse(arguments: Sequence[str]) -> Command:
    """Parse the command line.

    Args:
        arguments: Words after `handmap`.

    Returns:
        The command, ready to run.

    Raises:
        HandmapError: If a type of this package does not take a value.
        InvalidInputError: If there is no such command.
        SystemExit: After printing the help, the version, the completions or tyro's message about
            a mistake, which has the exit code 2.
    """
    firsts = (" ".join(arguments[:2]), *arguments[:1])
    commands = COMMANDS
    if {*firsts}.isdisjoint({*COMMANDS, *_OPTIONS}):
        commands = all_commands()
    name = next(filter(commands.__contains__, firsts), None)
    if not name:
        _answer_without_command(arguments)
    command = commands[name].load()
    # Options of a method had the name of one in front, before methods could be added.
    rest = [
        re.sub(r"^--teleoperation\.", "--", word)
        for word in arguments[len(name.split()) :]
    ]
    about = inspect.cleandoc(command.__doc__).partition("\nAttributes:")[0]
    page = _Page()
    try:
        with contextlib.redirect_stdout(page):
            # It takes longer to import than all commands without one.
            import tyro

            # The help says in words that an argument may be omitted.
            settings = [tyro.conf.DisallowNone]
            return tyro.cli(
                command,
                prog=f"handmap {name}",
                description=about,
                args=rest,
                config=settings,
            )
    except SystemExit:
        print(_wrapped(page.getvalue().replace("None)", "none)")), end="")
        raise


def _answer_without_command(words: Sequence[str]) -> NoReturn:
    """Print the page that was asked for and exit, or name the mistake."""
    match words:
        case ["--version"]:
            print(f"handmap {handmap_qp.__version__}")
        case ["--help" | "-h"]:
            _print_overview("", _ABOUT)
        case [group] | [group, "--help" | "-h"] if group in _GROUPS:
            _print_overview(f"{group} ", f"{_GROUPS[group]}\n")
        case ["--completion", *shell]:
            _print_completion(" ".join(shell))
        case []:
            raise InvalidInputError("expected a command (see handmap --help)")
        case [group, word, *_] if group in _GROUPS:
            _refuse(f"{group} ", word)
        case [word, *_]:
            _refuse("", word)
    raise SystemExit(0)


def _refuse(prefix: str, word: str) -> NoReturn:
    """Say that no command or option of a group goes on by a word, and what may be meant."""
    if folder := _FOLDERS.get(prefix + word):
        raise InvalidInputError(
            f"{prefix + word} comes with a package of its own: in a checkout, "
            f"pip install '{folder}'"
        )
    kind = "option" if word.startswith("-") else "command"
    members = [
        name.removeprefix(prefix) for name in all_commands() if name.startswith(prefix)
    ]
    hint = did_you_mean(word, {*_OPTIONS, *(name.split()[0] for name in members)})
    if not hint and "show" in members:
        hint = f"to describe one: handmap {prefix}show {word}"
    hint = hint or f"see handmap {prefix}--help"
    raise InvalidInputError(f"no {kind} {prefix + word!r}: {hint}")


def _print_overview(prefix: str, about: str) -> None:
    """Print usage, explanation and list of a group of commands, fitting the terminal."""
    width = min(100, max(40, shutil.get_terminal_size().columns))
    print(f"usage: handmap {prefix or '[-h] '}COMMAND ...\n\n{about}\nCommands:")
    listed = {n: each for n, each in all_commands().items() if n.startswith(prefix)}
    column = max(map(len, listed)) + 2
    after = " " * (column + 2)
    for name, place in listed.items():
        current = _FORMER_NAMES.get(name)
        about = f"Former name of `{current}`." if current else place.about
        line = f"  {name:<{column}}{about}"
        print(textwrap.fill(line, width, subsequent_indent=after))


def _print_completion(shell: str) -> None:
    """Print the completions of all commands for a shell."""
    shells = "bash, zsh or tcsh"
    expect(shell in ("bash", "zsh", "tcsh"), "--completion", shells, value=shell)
    import tyro

    words = ["--tyro-print-completion", shell]
    page = io.StringIO()
    settings = [tyro.conf.DisallowNone]
    with contextlib.redirect_stdout(page), contextlib.suppress(SystemExit):
        tyro.cli(_any_command(), prog="handmap", args=words, config=settings)
    script = re.sub(
        r"^COMPLETION_SPEC = .*", _on_one_line, page.getvalue(), flags=re.MULTILINE
    )
    print(script, end="")


def _on_one_line(spec: re.Match[str]) -> str:
    """Repair the table in tyro's completions: a line break of an explanation ends a completion."""
    text = spec[0].replace("\\n", " ")
    return text.replace("'None', ", "").replace(", 'None'", "")


def _any_command() -> Any:
    """Return a type whose values are all commands."""
    import tyro

    def named(word: str, kind: Any, about: str | None = None) -> Any:
        settings = tyro.conf.subcommand(word, description=about, prefix_name=False)
        return Annotated[kind, settings]

    # By the first of two words, which commands of one word do not have.
    kinds = defaultdict(list)
    for name, place in all_commands().items():
        group, _, word = name.rpartition(" ")
        # One of another package that cannot be loaded is left out.
        with contextlib.suppress(HandmapError):
            kinds[group].append(named(word, place.load(), place.about))
    groups = [named(group, reduce(or_, kinds[group])) for group in _GROUPS]
    return reduce(or_, [*kinds[""], *groups])


class _Page(io.StringIO):
    """Collect what would be printed, in colour if stdout is a terminal."""

    encoding = "utf-8"

    def isatty(self) -> bool:
        """Return whether stdout is a terminal."""
        return os.isatty(1)


def _wrapped(page: str) -> str:
    """Wrap the paragraphs of a help page that tyro leaves too long: the description."""
    width = max(40, shutil.get_terminal_size().columns)

    def wrap(found: re.Match[str]) -> str:
        is_long = max(map(len, found[0].splitlines())) > width
        return textwrap.fill(found[0].strip(), width) if is_long else found[0]

    prose = r"(?:(?<=\n\n)\n)?^[^\s│╭╰].*(?:\n[^\s│╭╰].*)*"
    return re.sub(prose, wrap, page, flags=re.MULTILINE)


if __name__ == "__main__":
    sys.exit(main())
