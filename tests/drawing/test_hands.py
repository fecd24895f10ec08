"""Shapes are placed by forward kinematics and drawn where the camera projects them."""

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from handmap_qp.apps.drawing.hands import (
    _SMOOTH_ANGLE,
    draw_hands,
    load_shape,
    solid,
    spheres,
    tube,
)
from handmap_qp.apps.drawing.raster import (
    Camera,
    Triangles,
    _creases,
    _rasterise,
    merged,
    render,
)
from handmap_qp.apps.drawing.shapes import read_shapes
from handmap_qp.errors import MissingExtraError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.spec import HandSpec, PalmSpec, PointSpec, WristSpec
from handmap_qp.hands.urdf import parse_urdf
from handmap_qp.se3 import affine, rotation_from_quat_wxyz, transform_points, unit

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.8, 0.1)
WRIST = affine(
    rotation_from_quat_wxyz([0.9, 0.2, -0.3, 0.1]), np.array([0.3, -0.2, 0.5])
)

URDF = """<robot name="finger">
  <material name="blue"><color rgba="0.1 0.2 0.9 1"/></material>
  <link name="palm">
    <visual>
      <origin xyz="0.02 0 0"/><geometry><sphere radius="0.01"/></geometry><material name="blue"/>
    </visual>
  </link>
  <link name="proximal">
    <visual>
      <origin xyz="0.03 0 0" rpy="0 1.5707963 0"/>
      <geometry><cylinder radius="0.008" length="0.06"/></geometry>
    </visual>
  </link>
  <link name="distal">
    <visual><origin xyz="0.02 0.005 0"/><geometry>{distal}</geometry></visual>
  </link>
  <joint name="base" type="revolute">
    <parent link="palm"/><child link="proximal"/><origin xyz="0.05 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="end" type="revolute">
    <parent link="proximal"/><child link="distal"/><origin xyz="0.06 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


def finger(
    distal: str = '<box size="0.04 0.01 0.01"/>', directory: Path | None = None
) -> Hand:
    """Make a finger of two joints, with a palm rotated in its link and a point named as a link."""
    spec = HandSpec(
        name="finger",
        urdf="finger.urdf",
        side="right",
        palm=PalmSpec(
            link="palm",
            distal=(-1.0, 0.0, 0.0),
            dorsal=(0.0, 0.0, 1.0),
            xyz=(0.0, 0.0, 0.3),
        ),
        wrist=WristSpec(link="palm"),
        joints=("base", "end"),
        rest={"base": 0.0, "end": 0.0},
        points=(PointSpec("distal", "distal", (0.04, 0.0, 0.0)),),
        sets={"tip": ("distal",)},
        reference="tip",
        directory=directory,
    )
    return Hand(spec, urdf_text=URDF.format(distal=distal))


def centroid(triangles: Triangles) -> np.ndarray:
    """Return the centroid of the surface."""
    a, b, c = np.moveaxis(triangles.vertices, 1, 0)
    return np.average(
        (a + b + c) / 3.0,
        axis=0,
        weights=np.linalg.norm(np.cross(b - a, c - a), axis=1),
    )


def volume(triangles: Triangles) -> float:
    """Return the enclosed volume, negative if the triangles are wound inside out."""
    a, b, c = np.moveaxis(
        triangles.vertices - triangles.vertices.mean(axis=(0, 1)), 1, 0
    )
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0


def by_link(
    hand: Hand, q: np.ndarray, wrist: np.ndarray | None = None
) -> dict[str, Triangles]:
    """Return the placed triangles of each link."""
    shape = load_shape(hand)
    placed = shape.triangles(q, wrist)
    stops = np.cumsum([len(each.vertices) for each in shape.links.values()])[:-1]
    columns = [np.split(column, stops) for column in placed]
    return {
        link: Triangles(*parts)
        for link, *parts in zip(shape.links, *columns, strict=True)
    }


def test_shapes_lie_where_forward_kinematics_puts_their_links() -> None:
    q = np.array([0.4, -0.7])
    links = by_link(finger(), q, WRIST)
    turn = [
        affine(
            np.array(
                [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
            ),
            np.zeros(3),
        )
        for a in q
    ]
    proximal = WRIST @ affine(np.eye(3), np.array([0.05, 0.0, 0.0])) @ turn[0]
    distal = proximal @ affine(np.eye(3), np.array([0.06, 0.0, 0.0])) @ turn[1]
    expected = {
        "palm": (WRIST, (0.02, 0.0, 0.0)),
        "proximal": (proximal, (0.03, 0.0, 0.0)),
        "distal": (distal, (0.02, 0.005, 0.0)),
    }
    for link, (pose, centre) in expected.items():
        np.testing.assert_allclose(
            centroid(links[link]),
            transform_points(pose, np.array([centre]))[0],
            atol=1e-9,
        )


def test_a_joint_moves_only_what_hangs_from_it() -> None:
    hand = load_hand("human")
    bent = hand.rest.copy()
    bent[hand.joint_names.index("index_PIP_flexion")] += 0.3
    before, after = by_link(hand, hand.rest), by_link(hand, bent)
    moved = {
        name
        for name in before
        if not np.allclose(before[name].vertices, after[name].vertices, atol=1e-12)
    }
    assert len(moved) >= 2
    assert all(name.startswith("index") for name in moved)


def test_surfaces_face_outwards_with_unit_normals() -> None:
    for name, part in by_link(finger(), np.zeros(2)).items():
        assert volume(part) > 0.0, name
        np.testing.assert_allclose(np.linalg.norm(part.normals, axis=2), 1.0, atol=1e-9)
    ball = by_link(finger(), np.zeros(2))["palm"]
    radial = (ball.vertices - [0.02, 0.0, 0.0]) / 0.01
    assert np.abs(ball.normals - radial).max() < 0.02
    box = by_link(finger(), np.zeros(2))["distal"]
    assert np.allclose(np.abs(box.normals).max(axis=2), 1.0), "a box keeps its edges"


def test_colours_come_from_the_urdf_unless_given() -> None:
    shape = load_shape(finger())
    np.testing.assert_allclose(shape.links["palm"].colours[0], [0.1, 0.2, 0.9])
    assert (
        load_shape(finger(), colour=RED).triangles(np.zeros(2)).colours == RED
    ).all()


@pytest.mark.parametrize("scale", ["1 1 1", "-2 2 2"])
def test_meshes_are_found_beside_the_urdf_scaled_and_outside_out(
    tmp_path: Path, scale: str
) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box(extents=(0.02, 0.01, 0.01)).apply_translation(
        [0.01, 0, 0]
    ).export(tmp_path / "part.stl")
    hand = finger(f'<mesh filename="part.stl" scale="{scale}"/>', tmp_path)
    part = by_link(hand, np.zeros(2))["distal"]
    factor = float(scale.split()[0])
    assert volume(part) == pytest.approx(abs(factor) ** 3 * 2e-6)
    np.testing.assert_allclose(
        centroid(part), [0.11 + 0.02 + 0.01 * factor, 0.005, 0.0], atol=1e-7
    )


def test_a_mesh_is_its_readers_own_and_read_again_when_it_changes(
    tmp_path: Path,
) -> None:
    trimesh = pytest.importorskip("trimesh")
    hand = finger('<mesh filename="part.stl"/>', tmp_path)
    for size in (0.01, 0.02):
        trimesh.creation.box(extents=[size] * 3).export(tmp_path / "part.stl")
        for _ in range(2):
            ((meshes, _),) = read_shapes(hand, "visual")["distal"]
            np.testing.assert_allclose(meshes[0].extents, size, rtol=1e-6)
            # The reader's own: nobody else sees this.
            meshes[0].vertices *= 3.0


def test_a_fine_mesh_is_simplified(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(subdivisions=5, radius=0.02).export(
        tmp_path / "part.stl"
    )
    part = by_link(finger('<mesh filename="part.stl"/>', tmp_path), np.zeros(2))[
        "distal"
    ]
    assert 1000 < len(part.vertices) <= 8000
    assert volume(part) == pytest.approx(4 / 3 * np.pi * 0.02**3, rel=0.05)


@pytest.mark.parametrize("solid", ['<mesh filename="package://nowhere/part.stl"/>', ""])
def test_a_missing_mesh_is_drawn_by_a_stand_in(tmp_path: Path, solid: str) -> None:
    hand = finger(solid, tmp_path)
    if not solid:
        # A robot without any shapes.
        robot = parse_urdf(hand.urdf_text)
        for link in robot.iterfind("link"):
            for tag in ("visual", "collision"):
                for shape in link.findall(tag):
                    link.remove(shape)
        hand = Hand(hand.spec, urdf_text=ElementTree.tostring(robot, "unicode"))
    shape = load_shape(hand)
    assert list(shape.links) == ["palm", "proximal", "distal"]
    assert all(len(triangles.vertices) for triangles in shape.links.values())


def test_the_camera_frames_what_it_is_given() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    camera = Camera.framing(
        points, (300, 200), azimuth=20.0, elevation=40.0, margin=0.1
    )
    pixels = camera.project(points)
    assert (pixels[:, 2] > 0.0).all()
    low, high = pixels[:, :2].min(axis=0), pixels[:, :2].max(axis=0)
    np.testing.assert_allclose(0.5 * (low + high), [150.0, 100.0], atol=1e-9)
    assert (low >= 20.0 - 1e-9).all()
    assert np.isclose(low, 20.0).any(), "one of the directions is filled"


def test_higher_points_appear_higher_in_the_picture() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.1, 0.0, 0.0]])
    pixels = Camera.framing(points, (100, 100), azimuth=-90.0).project(points)
    assert pixels[1, 1] < pixels[0, 1]
    assert pixels[2, 0] > pixels[0, 0]


def test_the_hand_covers_the_pixels_of_its_reference_points() -> None:
    hand = load_hand("human")
    triangles = load_shape(hand).triangles(hand.rest, WRIST)
    camera = Camera.framing(triangles.vertices.reshape(-1, 3), (320, 240))
    image = render(triangles, camera, supersampling=1)
    for column, row, _ in camera.project(hand.points(hand.rest, WRIST)):
        assert image[int(row), int(column), 3] == 1.0
    assert 0.1 < (image[..., 3] > 0.5).mean() < 0.7
    assert image[0, 0, 3] == 0.0


@pytest.mark.parametrize("supersampling", [1, 3])
def test_a_surface_has_no_holes_between_its_triangles(supersampling: int) -> None:
    ball = spheres([[0.0, 0.0, 0.0]], 1.0, RED)
    camera = Camera.framing(ball.vertices.reshape(-1, 3), (200, 200), margin=0.0)
    image = render(ball, camera, supersampling=supersampling)
    y, x = np.mgrid[:200, :200] + 0.5
    inside = np.hypot(x - 100.0, y - 100.0) < 97.0
    assert (image[inside, 3] == 1.0).all()
    assert (image[..., 3] > 0.0).mean() == pytest.approx(np.pi / 4.0, abs=0.01)


@pytest.mark.parametrize("order", [1, -1])
def test_what_is_in_front_hides_what_is_behind(order: int) -> None:
    # Seen from -y, the red ball hides the green one in either order of the list.
    balls = [
        spheres([[0.0, -0.1, 0.0]], 0.02, RED),
        spheres([[0.0, 0.1, 0.0]], 0.02, GREEN),
    ][::order]
    camera = Camera.framing(
        np.array([[-0.05, 0, -0.05], [0.05, 0, 0.05]]),
        (100, 100),
        azimuth=-90.0,
        elevation=0.0,
    )
    red, green, _, opacity = render(merged(balls), camera, supersampling=1)[50, 50]
    assert opacity == 1.0
    assert red > 2.0 * green


def test_marks_shine_through_and_stand_in_front() -> None:
    camera = Camera.framing(
        np.array([[-0.05, 0, -0.05], [0.05, 0, 0.05]]),
        (100, 100),
        azimuth=-90.0,
        elevation=0.0,
    )
    wall = spheres([[0.0, 0.0, 0.0]], 0.03, GREEN)
    bare, hidden, shown = (
        render(wall, camera, marks=marks, supersampling=1)[50, 50]
        for marks in (
            None,
            spheres([[0.0, 0.0, 0.0]], 0.01, RED),
            spheres([[0.0, -0.05, 0.0]], 0.01, RED),
        )
    )
    assert bare[0] < hidden[0] < shown[0]
    assert bare[1] > hidden[1] > shown[1]


def test_a_tube_has_its_radius_and_its_ends() -> None:
    start, end = np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.0, 0.5])
    along = (end - start) / np.linalg.norm(end - start)
    offsets = tube([start, end], 0.01, RED).vertices.reshape(-1, 3) - start
    beside = np.linalg.norm(offsets - np.outer(offsets @ along, along), axis=1)
    # The middles of both lids lie on the axis.
    assert np.isclose(beside[:, None], [0.0, 0.01]).any(axis=1).all()
    length = np.linalg.norm(end - start)
    assert np.isclose((offsets @ along)[:, None], [0.0, length]).any(axis=1).all()


def test_draw_hands_makes_the_axes_pixels_and_leaves_no_figure_behind() -> None:
    figure_module = pytest.importorskip("matplotlib.figure")
    from matplotlib._pylab_helpers import Gcf

    axes = figure_module.Figure().add_subplot()
    ball = spheres([[0.0, 0.0, 0.0]], 0.01, RED)
    draw_hands(
        axes,
        ball,
        Camera.framing(ball.vertices.reshape(-1, 3), (60, 40)),
        supersampling=1,
    )
    assert axes.get_xlim() == (0.0, 60.0)
    assert axes.get_ylim() == (40.0, 0.0)
    assert not axes.axison
    assert not Gcf.figs


def test_an_absent_package_is_named_with_its_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hand = finger()
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(MissingExtraError, match=r"trimesh .*handmap-qp\[plot\]"):
        load_shape(hand)


def test_hand_without_visual_shapes_is_drawn_by_its_collision_shapes() -> None:
    text = URDF.format(distal='<box size="0.04 0.01 0.01"/>')
    spec = finger().spec
    seen = load_shape(finger())
    bare = load_shape(Hand(spec, urdf_text=text.replace("visual>", "collision>")))
    # Where there are visual shapes, collision shapes are not drawn beside them.
    extra = '<collision><geometry><sphere radius="0.1"/></geometry></collision></link>'
    both = load_shape(Hand(spec, urdf_text=text.replace("</link>", extra, 1)))
    q = [0.3, 0.5]
    for shape in (bare, both):
        np.testing.assert_allclose(
            shape.triangles(q).vertices, seen.triangles(q).vertices, atol=1e-12
        )


def test_creases_are_hollows_and_neither_slopes_nor_outlines() -> None:
    camera = Camera(np.eye(4), 1000.0, (80.0, 60.0), (160, 120))
    rows, columns = np.mgrid[:120, :160].astype(float)
    # The border of the picture is repeated, so leave out what it can reach.
    inner = np.s_[30:-30, 30:-30]
    slope = 0.5 + 5e-4 * columns + 3e-4 * rows
    slope[:40] = np.inf
    assert _creases(slope, camera)[inner].max() < 1e-9
    # A valley along a column, of a tilt of 45 degrees: a pixel is 0.5 mm there.
    valley = 0.5 - 5e-4 * np.abs(columns - 80.0)
    crease = _creases(valley, camera)[inner]
    assert crease[:, 48:53].min() > 0.2
    assert crease[:, :20].max() < 1e-3
    np.testing.assert_allclose(crease[:, 30:50], crease[:, 70:50:-1], atol=1e-12)
    # A hand in front of another one: a step, far larger than a crease is deep.
    step = np.where(columns < 80.0, 0.5, 0.6)
    assert _creases(step, camera)[inner].max() < 1e-9


def test_the_faces_of_a_tube_look_outward() -> None:
    rod = tube([[0.0, 0.0, 0.1], [0.05, 0.0, 0.2]], 0.004, RED)
    a, b, c = np.moveaxis(rod.vertices, 1, 0)
    outward = np.cross(b - a, c - a)[:, None]
    assert ((outward * rod.normals).sum(axis=2) > 0.0).all()


def test_depth_is_measured_along_the_axis_of_the_camera() -> None:
    corners = np.array([[[0.0, 0.0, 2.0], [0.0, 1.0, 3.0], [1.0, 0.0, 2.5]]])
    camera = Camera(np.eye(4), 1000.0, (80.0, 60.0), (160, 120))
    pixels, _, _, depth = _rasterise(corners, camera)
    # Its plane is z = 2 + x / 2 + y, where x and y are z times the ray's tangents.
    y, x = np.divmod(pixels, 160)
    slope = ((x - 79.5) / 2.0 + (y - 59.5)) / 1000.0
    assert len(x) > 1000
    np.testing.assert_allclose(depth[y, x], 2.0 / (1.0 - slope))


def test_of_two_faces_in_one_plane_the_last_one_is_seen() -> None:
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    flat = np.hstack([corners, np.zeros((4, 1))])
    tilted = transform_points(WRIST, flat)
    faces = tilted[[[0, 1, 2], [0, 2, 3], [0, 1, 3], [1, 2, 3]]]
    normals = np.broadcast_to(WRIST[:3, 2], (2, 3, 3))
    both = merged(
        [
            Triangles.painted(part, normals, colour)
            for part, colour in zip(np.split(faces, 2), (GREEN, RED), strict=True)
        ]
    )
    camera = Camera.framing(tilted, (120, 90), azimuth=20.0, elevation=70.0)
    picture = render(both, camera)
    inside = picture[picture[..., 3] > 0.99]
    assert len(inside) > 1000
    assert (inside[:, 0] > inside[:, 1]).all()


def test_normals_are_smooth_but_at_edges() -> None:
    """They are those of trimesh, which cuts the mesh into its smooth surfaces."""
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.creation.cylinder(0.01, 0.03, sections=16)
    cut = trimesh.graph.smooth_shade(mesh, angle=_SMOOTH_ANGLE, facet_minarea=None)
    ours = solid(mesh, RED)

    def corners(triangles: np.ndarray, normals: np.ndarray) -> np.ndarray:
        rows = np.concatenate([triangles, normals], axis=2).reshape(-1, 6)
        return rows[np.lexsort(np.round(rows, 9).T)]

    found = corners(ours.vertices, ours.normals)
    expected = corners(cut.triangles, unit(cut.vertex_normals[cut.faces]))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_scipy_is_not_imported_before_a_picture_is_drawn() -> None:
    program = (
        "import sys, handmap_qp.apps.offline.cli, handmap_qp.apps.datasets.convert\n"
        "print([name for name in sys.modules if name.startswith('scipy')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
