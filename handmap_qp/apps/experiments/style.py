"""Common style of the pictures of paper and demo."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec

from handmap_qp.apps.drawing.hands import require_matplotlib

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, PALE = "#222831", "#8a929c"
COLOURS = ("#c8452f", "#2f7d6b", "#3f6fb5", "#c48a1d", "#7a56a6")
STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": PALE,
    "axes.linewidth": 0.8,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e7eb",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "xtick.color": PALE,
    "ytick.color": PALE,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.8,
    "legend.frameon": False,
    "figure.dpi": 160,
    "savefig.dpi": 160,
    "figure.facecolor": "white",
    # A fixed salt: the same numbers must give the same file.
    "svg.hashsalt": "handmap",
}

_Arguments = ParamSpec("_Arguments")


def styled(draw: Callable[_Arguments, Figure]) -> Callable[_Arguments, Figure]:
    """Decorate a drawing function to use `STYLE`, without changing matplotlib's settings."""

    @wraps(draw)
    def drawn(*arguments: _Arguments.args, **named: _Arguments.kwargs) -> Figure:
        with require_matplotlib().rc_context(STYLE):
            return draw(*arguments, **named)

    return drawn


def new_figure(**settings: Any) -> Figure:
    """Return an empty figure; settings as of `matplotlib.figure.Figure`."""
    from matplotlib.figure import Figure

    return Figure(**settings)


def words(name: str) -> str:
    """Replace the underscores of a name by spaces."""
    return name.replace("_", " ")
