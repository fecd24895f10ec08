"""Merged shapes: the same surface and colours, in one object a link."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from handmap_qp.viewer.merged_shapes import merge_shapes

trimesh = pytest.importorskip("trimesh", reason="pip install 'handmap-qp[view]'")
yourdfpy = pytest.importorskip("yourdfpy", reason="pip install 'handmap-qp[view]'")

SHAPE = """<visual name="{name}"><origin xyz="{xyz}" rpy="0.3 0 0"/><geometry>{shape}</geometry>
<material name="{name}"><color rgba="{rgba}"/></material></visual>"""
TURN, RED, BLUE = 0.3, (255, 0, 0, 255), (0, 0, 255, 255)


def test_a_link_is_one_mesh_with_the_surface_and_colours_of_its_shapes(tmp_path: Path) -> None:
    corner = trimesh.creation.box((0.1, 0.2, 0.3))
    corner.vertices += 0.5
    corner.export(tmp_path / "corner.stl")
    box = SHAPE.format(name="box", xyz="1 0 0", shape='<box size="0.1 0.1 0.1"/>', rgba="1 0 0 1")
    mirrored = SHAPE.format(
        name="mirrored",
        xyz="0 0 0",
        shape='<mesh filename="corner.stl" scale="2 -2 2"/>',
        rgba="0 0 1 1",
    )
    other = SHAPE.format(name="other", xyz="0 0 0", shape='<sphere radius="1"/>', rgba="0 1 0 1")
    text = (
        f'<robot name="r"><link name="a">{box}{mirrored}</link><link name="b">{other}</link>'
        '<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint></robot>'
    )
    urdf = yourdfpy.URDF.load(
        io.BytesIO(text.encode()), filename_handler=lambda fname: str(tmp_path / fname)
    )
    # As a mesh file with a mirroring node has it; the box is its own mirror image.
    graph = urdf.scene.graph
    pose = graph.get("box", "a")[0] @ np.diag([-1.0, 1.0, 1.0, 1.0])
    graph.update(frame_to="box", frame_from="a", matrix=pose)
    bounds = urdf.scene.bounds.copy()
    merge_shapes(urdf)
    np.testing.assert_allclose(urdf.scene.bounds, bounds, atol=1e-9)
    assert sorted(urdf.scene.graph.transforms.parents[name] for name in urdf.scene.geometry) == [
        "a",
        "b",
    ]
    (mesh,) = (g for g in urdf.scene.geometry.values() if g.volume < 1.0)
    # An inverted part would count as negative.
    assert mesh.volume == pytest.approx(0.1**3 + 8.0 * 0.1 * 0.2 * 0.3)
    turn = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
    for colour, middle in ((RED, (1.0, 0.0, 0.0)), (BLUE, (1.0, *(turn @ (-1.0, 1.0))))):
        faces = (mesh.visual.face_colors == colour).all(axis=1)
        assert faces.sum() == 12
        np.testing.assert_allclose(mesh.triangles[faces].mean(axis=(0, 1)), middle, atol=1e-9)
