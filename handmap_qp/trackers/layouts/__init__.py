"""Layouts of trackers, by name or by file.

A layout is a table, a YAML file of this folder or one of the user's own, not code. Other packages
add layouts by entry points of the group `handmap_qp.layouts`. They are loaded at the first use.

    layout = load_layout("openxr26")
    sample = layout.read(poses, time=0.0, side="right")     # a HumanSample
    values = layout.write(sample)                           # the same in the layout's own form
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

from handmap_qp.plugins import Plugins

if TYPE_CHECKING:
    from handmap_qp.trackers.layouts.base import Layout


def _own() -> Mapping[str, Layout]:
    return import_module(f"{__name__}.tables").read_tables()


def _is_layout(found: Any) -> bool:
    return isinstance(found, import_module(f"{__name__}.base").Layout)


LAYOUTS: Mapping[str, Layout] = Plugins(
    "handmap_qp.layouts", _own, _is_layout, "a Layout"
)
"""All layouts by name."""
