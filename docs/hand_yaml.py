"""Write the field reference of `hand_yaml.md` from the classes of `handmap_qp.hands.spec`.

Run `python docs/hand_yaml.py` after a field has changed; a test compares the page with the classes.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import msgspec

from handmap_qp.hands.spec import (
    ArmSpec,
    CollisionSpec,
    HandSpec,
    LimitSpec,
    MimicSpec,
    PadSpec,
    PalmSpec,
    PointSpec,
    WristSpec,
)

PAGE = Path(__file__).with_name("hand_yaml.md")
BEGIN, END = "<!-- reference: docs/hand_yaml.py -->", "<!-- end of the reference -->"
SECTIONS: dict[str, type[msgspec.Struct]] = {
    "The hand": HandSpec,
    "`palm`": PalmSpec,
    "`wrist`": WristSpec,
    "`points`: one of them": PointSpec,
    "`pad`: of one point": PadSpec,
    "`collision`": CollisionSpec,
    "`limits`: of one joint": LimitSpec,
    "`mimic`: of one joint": MimicSpec,
    "`arm`": ArmSpec,
}
# Set by the reader of the file, not a key of it.
_NOT_KEYS = ("directory", "file")


def reference() -> str:
    """Return the reference of all keys as Markdown."""
    parts = []
    for title, kind in SECTIONS.items():
        parts += [f"### {title}", "", f"{_summary(kind)}", ""]
        parts += ["| key | type | default | meaning |", "|---|---|---|---|"]
        meanings = attribute_texts(kind)
        for field in msgspec.structs.fields(kind):
            if field.name not in _NOT_KEYS:
                default = _default(field)
                parts.append(
                    f"| `{field.name}` | {_type(field.type)} | {default} | {meanings[field.name]} |"
                )
        parts.append("")
    return "\n".join(parts).rstrip()


def attribute_texts(kind: type) -> dict[str, str]:
    """Return the description of each attribute in a class's Google docstring."""
    text = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")[2]
    found: dict[str, str] = {}
    name = ""
    for line in text.splitlines():
        if match := re.match(r"    (\w+): (.*)", line):
            name = match[1]
            found[name] = match[2]
        elif line.startswith("        ") and name:
            found[name] += " " + line.strip()
        elif line and not line.startswith(" "):
            break
    return {name: text.replace("|", "\\|") for name, text in found.items()}


def page() -> str:
    """Return the page with the reference written again."""
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{reference()}\n{END}{after}"


def _summary(kind: type) -> str:
    text = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:")[0]
    return " ".join(text.split())


def _type(kind: Any) -> str:
    """Return a type as YAML has it."""
    text = str(kind) if not isinstance(kind, type) else kind.__name__
    text = re.sub(r"typing\.|handmap_qp\.hands\.spec\.", "", text)
    text = re.sub(r"Annotated\[(.+), msgspec\.Meta\(.*?\)\]", r"\1", text)
    if literal := re.search(r"Literal\[([^\]]+)\]", text):
        return " or ".join(f"`{word.strip()[1:-1]}`" for word in literal[1].split(","))
    names = {
        "tuple[float, float, float]": "3 numbers",
        "dict[str, float]": "numbers by joint",
        "dict[str, tuple[float, float, float]]": "3 numbers by shape",
        "tuple[tuple[str, str], ...]": "list of pairs",
        "dict[str, tuple[str, ...]]": "lists of names",
        "tuple[str, ...]": "list of names",
        "tuple[PointSpec, ...]": "list of points",
        "dict[str, LimitSpec]": "limits by joint",
        "dict[str, MimicSpec | None]": "rules by joint",
        "dict[str, Any]": "values by name",
        "str": "text",
        "float": "number",
        "bool": "`true` or `false`",
        "PalmSpec": "keys below",
        "WristSpec": "keys below",
        "CollisionSpec": "keys below",
        "ArmSpec": "keys below",
        "PadSpec": "keys below",
    }
    text = text.removesuffix(" | None") if text not in names else text
    return names[text]


def _default(field: Any) -> str:
    if field.default_factory is not msgspec.NODEFAULT:
        return "none"
    if field.default is msgspec.NODEFAULT:
        return "required"
    if field.default in (None, ()) or field.default == {}:
        return "none"
    if isinstance(field.default, bool):
        return f"`{str(field.default).lower()}`"
    if isinstance(field.default, tuple):
        return f"`[{', '.join(f'{value:g}' for value in field.default)}]`"
    return f"`{field.default}`"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
