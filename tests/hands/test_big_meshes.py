"""Meshes of millions of triangles: few corners go on, and shape and convex hull stay."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh

from handmap_core.se3 import Array
from handmap_qp.apps.drawing import shape_meshes
from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.hands import (
    MOST_TRIANGLES,
    coarsen_triangles,
    load_hand,
    parse_urdf,
    read_big_mesh,
    read_collision_shapes,
)
from handmap_qp.hands.big_meshes import (
    coarsen,
    directions,
    extremes_of,
    outermost_corners,
    stl_triangles,
)
from handmap_qp.hands.library import urdf_directory

SIZES = np.array([0.04, 0.05, 0.012])
COUNT = MOST_TRIANGLES + 10_000
CELL = 2.0 * SIZES.max() / 128.0


def grid_sphere(count: int) -> tuple[Array, Array]:
    """Return a bumpy ellipsoid of about `count` triangles, open at its poles."""
    sides = int((count / 2) ** 0.5)
    turn, tilt = np.meshgrid(
        np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False),
        np.linspace(0.01, np.pi - 0.01, sides + 1),
    )
    radius = 1.0 + 0.02 * np.sin(7.0 * turn) * np.sin(5.0 * tilt)
    across = radius * np.sin(tilt)
    ball = (across * np.cos(turn), across * np.sin(turn), radius * np.cos(tilt))
    rows = np.arange(sides)[:, None] * sides
    here = rows + np.arange(sides)
    beside = rows + (np.arange(sides) + 1) % sides
    faces = [
        np.stack([here, here + sides, beside], -1),
        np.stack([beside, here + sides, beside + sides], -1),
    ]
    vertices = SIZES * np.stack(ball, -1).reshape(-1, 3)
    return vertices, np.concatenate([each.reshape(-1, 3) for each in faces])


@pytest.fixture(scope="module")
def big(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A binary STL file with a few more triangles than a small one."""
    file = tmp_path_factory.mktemp("big") / "palm.stl"
    vertices, faces = grid_sphere(COUNT)
    trimesh.Trimesh(vertices, faces, process=False).export(file)
    return file


def corners_of(count: int) -> Array:
    """Return the corners of `grid_sphere` as a file has them, in single precision."""
    return grid_sphere(count)[0].astype(np.float32).astype(float)


def support(points: Array) -> Array:
    return np.array([(points @ way).max() for way in directions()])


def test_few_corners_and_triangles_go_on(big: Path) -> None:
    mesh = read_big_mesh(str(big))
    assert mesh is not None
    triangles = stl_triangles(str(big))
    assert triangles is not None
    assert len(triangles) > MOST_TRIANGLES
    assert 5_000 < len(mesh.vertices) < 50_000
    assert 5_000 < len(mesh.faces) < 100_000
    assert 100 < len(mesh.extremes) <= len(directions())
    # All are corners of the file.
    corners = {*map(tuple, corners_of(COUNT))}
    assert corners >= {*map(tuple, mesh.vertices)} >= {*map(tuple, mesh.extremes)}


def test_shape_and_hull_stay(big: Path) -> None:
    mesh = read_big_mesh(str(big))
    assert mesh is not None
    points = corners_of(COUNT)
    # The farthest corner of a cell loses 0.05 of a cell here at most, the nearest 0.15.
    lost = support(points) - support(mesh.extremes)
    assert lost.min() > -1e-12
    assert lost.max() < 0.1 * CELL
    # Every corner has a vertex in its cell.
    keys = {*map(tuple, np.floor((points - points.min(axis=0)) / CELL).astype(int))}
    assert 0.5 * len(keys) < len(mesh.vertices) < 2.0 * len(keys)
    coarse = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    whole = trimesh.Trimesh(*grid_sphere(COUNT), process=False)
    assert coarse.area == pytest.approx(whole.area, rel=0.02)
    # Faces are seen from the same side: both volumes are positive.
    assert coarse.volume == pytest.approx(whole.volume, rel=0.03)
    assert coarse.volume > 0.0


def test_chunks_do_not_decide() -> None:
    vertices, faces = grid_sphere(20_000)

    def chunks(size: int) -> Iterator[Array]:
        for start in range(0, len(faces), size):
            yield vertices[faces[start : start + size]]

    whole = coarsen(lambda: chunks(len(faces)))
    for size in (1_000, 7_777):
        parts = coarsen(lambda size=size: chunks(size))
        for one, other in zip(whole, parts, strict=True):
            np.testing.assert_array_equal(one, other)
    for one, other in zip(whole, coarsen_triangles(vertices, faces), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_mesh_coarser_than_the_grid_stays() -> None:
    box = trimesh.creation.box((0.1, 0.06, 0.02))
    mesh = coarsen_triangles(box.vertices, box.faces)
    assert len(mesh.vertices) == 8
    assert len(mesh.faces) == 12
    again = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert again.volume == pytest.approx(box.volume)


def test_outermost_corners_are_those_of_every_kind_of_file(
    big: Path, tmp_path: Path
) -> None:
    vertices, faces = grid_sphere(COUNT)
    file = tmp_path / "palm.obj"
    trimesh.Trimesh(vertices, faces, process=False).export(file, digits=8)
    found = outermost_corners(str(file))
    assert found is not None
    assert len(found) <= len(directions())
    stl = outermost_corners(str(big))
    assert stl is not None
    for other in (stl, extremes_of(vertices)):
        np.testing.assert_allclose(support(found), support(other), atol=0.2 * CELL)


def test_small_and_other_files_are_not_taken(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.1, 0.06, 0.02))
    for name in ("box.stl", "box.obj", "box.stl.txt"):
        box.export(tmp_path / name, file_type=name.split(".")[1])
        assert read_big_mesh(str(tmp_path / name)) is None
        assert outermost_corners(str(tmp_path / name)) is None
    (tmp_path / "short.stl").write_bytes(b"solid")
    assert stl_triangles(str(tmp_path / "short.stl")) is None
    with pytest.raises(OSError, match="lost"):
        read_big_mesh(str(tmp_path / "lost.stl"))


def with_palm(mesh: Path) -> str:
    """Return the three-fingered hand's URDF with a mesh as its palm."""
    text = (urdf_directory() / "three_finger" / "hand.urdf").read_text()
    shape = f'<geometry><mesh filename="{mesh}" scale="1 1 2"/></geometry></{{0}}>'
    start = text.index('<link name="palm">') + len('<link name="palm">')
    end = text.index("</link>", start)
    shapes = "".join(
        f"<{kind}>{shape.format(kind)}" for kind in ("visual", "collision")
    )
    return text[:start] + shapes + text[end:]


@pytest.mark.parametrize("kind", ["stl", "obj"])
def test_hands_are_described_with_few_of_the_corners(
    kind: str, big: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = big
    if kind != "stl":
        file = tmp_path / f"palm.{kind}"
        vertices, faces = grid_sphere(COUNT)
        trimesh.Trimesh(vertices, faces, process=False).export(file)
    urdf = tmp_path / "hand.urdf"
    urdf.write_text(with_palm(file))
    (palm,) = parse_urdf(urdf.read_text()).iterfind("link[@name='palm']/visual")
    (mesh,) = shape_meshes(palm)
    assert len(mesh.vertices) < 50_000
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0)[2], 0.048, rtol=0.05)
    # A caller may change what it gets.
    mesh.apply_scale(2.0)
    assert np.ptp(shape_meshes(palm)[0].vertices, axis=0)[2] < 0.06
    # A file is read once for all who look at it.
    monkeypatch.setattr(trimesh, "load_scene", None)
    robot = Robot(urdf)
    for look in ("visual", "collision"):
        (cloud,) = robot.clouds("palm", look)
        assert len(cloud) < 10_000
    spec = load_hand("three_finger").spec
    hand = load_hand(msgspec.structs.replace(spec, urdf=str(urdf), collision=None))
    shapes = read_collision_shapes(hand).geometryObjects
    (hull,) = [shape.geometry for shape in shapes if shape.name.startswith("palm")]
    assert hull.num_points <= len(directions())
