"""Marks of single parameters."""

from __future__ import annotations

from typing import Any

import pytest


def slow(value: Any) -> Any:
    """Return a parameter whose test runs in the whole suite only."""
    return pytest.param(value, marks=pytest.mark.slow)
