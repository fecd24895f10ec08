"""Shared by all tests: the hypothesis profile, data files, recordings and robot hands."""

from __future__ import annotations

import gc
import json
import os
import random
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from patience import PATIENCE

# Draw the same examples on every run, so that a failure is reproducible.
# `--hypothesis-profile=explore` draws others.
# On a busy machine all examples come slowly, which says nothing of their strategy.
settings.register_profile(
    "ci",
    deadline=None,
    max_examples=40,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile(
    "explore",
    deadline=None,
    max_examples=2000,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
# `-m "not slow"` draws few examples; the whole suite draws all of them.
settings.register_profile("fast", settings.get_profile("ci"), max_examples=6)
settings.load_profile("ci")

TESTS = Path(__file__).resolve().parent


# All that collection makes stays: looking for garbage in it took a third of its time.
gc.disable()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--full",
        action="store_true",
        help="also run tests marked `full`: all cases of matrices, and builds of packages. "
        "A file that is named runs with them, too",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Load the profile of the fast suite, unless the command line names one."""
    if (
        "not slow" in config.option.markexpr
        and config.option.hypothesis_profile is None
    ):
        settings.load_profile("fast")


def pytest_collection_modifyitems(
    config: pytest.Config, items: list[pytest.Item]
) -> None:
    """Leave out tests marked `full`, unless `--full` asks for them or their file is named."""
    if config.option.full:
        return
    named = {
        (config.invocation_params.dir / argument.partition("::")[0]).resolve()
        for argument in config.args
    }
    kept, left_out = list[pytest.Item](), list[pytest.Item]()
    for item in items:
        is_left_out = item.get_closest_marker("full") and item.path not in named
        (left_out if is_left_out else kept).append(item)
    config.hook.pytest_deselected(items=left_out)
    items[:] = kept


def pytest_collection_finish() -> None:
    """Look for garbage from now on, but not among tests and modules."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def load_data() -> Callable[[str], dict[str, Any]]:
    """Read a JSON file of `tests/data` by its name without suffix."""
    return lambda name: json.loads(
        (TESTS / "data" / f"{name}.json").read_text(encoding="utf-8")
    )


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of recordings of real hands, which are too large to be kept beside the tests."""
    named = os.environ.get("HANDMAP_RECORDINGS")
    folder = Path(named) if named else TESTS.parents[1] / "shared" / "recordings"
    if not any(folder.glob("*.npz")):
        pytest.skip(
            f"no recordings (*.npz) in {folder}: set HANDMAP_RECORDINGS to the folder of them"
        )
    return folder


@pytest.fixture(scope="session")
def shared_hands() -> Path:
    """The folder of robot hands with meshes, which are too large to be kept beside the tests."""
    named = os.environ.get("HANDMAP_HANDS")
    folder = Path(named) if named else TESTS.parents[1] / "shared" / "hands"
    if not any(folder.glob("*/*.urdf")):
        pytest.skip(
            f"no hands (*/*.urdf) in {folder}: set HANDMAP_HANDS to the folder of them"
        )
    return folder


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands wait long for a service, which answers late on a busy machine."""
    monkeypatch.setattr("handmap_qp.apps.connection.TIMEOUT", PATIENCE)


@pytest.fixture
def free_port() -> int:
    """Return a port that no program listens on.

    It is below those that a system gives to programs that ask for any, so that no other test takes
    it meanwhile.
    """
    for port in random.SystemRandom().sample(range(20_000, 32_000), 100):
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    pytest.fail("no free port")
