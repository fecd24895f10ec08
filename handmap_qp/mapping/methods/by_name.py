"""The mapping methods of the package, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType

from handmap_qp.mapping.method import Method
from handmap_qp.mapping.methods.homogeneous import Homogeneous
from handmap_qp.mapping.presets import PRESETS

METHODS: Mapping[str, Callable[[], Method]] = MappingProxyType(
    {"homogeneous": Homogeneous}
    | {name: partial(preset.method.replaced) for name, preset in PRESETS.items()}
)
"""Constructor of each method, by the name of its preset; `homogeneous` is the paper's."""
