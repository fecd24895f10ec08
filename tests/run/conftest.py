"""The small wheel's package, for all tests of it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from run_cases import write_package


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make `handmap_run` importable, beside `handmap_qp`."""
    folder = write_package(tmp_path_factory.mktemp("site"))
    sys.path.insert(0, str(folder))
    return folder
