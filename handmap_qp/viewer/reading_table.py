"""Point error, wrist error and pinch gaps of an instant as HTML: `reading_table`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from handmap_qp.viewer.markup import FIRST, HUMAN, SECOND
from handmap_qp.viewer.readings import Readings

# Gaps longer than this fill the whole bar [m].
_LONGEST_GAP = 0.15
_CELL = "padding:0 0 0 8px;text-align:right;white-space:nowrap"


def reading_table(
    labels: Sequence[str], readings: Sequence[Readings], human: Mapping[str, float]
) -> str:
    """Return the numbers of one instant.

    Args:
        labels: Names of the methods, one or two.
        readings: Their numbers.
        human: The human's pinch gaps [m], by the finger's name.

    Returns:
        The HTML.
    """
    colours = (FIRST, SECOND)
    heads = "".join(
        f'<th style="{_CELL};color:{colour};font-weight:600">{escape(label)}</th>'
        for label, colour in zip(labels, colours, strict=False)
    )
    rows = "".join(
        f'<tr><td style="color:#666">{name}</td>'
        + "".join(f'<td style="{_CELL}">{text(reading)}</td>' for reading in readings)
        + "</tr>"
        for name, text in (
            ("point error, mean", lambda reading: _millimetres(reading.error, 0)),
            ("point error, largest", lambda reading: _millimetres(reading.error, 1)),
            ("wrist position error", lambda reading: _millimetres(reading.wrist, 0)),
            ("wrist rotation error", _wrist_angle),
        )
    )
    return (
        '<div style="font-size:11px;line-height:15px;padding:2px 14px">'
        f'<table style="width:100%;border-collapse:collapse"><tr><th></th>{heads}</tr>{rows}'
        f"</table>{_pinches(readings, human, colours)}</div>"
    )


def _pinches(
    readings: Sequence[Readings], human: Mapping[str, float], colours: Sequence[str]
) -> str:
    """Return the gaps between the thumb and each finger, as bars and numbers."""
    fingers = dict.fromkeys([name for reading in readings for name in reading.pinches])
    if not fingers:
        return ""
    rows = []
    for finger in fingers:
        values = [human.get(finger), *(reading.pinches.get(finger) for reading in readings)]
        entries = list(zip(values, (HUMAN, *colours), strict=False))
        bars = "".join(
            f'<div style="height:4px;margin:1px 0;width:{_share(value):.1f}%;'
            f'background:{colour}"></div>'
            for value, colour in entries
        )
        numbers = "".join(
            f'<span style="display:inline-block;width:30px;text-align:right;color:{colour}">'
            f"{_number(value)}</span>"
            for value, colour in entries
        )
        rows.append(
            '<div style="display:flex;align-items:center;margin-top:1px">'
            f'<span style="width:44px;color:#666">{escape(finger)}</span>'
            f'<span style="flex:1;background:#f1f2f4">{bars}</span>{numbers}</div>'
        )
    return (
        '<div style="margin-top:4px"><b style="font-weight:600">pinch gaps [mm]</b>'
        ' <span style="color:#666">thumb to finger: </span>'
        f'<span style="color:{HUMAN}">human</span>'
        f'<span style="color:#666">, </span><span style="color:{FIRST}">robot</span>'
        f"</div>{''.join(rows)}"
    )


def _share(gap: float | None) -> float:
    """Return a bar's length [%]."""
    return 0.0 if gap is None else 100.0 * float(np.clip(gap / _LONGEST_GAP, 0.0, 1.0))


def _number(gap: float | None) -> str:
    return "-" if gap is None else f"{1e3 * gap:.0f}".replace("-0", "0")


def _millimetres(pair: tuple[float, float] | None, which: int) -> str:
    return "-" if pair is None else f"{1e3 * pair[which]:.1f} mm"


def _wrist_angle(reading: Readings) -> str:
    return "-" if reading.wrist is None else f"{np.degrees(reading.wrist[1]):.1f}°"
