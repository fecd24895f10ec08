"""One mesh for all shapes of a link, so that a page has few objects to receive and to draw."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from handmap_qp.se3 import transform_points


def merge_shapes(urdf: Any) -> None:
    """Replace the shapes of each link by one mesh in the frame of the link, colours included.

    Meshes with textures stay as they are.

    Args:
        urdf: A `yourdfpy.URDF` with its meshes; its scene is changed.
    """
    scene = urdf.scene
    shapes: defaultdict[str, list[str]] = defaultdict(list)
    for name, mesh in scene.geometry.items():
        if mesh.visual.kind != "texture":
            shapes[scene.graph.transforms.parents[name]].append(name)
    for link, names in shapes.items():
        if len(names) > 1:
            merged = _merged([(scene.geometry[n], urdf.get_transform(n, link)) for n in names])
            scene.delete_geometry(names)
            scene.add_geometry(merged, names[0], names[0], parent_node_name=link)


def _merged(parts: list[tuple[Any, np.ndarray]]) -> Any:
    """Return one mesh of several with their poses (4, 4); the poses may scale and mirror."""
    from trimesh import Trimesh

    vertices, faces, colours, count = [], [], [], 0
    for mesh, pose in parts:
        vertices.append(transform_points(pose, mesh.vertices))
        # A mirror image has its faces inside out.
        order = 1 if np.linalg.det(pose[:3, :3]) > 0.0 else -1
        faces.append(mesh.faces[:, ::order] + count)
        colours.append(mesh.visual.face_colors)
        count += len(mesh.vertices)
    return Trimesh(
        np.concatenate(vertices),
        np.concatenate(faces),
        face_colors=np.concatenate(colours),
        process=False,
    )
