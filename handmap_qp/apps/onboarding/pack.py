"""A hand in one folder, small enough to pass on: `pack_hand`.

The folder has the description, the URDF, meshes with few triangles and the licence of the model. It
needs no other package. What the mapping reads stays as it is: collision meshes keep their vertices,
or, where they have many triangles, those of their convex hulls, which is what the mapping uses.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from handmap_core.errors import HandError, expect, require
from handmap_qp.apps.drawing.hands import MAX_MESH_TRIANGLES, simplified
from handmap_qp.hands import load_hand, source_file, urdf_path
from handmap_qp.hands.library import find_file
from handmap_qp.hands.sources import find_mesh, read_urdf
from handmap_qp.output_files import check_new, make_folder, writing

DEFAULT_TRIANGLES = MAX_MESH_TRIANGLES
"""Most triangles of a mesh: pictures show no more."""
_LEAST_TRIANGLES = 12
# Names of the file in which a model's maker says what is allowed.
_LICENCE = re.compile(r"(licen[cs]e|copying)([._-].*)?", re.IGNORECASE)
# A licence lies beside the model, or at most this many folders above it.
_FOLDERS_ABOVE = 3
# The line of a description that says where its URDF is.
_URDF_LINE = re.compile(r"(?m)^urdf:.*$")


class PackedHand(NamedTuple):
    """What `pack_hand` wrote.

    Attributes:
        file: The description.
        meshes: Number of files with meshes.
        size: Size of all files together [bytes].
        licence: The file with the licence of the model; None if none was found.
    """

    file: Path
    meshes: int
    size: int
    licence: Path | None


def pack_hand(
    hand: str | Path,
    folder: Path,
    *,
    triangles: int = DEFAULT_TRIANGLES,
    overwrite: bool = False,
) -> PackedHand:
    """Write a hand with its URDF and its meshes into a folder of its own.

    Args:
        hand: Name of a hand, or path of a hand.yaml.
        folder: The folder; made if there is none.
        triangles: Most triangles of a mesh.
        overwrite: Whether to replace a description that is there.

    Raises:
        HandError: If the hand cannot be read, extends another one, or hangs on an arm; or if a mesh
            is missing.
        InvalidInputError: If the folder has a description already, is the hand's own, or cannot be
            written.
        MissingExtraError: If the package that reads meshes is not installed.
        MissingPackageError: If the package that holds the hand's model is not installed.
    """
    expect(
        triangles >= _LEAST_TRIANGLES,
        "triangles",
        f"at least {_LEAST_TRIANGLES}",
        value=triangles,
    )
    # What is not a hand is not packed.
    spec = load_hand(hand).spec
    source = find_file(hand)
    if spec.arm:
        advice = "pack the hand without the arm"
        raise spec.error(f"it hangs on an arm of another model; {advice}", "arm")
    text = source.read_text(encoding="utf-8")
    if not _URDF_LINE.search(text):
        raise spec.error("it extends another description; pack that one", "extends")
    urdf = urdf_path(spec)
    own = {source.resolve().parent, urdf.resolve().parent}
    is_apart = folder.resolve() not in own
    expect(is_apart, "out", "another folder than the hand's own", value=str(folder))
    file = folder / "hand.yaml"
    check_new("out", file, overwrite=overwrite)
    # It is valid XML: the hand was loaded from it.
    tree: ET.ElementTree[ET.Element] = ET.ElementTree(ET.fromstring(read_urdf(spec)))
    make_folder(folder / "meshes", "out")
    meshes = _MeshFolder(folder, triangles)
    with writing(folder, "out"):
        for mesh, is_felt in _meshes(tree):
            found = find_mesh(mesh.attrib["filename"], urdf.parent)
            mesh.set("filename", meshes.add(found, is_felt))
        ET.indent(tree)
        tree.write(folder / "hand.urdf", encoding="unicode")
        licence = _licence(source_file(spec))
        if licence:
            (folder / "LICENSE").write_bytes(licence.read_bytes())
        # Last: a folder with a description is complete.
        file.write_text(_URDF_LINE.sub("urdf: hand.urdf", text), encoding="utf-8")
    size = sum(each.stat().st_size for each in folder.rglob("*") if each.is_file())
    return PackedHand(file, len(meshes.names), size, licence)


def _meshes(tree: ET.ElementTree[ET.Element]) -> Iterator[tuple[ET.Element, bool]]:
    """Yield each mesh of a URDF, and whether it is a collision shape."""
    for kind in ("visual", "collision"):
        for shape in tree.iter(kind):
            for mesh in shape.iterfind("geometry/mesh"):
                yield mesh, kind == "collision"


class _MeshFolder:
    """Meshes with few triangles, each written once.

    Args:
        folder: Folder of the URDF; the meshes lie in `meshes` there.
        most: Most triangles of a mesh.
    """

    def __init__(self, folder: Path, most: int) -> None:
        self._folder = folder
        self._most = most
        self.names: dict[tuple[Path, str], str] = {}
        """Path in the folder of each file, as it is, as a hull, or with few triangles."""
        self._added: dict[tuple[Path, bool], str] = {}

    def add(self, file: Path, is_felt: bool) -> str:
        """Write a mesh for collisions or for the eye; return its path in the folder.

        Raises:
            HandError: If it cannot be read.
        """
        # Fingers share their meshes: each file is read once.
        if (file, is_felt) not in self._added:
            self._added[file, is_felt] = self._write(file, is_felt)
        return self._added[file, is_felt]

    def _write(self, file: Path, is_felt: bool) -> str:
        trimesh = require("trimesh", "plot")
        try:
            mesh = trimesh.load(file, force="mesh")
        except (OSError, ValueError) as error:
            raise HandError(f"the mesh cannot be read: {error}", file=file) from error
        if not len(mesh.faces):
            raise HandError("the mesh cannot be read: it has no triangles", file=file)
        has_few = len(mesh.faces) <= self._most
        kind = "" if has_few else "_hull" if is_felt else "_few"
        if (file, kind) in self.names:
            return self.names[file, kind]
        stem = f"{file.stem}{kind}"
        suffix = file.suffix if has_few else ".stl"
        name = f"meshes/{stem}{suffix}"
        number = 2
        while name in self.names.values():
            name = f"meshes/{stem}_{number}{suffix}"
            number += 1
        if has_few:
            # To the last bit: a file of another format may round.
            (self._folder / name).write_bytes(file.read_bytes())
        elif is_felt:
            mesh.convex_hull.export(self._folder / name)
        else:
            mesh.merge_vertices(merge_tex=True, merge_norm=True)
            simplified(mesh, self._most).export(self._folder / name)
        self.names[file, kind] = name
        return name


def _licence(model: Path) -> Path | None:
    """Return the licence that lies nearest to a model."""
    for folder in [*model.resolve().parents][: _FOLDERS_ABOVE + 1]:
        found = sorted(
            each
            for each in folder.iterdir()
            if each.is_file() and _LICENCE.fullmatch(each.name)
        )
        if found:
            return found[0]
    return None
