"""The point error over time as a picture in a page: `error_plot`."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from handmap_qp.viewer.markup import FIRST, GREY, ORANGE, SECOND, legend
from handmap_qp.viewer.sample import Variant

_WIDTH, _HEIGHT, _LEFT, _TOP = 228.0, 86.0, 30.0, 8.0
# A line has at most this many points.
_MOST_POINTS = 456


def error_plot(variants: Sequence[Variant]) -> str:
    """Return the mean point error of each robot, and the first one's largest, as HTML.

    The line with the id `handmap-now` marks the time. It is to be moved by up to `data-width`.
    """
    rows = []
    for variant in variants:
        errors = [1e3 * sample.point_error for sample in variant.samples]
        rows.append([error.mean() if len(error) else np.nan for error in errors])
        if not rows[1:]:
            rows.append([error.max() if len(error) else np.nan for error in errors])
    if not np.isfinite(rows).any():
        return ""
    time = np.array([sample.time for sample in variants[0].samples])
    span = max(float(time[-1] - time[0]), 1e-3)
    top = _round_up(float(np.nanmax(rows)))
    x = _WIDTH * (time - time[0]) / span
    colours = (FIRST, GREY, SECOND)
    lines = "".join(
        f'<path d="{_path(x, _HEIGHT * (1.0 - np.array(row) / top))}" fill="none" '
        f'stroke="{colour}"/>'
        for row, colour in reversed(list(zip(rows, colours, strict=False)))
    )
    grid = "".join(
        f'<g transform="translate(0 {_HEIGHT * (1 - share):.1f})"><path d="M0 0h{_WIDTH}" '
        f'stroke="#e6e8eb"/><text x="-4" y="3.5" text-anchor="end">{share * top:g}</text></g>'
        for share in (0.0, 0.5, 1.0)
    )
    times = "".join(
        f'<text x="{_WIDTH * share:.1f}" y="{_HEIGHT + 13}" text-anchor="{anchor}">'
        f"{share * span:.1f}{unit}</text>"
        for share, anchor, unit in ((0.0, "start", ""), (0.5, "middle", ""), (1.0, "end", " s"))
    )
    names = [(variants[0].label if variants[1:] else "mean", FIRST), ("largest", GREY)]
    names += [(variant.label, SECOND) for variant in variants[1:]]
    return (
        '<div style="padding:4px 14px 0;font-size:11px;font-weight:600">point error [mm]</div>'
        f'<svg viewBox="0 0 {_LEFT + _WIDTH + 14} {_TOP + _HEIGHT + 18}" style="width:100%;'
        'display:block;font:10px system-ui,sans-serif" fill="#666">'
        f'<g transform="translate({_LEFT} {_TOP})">{grid}{times}{lines}'
        f'<path id="handmap-now" data-width="{_WIDTH}" d="M0 0v{_HEIGHT}" stroke="{ORANGE}" '
        f'stroke-width="2"/></g></svg>' + legend([(escape(name), colour) for name, colour in names])
    )


def _path(x: np.ndarray, y: np.ndarray) -> str:
    """Return an SVG path with gaps where y is NaN; each bin of samples gives its highest point."""
    starts = np.linspace(0, len(x), min(len(x), _MOST_POINTS), endpoint=False).astype(int)
    words, is_pen_down = [], False
    for i, height in zip(starts, np.fmin.reduceat(y, starts), strict=True):
        if np.isfinite(height):
            words.append(f"{'L' if is_pen_down else 'M'}{x[i]:.1f} {height:.1f}")
        is_pen_down = bool(np.isfinite(height))
    return "".join(words)


def _round_up(value: float) -> float:
    """Return the next round number above a value."""
    decade = 10.0 ** np.floor(np.log10(max(value, 1e-3)))
    return float(
        next(
            step * decade
            for step in (1.0, 2.0, 4.0, 6.0, 8.0, 10.0)
            if step * decade >= value * (1 - 1e-9)
        )
    )
