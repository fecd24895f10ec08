"""Geoms of a compiled MuJoCo model as shapes of URDF links, and their meshes."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Iterator

import mujoco
import numpy as np
import trimesh

from handmap_qp.hands.urdf import set_numbers, set_origin
from handmap_qp.se3 import affine, rotation_from_quat_wxyz

_GEOM = mujoco.mjtGeom
# Last group of geoms that MuJoCo's viewer shows unless it is asked for more.
_LAST_SHOWN_GROUP = 2


def pose_of(position: np.ndarray, quat_wxyz: np.ndarray) -> np.ndarray:
    """Return a pose of MuJoCo as a matrix, shape (4, 4)."""
    return affine(rotation_from_quat_wxyz(quat_wxyz), np.array(position))


class ShapeWriter:
    """Writes geoms as `<visual>` and `<collision>` elements, and collects their meshes.

    A geom with `contype = conaffinity = 0` is visual. The others collide; they also show if their
    body has no visual geom, or if they are meshes that MuJoCo's viewer shows (groups 0 to 2).

    Args:
        model: The model.
        folder: Folder of the meshes, relative to the URDF.

    Attributes:
        meshes: Each mesh [m] by the path of its file relative to the URDF.
        omitted: Kinds of geoms that have no counterpart in URDF.
    """

    def __init__(self, model: mujoco.MjModel, folder: str) -> None:
        self._model = model
        self._folder = folder
        self._files: dict[int, str] = {}
        self._names: set[str] = set()
        self.meshes: dict[str, trimesh.Trimesh] = {}
        self.omitted: set[str] = set()

    def add_shapes(self, link: ET.Element, body: int) -> None:
        """Add the geoms of a body to its `<link>`, whose frame is the body's."""
        model = self._model
        geoms = np.flatnonzero(model.geom_bodyid == body)
        collides = (model.geom_contype[geoms] != 0) | (
            model.geom_conaffinity[geoms] != 0
        )
        is_mesh = model.geom_type[geoms] == int(_GEOM.mjGEOM_MESH)
        is_seen = ~collides | (is_mesh & (model.geom_group[geoms] <= _LAST_SHOWN_GROUP))
        shown = geoms[is_seen] if not collides.all() else geoms
        for tag, chosen in (("visual", shown), ("collision", geoms[collides])):
            for geom in chosen:
                for pose, geometry in self._geometries(int(geom)):
                    element = ET.SubElement(link, tag)
                    set_origin(element, pose)
                    ET.SubElement(element, "geometry").append(geometry)

    def _geometries(self, geom: int) -> Iterator[tuple[np.ndarray, ET.Element]]:
        """Iterate over the URDF geometries of a geom, with their poses in the link."""
        model = self._model
        size = self._model.geom_size[geom]
        pose = pose_of(model.geom_pos[geom], model.geom_quat[geom])
        match _GEOM(int(model.geom_type[geom])):
            case _GEOM.mjGEOM_MESH | _GEOM.mjGEOM_SDF:
                yield pose, self._mesh(int(model.geom_dataid[geom]))
            case _GEOM.mjGEOM_BOX:
                yield pose, set_numbers(ET.Element("box"), size=2.0 * size)
            case _GEOM.mjGEOM_SPHERE:
                yield pose, set_numbers(ET.Element("sphere"), radius=size[0])
            case _GEOM.mjGEOM_CYLINDER | _GEOM.mjGEOM_CAPSULE as kind:
                yield (
                    pose,
                    set_numbers(
                        ET.Element("cylinder"), radius=size[0], length=2.0 * size[1]
                    ),
                )
                # URDF has no capsules.
                for sign in (-1.0, 1.0) if kind == _GEOM.mjGEOM_CAPSULE else ():
                    end = affine(np.eye(3), np.array([0.0, 0.0, sign * size[1]]))
                    yield pose @ end, set_numbers(ET.Element("sphere"), radius=size[0])
            case _GEOM.mjGEOM_ELLIPSOID:
                file = f"{self._folder}/unit_sphere.stl"
                self.meshes.setdefault(file, trimesh.creation.icosphere())
                yield pose, set_numbers(ET.Element("mesh", filename=file), scale=size)
            case kind:
                self.omitted.add(kind.name.removeprefix("mjGEOM_").lower())

    def _mesh(self, mesh: int) -> ET.Element:
        model = self._model
        if mesh not in self._files:
            name = file_name(model.mesh(mesh).name or f"mesh{mesh}")
            file = f"{self._folder}/{unique(name, self._names)}.stl"
            first = model.mesh_vertadr[mesh]
            number = model.mesh_vertnum[mesh]
            vertices = model.mesh_vert[first : first + number]
            first = model.mesh_faceadr[mesh]
            number = model.mesh_facenum[mesh]
            faces = model.mesh_face[first : first + number]
            self.meshes[file] = trimesh.Trimesh(vertices, faces, process=False)
            self._files[mesh] = file
        return ET.Element("mesh", filename=self._files[mesh])


def unique(name: str, taken: set[str]) -> str:
    """Return a name that is not taken yet, whatever its case, and count it as taken."""
    candidates = itertools.chain([name], (f"{name}_{i}" for i in itertools.count(2)))
    found = next(each for each in candidates if each.lower() not in taken)
    taken.add(found.lower())
    return found


def file_name(name: str) -> str:
    """Return a name as that of a file, without unusual characters."""
    plain = "".join(c if c.isalnum() or c in "_-." else "_" for c in name)
    return plain.lstrip(".") or "mesh"
