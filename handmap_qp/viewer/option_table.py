"""Options of a mapping as text, and as a table of a page: `option_texts`, `option_table`."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from html import escape
from typing import Any

from handmap_qp.viewer.sample import Variant


def option_texts(*parts: Any) -> dict[str, tuple[str, bool]]:
    """Return options as text, and whether each differs from its default.

    Args:
        parts: Objects with options as fields, such as a method and `IkOptions`.
    """
    texts = {}
    for part in parts:
        usual = type(part)() if is_dataclass(part) else None
        for item in fields(part) if is_dataclass(part) else ():
            value = getattr(part, item.name)
            texts[item.name] = _text(value), _text(value) != _text(getattr(usual, item.name))
    return texts


def option_table(variant: Variant) -> str:
    """Return the options of a robot's method as HTML; those that differ are marked."""
    rows = "".join(
        f"<tr{' class=changed' if is_changed else ''}><td>{escape(name.replace('_', ' '))}</td>"
        f"<td>{escape(text)}</td></tr>"
        for name, (text, is_changed) in variant.options.items()
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
