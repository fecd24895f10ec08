"""The mapping methods by name."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from .method import PRESETS, Method

METHODS: Mapping[str, Callable[..., Method]] = MappingProxyType(
    {name: preset.method.replaced for name, preset in PRESETS.items()}
)
"""Constructor of each method, by the name of its preset."""
