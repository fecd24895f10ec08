"""Options of a mapping as a table of a page."""

from __future__ import annotations

from html import escape
from typing import Any

from handmap_qp.viewer.sample import Variant


def option_table(variant: Variant) -> str:
    """Return the options of a robot's method as HTML; those that are no defaults are marked."""
    parts = (variant.choice.method, variant.choice.ik)
    rows = "".join(
        f"<tr{' class=changed' if name in type(part)().changes_to(part) else ''}>"
        f"<td>{escape(name.replace('_', ' '))}</td><td>{escape(_text(value))}</td></tr>"
        for part in parts
        for name, value in part.values.items()
    )
    return (
        f"<details open><summary>options: {escape(variant.label)}</summary>"
        f'<table class="options">{rows}</table></details>'
    )


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    return "none" if value is None else str(value)
