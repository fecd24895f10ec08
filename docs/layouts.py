"""Write a page for each tracker from the tables of layouts, and draw their pictures.

Run `python docs/layouts.py` after a table has changed; a test compares the pages with the tables.
`--no-pictures` leaves the pictures as they are.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from PIL import Image

from handmap_qp.apps.drawing.layout_pictures import save_layout_picture
from handmap_qp.trackers.layouts import LAYOUTS
from handmap_qp.trackers.layouts.base import Layout

DOCS = Path(__file__).parent
OVERVIEW = DOCS / "trackers.md"
PICTURES = DOCS / "images"
BEGIN, END = "<!-- table: docs/layouts.py -->", "<!-- end of the table -->"
READ = """
    handmap retarget recording.npz --layout {name} --robot allegro_right

In Python, `load_layout("{name}").read(values, time=seconds, side="right")` reads one sample. In a
session of the service, open it with `layout="{name}"`. See also [Trackers](../trackers.md).
"""
LEGEND = (
    "Blue points are landmarks, grey points are ignored. Arrows are the axes of the wrist pose: x "
    "red, y green, z\nblue. Lines connect the index of an angle with its joint."
)


def page(layout: Layout) -> str:
    """Return the page of one layout as Markdown."""
    lines = [f"# {layout.name}", "", f"{layout.title}.", READ.format(name=layout.name)]
    lines += [f"![{layout.name}](../images/layout_{layout.name}.png)", ""]
    lines += [LEGEND, ""]
    facts = {
        "one sample": layout.values,
        "shapes": _shapes(layout),
        "unit": layout.unit,
        "axes": layout.axes,
    }
    if layout.mirror:
        facts["handedness"] = f"left-handed; {layout.mirror} is negated"
    facts["wrist pose"] = _wrist(layout)
    facts["not given"] = "; ".join(layout.missing) or "-"
    lines += [
        "| | |",
        "|---|---|",
        *(f"| {name} | {text} |" for name, text in facts.items()),
        "",
    ]
    index, name, *ours = layout.rows()[0]
    lines += [f"| {index} | {name} | {' / '.join(ours)} |", "|---|---|---|"]
    lines += [f"| {a} | {b} | {c} |" for a, b, c in _order(layout)]
    sources = ", ".join(_link(source) for source in layout.sources)
    return "\n".join([*lines, "", f"Sources: {sources}", ""])


def overview(text: str) -> str:
    """Return the page of all trackers with a new table."""
    head, _, rest = text.partition(BEGIN)
    _, _, tail = rest.partition(END)
    rows = [
        f"| [{layout.name}](trackers/{layout.name}.md) | {layout.title} "
        f"| {_shapes(layout)} |"
        for layout in LAYOUTS.values()
    ]
    table = "\n".join(
        ["| layout | tracker | shape of a sample |", "|---|---|---|", *rows]
    )
    return f"{head}{BEGIN}\n{table}\n{END}{tail}"


def pages() -> dict[Path, str]:
    """Return the text of every page by its file."""
    found = {
        DOCS / "trackers" / f"{layout.name}.md": page(layout)
        for layout in LAYOUTS.values()
    }
    return {OVERVIEW: overview(OVERVIEW.read_text(encoding="utf-8")), **found}


def _shapes(layout: Layout) -> str:
    return " or ".join(f"`{shape}`" for shape in layout.shapes)


def _wrist(layout: Layout) -> str:
    table = layout.wrist
    if table is None:
        return (
            "fitted"
            if layout.has_wrist
            else "none; the palm is fitted to the landmarks"
        )
    where = (
        f"in the values (`{table.joint}`)" if layout.has_wrist else "beside the values"
    )
    axes = f"fingers along {table.right.distal}, back of the hand along {table.right.dorsal}"
    if table.left is not None:
        axes += f"; of a left hand {table.left.distal} and {table.left.dorsal}"
    return f"{where}; {axes}; quaternions {getattr(layout, 'quaternion', table.quaternion)}"


def _order(layout: Layout) -> list[tuple[str, str, str]]:
    """Return index, the tracker's name and ours; joints that are not read in one row."""
    rows = []
    for row in layout.rows():
        index, name, *ours = row.values()
        own = " / ".join(str(value) for value in ours if value)
        rows.append((str(index), str(name), own.replace("|", "")))
    merged: list[tuple[str, str, str]] = []
    for is_used, group in groupby(rows, key=lambda row: bool(row[2])):
        found = list(group)
        if is_used or len(found) == 1:
            merged += [(a, b, c or "-") for a, b, c in found]
        else:
            merged.append((f"{found[0][0]}-{found[-1][0]}", f"{found[0][1]} ...", "-"))
    return merged


def _link(source: str) -> str:
    return f"<{source}>" if source.startswith("http") else f"`{source}`"


def main(words: Sequence[str]) -> None:
    """Write the pages, and the pictures."""
    for file, text in pages().items():
        file.parent.mkdir(exist_ok=True)
        file.write_text(text, encoding="utf-8")
        print(f"wrote {file}")
    if "--no-pictures" in words:
        return
    for layout in LAYOUTS.values():
        file = PICTURES / f"layout_{layout.name}.png"
        save_layout_picture(layout, file)
        # A palette takes a third of the space.
        Image.open(file).convert("RGB").quantize(
            128, method=Image.Quantize.MAXCOVERAGE
        ).save(file, optimize=True)
        print(f"wrote {file}")


if __name__ == "__main__":
    main(sys.argv[1:])
