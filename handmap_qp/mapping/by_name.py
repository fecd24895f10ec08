"""The mapping methods by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from handmap_qp.mapping.method import Method
from handmap_qp.mapping.presets import PRESETS, get_preset

METHODS: Mapping[str, Callable[..., Method]] = MappingProxyType(
    {"homogeneous": get_preset("paper").method.replaced}
    | {name: preset.method.replaced for name, preset in PRESETS.items()}
)
"""Constructor of each method, by the name of its preset; `homogeneous` is the paper's."""
