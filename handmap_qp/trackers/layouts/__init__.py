"""Layouts of trackers, by name or by file.

A layout is a table, a YAML file of this folder or one of the user's own, not code. Other packages
add layouts by entry points of the group `handmap_qp.layouts`. They are loaded at the first use.

    layout = load_layout("openxr26")
    sample = layout.read(poses, time=0.0, side="right")     # a HumanSample
    values = layout.write(sample)                           # the same in the layout's own form
"""

from __future__ import annotations

from collections.abc import Mapping
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from handmap_core.plugins import Plugins

if TYPE_CHECKING:
    from .base import Layout


LAYOUTS: Mapping[str, Layout] = Plugins(
    "handmap_qp.layouts",
    lambda: resolve_name("handmap_qp.trackers.layouts.tables:read_tables")(),
    "handmap_qp.trackers.layouts.base:Layout",
    quest="webxr25",
)
"""All layouts by name; that of the browser of a Quest by its own name, too."""
