"""Colours and pieces of HTML that the gauges share."""

from __future__ import annotations

from collections.abc import Sequence

from handmap_qp.viewer.figure import Colour, as_bytes

HUMAN, FIRST, SECOND = "#8a8f98", "#2166d8", "#0b8f7c"
"""The human hand's values, the robot's, and those of the robot that it is compared with."""
GREY, RED, ORANGE = "#9aa0a8", "#d62929", "#f08c00"


def legend(entries: Sequence[tuple[str, str]]) -> str:
    """Return a legend of coloured dots as HTML.

    Args:
        entries: Names and colours.
    """
    return small_text(
        " ".join(
            f'<span style="white-space:nowrap"><b style="color:{colour}">●</b> {name}&ensp;</span>'
            for name, colour in entries
        )
    )


def small_text(html: str) -> str:
    """Return a small line of text as HTML."""
    return f'<div style="font-size:11px;line-height:15px;padding:0 14px;color:#666">{html}</div>'


def css(colour: Colour) -> str:
    """Return a colour as CSS names it."""
    return f"rgb({', '.join(map(str, as_bytes(colour)))})"
