"""Pytest plugin: run the tests with another build of the compiled core.

    HANDMAP_CORE=build/sanitize/_core.so python -m pytest -p other_core ...

The library takes the place of `handmap_core._core` before anything imports that. It must be built
from the sources of this tree, which the package checks by their fingerprint. Processes that tests
start have the package's own core.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

NAME = "handmap_core._core"


def load_core(library: Path) -> None:
    """Load a library as the compiled core of the package.

    Raises:
        RuntimeError: If the package has a core already, or does not take this one.
    """
    if NAME in sys.modules:
        raise RuntimeError(f"{NAME} is loaded already: load this plugin first")
    spec = importlib.util.spec_from_file_location(NAME, library)
    if spec is None or spec.loader is None:
        raise RuntimeError(f"{library} is not a library of Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[NAME] = module
    spec.loader.exec_module(module)
    from handmap_core.core import core

    if core is not module:
        raise RuntimeError(f"the package does not take {library}")


load_core(Path(os.environ["HANDMAP_CORE"]))
