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

from handmap_qp import Hand, HandError, HandSpec, IkOptions, PointSpec
from handmap_qp.apps.onboarding.collision_pairs import colliding_links
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.spec import ArmSpec, CollisionSpec, PalmSpec, WristSpec
from handmap_qp.ik.qp import PointIk

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


def test_a_mesh_that_does_not_exist_is_named(tmp_path: Path) -> None:
    (tmp_path / "hand.urdf").write_text(
        FINGER.format(mesh="package://nowhere/gone.stl")
    )
    hand = Hand(msgspec.structs.replace(SPEC, directory=tmp_path))
    with pytest.raises(
        HandError, match=r"collision shapes cannot be read: .*gone\.stl"
    ):
        read_collision_shapes(hand)


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


def test_a_flat_mesh_is_named(tmp_path: Path) -> None:
    flat = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]]
    )
    flat.export(tmp_path / "flat.stl")
    (tmp_path / "hand.urdf").write_text(FINGER.format(mesh="flat.stl"))
    with pytest.raises(HandError, match=r"palm_0.* is flat"):
        read_collision_shapes(Hand(msgspec.structs.replace(SPEC, directory=tmp_path)))


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
