"""Data sets of hands with objects: small ones are written from known numbers, and read again."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mano_model import write_mano_model
from scipy.spatial.transform import Rotation

from handmap_qp import InvalidInputError, Recording, RecordingError, read_recording
from handmap_qp.apps.datasets.sources import find_files
from handmap_qp.cli import main
from handmap_qp.hands import Side
from handmap_qp.se3 import affine, transform_points
from handmap_qp.trackers.formats import FORMATS, list_sources, write_recordings

COUNT = 6
MODEL_SEEDS = {"left": 3, "right": 4}
MOVE = affine(Rotation.from_rotvec((0.4, -1.1, 0.7)).as_matrix(), (0.3, -0.2, 1.5))


def poses_of(seed: int) -> np.ndarray:
    """Poses that go through the world, shape (COUNT, 4, 4)."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.8, (COUNT, 3))).as_matrix()
    return affine(turns, rng.normal(0.0, 0.3, (COUNT, 3)))


def in_object(recording: Recording) -> np.ndarray:
    """Landmarks in the object's frame, which no motion of the world changes."""
    assert recording.object_pose is not None
    return transform_points(np.linalg.inv(recording.object_pose), recording.landmarks)


def refused(path: Path | str) -> str:
    with pytest.raises(RecordingError) as caught:
        read_recording(path, "right")
    assert "\n" not in str(caught.value)
    return str(caught.value)


# DexYCB


def write_dexycb(
    root: Path, *, side: Side = "right", move: np.ndarray | None = None
) -> tuple[Path, np.ndarray, np.ndarray]:
    """Write a sequence of two cameras, the second 1 m beside the first one.

    In sample 1 there is no hand, and in samples 2 and 3 no mustard bottle, which is what the hand
    grasps.

    Returns:
        The sequence's folder, and landmarks and poses in the frame of the first camera.
    """
    move = np.eye(4) if move is None else move
    folder = root / "subject-01" / "20200709_141754"
    hand = np.random.default_rng(7).normal(0.0, 0.05, (21, 3))
    joints = transform_points(move @ poses_of(1), hand)
    poses = move @ poses_of(2)
    for serial, shift in (("836212060125", 0.0), ("839512060362", 1.0)):
        camera = folder / serial
        camera.mkdir(parents=True)
        for i in range(COUNT):
            seen = poses_of(3)[:4, :3].astype(np.float32)
            seen[2] = poses[i, :3]
            seen[2, 0, 3] += shift
            seen[2] = {2: 0.0, 3: -1.0}.get(i, seen[2])
            points = np.full((21, 3), -1.0) if i == 1 else joints[i] + [shift, 0, 0]
            np.savez(
                camera / f"labels_{i:06d}.npz",
                seg=np.zeros((4, 4), np.uint8),
                pose_y=seen,
                joint_3d=points[None].astype(np.float32),
            )
    (folder / "meta.yml").write_text(
        f"mano_sides: [{side}]\nycb_ids: [1, 21, 5, 14]\nycb_grasp_ind: 2\n"
        f"num_frames: {COUNT}\nserials: ['836212060125', '839512060362']\n"
    )
    return folder, joints, poses


def write_mesh(root: Path) -> Path:
    mesh = root / "models" / "006_mustard_bottle" / "textured_simple.obj"
    mesh.parent.mkdir(parents=True)
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    lines = [f"v {0.06 * x:g} {0.06 * y:g} {0.1 * z:g}" for x, y, z in corners]
    lines += [f"f {a} {b} {c}" for a, b, c in ((1, 2, 4), (1, 4, 3), (5, 8, 6))]
    mesh.write_text("\n".join([*lines, "f 5 7 8", "f 1 6 2", "f 3 4 8"]))
    return mesh


@pytest.mark.parametrize("side", ["right", "left"])
def test_dexycb_is_read(tmp_path: Path, side: Side) -> None:
    mesh = write_mesh(tmp_path)
    folder, joints, poses = write_dexycb(tmp_path, side=side)
    (source,) = list_sources(folder)
    assert source.entry == (f"{side}_006_mustard_bottle", side, COUNT)
    found = source.read()
    assert (found.side, found.object_shape) == (side, str(mesh))
    np.testing.assert_allclose(found.time, np.arange(COUNT) / 30.0)
    np.testing.assert_array_equal(found.valid, np.arange(COUNT) != 1)
    seen = found.valid
    np.testing.assert_allclose(found.landmarks[seen], joints[seen], atol=1e-6)
    assert found.object_pose is not None
    is_lost = np.isnan(found.object_pose).any(axis=(1, 2))
    np.testing.assert_array_equal(is_lost, np.isin(np.arange(COUNT), (2, 3)))
    np.testing.assert_allclose(found.object_pose[~is_lost], poses[~is_lost], atol=1e-6)


def test_each_camera_of_dexycb_is_a_recording(tmp_path: Path) -> None:
    folder, joints, _ = write_dexycb(tmp_path)
    one, other = (
        read_recording(folder / name) for name in ("836212060125", "839512060362")
    )
    np.testing.assert_array_equal(one.landmarks, read_recording(folder).landmarks)
    np.testing.assert_allclose(other.landmarks[0], joints[0] + [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(in_object(one)[4], in_object(other)[4], atol=1e-6)
    assert one.object_shape == "", "the mesh is not there"


def test_dexycb_is_the_same_in_a_world_that_is_moved(tmp_path: Path) -> None:
    still = read_recording(write_dexycb(tmp_path / "still")[0])
    moved = read_recording(write_dexycb(tmp_path / "moved", move=MOVE)[0])
    assert np.abs(still.landmarks[0] - moved.landmarks[0]).max() > 0.5
    for i in (0, 4, 5):
        np.testing.assert_allclose(in_object(still)[i], in_object(moved)[i], atol=1e-6)


def test_an_object_that_is_never_seen_is_none(tmp_path: Path) -> None:
    write_mesh(tmp_path)
    folder, _, _ = write_dexycb(tmp_path)
    for file in folder.glob("*/labels_*.npz"):
        arrays: dict[str, Any] = {**np.load(file), "pose_y": np.zeros((4, 3, 4))}
        np.savez(file, **arrays)
    found = read_recording(folder)
    assert found.object_pose is None
    assert found.object_shape == ""


def edit_labels(folder: Path, **changes: Any) -> None:
    file = folder / "836212060125" / "labels_000003.npz"
    arrays = dict(np.load(file)) | changes
    np.savez(
        file, **{name: value for name, value in arrays.items() if value is not None}
    )


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: (f / "meta.yml").unlink(), "meta.yml: cannot be read: No such file"),
        (lambda f: (f / "meta.yml").write_text("{"), "meta.yml: cannot be read"),
        (lambda f: (f / "meta.yml").write_text("ycb_grasp_ind: 2"), "ycb_ids"),
        (
            lambda f: (f / "meta.yml").write_text(
                "{mano_sides: [up], ycb_ids: [3], ycb_grasp_ind: 0}"
            ),
            "side: expected right or left, got 'up'",
        ),
        (
            lambda f: (f / "meta.yml").write_text(
                "{mano_sides: [right], ycb_ids: [99], ycb_grasp_ind: 0}"
            ),
            "meta.yml: cannot be read: ",
        ),
        (lambda f: edit_labels(f, joint_3d=None), "labels_000003.npz: .*joint_3d"),
        (lambda f: edit_labels(f, pose_y=np.zeros((2, 3, 4))), "labels_000003.npz: "),
        (lambda f: edit_labels(f, joint_3d=np.zeros((1, 20, 3))), "labels_000003.npz"),
        (lambda f: edit_labels(f, joint_3d=np.array("x")), "labels_000003.npz"),
        (
            lambda f: edit_labels(f, pose_y=np.arange(48.0).reshape(4, 3, 4)),
            "object_pose: expected poses, got another matrix in sample 3",
        ),
        (
            lambda f: (f / "836212060125" / "labels_000002.npz").write_bytes(b"PK"),
            "labels_000002.npz: is not an .npz file",
        ),
    ],
)
def test_what_is_wrong_with_dexycb_is_said(
    tmp_path: Path, damage: Callable[[Path], Any], words: str
) -> None:
    folder, _, _ = write_dexycb(tmp_path)
    damage(folder)
    with pytest.raises(RecordingError, match=words) as caught:
        read_recording(folder)
    assert "\n" not in str(caught.value)


# ARCTIC


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Models of both hands, by side; the environment names them."""
    folder = tmp_path / "models_of_mano"
    folder.mkdir()
    found = {}
    for side, seed in MODEL_SEEDS.items():
        file = folder / f"MANO_{side.upper()}.pkl"
        write_mano_model(file, seed)
        found[side] = pickle.loads(file.read_bytes())
    monkeypatch.setenv("HANDMAP_MANO", str(folder))
    return found


def hands_of() -> dict[str, dict[str, np.ndarray]]:
    """Parameters of both hands as ARCTIC has them."""
    rng = np.random.default_rng(11)
    return {
        side: {
            "rot": rng.normal(0.0, 0.7, (COUNT, 3)),
            "pose": rng.normal(0.0, 0.2, (COUNT, 45)),
            "trans": rng.normal(0.0, 0.4, (COUNT, 3)),
            "shape": rng.normal(0.0, 1.0, 10),
            "fitting_err": rng.uniform(size=COUNT),
        }
        for side in ("right", "left")
    }


def write_arctic(
    folder: Path, hands: dict[str, Any], poses: np.ndarray, name: str = "box_grab_01"
) -> Path:
    """Write both hands and the object, whose lid opens."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.mano.npy"
    np.save(path, np.array(hands, dtype=object))
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    lid = np.linspace(0.0, 0.5, len(poses))
    rows = np.column_stack([lid, turns, 1000.0 * poses[:, :3, 3]])
    np.save(folder / f"{name}.object.npy", rows.astype(np.float32))
    return path


def joints_of(model: dict[str, Any], own: dict[str, np.ndarray]) -> np.ndarray:
    """The 16 joints of MANO by its definition, one after the other, shape (T, 16, 3)."""
    vertices = model["v_template"] + model["shapedirs"] @ own["shape"]
    rest = model["J_regressor"] @ vertices
    parents = model["kintree_table"][0]
    found = []
    poses = own["pose"] + model["hands_mean"]
    for rot, pose, trans in zip(own["rot"], poses, own["trans"], strict=True):
        angles = [rot, *pose.reshape(15, 3)]
        turns = [Rotation.from_rotvec(angles[0])]
        places = [rest[0]]
        for j in range(1, 16):
            up = int(parents[j])
            places.append(places[up] + turns[up].apply(rest[j] - rest[up]))
            turns.append(turns[up] * Rotation.from_rotvec(angles[j]))
        found.append(np.array(places) + trans)
    return np.array(found)


LANDMARKS_OF_JOINTS = [0, 5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3]


@pytest.mark.parametrize("is_repeated", [False, True])
def test_arctic_is_read(
    tmp_path: Path, models: dict[str, Any], is_repeated: bool
) -> None:
    hands, poses = hands_of(), poses_of(5)
    given = {side: dict(own) for side, own in hands.items()}
    if is_repeated:
        for own in given.values():
            own["shape"] = np.tile(own["shape"], (COUNT, 1))
    path = write_arctic(tmp_path / "s01", given, poses)
    sources = {source.entry.side: source for source in list_sources(path)}
    assert sorted(source.entry.name for source in sources.values()) == [
        "left_box",
        "right_box",
    ]
    for side, source in sources.items():
        found = source.read()
        joints = joints_of(models[side], hands[side])
        np.testing.assert_allclose(
            found.landmarks[:, LANDMARKS_OF_JOINTS], joints, atol=1e-9
        )
        assert found.object_pose is not None
        np.testing.assert_allclose(found.object_pose, poses, atol=1e-6)
        np.testing.assert_allclose(found.time, np.arange(COUNT) / 30.0)
        assert found.valid.all()
        assert found.object_shape == ""
        same = read_recording(f"{path}::{side}_box")
        np.testing.assert_array_equal(same.landmarks, found.landmarks)
        # The tips too are those of the same parameters in our own form.
        own = hands[side]
        npz = tmp_path / "own.npz"
        np.savez(
            npz,
            side=side,
            fps=30.0,
            pose=np.hstack([own["rot"], own["pose"]]),
            transl=own["trans"],
            betas=own["shape"],
            flat_hand_mean=False,
        )
        np.testing.assert_allclose(read_recording(npz).landmarks, found.landmarks)


def test_arctic_is_the_same_in_a_world_that_is_moved(
    tmp_path: Path, models: dict[str, Any]
) -> None:
    hands, poses = hands_of(), poses_of(5)
    still = write_arctic(tmp_path / "still", hands, poses)
    for side, own in hands.items():
        model = models[side]
        vertices = model["v_template"] + model["shapedirs"] @ own["shape"]
        # MANO turns about the wrist at rest.
        root = (model["J_regressor"] @ vertices)[0]
        turn = Rotation.from_matrix(MOVE[:3, :3])
        own["rot"] = (turn * Rotation.from_rotvec(own["rot"])).as_rotvec()
        own["trans"] = transform_points(MOVE, own["trans"] + root) - root
    moved = write_arctic(tmp_path / "moved", hands, MOVE @ poses)
    for side in ("left", "right"):
        one, other = (read_recording(path, side) for path in (still, moved))
        assert np.abs(one.landmarks - other.landmarks).max() > 0.5
        np.testing.assert_allclose(in_object(one), in_object(other), atol=2e-6)


def test_an_object_that_arctic_lost_is_not_seen(
    tmp_path: Path, models: dict[str, Any]
) -> None:
    path = write_arctic(tmp_path, hands_of(), poses_of(5))
    rows = np.load(tmp_path / "box_grab_01.object.npy")
    rows[2] = np.nan
    np.save(tmp_path / "box_grab_01.object.npy", rows)
    poses = read_recording(path, "right").object_pose
    assert poses is not None
    is_lost = np.isnan(poses).any(axis=(1, 2))
    np.testing.assert_array_equal(is_lost, np.arange(COUNT) == 2)


def test_one_hand_alone_is_read(tmp_path: Path, models: dict[str, Any]) -> None:
    hands = {"right": hands_of()["right"]}
    (source,) = list_sources(write_arctic(tmp_path, hands, poses_of(5)))
    assert source.read().side == "right"


class Harmful:
    """Writes a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.file, "run")


def test_a_pickle_that_runs_code_is_refused(
    tmp_path: Path, models: dict[str, Any]
) -> None:
    out = tmp_path / "run"
    path = write_arctic(tmp_path, hands_of(), poses_of(5))
    for content in (Harmful(out), {**hands_of(), "right": Harmful(out)}):
        np.save(path, np.array(content, dtype=object))
        assert "which is not read" in refused(path)
        assert not out.exists()
    # It would have run.
    np.load(path, allow_pickle=True)
    assert out.read_text() == "run"


def edit_object(path: Path, rows: np.ndarray) -> None:
    np.save(path.with_name("box_grab_01.object.npy"), rows)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (
            lambda p: p.with_name("box_grab_01.object.npy").unlink(),
            "box_grab_01.object.npy: cannot be read: No such file",
        ),
        (
            lambda p: edit_object(p, np.zeros((COUNT, 5))),
            r"box_grab_01.object.npy: expected numbers of shape \(T, 7\)",
        ),
        (
            lambda p: edit_object(p, np.zeros((COUNT + 1, 7))),
            "object_pose: expected numbers of shape",
        ),
        (
            lambda p: edit_object(p, np.array({"a": 1}, dtype=object)),
            "box_grab_01.object.npy: cannot be read",
        ),
        (lambda p: p.write_bytes(b"no array"), "box_grab_01.mano.npy: cannot be read"),
        (lambda p: p.write_bytes(p.read_bytes()[:900]), "mano.npy: cannot be read"),
        (lambda p: np.save(p, np.zeros(3)), "mano.npy: cannot be read"),
        (
            lambda p: np.save(p, np.array({"up": hands_of()["left"]}, dtype=object)),
            "side: expected right or left, got 'up'",
        ),
        (
            lambda p: np.save(p, np.array({"right": {"rot": 1}}, dtype=object)),
            "mano.npy: cannot be read: .*pose",
        ),
    ],
)
def test_what_is_wrong_with_arctic_is_said(
    tmp_path: Path, models: dict[str, Any], damage: Callable[[Path], Any], words: str
) -> None:
    path = write_arctic(tmp_path, hands_of(), poses_of(5))
    damage(path)
    with pytest.raises(RecordingError, match=words) as caught:
        read_recording(path, "right")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [("rot", np.zeros((COUNT, 4))), ("pose", np.full((COUNT, 45), np.nan))],
)
def test_parameters_that_are_none_are_named(
    tmp_path: Path, models: dict[str, Any], name: str, value: np.ndarray
) -> None:
    hands = hands_of()
    hands["right"][name] = value
    own = {"rot": "global_orient", "pose": "hand_pose"}[name]
    assert f"{own}: expected finite numbers" in refused(
        write_arctic(tmp_path, hands, poses_of(5))
    )


def test_arctic_needs_the_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HANDMAP_MANO", raising=False)
    path = write_arctic(tmp_path, hands_of(), poses_of(5))
    assert "need the licensed model" in refused(path)


# GRAB


def write_grab(root: Path, hands: dict[str, Any], poses: np.ndarray) -> Path:
    """Write a sequence with the meshes of the person and of the object."""
    trimesh = pytest.importorskip("trimesh")
    meshes = root / "tools" / "subject_meshes" / "female"
    meshes.mkdir(parents=True)
    tables: dict[str, Any] = {}
    for side, own in hands.items():
        mesh = trimesh.Trimesh(own["v_template"], [[0, 1, 2]], process=False)
        mesh.export(meshes / f"s1_{side[0]}hand.ply", encoding="ascii")
        tables[f"{side[0]}hand"] = {
            "params": {
                "global_orient": own["rot"],
                "hand_pose": own["components"],
                "transl": own["trans"],
                "fullpose": np.zeros((COUNT, 45)),
            },
            "vtemp": f"tools/subject_meshes/female/s1_{side[0]}hand.ply",
        }
    things = root / "tools" / "object_meshes" / "contact_meshes"
    things.mkdir(parents=True)
    trimesh.creation.box((0.03, 0.06, 0.05)).export(things / "banana.ply")
    # Points are rows there, `points @ R + transl`.
    turns = Rotation.from_matrix(poses[:, :3, :3].swapaxes(1, 2)).as_rotvec()
    tables["object"] = {
        "params": {"global_orient": turns, "transl": poses[:, :3, 3]},
        "object_mesh": "tools/object_meshes/contact_meshes/banana.ply",
    }
    tables["body"] = {"params": {}, "vtemp": ""}
    path = root / "grab" / "s1" / "banana_eat_1.npz"
    path.parent.mkdir(parents=True)
    packed: dict[str, Any] = {
        name: np.array(table, dtype=object) for name, table in tables.items()
    }
    packed |= {"gender": "female", "obj_name": "banana"}
    packed |= {"framerate": 120.0, "n_comps": 24, "n_frames": COUNT}
    np.savez(path, **packed)
    return path


def persons(models: dict[str, Any]) -> dict[str, Any]:
    """Parameters of both hands as GRAB has them, with the meshes of a person."""
    rng = np.random.default_rng(13)
    hands = hands_of()
    for own in hands.values():
        own["components"] = rng.normal(0.0, 0.3, (COUNT, 24))
        own["v_template"] = rng.normal(0.0, 0.05, (778, 3)).round(6)
    return hands


def test_grab_is_read(tmp_path: Path, models: dict[str, Any]) -> None:
    hands, poses = persons(models), poses_of(5)
    path = write_grab(tmp_path, hands, poses)
    for source in list_sources(path):
        found, side = source.read(), source.entry.side
        own, model = hands[side], models[side]
        assert source.entry.name == side
        # A pose of zero is the flat hand, and the mesh is that of the person.
        flat = {"hands_mean": 0.0, "v_template": own["v_template"]}
        pose = own["components"] @ model["hands_components"][:24]
        joints = joints_of(
            {**model, **flat}, {**own, "pose": pose, "shape": np.zeros(10)}
        )
        np.testing.assert_allclose(
            found.landmarks[:, LANDMARKS_OF_JOINTS], joints, atol=1e-6
        )
        assert found.object_pose is not None
        np.testing.assert_allclose(found.object_pose, poses, atol=1e-9)
        np.testing.assert_allclose(found.time, np.arange(COUNT) / 120.0)
        mesh = tmp_path / "tools" / "object_meshes" / "contact_meshes" / "banana.ply"
        assert found.object_shape == str(mesh)


def test_what_is_wrong_with_grab_is_said(
    tmp_path: Path, models: dict[str, Any]
) -> None:
    path = write_grab(tmp_path, persons(models), poses_of(5))
    arrays: dict[str, Any] = dict(np.load(path, allow_pickle=True))
    out = tmp_path / "run"
    harm: Any = np.array(Harmful(out), dtype=object)
    np.savez(path, **(arrays | {"rhand": harm}))
    assert "which is not read" in refused(path)
    assert not out.exists()
    np.savez(path, **{n: a for n, a in arrays.items() if n != "lhand"})
    assert "lhand" in refused(path)
    np.savez(path, **arrays)
    (tmp_path / "tools" / "subject_meshes" / "female" / "s1_rhand.ply").unlink()
    assert "s1_rhand.ply" in refused(path)


# HOT3D

UIDS = (223371871635142, 37787722328019)


def write_hot3d(
    folder: Path,
    hands: dict[str, Any],
    poses: dict[int, np.ndarray],
    start: int = 56752108188860,
) -> Path:
    """Write a sequence; the right hand is not seen in sample 1, nor the second object in 2."""
    folder.mkdir(parents=True)
    stamps = [start + 33333333 * i for i in range(COUNT)]
    quats = {
        side: Rotation.from_rotvec(own["rot"]).as_quat(scalar_first=True)
        for side, own in hands.items()
    }
    lines = []
    for i, stamp in enumerate(stamps):
        seen = {
            {"left": "0", "right": "1"}[side]: {
                "pose": own["components"][i].tolist(),
                "wrist_xform": {
                    "t_xyz": own["trans"][i].tolist(),
                    "q_wxyz": quats[side][i].tolist(),
                },
                "betas": own["shape"].tolist(),
            }
            for side, own in hands.items()
            if (side, i) != ("right", 1)
        }
        lines.append(json.dumps({"timestamp_ns": stamp, "hand_poses": seen}))
    (folder / "mano_hand_pose_trajectory.jsonl").write_text("\n".join(lines) + "\n")
    rows = [
        "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z"
    ]
    for i, stamp in enumerate(stamps):
        for uid, own in poses.items():
            quat = Rotation.from_matrix(own[i, :3, :3]).as_quat(scalar_first=True)
            if (uid, i) != (UIDS[1], 2):
                numbers = map(repr, map(float, [*own[i, :3, 3], *quat]))
                rows.append(",".join([str(uid), str(stamp), *numbers]))
    (folder / "dynamic_objects.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.mark.parametrize("is_mirrored", [False, True])
def test_hot3d_is_read(
    tmp_path: Path, models: dict[str, Any], is_mirrored: bool
) -> None:
    """Both hands with each object; shapes of a left model that are the right one's are mirrored."""
    if is_mirrored:
        left = models["left"]
        left["shapedirs"][:, 0] = models["right"]["shapedirs"][:, 0]
        file = tmp_path / "models_of_mano" / "MANO_LEFT.pkl"
        file.write_bytes(pickle.dumps(left))
        left["shapedirs"][:, 0] *= -1.0
    rng = np.random.default_rng(17)
    hands, poses = hands_of(), dict(zip(UIDS, (poses_of(5), poses_of(6)), strict=True))
    for own in hands.values():
        own["components"] = rng.normal(0.0, 0.3, (COUNT, 15))
    path = write_hot3d(tmp_path / "P0003_c701bd11", hands, poses)
    mesh = tmp_path / "assets" / f"{UIDS[0]}.glb"
    mesh.parent.mkdir()
    mesh.touch()
    sources = {source.entry.name: source for source in list_sources(path)}
    assert set(sources) == {f"{side}_{uid}" for side in hands for uid in UIDS}
    for name, source in sources.items():
        found, side = source.read(), source.entry.side
        own, uid = hands[side], int(name.partition("_")[2])
        model = models[side]
        pose = own["components"] @ model["hands_components"][:15]
        seen = np.arange(COUNT) != (1 if side == "right" else -1)
        joints = joints_of(model, {**own, "pose": pose})[seen]
        np.testing.assert_allclose(
            found.landmarks[:, LANDMARKS_OF_JOINTS], joints, atol=1e-9
        )
        since = found.time - found.time[0]
        np.testing.assert_allclose(since, np.arange(COUNT)[seen] / 30.0, atol=1e-6)
        assert found.object_pose is not None
        is_lost = np.isnan(found.object_pose).any(axis=(1, 2))
        lost = (np.arange(COUNT) == 2) & (uid == UIDS[1])
        np.testing.assert_array_equal(is_lost, lost[seen])
        np.testing.assert_allclose(
            found.object_pose[~is_lost], poses[uid][seen & ~lost], atol=1e-9
        )
        assert found.object_shape == (str(mesh) if uid == UIDS[0] else "")
    assert "it has 2 recordings" in refused(path)


def test_hot3d_finds_its_object_at_instants_beyond_the_digits_of_a_float(
    tmp_path: Path, models: dict[str, Any]
) -> None:
    hands = {"left": hands_of()["left"]}
    hands["left"]["components"] = np.zeros((COUNT, 15))
    # Nanoseconds since 1970, of which a float keeps every 256th.
    path = write_hot3d(
        tmp_path / "P0003", hands, {UIDS[0]: poses_of(5)}, 1700000000000000001
    )
    (source,) = list_sources(path)
    found = source.read()
    assert found.object_pose is not None
    np.testing.assert_allclose(found.object_pose, poses_of(5), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        (
            "mano_hand_pose_trajectory.jsonl",
            "{",
            "cannot be read: Input data",
        ),
        ("mano_hand_pose_trajectory.jsonl", "{}", "hand_poses"),
        ("dynamic_objects.csv", "object_uid\nx", "dynamic_objects.csv: cannot be read"),
        ("dynamic_objects.csv", "object_uid\n1,2,3", "dynamic_objects.csv: expected 7"),
    ],
)
def test_what_is_wrong_with_hot3d_is_said(
    tmp_path: Path, models: dict[str, Any], name: str, content: str, words: str
) -> None:
    hands = hands_of()
    for own in hands.values():
        own["components"] = own["pose"][:, :15]
    path = write_hot3d(tmp_path / "P0003", hands, {UIDS[0]: poses_of(5)})
    (path / name).write_text(content)
    assert words in refused(path)


# What is not read, and what is not written


@pytest.fixture
def _alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the formats of other packages, such as packages/hamer."""
    monkeypatch.setattr(FORMATS, "_others", {})


@pytest.mark.usefixtures("_alone")
def test_oakink_is_refused_with_what_to_do(tmp_path: Path) -> None:
    path, out = tmp_path / "anno.pkl", tmp_path / "run"
    path.write_bytes(pickle.dumps(Harmful(out)))
    words = refused(path)
    assert "OakInk2" in words
    assert "object_pose" in words
    assert not out.exists()


def test_the_form_mano_takes_objects(tmp_path: Path) -> None:
    poses = poses_of(5)
    np.savez(
        tmp_path / "own.npz",
        side="left",
        fps=30.0,
        joints=transform_points(poses_of(1), np.ones((21, 3))),
        object_pose=poses,
        object_shape="box:0.05",
    )
    found = read_recording(tmp_path / "own.npz")
    np.testing.assert_array_equal(found.object_pose, poses)
    assert found.object_shape == "box:0.05"
    (source,) = list_sources(tmp_path / "own.npz")
    assert source.format.unread(source.path) == ()


@pytest.mark.parametrize("name", ["dexycb", "arctic", "grab", "hot3d"])
def test_data_sets_are_not_written(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture
) -> None:
    given = read_recording("demo", "right")
    with pytest.raises(InvalidInputError, match=f"{name}: is read and not written"):
        write_recordings([given], tmp_path / "a", FORMATS[name])
    with pytest.raises(InvalidInputError, match="arctic: is read and not written"):
        write_recordings([given], tmp_path / "a.mano.npy")
    assert main(["convert", "demo::right", str(tmp_path / "a.mano.npy")]) == 2
    assert "arctic: is read and not written" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


@pytest.mark.usefixtures("_alone")
def test_other_files_of_arctic_are_no_landmarks(tmp_path: Path) -> None:
    write_arctic(tmp_path, hands_of(), poses_of(5))
    words = refused(tmp_path / "box_grab_01.object.npy")
    assert "expected landmarks of one hand" in words


# Commands


def test_convert_reads_data_sets(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    models: dict[str, Any],
    capsys: pytest.CaptureFixture,
) -> None:
    monkeypatch.delenv("HANDMAP_MANO")
    path = write_arctic(tmp_path / "s01", hands_of(), poses_of(5))
    folder, _, _ = write_dexycb(tmp_path)
    write_mesh(tmp_path)
    out = tmp_path / "out.npz"
    # What the command sets is undone with it.
    monkeypatch.setenv("HANDMAP_MANO", "")
    model = tmp_path / "models_of_mano"
    assert main(["convert", str(path), str(out), "--mano", str(model)]) == 0
    assert "lost: the articulation of the object" in capsys.readouterr().out
    monkeypatch.setenv("HANDMAP_MANO", str(model))
    for side in ("left", "right"):
        one, other = read_recording(out, side), read_recording(path, side)
        np.testing.assert_array_equal(one.landmarks, other.landmarks)
        np.testing.assert_array_equal(one.object_pose, other.object_pose)
    assert main(["convert", str(folder), str(out)]) == 0
    assert "lost: other cameras" in capsys.readouterr().out
    one, other = read_recording(out), read_recording(folder)
    np.testing.assert_array_equal(one.object_pose, other.object_pose)
    assert one.object_shape == other.object_shape != ""


def test_a_folder_is_searched_for_data_sets(
    tmp_path: Path, models: dict[str, Any]
) -> None:
    """Each sequence is found once, and of ARCTIC and HOT3D the files of hands alone."""
    write_arctic(tmp_path / "arctic" / "s01", hands_of(), poses_of(5))
    hands = persons(models)
    grab = write_grab(tmp_path / "grab", hands, poses_of(5))
    hot3d = write_hot3d(tmp_path / "hot3d" / "P0003", hands, {UIDS[0]: poses_of(5)})
    folder, _, _ = write_dexycb(tmp_path)
    (tmp_path / "model.pkl").write_bytes(b"")
    found, repeated = find_files([tmp_path], tmp_path / "out")
    assert sorted(found.values()) == [
        tmp_path / "arctic" / "s01" / "box_grab_01.mano.npy",
        grab,
        hot3d,
        folder,
    ]
    assert not repeated


def test_the_robot_touches_the_object_of_a_data_set(tmp_path: Path) -> None:
    """`held` in the form of DexYCB is mapped as itself, whatever the origin of its mesh."""
    trimesh = pytest.importorskip("trimesh")
    held = read_recording("held").part(slice(0, 90))
    assert held.object_pose is not None
    camera = tmp_path / "data" / "subject-01" / "sequence" / "836212060125"
    camera.mkdir(parents=True)
    origin = affine(np.eye(3), (0.02, -0.03, 0.05))
    poses = held.object_pose @ np.linalg.inv(origin)
    for i in range(len(held)):
        np.savez(
            camera / f"labels_{i:06d}.npz",
            joint_3d=held.landmarks[None, i],
            pose_y=poses[None, i, :3],
        )
    (camera.parent / "meta.yml").write_text(
        "{mano_sides: [right], ycb_ids: [5], ycb_grasp_ind: 0}"
    )
    mesh = tmp_path / "data" / "models" / "006_mustard_bottle" / "textured_simple.obj"
    mesh.parent.mkdir(parents=True)
    trimesh.creation.box((0.03, 0.06, 0.05), origin).export(mesh)
    out = tmp_path / "mapped.npz"
    command = ["map", str(camera.parent), "--robot", "allegro_right", "--out", str(out)]
    assert main(command) == 0
    with np.load(out) as arrays:
        assert arrays["object_pose"].shape == (90, 4, 4)
        touched = arrays["q"]
    same = tmp_path / "same.npz"
    write_recordings([replace(held, time=np.arange(90) / 30.0)], same)
    assert main(["map", str(same), *command[2:]]) == 0
    with np.load(out) as arrays:
        np.testing.assert_allclose(touched, arrays["q"], atol=2e-3)
    alone = replace(read_recording(same), object_pose=None, object_shape="")
    write_recordings([alone], same)
    assert main(["map", str(same), *command[2:]]) == 0
    with np.load(out) as arrays:
        assert np.abs(touched - arrays["q"]).max() > 0.05
