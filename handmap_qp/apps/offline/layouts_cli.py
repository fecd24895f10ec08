"""The command `handmap layouts`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from handmap_core.errors import InvalidInputError
from handmap_qp.apps.arguments import hinted
from handmap_qp.apps.drawing import save_layout_picture
from handmap_qp.apps.tables import print_result
from handmap_qp.hands import Values
from handmap_qp.output_files import check_new, check_output, replaced_file
from handmap_qp.trackers import LAYOUTS, Layout, load_layout, table_text


@dataclass(frozen=True)
class Layouts:
    """List the layouts of trackers, or show one: order, frame and units.

    A layout says how a tracker lays out one sample of a hand. `handmap retarget` and others take
    one by --layout. It is a table; for a tracker of your own, write one with --template, change it,
    and give its path where a name is expected.

    Examples:
        handmap layouts
        handmap layouts openxr26
        handmap layouts manus --template my_glove.yaml
        handmap layouts openxr26 --picture openxr26.png

    Attributes:
        layout: Layout to show: a name, or the path of a table of your own.
        template: Write the layout's table to this file, to start one of your own from.
        picture: Draw the layout's hand with its indices and wrist axes.
        json: Print JSON instead of tables.
    """

    layout: Positional[
        Annotated[str | None, hinted("[LAYOUT]", "(default: list all)")]
    ] = None
    template: Annotated[Path | None, hinted("FILE.yaml")] = None
    picture: Annotated[Path | None, hinted("FILE.png")] = None
    json: bool = False

    def run(self) -> None:
        """Print the list or the layout, and write what is asked for."""
        if self.layout is None:
            self._list()
            return
        layout = load_layout(self.layout)
        if self.template:
            out = check_output("--template", self.template, (".yaml", ".yml"))
            check_new("--template", out, advice="name another file")
            with replaced_file(out, "--template") as file:
                file.write(table_text(self.layout).encode())
        if self.picture:
            out = check_output("--picture", self.picture, (".png",))
            save_layout_picture(layout, out)
        facts = _facts(layout)
        texts = {
            key: "; ".join(fact) if isinstance(fact, list) else fact
            for key, fact in facts.items()
        }
        rows = layout.rows()
        tables = {layout.name: texts, "Order": rows}
        files = filter(None, (self.template, self.picture))
        print_result({**facts, "entries": rows}, tables, files, as_json=self.json)

    def _list(self) -> None:
        """Print all layouts."""
        for name in ("template", "picture"):
            if getattr(self, name):
                raise InvalidInputError(
                    "needs a layout",
                    argument=f"--{name}",
                    advice="name one of `handmap layouts`",
                )
        rows = list(map(_summary, LAYOUTS.values()))
        print_result(rows, {"Layouts": rows}, as_json=self.json)


def _summary(layout: Layout) -> Values:
    """Return one row of the list."""
    wrist = "beside them" if layout.wrist else "none"
    if layout.has_wrist:
        wrist = "in the values"
    return {
        "name": layout.name,
        "tracker": layout.title,
        "one sample": " or ".join(str(shape) for shape in layout.shapes),
        "unit": layout.unit,
        "wrist pose": wrist,
    }


def _facts(layout: Layout) -> Values:
    """Return what the table says, in words."""
    facts: Values = {
        "tracker": layout.title,
        "values": layout.values,
        "one sample": [str(shape) for shape in layout.shapes],
        "unit": layout.unit,
        "axes": layout.axes,
    }
    if layout.mirror:
        facts["left-handed"] = f"{layout.mirror} is negated"
    wrist = layout.wrist
    facts["wrist pose"] = "fitted" if layout.has_wrist else "none; fitted to the palm"
    if wrist:
        own = f"of the joint {wrist.joint}"
        facts["wrist pose"] = [
            own if layout.has_wrist else "given beside the values",
            *(
                f"{side}: fingers along {axes.distal}, back of the hand along {axes.dorsal}"
                for side in ("right", "left")
                if (axes := getattr(wrist, side))
            ),
        ]
        facts["quaternions"] = getattr(layout, "quaternion", wrist.quaternion)
    return facts | {
        "not given": [*layout.missing],
        "arrays in .npz": [*layout.arrays],
        "sources": [*layout.sources],
    }
