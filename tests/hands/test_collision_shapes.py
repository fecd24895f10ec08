"""Collision shapes: meshes are found wherever the description of the hand lies."""

from __future__ import annotations

import shutil
from pathlib import Path

import msgspec
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from arm_cases import mounted

from handmap_core.hands.stiffness import SLIDING_STIFFNESS, STIFFNESS
from handmap_qp import (
    Hand,
    HandMapper,
    HandSpec,
    IkOptions,
    PointSpec,
    load_hand,
)
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.apps.onboarding.collision_pairs import colliding_links
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.shape_pairs import all_pairs, pair_ends, yield_to
from handmap_qp.hands.spec import ArmSpec, CollisionSpec, PalmSpec, WristSpec
from handmap_qp.ik.qp import PointIk
from handmap_qp.trackers.formats import read_recording

FINGER = """
<robot name="finger">
  <link name="palm"><collision><geometry><mesh filename="{mesh}"/></geometry></collision></link>
  <joint name="bend" type="revolute">
    <parent link="palm"/><child link="tip"/><origin xyz="0.1 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="5"/>
  </joint>
  <link name="tip"><collision><geometry><box size="0.02 0.02 0.02"/></geometry></collision></link>
</robot>
"""
SPEC = HandSpec(
    name="finger",
    urdf="hand.urdf",
    side="right",
    palm=PalmSpec("palm", (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    wrist=WristSpec("palm"),
    joints=("bend",),
    rest={"bend": 0.0},
    points=(PointSpec("tip", "tip"),),
    sets={"fingertips": ("tip",)},
    reference="fingertips",
)


@pytest.mark.parametrize(
    ("mesh", "place", "marker"),
    [
        ("part.stl", "urdf/part.stl", ""),
        ("meshes/part.stl", "urdf/meshes/part.stl", ""),
        ("../meshes/part.stl", "meshes/part.stl", ""),
        ("file://{root}/part.stl", "part.stl", ""),
        ("{root}/part.stl", "part.stl", ""),
        (
            "package://finger_description/meshes/part.stl",
            "meshes/part.stl",
            "package.xml",
        ),
        ("package://urdf/meshes/part.stl", "urdf/meshes/part.stl", ""),
        ("model://urdf/part.stl", "urdf/part.stl", ""),
    ],
)
def test_meshes_are_found_from_the_urdf(
    tmp_path: Path, mesh: str, place: str, marker: str
) -> None:
    root, elsewhere = tmp_path / "robot", tmp_path / "elsewhere"
    for folder in (root / "urdf", (root / place).parent, elsewhere):
        folder.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box((0.04, 0.02, 0.02)).export(root / place)
    if marker:
        (root / marker).write_text("<package/>")
    (root / "urdf" / "hand.urdf").write_text(FINGER.format(mesh=mesh.format(root=root)))
    relative = "../robot/urdf/hand.urdf"
    hand = Hand(msgspec.structs.replace(SPEC, urdf=relative, directory=elsewhere))
    palm, _ = read_collision_shapes(hand).geometryObjects
    palm.geometry.computeLocalAABB()
    np.testing.assert_allclose(
        palm.geometry.aabb_local.max_, [0.02, 0.01, 0.01], atol=1e-6
    )
    # The check of a description and the mapping find the same meshes.
    assert colliding_links(hand, hand.rest) == []


@pytest.mark.parametrize("mesh", ["part.stl", "package://arm_description/part.stl"])
def test_meshes_of_an_arm_are_found_from_its_own_urdf(
    tmp_path: Path, mesh: str
) -> None:
    for name, size in (("hand", 0.02), ("arm_description", 0.04)):
        (tmp_path / name).mkdir()
        trimesh.creation.box((size, size, size)).export(tmp_path / name / "part.stl")
    (tmp_path / "hand" / "hand.urdf").write_text(FINGER.format(mesh="part.stl"))
    lift = FINGER.replace('"tip"', '"flange"').replace('"bend"', '"lift"')
    (tmp_path / "arm_description" / "arm.urdf").write_text(lift.format(mesh=mesh))
    arm = ArmSpec(
        name="arm",
        urdf="arm.urdf",
        tip="flange",
        joints=("lift",),
        rest={"lift": 0.0},
        directory=tmp_path / "arm_description",
    )
    hand = Hand(
        mounted(msgspec.structs.replace(SPEC, directory=tmp_path / "hand"), arm)
    )
    sizes = {}
    for shape in read_collision_shapes(hand).geometryObjects:
        shape.geometry.computeLocalAABB()
        sizes[shape.name] = 2.0 * shape.geometry.aabb_local.max_[0]
    assert sizes["arm_palm_0"] == pytest.approx(0.04)
    assert sizes["palm_0"] == pytest.approx(0.02)


LOST = [
    "gone.stl",
    "package://nowhere/gone.stl",
    "pointer.stl",
    "flat.stl",
    "words.obj",
]
"""Meshes that cannot be had: missing, an LFS pointer, without volume, unreadable."""


def hand_with(folder: Path, text: str) -> Hand:
    flat = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]]
    )
    flat.export(folder / "flat.stl")
    trimesh.creation.box((20.0, 30.0, 40.0)).export(folder / "huge.stl")
    trimesh.creation.box((2e-5, 3e-5, 4e-5)).export(folder / "tiny.stl")
    (folder / "pointer.stl").write_text("version https://git-lfs.github.com/spec/v1\n")
    (folder / "words.obj").write_text("no mesh\n")
    (folder / "hand.urdf").write_text(text)
    return Hand(msgspec.structs.replace(SPEC, directory=folder))


def corners_of(shape: pin.GeometryObject) -> np.ndarray:
    shape.geometry.computeLocalAABB()
    box = shape.geometry.aabb_local
    ends = np.array([box.min_, box.max_])
    return np.sort([shape.placement.act(end) for end in ends], axis=0)


@pytest.mark.parametrize("mesh", LOST)
def test_a_lost_mesh_has_a_cylinder_to_the_next_joint(
    tmp_path: Path, mesh: str
) -> None:
    hand = hand_with(tmp_path, FINGER.format(mesh=mesh))
    palm, tip = read_collision_shapes(hand).geometryObjects
    assert (palm.name, tip.name) == ("palm_0", "tip_0")
    # The joint is 100 mm along x; the box of the other link is as it was.
    low, high = corners_of(palm)
    np.testing.assert_allclose([low[0], high[0]], [0.0, 0.1], atol=1e-9)
    np.testing.assert_allclose(high[1:], 0.006, atol=1e-4)
    np.testing.assert_allclose(corners_of(tip)[1], 0.01)


def test_a_lost_mesh_at_the_end_of_a_finger_has_a_ball(tmp_path: Path) -> None:
    text = FINGER.format(mesh="gone.stl").replace(
        '<box size="0.02 0.02 0.02"/>', '<mesh filename="gone.stl"/>'
    )
    _, tip = read_collision_shapes(hand_with(tmp_path, text)).geometryObjects
    np.testing.assert_allclose(corners_of(tip), [[-0.006] * 3, [0.006] * 3])


def test_a_lost_mesh_has_the_visual_shape_of_its_link(tmp_path: Path) -> None:
    visual = """<visual><origin xyz="0 0.01 0"/><geometry><sphere radius="0.03"/></geometry>
      </visual><collision>"""
    text = FINGER.format(mesh="gone.stl").replace("<collision>", visual, 1)
    palm, _ = read_collision_shapes(hand_with(tmp_path, text)).geometryObjects
    np.testing.assert_allclose(palm.placement.translation, [0.0, 0.01, 0.0])
    assert palm.geometry.radius == pytest.approx(0.03)


@pytest.mark.parametrize(
    "given",
    [
        '<mass value="1"/>',
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>',
    ],
)
def test_a_link_with_half_an_inertial_keeps_its_shapes(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], given: str
) -> None:
    half = f'<link name="palm"><inertial>{given}</inertial>'
    box = '<box size="0.1 0.1 0.1"/>'
    text = FINGER.replace('<link name="palm">', half)
    text = text.replace('<mesh filename="{mesh}"/>', box)
    (tmp_path / "hand.urdf").write_text(text, encoding="utf-8")
    hand = load_hand(msgspec.structs.replace(SPEC, directory=tmp_path))
    shapes = read_collision_shapes(hand).geometryObjects
    assert {shape.name for shape in shapes} == {"palm_0", "tip_0"}
    assert capfd.readouterr().err == ""


def test_a_link_keeps_the_shapes_that_it_has_beside_a_lost_one(tmp_path: Path) -> None:
    more = (
        "<collision><geometry><sphere radius='0.02'/></geometry></collision><collision>"
    )
    text = FINGER.format(mesh="gone.stl").replace("<collision>", more, 1)
    palm, _ = read_collision_shapes(hand_with(tmp_path, text)).geometryObjects
    assert palm.geometry.radius == pytest.approx(0.02)


@pytest.mark.slow
def test_a_hand_without_its_meshes_is_mapped_and_keeps_its_links_apart() -> None:
    whole = load_hand("allegro_right")
    bare = Hand(whole.spec, urdf_text=whole.urdf_text.replace(".STL", ".gone"))
    human = load_hand("human", points="landmarks")
    recording = read_recording("demo::right").part(slice(0, 240))
    mapped = [
        map_recording(HandMapper(human, hand, "teleoperation"), recording)
        for hand in (whole, bare)
    ]
    own, other = (each.q[np.isfinite(each.q).all(axis=1)] for each in mapped)
    # Fingers do the same; only where links touch, and pads are, differs.
    assert np.median(np.abs(own - other)) < 0.03
    shapes = read_collision_shapes(bare).geometryObjects
    assert len(shapes) == len({shape.name for shape in shapes}) >= 16


def test_a_cylinder_counts_as_a_prism_that_holds_it(tmp_path: Path) -> None:
    mesh = '<mesh filename="{mesh}"/>'
    (tmp_path / "hand.urdf").write_text(
        FINGER.replace(mesh, '<cylinder radius="0.01" length="0.06"/>')
    )
    hand = Hand(msgspec.structs.replace(SPEC, directory=tmp_path))
    prism = read_collision_shapes(hand).geometryObjects[0].geometry
    corners = np.array([prism.point(i) for i in range(prism.num_points)])
    normals = np.random.default_rng(0).normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cylinder = 0.01 * np.hypot(*normals.T[:2]) + 0.03 * np.abs(normals[:, 2])
    excess = (normals @ corners.T).max(axis=1) - cylinder
    assert excess.min() > -1e-12
    assert excess.max() < 0.0025 * 0.01


@pytest.mark.parametrize(("radius", "length"), [(0.01, 0.0), (0.0, 0.06), (0.0, 0.0)])
def test_a_flat_cylinder_is_a_thin_one(
    tmp_path: Path, radius: float, length: float
) -> None:
    size = f'<cylinder radius="{radius}" length="{length}"/>'
    (tmp_path / "hand.urdf").write_text(
        FINGER.replace('<mesh filename="{mesh}"/>', size)
    )
    hand = Hand(msgspec.structs.replace(SPEC, directory=tmp_path))
    shape = read_collision_shapes(hand).geometryObjects[0].geometry
    shape.computeLocalAABB()
    half = np.maximum([radius, radius, 0.5 * length], 1e-5)
    np.testing.assert_allclose(shape.aabb_local.max_, half, rtol=0.003)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "obj"])
def test_distances_between_meshes_are_those_of_their_hulls(
    tmp_path: Path, kind: str
) -> None:
    # Binary STL is read here, all else by coal.
    suffix = kind.partition("_")[0]
    # Vertices inside the hull, as of a cavity or a screw hole, must not change it.
    rng, corners = np.random.default_rng(0), []
    for name in ("palm", "tip"):
        outer = trimesh.creation.icosphere(2, 0.05)
        outer.apply_scale((0.4, 1.0, 0.6))
        inner = trimesh.convex.convex_hull(rng.uniform(-0.01, 0.01, size=(60, 3)))
        mesh = trimesh.util.concatenate([inner, outer])
        mesh.export(tmp_path / f"{name}.{suffix}", file_type=kind)
        corners.append(np.vstack([inner.vertices, outer.vertices]))
    # One mesh is stretched.
    text = FINGER.format(mesh=f'palm.{suffix}" scale="0.5 1.5 0.8')
    text = text.replace(
        '<box size="0.02 0.02 0.02"/>', f'<mesh filename="tip.{suffix}"/>'
    )
    corners[0] *= (0.5, 1.5, 0.8)
    (tmp_path / "hand.urdf").write_text(text)
    hand = Hand(msgspec.structs.replace(SPEC, directory=tmp_path), mount="fixed")
    geometry = read_collision_shapes(hand)
    geometry.addCollisionPair(pin.CollisionPair(0, 1))
    data, placed = hand.model.createData(), geometry.createData()
    placed.distanceRequests[0].gjk_tolerance = 1e-9
    for angle in np.linspace(-1.0, 1.0, 15):
        q = hand.configuration_vector([angle])
        pin.updateGeometryPlacements(hand.model, data, geometry, placed, q)
        result = pin.computeDistance(geometry, placed, 0)
        palm, tip = (
            points @ pose.rotation.T + pose.translation
            for points, pose in zip(corners, placed.oMg, strict=True)
        )
        # The projections of two convex bodies onto the line between their nearest points.
        gap = (tip @ result.normal).min() - (palm @ result.normal).max()
        assert result.min_distance == pytest.approx(gap, abs=1e-7)
        assert gap > 0.01


def test_a_mesh_that_has_changed_is_read_again(tmp_path: Path) -> None:
    (tmp_path / "hand.urdf").write_text(FINGER.format(mesh="part.stl"))
    radii = []
    for size in (0.02, 0.04):
        trimesh.creation.box((size, size, size)).export(tmp_path / "part.stl")
        shapes = read_collision_shapes(
            Hand(msgspec.structs.replace(SPEC, directory=tmp_path))
        )
        radii.append(np.linalg.norm(shapes.geometryObjects[0].geometry.point(0)))
    assert radii[1] == pytest.approx(2.0 * radii[0], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("style", ["relative", "package"])
@pytest.mark.parametrize(
    "name", ["leap_hand/leap_hand_right.urdf", "schunk_hand/schunk_svh_hand_right.urdf"]
)
def test_a_description_elsewhere_avoids_self_collision(
    shared_hands: Path, tmp_path: Path, name: str, style: str
) -> None:
    urdf = shared_hands / name
    if style == "package":
        package = tmp_path / "ros" / "some_description"
        shutil.copytree(urdf.parent, package)
        (package / "urdf").mkdir()
        text = urdf.read_text(encoding="utf-8").replace(
            'filename="meshes', 'filename="package://some_description/meshes'
        )
        urdf = package / "urdf" / urdf.name
        urdf.write_text(text, encoding="utf-8")
    spec = detect(urdf).spec
    spec = msgspec.structs.replace(spec, urdf=str(urdf), directory=tmp_path)
    shapes = read_collision_shapes(plain := Hand(spec)).geometryObjects
    assert len(shapes) > 10
    first, *_, last = (plain.model.frames[shape.parentFrame].name for shape in shapes)
    hand = Hand(
        msgspec.structs.replace(spec, collision=CollisionSpec(pairs=((first, last),)))
    )
    ik = PointIk(hand, IkOptions(avoids_self_collision=True))
    ik.place(hand.configuration_vector(hand.rest))
    assert ik.solve(hand.points(hand.rest), None, 0.01).status != "failed"


def test_shapes_that_part_in_most_postures_are_kept_apart() -> None:
    """One pair of this hand overlaps in a third of random postures: it is no joint."""
    assert all_pairs(load_hand("hey5")).joined == ()


def test_links_press_no_deeper_than_a_part_of_the_thinner_one() -> None:
    """Beyond its middle, the direction in which they part would turn round."""
    hand = load_hand("allegro_right")
    pairs = all_pairs(hand)
    yielding = yield_to(hand, pairs, 4.0, STIFFNESS, SLIDING_STIFFNESS).yielding
    assert yielding is not None
    halves = []
    for shape in pairs.geometry.geometryObjects:
        shape.geometry.computeLocalAABB()
        box = shape.geometry.aabb_local
        halves.append(0.5 * float(np.min(box.max_ - box.min_)))
    thinner = np.array(
        [min(halves[i], halves[j]) for i, j in pair_ends(pairs.geometry)]
    )
    presses = yielding.depths > 0.0
    assert presses.any()
    np.testing.assert_allclose(yielding.depths[presses], 0.7 * thinner[presses])
