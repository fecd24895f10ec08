"""`handmap hands pack`: a hand in one folder moves as before, and needs no other package."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import trimesh

from handmap_qp import HandMapper, load_hand, read_recording, scaled_human
from handmap_qp.apps.onboarding.pack import pack_hand
from handmap_qp.cli import main
from handmap_qp.errors import HandError, InvalidInputError
from handmap_qp.hands import Hand

# A palm with two fingers of one joint: a block, and a ball of many triangles, as felt and as seen.
_URDF = """<robot name="blocks"><link name="palm"/>
{fingers}</robot>"""
_FINGER = """<link name="{name}">
  <visual><geometry><mesh filename="{seen}"/></geometry></visual>
  <collision><geometry><mesh filename="{felt}"/></geometry></collision>
</link>
<joint name="{name}_joint" type="revolute"><parent link="palm"/><child link="{name}"/>
  <origin xyz="{place}"/><axis xyz="0 1 0"/>
  <limit lower="0" upper="1.5" velocity="3" effort="1"/></joint>
"""
_HAND = """name: blocks
urdf: blocks.urdf  # as drawn
side: right
palm: {link: palm, xyz: [0, 0, 0], distal: [1, 0, 0], dorsal: [0, 0, 1]}
wrist: {link: palm}
joints: [a_joint, b_joint]
rest: {a_joint: 0.1, b_joint: 0.1}
points:
  - {name: thumb_tip, link: a, xyz: [0.05, 0, 0], finger: thumb}
  - {name: index_tip, link: b, xyz: [0.05, 0, 0], finger: index}
sets: {fingertips: [thumb_tip, index_tip]}
reference: fingertips
"""


def made(folder: Path, fine: int = 4) -> Path:
    """Write a hand whose fingers feel a dented ball of 20 * 4 ** `fine` triangles."""
    folder.mkdir(parents=True)
    ball = trimesh.creation.icosphere(fine, 0.02)
    # A dent, which a convex hull fills.
    ball.vertices *= np.where(ball.vertices[:, :1] > 0.018, 0.5, 1.0)
    ball.apply_translation([0.03, 0.0, 0.0])
    (folder / "felt").mkdir()
    ball.export(folder / "felt" / "ball.stl")
    (folder / "seen").mkdir()
    ball.export(folder / "seen" / "ball.obj")
    fingers = (
        _FINGER.format(
            name=name, seen="seen/ball.obj", felt="felt/ball.stl", place=place
        )
        for name, place in (("a", "0 0.03 0"), ("b", "0 -0.03 0"))
    )
    (folder / "blocks.urdf").write_text(_URDF.format(fingers="".join(fingers)))
    file = folder / "hand.yaml"
    file.write_text(_HAND)
    return file


def meshes(folder: Path) -> dict[str, trimesh.Trimesh]:
    """Return the meshes that a packed URDF names, all of which lie in its folder."""
    names = {
        mesh.attrib["filename"] for mesh in ET.parse(folder / "hand.urdf").iter("mesh")
    }
    assert names == {f"meshes/{file.name}" for file in (folder / "meshes").iterdir()}
    return {name: mesh_in(folder / name) for name in names}


def mesh_in(file: Path) -> trimesh.Trimesh:
    mesh = trimesh.load(file, force="mesh")
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def joints_for_demo(robot: Hand) -> np.ndarray:
    recording = read_recording("demo", robot.side)
    mapper = HandMapper(scaled_human(recording), robot)
    samples = list(recording)[:40]
    return np.array(
        [mapper.map_landmarks(each.landmarks).command.q for each in samples]
    )


def test_a_packed_hand_moves_as_before_to_the_last_bit(tmp_path: Path) -> None:
    packed = pack_hand("allegro_right", tmp_path / "allegro")
    moved = joints_for_demo(load_hand(packed.file))
    np.testing.assert_array_equal(moved, joints_for_demo(load_hand("allegro_right")))
    assert np.ptp(moved, axis=0).max() > 0.1
    assert packed.size == sum(
        file.stat().st_size for file in (tmp_path / "allegro").rglob("*.*")
    ) + (0 if packed.licence is None else (tmp_path / "allegro/LICENSE").stat().st_size)


def test_meshes_have_few_triangles_and_what_is_felt_keeps_its_hull(
    tmp_path: Path,
) -> None:
    source = made(tmp_path / "source")
    packed = pack_hand(source, tmp_path / "packed", triangles=500)
    found = meshes(tmp_path / "packed")
    assert packed.meshes == len(found) == 2
    felt = mesh_in(tmp_path / "source/felt/ball.stl")
    hull = found["meshes/ball_hull.stl"]
    np.testing.assert_allclose(hull.volume, felt.convex_hull.volume, rtol=1e-6)
    np.testing.assert_allclose(hull.bounds, felt.bounds, atol=1e-8)
    seen = found["meshes/ball_few.stl"]
    assert len(seen.faces) <= 500
    # The grid's cells are finer than this.
    np.testing.assert_allclose(seen.bounds, felt.bounds, atol=0.004)
    assert load_hand(packed.file).joint_names == load_hand(source).joint_names


def test_small_meshes_are_copied_and_files_of_one_name_stay_apart(
    tmp_path: Path,
) -> None:
    source = made(tmp_path / "source", fine=1)
    pack_hand(source, tmp_path / "packed")
    found = tmp_path / "packed/meshes"
    for kind, suffix in (("seen", "obj"), ("felt", "stl")):
        original = tmp_path / "source" / kind / f"ball.{suffix}"
        assert (found / f"ball.{suffix}").read_bytes() == original.read_bytes()
    # Both named ball.stl, with other contents.
    seen = trimesh.creation.box([0.01, 0.02, 0.03])
    seen.export(tmp_path / "source/seen/ball.stl")
    urdf = tmp_path / "source/blocks.urdf"
    urdf.write_text(urdf.read_text().replace("seen/ball.obj", "seen/ball.stl"))
    pack_hand(source, tmp_path / "again")
    volumes = sorted(mesh.volume for mesh in meshes(tmp_path / "again").values())
    np.testing.assert_allclose(volumes[0], seen.volume, rtol=1e-5)
    assert volumes[1] > 2.0 * volumes[0]


def test_the_licence_of_the_model_goes_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = made(tmp_path / "maker" / "hand", fine=1)
    main(["hands", "pack", str(source), "--out", str(tmp_path / "without")])
    assert "ask its maker" in capsys.readouterr().out
    (tmp_path / "maker" / "License.txt").write_text("You may.")
    main(["hands", "pack", str(source), "--out", str(tmp_path / "with")])
    assert str(tmp_path / "maker" / "License.txt") in capsys.readouterr().out
    assert (tmp_path / "with" / "LICENSE").read_text() == "You may."


@pytest.mark.parametrize("side", ["left", "right"])
def test_leap_of_the_package_is_packed_with_its_licence(side: str) -> None:
    hand = load_hand("leap", side="right" if side == "right" else "left")
    folder = Path(str(hand.spec.directory))
    assert "Permission is hereby granted" in (folder / "LICENSE").read_text()
    assert all(len(mesh.faces) <= 4000 for mesh in meshes(folder).values())


@pytest.mark.parametrize(
    ("file", "content"),
    [("seen/ball.obj", "no mesh"), ("felt/ball.stl", ""), ("blocks.urdf", "<robot")],
)
def test_a_model_that_cannot_be_read_leaves_no_description(
    tmp_path: Path, file: str, content: str
) -> None:
    source = made(tmp_path / "source", fine=1)
    broken = source.parent / file
    broken.write_text(content)
    with pytest.raises(HandError, match=r"cannot be read|not valid XML"):
        pack_hand(source, tmp_path / "packed")
    broken.unlink()
    with pytest.raises(HandError, match="cannot be read"):
        pack_hand(source, tmp_path / "packed")
    assert not (tmp_path / "packed/hand.yaml").exists()


def test_what_cannot_be_packed_is_refused(tmp_path: Path) -> None:
    source = made(tmp_path / "source", fine=1)
    with pytest.raises(InvalidInputError, match="triangles"):
        pack_hand(source, tmp_path / "packed", triangles=3)
    with pytest.raises(HandError, match="pack the hand without the arm"):
        pack_hand("ur5_allegro", tmp_path / "packed")
    other = tmp_path / "source" / "other.yaml"
    other.write_text("extends: hand.yaml\nname: other\n")
    with pytest.raises(HandError, match="extends another description"):
        pack_hand(other, tmp_path / "packed")
    with pytest.raises(InvalidInputError, match="another folder than the hand's own"):
        pack_hand(source, source.parent, overwrite=True)
    assert not (tmp_path / "packed").exists()
    pack_hand(source, tmp_path / "packed")
    with pytest.raises(InvalidInputError, match="exists already"):
        pack_hand(source, tmp_path / "packed")
    pack_hand(source, tmp_path / "packed", overwrite=True)
