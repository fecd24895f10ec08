"""Every error that `handmap_qp` raises on purpose.

An error carries its evidence as attributes, so that a program can act on it, and says in one line what was expected, where,
and what came instead. Whatever raises one leaves its object as it was before the call.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np


class HandmapError(Exception):
    """Base of all errors of this package: catch it to catch them all."""


class InvalidInputError(HandmapError, ValueError):
    """A value given to a public function cannot be used.

    Attributes:
        value: The offending value, where it is short enough to be worth keeping.
    """

    def __init__(self, message: str, *, value: Any = None) -> None:
        super().__init__(message)
        self.value = value


class InvalidOptionsError(HandmapError, ValueError):
    """Options that contradict each other or the hands they are used with."""


class HandError(HandmapError, ValueError):
    """A hand description (`hand.yaml` or URDF) cannot be used.

    Attributes:
        file: The file at fault, if the description came from one.
        key: The path of the key inside it, such as `points[2].link`.
        value: The value found there.
    """

    def __init__(self, message: str, *, file: Path | None = None, key: str | None = None, value: Any = None) -> None:
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
