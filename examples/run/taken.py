"""The Python of `handmap_run`: files of this tree that need numpy and msgspec alone, renamed.

    python taken.py FOLDER        # writes FOLDER/handmap_run, all but the compiled core

A robot's computer runs what `handmap_qp` runs, so there is no second text of it: files are taken as
they are, but for the name of the package and for what numpy 1.26, or an environment without
Pinocchio and scipy, does not have. Files in `run` take the place of those that need more.
"""

from __future__ import annotations

import ast
import shutil
import sys
from pathlib import Path

NAME = "handmap_run"
ROOT = Path(__file__).parents[2] / "handmap_qp"
OWN = Path(__file__).with_name("run")

TAKEN = """
errors se3 options
human/recording human/sample
ik/core ik/limits ik/options ik/qp ik/tasks ik/collision
mapping/alignment mapping/decomposition mapping/estimation mapping/mapper mapping/method
mapping/palm mapping/methods/__init__ mapping/methods/homogeneous mapping/methods/teleoperation
stream/follower stream/following stream/guard stream/step_table
trackers/hand_geometry trackers/plausibility trackers/wrist_axes
client/__init__ client/messages
"""
DATA = ("human/rules.json", "trackers/proportions.json")

# What is written otherwise: the name, then what is missing here.
CHANGES = (
    ("handmap_qp", NAME),
    ("import pinocchio as pin", f"from {NAME} import rotations as pin"),
    ("import daqp\n", ""),
    ("scipy.spatial.transform", f"{NAME}.quaternions"),
    # numpy 2 has these.
    (".mT", ".swapaxes(-1, -2)"),
    ("np.vecdot(", 'np.einsum("...i,...i", '),
)
# Constants of files that need more than numpy.
CONSTANTS = {
    "hands/hand": ("LONGEST_STOP",),
    "hands/human": ("FINGERS", "THUMB", "CONTACT_GAP"),
    "hands/shape_pairs": ("LINK_MARGIN",),
    "hands/spec": ("OTHER_SIDE", "UPRIGHT"),
}
# These run beside `handmap_qp`, whose objects they write down.
BESIDE = ("command.py", "saving.py")
# Names of a package that are in a file of `run`.
ELSEWHERE = {"ik": {"PointIk": "saved"}}


def changed(text: str) -> str:
    """Return the text of a file as it is in `handmap_run`."""
    for before, after in CHANGES:
        text = text.replace(before, after)
    return text


def package_text(folder: Path) -> str:
    """Return the `__init__.py` of a package whose names are those of its `__init__.pyi`."""
    stub = ast.parse((folder / "__init__.pyi").read_text(encoding="utf-8"))
    homes = {
        alias.name: node.module or alias.name
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    homes |= ELSEWHERE.get(folder.name, {})
    return f"from {NAME}.lazy import named\n\n__getattr__ = named(__name__, {homes})\n"


def constants_text() -> str:
    """Return the lines of the tree that give `CONSTANTS` their values."""
    lines = []
    for name, wanted in CONSTANTS.items():
        text = (ROOT / f"{name}.py").read_text(encoding="utf-8")
        for node in ast.parse(text).body:
            if isinstance(node, ast.Assign):
                given = {ast.unparse(target) for target in node.targets}
            elif isinstance(node, ast.AnnAssign):
                given = {ast.unparse(node.target)}
                node.annotation = ast.Name("dict")
            else:
                continue
            if given & {*wanted}:
                lines.append(f"{ast.unparse(node)}\n")
    return "".join(lines)


def write_package(folder: Path) -> Path:
    """Write the package into a folder, all but the compiled core; return it."""
    package = folder / NAME
    shutil.rmtree(package, ignore_errors=True)
    texts = {f"{name}.py": ROOT / f"{name}.py" for name in TAKEN.split()}
    texts |= {str(file.relative_to(OWN)): file for file in OWN.rglob("*.py")}
    written = {name: file.read_text(encoding="utf-8") for name, file in texts.items()}
    written = {
        name: text if name in BESIDE else changed(text)
        for name, text in written.items()
    }
    written["hands/__init__.py"] += constants_text()
    for name in ("human", "ik", "mapping", "stream", "trackers"):
        written[f"{name}/__init__.py"] = package_text(ROOT / name)
    written |= {name: (ROOT / name).read_text(encoding="utf-8") for name in DATA}
    for name, text in written.items():
        target = package / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")
    return package


if __name__ == "__main__":
    write_package(Path(sys.argv[1]))
