"""Geoms of a compiled MuJoCo model as shapes of URDF links, and their meshes."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

import mujoco
import numpy as np

from handmap_qp.hands.urdf import set_numbers
from handmap_qp.se3 import affine, rotation_from_quat_wxyz, rpy_from_rotation

_GEOM = mujoco.mjtGeom
# Rings and points per ring of the sphere that ellipsoids are scaled from.
_RINGS, _SECTORS = 12, 24
# Last group of geoms that MuJoCo's viewer shows unless it is asked for more.
_LAST_SHOWN_GROUP = 2


class ShapeWriter:
    """Writes geoms as `<visual>` and `<collision>` elements, and collects their meshes.

    A geom with `contype = conaffinity = 0` is visual. The others collide; they also show if their
    body has no visual geom, or if they are meshes that MuJoCo's viewer shows (groups 0 to 2).

    Args:
        model: `mujoco.MjModel`.
        folder: Folder of the meshes, relative to the URDF.

    Attributes:
        meshes: Triangles of each mesh file by its path relative to the URDF [m], shape (k, 3, 3).
        omitted: Kinds of geoms that have no counterpart in URDF.
    """

    def __init__(self, model: Any, folder: str) -> None:
        self._model = model
        self._folder = folder
        self._files: dict[int, str] = {}
        self.meshes: dict[str, np.ndarray] = {}
        self.omitted: set[str] = set()

    def add_shapes(self, link: ET.Element, body: int) -> None:
        """Add the geoms of a body to its link.

        Args:
            link: The `<link>`, whose frame is the body's.
            body: Index of the body.
        """
        model = self._model
        geoms = np.flatnonzero(model.geom_bodyid == body)
        collides = (model.geom_contype[geoms] != 0) | (model.geom_conaffinity[geoms] != 0)
        is_mesh = model.geom_type[geoms] == int(_GEOM.mjGEOM_MESH)
        is_seen = ~collides | (is_mesh & (model.geom_group[geoms] <= _LAST_SHOWN_GROUP))
        shown = geoms[is_seen] if not collides.all() else geoms
        for tag, chosen in (("visual", shown), ("collision", geoms[collides])):
            for geom in chosen:
                for pose, geometry in self._geometries(int(geom)):
                    element = ET.SubElement(link, tag)
                    add_origin(element, pose)
                    ET.SubElement(element, "geometry").append(geometry)

    def _geometries(self, geom: int) -> list[tuple[np.ndarray, ET.Element]]:
        """Return the URDF geometries of a geom with their poses in the link."""
        model, size = self._model, self._model.geom_size[geom]
        pose = affine(
            rotation_from_quat_wxyz(model.geom_quat[geom]), np.array(model.geom_pos[geom])
        )
        kind = _GEOM(int(model.geom_type[geom]))
        if kind in (_GEOM.mjGEOM_MESH, _GEOM.mjGEOM_SDF):
            return [(pose, self._mesh(int(model.geom_dataid[geom])))]
        if kind == _GEOM.mjGEOM_BOX:
            return [(pose, _element("box", size=2.0 * size))]
        if kind == _GEOM.mjGEOM_SPHERE:
            return [(pose, _element("sphere", radius=size[:1]))]
        if kind == _GEOM.mjGEOM_CYLINDER:
            return [(pose, _element("cylinder", radius=size[:1], length=2.0 * size[1:2]))]
        if kind == _GEOM.mjGEOM_CAPSULE:  # URDF has none
            ends = (np.array([0.0, 0.0, sign * size[1]]) for sign in (-1.0, 1.0))
            return [
                (pose, _element("cylinder", radius=size[:1], length=2.0 * size[1:2])),
                *((pose @ affine(np.eye(3), e), _element("sphere", radius=size[:1])) for e in ends),
            ]
        if kind == _GEOM.mjGEOM_ELLIPSOID:
            return [(pose, self._ellipsoid(size))]
        self.omitted.add(kind.name.removeprefix("mjGEOM_").lower())
        return []

    def _mesh(self, mesh: int) -> ET.Element:
        model = self._model
        if mesh not in self._files:
            name = file_name(model.mesh(mesh).name or f"mesh{mesh}")
            file = _unused(f"{self._folder}/{name}", self.meshes)
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            vertices = model.mesh_vert[first : first + count]
            first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            self.meshes[file] = np.array(vertices[model.mesh_face[first : first + count]])
            self._files[mesh] = file
        return ET.Element("mesh", filename=self._files[mesh])

    def _ellipsoid(self, radii: np.ndarray) -> ET.Element:
        file = f"{self._folder}/unit_sphere.stl"
        if file not in self.meshes:
            self.meshes[file] = _unit_sphere()
        element = ET.Element("mesh", filename=file)
        set_numbers(element, "scale", [float(radius) for radius in radii])
        return element


def add_origin(element: ET.Element, pose: np.ndarray) -> None:
    """Add an `<origin>` to an element of a URDF.

    Args:
        element: The element.
        pose: Its pose [m], shape (4, 4).
    """
    origin = ET.SubElement(element, "origin")
    set_numbers(origin, "xyz", pose[:3, 3].tolist())
    set_numbers(origin, "rpy", rpy_from_rotation(pose[:3, :3]).tolist())


def binary_stl(triangles: np.ndarray) -> bytes:
    """Return triangles as a binary STL file.

    Args:
        triangles: Corners [m], shape (k, 3, 3).
    """
    kind: np.dtype[np.void] = np.dtype(
        [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )  # ty: ignore[invalid-assignment]
    rows = np.zeros(len(triangles), kind)
    rows["corners"] = triangles
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]).astype(
        float
    )
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    rows["normal"] = normals / np.where(lengths > 0.0, lengths, 1.0)
    return bytes(80) + np.uint32(len(rows)).tobytes() + rows.tobytes()


def file_name(name: str) -> str:
    """Return the file name of a mesh: its name with unusual characters replaced."""
    plain = "".join(c if c.isalnum() or c in "_-." else "_" for c in name)
    return f"{plain.lstrip('.') or 'mesh'}.stl"


def _unused(name: str, names: dict[str, np.ndarray]) -> str:
    stem, count = name.removesuffix(".stl"), 2
    while name.lower() in {other.lower() for other in names}:
        name = f"{stem}_{count}.stl"
        count += 1
    return name


def _element(tag: str, **numbers: np.ndarray) -> ET.Element:
    element = ET.Element(tag)
    for key, values in numbers.items():
        set_numbers(element, key, [float(value) for value in values])
    return element


def _unit_sphere() -> np.ndarray:
    """Return the triangles of a sphere of radius 1, shape (k, 3, 3)."""
    polar = np.linspace(0.0, np.pi, _RINGS + 1)[:, None]
    around = np.linspace(0.0, 2.0 * np.pi, _SECTORS + 1)[None, :]
    x, y = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)
    grid = np.stack([x, y, np.broadcast_to(np.cos(polar), x.shape)], axis=-1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    lower, upper = np.stack([a, b, c], axis=2)[:-1], np.stack([a, c, d], axis=2)[1:]
    return np.concatenate([lower.reshape(-1, 3, 3), upper.reshape(-1, 3, 3)])
