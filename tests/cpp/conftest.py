"""What tests of the library in C and C++ share: the library is compiled once."""

from __future__ import annotations

from pathlib import Path

import pytest
from library_in_c import installed_library
from run_cases import mapper_of

from handmap_qp import HandMapper
from handmap_qp.apps.saving import saved_bytes


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return where the library and programs are built."""
    return tmp_path_factory.mktemp("library")


@pytest.fixture(scope="session")
def prefix(folder: Path) -> Path:
    """Return where the library is installed, away from the checkout."""
    return installed_library(folder)


@pytest.fixture(scope="module")
def mapper() -> HandMapper:
    """Return the demo's person with a hand that keeps its links apart."""
    return mapper_of("allegro_right", "teleoperation")


@pytest.fixture(scope="module")
def saved(mapper: HandMapper) -> bytes:
    """Return the saved hand."""
    return saved_bytes(mapper)
