"""Every error that `handmap_qp` raises on purpose.

An error carries its evidence as attributes, so that a program can act on it, and says in one line
what was expected, where, and what came instead. Whatever raises one leaves its object as it was
before the call.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np


class HandmapError(Exception):
    """Base of all errors of this package: catch it to catch them all."""


class _DescribedError(HandmapError, ValueError):
    """What is wrong with one named thing, kept as attributes; the text is composed of them."""

    def __init__(
        self, name: str, problem: str, expected: str, value: Any, got: str, advice: str
    ) -> None:
        # All arguments go to `Exception`, which rebuilds the error from them when it is unpickled.
        super().__init__(name, problem, expected, value, got, advice)
        self.problem = problem
        self.expected = expected
        self.value = value
        self.got = got or (_shortened(value) if value is not None else "")
        self.advice = advice

    def __str__(self) -> str:
        """Compose `name: expected X, got Y: advice` in one line."""
        name = self.args[0]
        what = self.problem or f"expected {self.expected}" + (
            f", got {self.got}" if self.got else ""
        )
        text = f"{name}: {what}" if name else what
        return f"{text}: {self.advice}" if self.advice else text


class InvalidInputError(_DescribedError):
    """A value given to a public function cannot be used.

    Attributes:
        argument: The argument at fault, `human_q` or `points[3]`; empty where there is none.
        expected: What it must be.
        value: What it is, where that is short enough to be worth keeping.
        got: The same as text.
        problem: What is wrong, where "expected X, got Y" does not say it.
        advice: What to do about it.
    """

    def __init__(
        self,
        problem: str = "",
        *,
        argument: str = "",
        expected: str = "",
        value: Any = None,
        got: str = "",
        advice: str = "",
    ) -> None:
        super().__init__(argument, problem, expected, value, got, advice)
        self.argument = argument

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (type(self), self.args)


class InvalidOptionsError(_DescribedError):
    """Options that contradict each other or the hands they are used with.

    Attributes:
        option: The option at fault; empty where there is no single one.
        expected: What it must be.
        value: What it is.
        got: The same as text.
        problem: What is wrong, where "expected X, got Y" does not say it.
        advice: What to do about it.
    """

    def __init__(
        self,
        problem: str = "",
        *,
        option: str = "",
        expected: str = "",
        value: Any = None,
        got: str = "",
        advice: str = "",
    ) -> None:
        super().__init__(option, problem, expected, value, got, advice)
        self.option = option

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (type(self), self.args)


def _rebuilt(kind: type[_DescribedError], arguments: tuple[Any, ...]) -> _DescribedError:
    """Unpickle an error of keyword arguments."""
    name, problem, expected, value, got, advice = arguments
    key = "argument" if kind is InvalidInputError else "option"
    return kind(problem, **{key: name}, expected=expected, value=value, got=got, advice=advice)


def _shortened(value: Any) -> str:
    """The value as text of one line and at most 80 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


class HandError(HandmapError, ValueError):
    """A hand description (`hand.yaml` or URDF) cannot be used.

    Attributes:
        file: The file at fault, if the description came from one.
        key: The path of the key inside it, such as `points[2].link`.
        value: The value found there.
    """

    def __init__(
        self, message: str, *, file: Path | None = None, key: str | None = None, value: Any = None
    ) -> None:
        place = ": ".join(str(part) for part in (file, key) if part is not None)
        super().__init__(f"{place}: {message}" if place else message)
        self.file = file
        self.key = key
        self.value = value


class RecordingError(HandmapError, ValueError):
    """A recording of a human hand cannot be read.

    Attributes:
        file: The recording.
    """

    def __init__(self, message: str, *, file: Path) -> None:
        super().__init__(f"{file}: {message}")
        self.file = file


class DegeneratePointsError(HandmapError, ValueError):
    """The reference points do not determine the motion (eq. 6 has no unique solution).

    Attributes:
        singular_values: Of the weighted, centred points, largest first [m], shape (3,).
    """

    def __init__(self, message: str, *, singular_values: np.ndarray) -> None:
        values = ", ".join(f"{1e3 * value:.3g}" for value in singular_values)
        super().__init__(f"{message} (singular values {values} mm)")
        self.singular_values = singular_values


class MissingExtraError(HandmapError, ImportError):
    """An optional dependency is needed and not installed.

    Attributes:
        package: What could not be imported.
        extra: The extra of `handmap-qp` that installs it.
    """

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed: pip install 'handmap-qp[{extra}]'")
        self.package = package
        self.extra = extra


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
