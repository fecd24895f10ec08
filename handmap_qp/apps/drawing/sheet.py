"""A sheet of pictures with a row for each moment or pose, and titles: `draw_sheet`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from handmap_core.errors import expect
from handmap_core.se3 import Array
from handmap_qp.hands import Values
from .hands import require_matplotlib

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEFT = 118
"""Width of the column with the names of the rows [pixel]."""
TOP = 54
"""Height of the titles [pixel]."""
_BOTTOM = 30
_DPI = 100
_RULE = 0.86
_INK, _PALE = "#222831", "#6b7280"


class SheetColumn(NamedTuple):
    """A column of pictures.

    Attributes:
        title: Printed above it.
        note: Printed below the title, in small letters.
        pictures: A picture for each row: red, green and blue from 0 to 1, shape
            (rows, height, width, 3).
    """

    title: str
    note: str
    pictures: Array


def draw_sheet(
    columns: Sequence[SheetColumn],
    rows: Sequence[tuple[str, str]],
    *,
    title: str = "",
    footnote: str = "",
) -> Figure:
    """Put pictures into a grid.

    Args:
        columns: The columns, whose pictures have one height.
        rows: Name of each row, and what else is to be said about it: a line or more.
        title: Printed above the names of the rows.
        footnote: Printed below the pictures.

    Returns:
        The sheet, one pixel per pixel at its own resolution.

    Raises:
        InvalidInputError: If there are no rows.
        MissingExtraError: If matplotlib is not installed.
    """
    expect(rows, "rows", "at least one", got="none")
    cell_height = columns[0].pictures.shape[1]
    pictures = np.concatenate([column.pictures for column in columns], axis=2)
    sheet = pictures.reshape(len(rows) * cell_height, -1, 3)
    margins = (TOP, _BOTTOM), (LEFT, 0), (0, 0)
    canvas = np.pad(sheet, margins, constant_values=1.0)
    widths = [column.pictures.shape[2] for column in columns]
    edges = LEFT + np.cumsum([0, *widths])
    bottom = TOP + len(sheet)
    canvas[TOP - 1 : bottom : cell_height] = _RULE
    canvas[TOP - 1 : bottom, edges[:-1]] = _RULE
    height, width = canvas.shape[:2]
    with require_matplotlib().rc_context({"font.family": "DejaVu Sans"}):
        from matplotlib.figure import Figure

        figure = Figure((width / _DPI, height / _DPI), _DPI, facecolor="white")
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.imshow(canvas, extent=(0.0, width, height, 0.0), interpolation="nearest")
        axes.set_axis_off()
        bold: Values = {"color": _INK, "fontweight": "bold", "va": "center"}
        pale: Values = {"color": _PALE, "va": "center"}
        middles = 0.5 * (edges[:-1] + edges[1:])
        for column, middle in zip(columns, middles, strict=True):
            axes.text(middle, 24, column.title, ha="center", fontsize=10, **bold)
            axes.text(middle, 43, column.note, ha="center", fontsize=6.5, **pale)
        for i, (name, note) in enumerate(rows):
            centre = TOP + (i + 0.5) * cell_height
            axes.text(10, centre - 8, name, fontsize=9.5, **bold)
            axes.text(10, centre + 4, note, fontsize=7.5, color=_PALE, va="top")
        axes.text(10, 24, title, fontsize=7, **pale)
        axes.text(10, height - 0.5 * _BOTTOM, footnote, fontsize=8, **pale)
    return figure
