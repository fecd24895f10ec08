"""The library in C, built once for all its tests."""

from __future__ import annotations

from pathlib import Path

import pytest
from library_in_c import installed_library


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return where the library and programs are built."""
    return tmp_path_factory.mktemp("library")


@pytest.fixture(scope="session")
def prefix(folder: Path) -> Path:
    """Return where the library is installed."""
    return installed_library(folder)
