"""The layouts of the package, and tables of the user's own: load them by name or by file."""

from pathlib import Path

import msgspec

from handmap_core.errors import InvalidInputError, did_you_mean, expect, reason_of
from . import LAYOUTS
from .angles import AngleLayout
from .base import Layout
from .markers import MarkerLayout
from .points import PointLayout

_FOLDER = Path(__file__).parent


def read_tables() -> dict[str, Layout]:
    """Return the layouts of the package by name."""
    return {file.stem: _load(file) for file in sorted(_FOLDER.glob("*.yaml"))}


def table_text(layout: str | Path) -> str:
    """Return the text of a layout's table, with its comments if it is a file.

    Raises:
        InvalidInputError: See `load_layout`.
    """
    found = load_layout(layout)
    file = _FOLDER / f"{found.name}.yaml" if str(layout) in LAYOUTS else Path(layout)
    if not file.is_file():
        return msgspec.yaml.encode(found).decode()
    return file.read_text(encoding="utf-8")


def load_layout(layout: str | Path | Layout) -> Layout:
    """Load a layout.

    Args:
        layout: Name of a layout, path of a table (`.yaml`), or a layout.

    Raises:
        InvalidInputError: If there is no such layout, or the table is not one.
    """
    if isinstance(layout, Layout):
        return layout
    expect(isinstance(layout, str | Path), "layout", "a name or a path", value=layout)
    name = str(layout)
    if Path(name).suffix in (".yaml", ".yml"):
        return _load(Path(name))
    expect(
        name in LAYOUTS,
        "layout",
        f"one of {', '.join(LAYOUTS)}, or the path of a table (.yaml)",
        value=name,
        advice=did_you_mean(name, LAYOUTS),
    )
    return LAYOUTS[name]


def _load(file: Path) -> Layout:
    try:
        kinds = PointLayout | AngleLayout | MarkerLayout
        return msgspec.yaml.decode(file.read_bytes(), type=kinds)
    # ValueError and TypeError: also those of yaml and msgspec.
    except (OSError, ValueError, TypeError) as error:
        reason = reason_of(error)
        text = f"cannot be read: {reason}" if isinstance(error, OSError) else reason
        raise InvalidInputError(
            f"{file}: {text}", argument="layout", value=str(file)
        ) from error
