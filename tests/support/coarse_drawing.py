"""Pictures of hands with a sample a pixel: what is drawn, and where, is the same, in less time."""

from __future__ import annotations

from functools import partial

import pytest

from handmap_qp.apps.drawing import contact_sheet
from handmap_qp.apps.drawing.raster import render


def draw_coarsely(patch: pytest.MonkeyPatch) -> None:
    """Let contact sheets draw hands so, until the patch is undone."""
    patch.setattr(contact_sheet, "render", partial(render, supersampling=1))
