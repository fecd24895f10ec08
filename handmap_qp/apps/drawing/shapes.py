"""The shapes of a URDF's links as meshes of trimesh: `read_shapes`."""

import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from handmap_core.errors import require
from handmap_qp.hands import (
    BIG_FILE,
    MOST_TRIANGLES,
    CoarseMesh,
    Hand,
    add_stand_ins,
    coarsen_triangles,
    get_numbers,
    is_missing,
    origin_of,
    parse_urdf,
    read_big_mesh,
)
from .raster import Colour

LinkShape = tuple[list[Any], Colour | None]
"""Meshes of trimesh, several of some files, and their colour; None for that of the file."""


def read_shapes(hand: Hand, kind: str) -> dict[str, list[LinkShape]]:
    """Read the shapes of each link that has any, in the link's frame [m].

    Stand-ins take the place of meshes that are missing (`add_stand_ins`), and of all shapes if
    there are none; other meshes that cannot be read are left out.

    Args:
        hand: The hand.
        kind: `visual` or `collision`.

    Raises:
        HandError: If a shape lacks its numbers.
        MissingExtraError: If trimesh is not installed.
    """
    robot = parse_urdf(hand.urdf_text)
    if not [*robot.iterfind("link/*/geometry")]:
        # Every link gets a stand-in.
        for link in robot.iterfind("link"):
            ET.SubElement(ET.SubElement(ET.SubElement(link, kind), "geometry"), "mesh")
    add_stand_ins(robot, kind, is_missing)
    named = {each.get("name"): each for each in robot.iter("material") if len(each)}
    found = {}
    for link in robot.iterfind("link"):
        shapes = [
            (meshes, _colour(shape.find("material"), named))
            for shape in link.iterfind(kind)
            if (meshes := shape_meshes(shape))
        ]
        if shapes:
            found[link.get("name", "")] = shapes
    return found


def shape_meshes(shape: ET.Element, miss: Callable[[str], object] = str) -> list[Any]:
    """Read one shape in the frame of its link; a file may hold several meshes.

    Args:
        shape: A `<visual>` or `<collision>` element of `Hand.urdf_text`.
        miss: Called with the name of a file that cannot be read.
    """
    return [
        mesh.apply_transform(origin_of(shape))
        for solid in shape.iterfind("geometry/*")
        for mesh in _meshes(solid, miss)
    ]


def _meshes(solid: ET.Element, miss: Callable[[str], object]) -> list[Any]:
    """Return the meshes of a URDF geometry; those of a file may be several."""
    trimesh = require("trimesh", "plot")
    made = trimesh.creation
    match solid.tag:
        case "box":
            return [made.box(get_numbers(solid, "size", 3))]
        case "sphere":
            (radius,) = get_numbers(solid, "radius", 1)
            # One of no size has no surface.
            return [made.icosphere(3, radius)] if radius > 0.0 else []
        case "cylinder":
            size = (get_numbers(solid, key, 1)[0] for key in ("radius", "length"))
            return [made.cylinder(*size, sections=40)]
        case "mesh":
            name = solid.get("filename", "")
            scale = get_numbers(solid, "scale", 3, "1 1 1")
            # Mesh readers raise many types; the other shapes do without this one.
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    found = _read_meshes(name)
            except Exception:
                miss(Path(name).name)
                return []
            solids = [each for each in found if len(each.faces)]
            # Other files with the name of a mesh are read as one without faces.
            if not solids:
                miss(Path(name).name)
            # Faces of a mirrored mesh are turned over.
            return [each.apply_scale(scale) for each in solids]
    return []


def _read_meshes(file: str) -> list[Any]:
    """Read the meshes of a file, which the caller may change; of big ones fewer triangles.

    A big mesh has one colour.

    Raises:
        Exception: Of any type, if it cannot be read.
    """
    size = Path(file).stat()
    meshes = _read(file, size.st_mtime_ns, size.st_size)
    return [mesh.copy() for mesh in meshes]


# A file is read several times: shown, measured, and compared with what collides.
@lru_cache(maxsize=64)
def _read(file: str, _: int, size: int) -> list[Any]:
    if size <= BIG_FILE:
        return require("trimesh", "plot").load_scene(file).dump()
    if big := read_big_mesh(file):
        return [_meshed(big)]
    return [
        _coarse(mesh) if len(mesh.faces) > MOST_TRIANGLES else mesh
        for mesh in require("trimesh", "plot").load_scene(file).dump()
    ]


def _coarse(mesh: Any) -> Any:
    """Return a mesh with fewer triangles, in its main colour."""
    coarse = _meshed(coarsen_triangles(mesh.vertices, mesh.faces))
    painted = mesh.visual.material if mesh.visual.kind == "texture" else mesh.visual
    coarse.visual.face_colors = painted.main_color
    return coarse


def _meshed(mesh: CoarseMesh) -> Any:
    trimesh = require("trimesh", "plot")
    return trimesh.Trimesh(mesh.vertices.copy(), mesh.faces.copy(), process=False)


def _colour(
    material: ET.Element | None, named: dict[str | None, ET.Element]
) -> Colour | None:
    """Return the colour of a URDF material, its own or by name; None without one."""
    if material is not None and not len(material):
        material = named.get(material.get("name"))
    colour = None if material is None else material.find("color")
    if colour is None:
        return None
    red, green, blue, _ = get_numbers(colour, "rgba", 4)
    return red, green, blue
