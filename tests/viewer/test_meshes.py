"""Meshes of links: the surface and the colours of their shapes, in one object a link."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from handmap_qp.apps.viewer.figure import link_meshes

trimesh = pytest.importorskip("trimesh", reason="pip install 'handmap-qp[view]'")

SHAPE = """<visual name="{name}"><origin xyz="{xyz}" rpy="0.3 0 0"/><geometry>{shape}</geometry>
<material name="{name}"><color rgba="{rgba}"/></material></visual>"""
TURN, RED, BLUE = 0.3, (255, 0, 0, 255), (0, 0, 255, 255)


def test_a_link_is_one_mesh_with_the_surface_and_colours_of_its_shapes(
    tmp_path: Path,
) -> None:
    corner = trimesh.creation.box((0.1, 0.2, 0.3))
    corner.vertices += 0.5
    corner.export(tmp_path / "corner.stl")
    # A visual may have the name of a link.
    box = SHAPE.format(
        name="b", xyz="1 0 0", shape='<box size="0.1 0.1 0.1"/>', rgba="1 0 0 1"
    )
    mirrored = SHAPE.format(
        name="mirrored",
        xyz="0 0 0",
        shape=f'<mesh filename="{tmp_path}/corner.stl" scale="2 -2 2"/>',
        rgba="0 0 1 1",
    )
    other = SHAPE.format(
        name="other", xyz="0 0 0", shape='<sphere radius="1"/>', rgba="0 1 0 1"
    )
    text = (
        f'<robot name="r"><link name="a">{box}{mirrored}</link><link name="b">{other}</link>'
        '<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint></robot>'
    )
    meshes = link_meshes(cast(Any, SimpleNamespace(urdf_text=text, spec=None)))
    assert {link: len(parts) for link, parts in meshes.items()} == {"a": 1, "b": 1}
    (mesh,) = meshes["a"]
    # An inverted part would count as negative.
    assert mesh.volume == pytest.approx(0.1**3 + 8.0 * 0.1 * 0.2 * 0.3)
    turn = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
    for colour, middle in (
        (RED, (1.0, 0.0, 0.0)),
        (BLUE, (1.0, *(turn @ (-1.0, 1.0)))),
    ):
        faces = (mesh.visual.face_colors == colour).all(axis=1)
        assert faces.sum() == 12
        np.testing.assert_allclose(
            mesh.triangles[faces].mean(axis=(0, 1)), middle, atol=1e-9
        )
