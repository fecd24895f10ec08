"""Where the views of a contact sheet are."""

from __future__ import annotations

from handmap_qp.apps.drawing.contact_sheet import CELL, VIEWS
from handmap_qp.apps.drawing.sheet import LEFT, TOP


def cell_of(column: int, row: int, view: int) -> tuple[int, int]:
    """Left and upper edge of a view in the picture [pixel]; column 0 is the human's."""
    width, height = CELL
    return LEFT + (column * len(VIEWS) + view) * width, TOP + row * height
