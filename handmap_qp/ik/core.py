"""The compiled core (`handmap_qp/core`, C++), where it was built and is allowed.

Everything that it does is in Python too: the readable reference, which runs where `core` is None.
"""

import importlib
import os
import zlib
from functools import cached_property, wraps
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

_AGAIN = (
    "install handmap_qp again with a C++ compiler, such as g++ (`make` in a checkout)"
)


def fingerprint() -> str:
    """Return a fingerprint of the core's sources; empty in a wheel, which has none."""
    sources = Path(__file__).parents[1] / "core"
    files = sorted(sources.glob("*.[ch]pp"))
    content = b"".join(file.read_bytes() for file in files)
    return f"{zlib.crc32(content):08x}" if content else ""


def _load() -> tuple[Any, str, str]:
    if os.environ.get("HANDMAP_PURE", "") not in ("", "0"):
        return None, "Python path: HANDMAP_PURE is set", ""
    try:
        found = importlib.import_module("handmap_qp._core")
    except ImportError as error:
        problem = f"no compiled core ({error}); {_AGAIN}"
    else:
        if fingerprint() in ("", found.SOURCES):
            return found, "compiled core", ""
        problem = f"the core is older than its sources; {_AGAIN}"
    return None, f"Python path: {problem}", problem


core, description, problem = _load()
"""The core, or None; which path runs, and why; and why it is not the one that is wanted."""


def in_core(reference: T) -> T:
    """Let an object's `core` do what this method does, by its name, where there is one."""
    method: Any = reference

    def call(self: Any, *values: Any, **named: Any) -> Any:
        if self.core:
            return getattr(self.core, method.__name__)(*values, **named)
        return method(self, *values, **named)

    wrapped: Any = wraps(method)(call)
    return wrapped if core else method


class Compiled:
    """Base of classes that the core has too, under the same name; subclasses run in Python."""

    _saved: Any = None
    """What the core's own of a former copy remembered, which that of this one begins with."""

    @cached_property
    def core(self) -> Any | None:
        """The core's own, made of this object's attributes; None without a core."""
        kind = getattr(core, type(self).__name__, None)
        return kind and kind(self)

    def __getstate__(self) -> dict[str, Any]:
        """Return all but the core's own, which a copy makes anew, and what that remembers."""
        state = vars(self).copy()
        save = getattr(state.pop("core", None), "save", None)
        return {**state, "_saved": save()} if save else state
