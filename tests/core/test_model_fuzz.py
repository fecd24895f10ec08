"""Damaged models are refused, or harm nothing, under the sanitizers: see judges/model_fuzz.py."""

from __future__ import annotations

import pytest
from model_fuzz import fuzz

# Compiling takes half a minute.
pytestmark = pytest.mark.full


def test_damaged_models_are_refused_or_harm_nothing() -> None:
    tried, accepted = fuzz(seed=1, seconds=0.0, rounds=3000)
    # Damage that is always refused would try nothing behind the reader.
    assert tried == 3000
    assert 100 < accepted < tried
