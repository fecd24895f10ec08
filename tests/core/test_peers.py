"""Exchange with the peers: frames, joint order, holds, errors, and real runs."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from handmap_core.human.recording import Recording
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.se3 import affine, transform_points
from handmap_qp.trackers.formats import read_recording

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
MODULES = ("build", "runner", "results")
CURLED = 0.6
POSE = affine(
    Rotation.from_euler("XYZ", [0.4, -0.9, 2.0]).as_matrix(), np.array([0.3, 1.1, -0.2])
)


@pytest.fixture(scope="module")
def peers() -> Iterator[Any]:
    """The modules of `benchmarks/peers`."""
    sys.path.insert(0, str(FOLDER))
    try:
        yield SimpleNamespace(
            **{name: importlib.import_module(f"peers.{name}") for name in MODULES}
        )
    finally:
        sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def built(peers: Any) -> Any:
    """Return these modules; skip where the environments of the peers are not built."""
    missing = peers.build.missing_peers()
    if missing:
        pytest.skip(
            f"{', '.join(missing)} not built in {peers.build.peers_folder()}: make peers"
        )
    return peers


@pytest.fixture(scope="module")
def allegro() -> Hand:
    return load_hand("allegro_right")


def human_landmarks(name: str = "human", pose: np.ndarray = POSE) -> np.ndarray:
    """Landmarks of a hand with its fingers half curled, in the world."""
    human = load_hand(name, points="landmarks")
    q = np.clip(CURLED, human.lower_limits, human.upper_limits)
    return transform_points(pose, human.points(q))


def recording_of(
    landmarks: np.ndarray, valid: np.ndarray | None = None, side: Any = "right"
) -> Any:
    time = np.arange(len(landmarks)) / 60.0
    seen = np.ones(len(landmarks), dtype=bool) if valid is None else valid
    return Recording("made", time, landmarks, seen, side)


def stretch(recording: Recording, first: int, count: int) -> Recording:
    return recording.part(slice(first, first + count))


def test_operator_frame_is_the_one_of_dex_retargetings_examples(peers: Any) -> None:
    landmarks = human_landmarks()
    # As in the peer's examples: a plane through three landmarks by SVD, then OPERATOR2MANO_RIGHT.
    points = landmarks[[0, 5, 9]]
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    x = points[0] - points[2]
    x = x - (x @ normal) * normal
    x /= np.linalg.norm(x)
    z = np.cross(x, normal)
    if z @ (points[1] - points[2]) < 0:
        normal, z = -normal, -z
    operator_to_mano = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    expected = np.column_stack([x, normal, z]) @ operator_to_mano
    frame = peers.runner.operator_frame(landmarks)
    np.testing.assert_allclose(frame, expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, atol=1e-12)


def test_operator_frame_has_the_axes_of_the_robots(peers: Any) -> None:
    frame = POSE[:3, :3].T @ peers.runner.operator_frame(human_landmarks())
    # Our palm: y distal, z dorsal, the thumb at -x. Theirs: z distal, x out of the palm, the thumb
    # at +y. The knuckle of the middle finger is a little off the axis of the palm.
    assert frame[:, 2] @ [0, 1, 0] > 0.95
    assert frame[:, 0] @ [0, 0, -1] > 0.9
    assert frame[:, 1] @ [-1, 0, 0] > 0.9


def test_a_left_hand_asks_for_the_mirror_image_of_a_right_one(peers: Any) -> None:
    vectors = np.array([[0, 0, 8], [4, 8, 4]])
    right, left = human_landmarks(), human_landmarks() * [-1.0, 1.0, 1.0]
    found = peers.runner.reference_value(left, vectors, -1.0)
    expected = peers.runner.reference_value(right, vectors) * [1.0, -1.0, 1.0]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    frame = peers.runner.operator_frame(left, -1.0)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, atol=1e-12)


def test_vectors_do_not_depend_on_where_the_hand_is(peers: Any) -> None:
    vectors = np.array([[0, 0, 8], [4, 8, 4]])
    here, there = human_landmarks(), human_landmarks(pose=np.eye(4))
    reference = peers.runner.reference_value
    np.testing.assert_allclose(
        reference(here, vectors), reference(there, vectors), atol=1e-12
    )
    lengths = np.linalg.norm(here[[4, 8, 4]] - here[[0, 0, 8]], axis=1)
    np.testing.assert_allclose(
        np.linalg.norm(reference(here, vectors), axis=1), lengths
    )
    # Positions stay in the tracker's world.
    np.testing.assert_array_equal(reference(here, np.array([4, 8])), here[[4, 8]])


def test_dexpilot_pairs_are_those_of_the_peers_documentation(peers: Any) -> None:
    origin, end = peers.runner.human_indices({"finger_tip_link_names": list("abcd")})
    assert list(origin // 4) == [2, 3, 4, 3, 4, 4, 0, 0, 0, 0]
    assert list(end // 4) == [1, 1, 1, 2, 2, 3, 1, 2, 3, 4]
    assert peers.runner.human_indices(
        {"finger_tip_link_names": list("abcde")}
    ).shape == (2, 15)


def test_free_root_turns_about_x_then_y_then_z(peers: Any) -> None:
    angles = np.array([0.7, -1.2, 2.8])
    pose = peers.runner.root_pose(np.concatenate([[1.0, 2.0, 3.0], angles]))
    np.testing.assert_allclose(
        pose[:3, :3], Rotation.from_euler("XYZ", angles).as_matrix(), atol=1e-12
    )
    np.testing.assert_array_equal(pose[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(
        peers.runner.root_angles(pose[:3, :3]), angles, atol=1e-12
    )


def test_samples_that_are_not_valid_hold_the_last_command(peers: Any) -> None:
    landmarks = np.tile(human_landmarks(), (6, 1, 1))
    valid = np.array([False, True, False, False, True, False])
    landmarks[~valid] = np.nan
    calls = []

    def retarget(reference: np.ndarray) -> np.ndarray:
        assert np.isfinite(reference).all()
        calls.append(reference)
        return np.full(2, float(len(calls)))

    solver = SimpleNamespace(sign=1.0, joint_names=["a", "b"], retarget=retarget)
    vectors = np.array([[0], [4]])
    done: list[int] = []
    q, cpu_time = peers.runner.retarget_all(
        solver, landmarks, valid, vectors, done.append
    )
    np.testing.assert_array_equal(q[:, 0], [1, 1, 1, 1, 2, 2])
    np.testing.assert_array_equal(np.isfinite(cpu_time), valid)
    assert len(calls) == 2
    assert done[-1] == 6


def test_free_root_starts_at_the_first_sample_that_is_valid(peers: Any) -> None:
    landmarks = np.stack([human_landmarks(), human_landmarks(pose=np.eye(4))])
    started = []
    solver = SimpleNamespace(
        sign=1.0,
        joint_names=["a"],
        retarget=lambda _: np.zeros(1),
        start=started.append,
    )
    valid = np.array([False, True])
    peers.runner.retarget_all(
        solver, landmarks, valid, np.array([4, 8]), lambda _: None
    )
    (first,) = started
    np.testing.assert_array_equal(first, landmarks[1])


def write_result(file: Path, names: list[str], q: np.ndarray, **more: Any) -> None:
    cpu_time = np.full(len(q), 1e-3)
    facts = np.array(json.dumps({"peer": "made"}))
    np.savez(
        file, joint_names=np.array(names), q=q, cpu_time=cpu_time, facts=facts, **more
    )


def test_joints_are_ordered_by_name(peers: Any, allegro: Hand, tmp_path: Path) -> None:
    # Pinocchio's order differs from ours: the thumb comes second. Mimic joints are left out.
    names = ["follower", *sorted(allegro.joint_names)]
    assert tuple(names[1:]) != allegro.joint_names
    q = np.array(
        [[float(name.split("_")[-1]) if "_" in name else -1.0 for name in names]]
    )
    write_result(tmp_path / "made.npz", names, q)
    method = peers.results.METHODS["dexi-vector"]
    recording = recording_of(human_landmarks()[None])
    motion = peers.results.read_result(
        tmp_path / "made.npz", method, recording, allegro
    )
    np.testing.assert_array_equal(motion.q, [np.arange(16.0)])
    assert motion.own_wrist is None


def test_result_of_another_robot_or_recording_is_rejected(
    peers: Any, allegro: Hand, tmp_path: Path
) -> None:
    file, method = tmp_path / "made.npz", peers.results.METHODS["dexi-vector"]
    write_result(file, list(allegro.joint_names)[1:], np.zeros((1, 15)))
    with pytest.raises(peers.results.PeerError, match=r"no joint joint_0\.0"):
        peers.results.read_result(
            file, method, recording_of(human_landmarks()[None]), allegro
        )
    write_result(file, list(allegro.joint_names), np.zeros((2, 16)))
    with pytest.raises(
        peers.results.PeerError, match="expected 1 samples of made, got 2"
    ):
        peers.results.read_result(
            file, method, recording_of(human_landmarks()[None]), allegro
        )


def test_left_hand_becomes_a_right_one(peers: Any) -> None:
    left = recording_of(human_landmarks("human_left", np.eye(4))[None], side="left")
    right = peers.results.mirrored(left)
    assert (right.side, left.side) == ("right", "left")
    # Mirroring changes the sign of x only; our models of both hands are mirrored likewise.
    np.testing.assert_allclose(
        right.landmarks[0], human_landmarks(pose=np.eye(4)), atol=1e-9
    )
    np.testing.assert_array_equal(
        peers.results.mirrored(right).landmarks, left.landmarks
    )


def test_palm_is_that_of_the_five_landmarks(
    peers: Any, allegro: Hand, tmp_path: Path
) -> None:
    poses = [np.eye(4), POSE, np.eye(4)]
    landmarks = np.array([human_landmarks(pose=pose) for pose in poses])
    # Fingers are not part of the palm.
    landmarks[1, [6, 7, 8]] += 0.02
    recording = recording_of(landmarks, np.array([False, True, False]))
    palms = peers.results.measured_palms(recording)
    # The model is measured on the same landmarks, so that only rounding remains.
    np.testing.assert_allclose(palms, [POSE, POSE, POSE], atol=1e-6)
    write_result(
        tmp_path / "made.npz", list(allegro.joint_names), np.tile(allegro.rest, (3, 1))
    )
    method = peers.results.METHODS["dex-vector"]
    motion = peers.results.read_result(
        tmp_path / "made.npz", method, recording, allegro
    )
    palm = allegro.frame_pose("palm", motion.q[1], motion.wrist[1])
    np.testing.assert_allclose(palm, palms[1], atol=1e-9)


def test_root_that_a_peer_moved_gives_its_wrist(
    peers: Any, allegro: Hand, tmp_path: Path
) -> None:
    write_result(
        tmp_path / "made.npz",
        list(allegro.joint_names),
        allegro.rest[None],
        base_pose=POSE[None],
    )
    method = peers.results.METHODS["dex-position"]
    recording = recording_of(human_landmarks()[None])
    motion = peers.results.read_result(
        tmp_path / "made.npz", method, recording, allegro
    )
    root = allegro.frame_pose("palm_link", motion.q[0], motion.own_wrist[0])
    np.testing.assert_allclose(root, POSE, atol=1e-9)


def test_peers_that_are_not_built_are_one_clear_line(
    peers: Any, allegro: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HANDMAP_PEERS", str(tmp_path))
    monkeypatch.setattr(peers.build, "find_spec", lambda _: None)
    recording = recording_of(human_landmarks()[None])
    with pytest.raises(peers.results.PeerError) as caught:
        peers.results.run_peer("dex-vector", recording, allegro)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("dex-retargeting, dexi-rs: not built")
    assert str(caught.value).endswith("run make peers")
    with pytest.raises(
        InvalidInputError, match="method: expected one of dex-vector,"
    ) as wrong:
        peers.results.run_peer("dex", recording, allegro)
    assert wrong.value.argument == "method"


@pytest.fixture
def installed(
    peers: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> dict[str, Path]:
    """Folders of the peers' modules, as if they were installed beside this interpreter."""
    monkeypatch.setenv("HANDMAP_PEERS", str(tmp_path / "peers"))
    folders = {peer.module: tmp_path / peer.module for peer in peers.build.PEERS}
    for peer in peers.build.PEERS:
        (folders[peer.module] / peer.data[0]).mkdir(parents=True)

    def find(name: str) -> SimpleNamespace | None:
        if name not in folders:
            return None
        return SimpleNamespace(submodule_search_locations=[str(folders[name])])

    monkeypatch.setattr(peers.build, "find_spec", find)
    monkeypatch.setattr(
        peers.build.importlib.metadata, "version", lambda name: f"1.0 of {name}"
    )
    return folders


def test_peers_that_are_installed_need_no_environment(
    peers: Any, installed: dict[str, Path]
) -> None:
    """Without torch and six, dex-retargeting has its configurations only."""
    build = peers.build
    assert build.missing_peers() == ["dex-retargeting"]
    assert build.python_of("dexi-rs") == sys.executable
    assert build.version_of("dexi-rs") == "1.0 of dexi-rs"
    # The environment of the other would have to be built.
    assert build.python_of("dex-retargeting") != sys.executable
    data = build.data_folder()
    for peer in build.PEERS:
        inside, name = peer.data
        assert (data / name).resolve() == installed[peer.module] / inside
    # Another installation takes the place of the first.
    moved = installed["dexi_rs"].rename(installed["dexi_rs"].with_name("moved"))
    installed["dexi_rs"] = moved
    assert (build.data_folder() / "hands").resolve().is_relative_to(moved)
    installed |= {name: moved for name in ("torch", "six")}
    assert build.missing_peers() == []


def test_one_peer_is_not_enough(peers: Any, installed: dict[str, Path]) -> None:
    """Descriptions are of the one, configurations of the other."""
    del installed["dex_retargeting"]
    assert {*peers.build.missing_peers()} == {"dex-retargeting", "dexi-rs"}


def test_what_to_do_depends_on_whether_there_is_a_checkout(
    peers: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "make peers" in peers.build.why_missing(["dexi-rs"])
    monkeypatch.setattr(peers.build, "is_checkout", lambda: False)
    text = peers.build.why_missing(["dexi-rs"])
    assert "pip install 'handmap-qp[peers]'" in text
    assert "make peers" not in text
    assert "\n" not in text


def test_a_built_environment_comes_before_what_is_installed(
    peers: Any, installed: dict[str, Path]
) -> None:
    build = peers.build
    for peer in build.PEERS:
        python = build.environment_python(peer.name)
        python.parent.mkdir(parents=True)
        python.touch()
        (build.peers_folder() / "data" / peer.data[1]).mkdir(parents=True)
        stamp = build.peers_folder() / peer.name / ".installed"
        stamp.write_text(peer.requirements.read_text("utf-8"), encoding="utf-8")
    assert installed
    assert build.missing_peers() == []
    assert build.python_of("dexi-rs") == str(build.environment_python("dexi-rs"))
    assert build.data_folder() == build.peers_folder() / "data"


def test_environment_is_built_again_after_its_requirements_change(
    peers: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HANDMAP_PEERS", str(tmp_path))
    for peer in peers.build.PEERS:
        python = peers.build.environment_python(peer.name)
        python.parent.mkdir(parents=True)
        python.touch()
        (tmp_path / "data" / peer.data[1]).mkdir(parents=True)
        stamp = tmp_path / peer.name / ".installed"
        stamp.write_text(
            peer.requirements.read_text(encoding="utf-8"), encoding="utf-8"
        )
    assert peers.build.missing_peers() == []
    (tmp_path / "dexi-rs" / ".installed").write_text(
        "dexi-rs==0.4.0\n", encoding="utf-8"
    )
    assert peers.build.missing_peers() == ["dexi-rs"]


def test_build_that_fails_is_one_line(
    peers: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("HANDMAP_PEERS", str(tmp_path))
    monkeypatch.setattr(
        peers.build, "_find_python", lambda: str(tmp_path / "no-python")
    )
    with pytest.raises(SystemExit) as caught:
        peers.build.main()
    assert caught.value.code == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        "make peers: dex-retargeting: its environment cannot be made"
    )


def fake_environment(folder: Path, peers: Any) -> None:
    """An environment that counts as built; its interpreter is ours, which has no peers."""
    for peer in peers.build.PEERS:
        python = folder / peer.name / "bin" / "python"
        python.parent.mkdir(parents=True)
        # Not a link: an interpreter finds its environment by the folder that it is called in.
        python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
        python.chmod(0o755)
        stamp = folder / peer.name / ".installed"
        stamp.write_text(
            peer.requirements.read_text(encoding="utf-8"), encoding="utf-8"
        )
    configs, hands = folder / "data" / "configs" / "teleop", folder / "data" / "hands"
    configs.mkdir(parents=True)
    hands.mkdir()
    for robot in peers.results.ROBOTS:
        text = f"retargeting: {{urdf_path: {robot}.urdf, low_pass_alpha: 0.2}}"
        (configs / f"{robot}.yml").write_text(text, encoding="utf-8")
        joint = f'<joint name="{robot}" type="revolute"/><joint name="f" type="fixed"/>'
        (hands / f"{robot}.urdf").write_text(
            f'<robot name="r">{joint}</robot>', encoding="utf-8"
        )


def test_run_that_fails_says_why_and_leaves_nothing(
    peers: Any, allegro: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HANDMAP_PEERS", str(tmp_path))
    fake_environment(tmp_path, peers)
    recording = recording_of(human_landmarks()[None])
    with pytest.raises(
        peers.results.PeerError, match=r"dexi-vector failed on made: .*dexi-rs"
    ):
        peers.results.run_peer("dexi-vector", recording, allegro)
    assert list((tmp_path / "cache").iterdir()) == []


def test_same_run_is_not_repeated(
    peers: Any, allegro: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HANDMAP_PEERS", str(tmp_path))
    fake_environment(tmp_path, peers)
    runs = []

    def run(method: Any, robot: str, recording: Recording, file: Path) -> None:
        runs.append((method.name, robot, recording.side))
        file.parent.mkdir(exist_ok=True)
        write_result(
            file, list(allegro.joint_names), np.tile(allegro.rest, (len(recording), 1))
        )

    monkeypatch.setattr(peers.results, "_run", run)
    recording = recording_of(human_landmarks()[None])
    for name in ("dexi-vector", "dexi-vector", "dexi-vector-unfiltered", "dex-vector"):
        peers.results.run_peer(name, recording, allegro)
    assert [name for name, _, _ in runs] == [
        "dexi-vector",
        "dexi-vector-unfiltered",
        "dex-vector",
    ]
    moved = replace(recording, landmarks=recording.landmarks + 1e-6)
    peers.results.run_peer("dexi-vector", moved, allegro)
    left = recording_of(human_landmarks("human_left")[None], side="left")
    assert (
        peers.results.run_peer("dexi-vector", left, allegro).recording.side == "right"
    )
    assert [side for _, _, side in runs] == ["right"] * 5


def test_robot_that_the_peers_do_not_know_is_rejected(
    peers: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HANDMAP_PEERS", str(tmp_path))
    fake_environment(tmp_path, peers)
    with pytest.raises(InvalidInputError, match="robot: expected a hand") as caught:
        peers.results.peer_robot(load_hand("three_finger"))
    assert caught.value.argument == "robot"
    assert peers.results.peer_robot(load_hand("allegro_left")) == "allegro_hand_left"
    described = SimpleNamespace(
        name="mine", side="right", joint_names=("leap_hand_right",)
    )
    assert peers.results.peer_robot(described) == "leap_hand_right"


# The peers' left Allegro has its thumb's second joint elsewhere, by 10 mm along the thumb.
@pytest.mark.parametrize(
    ("name", "theirs", "apart"),
    [
        ("leap_right", "leap_hand_right", 5e-4),
        ("leap_left", "leap_hand_left", 5e-4),
        ("shadow_right", "shadow_hand_right", 5e-4),
        ("shadow_left", "shadow_hand_left", 5e-4),
        ("ability_left", "ability_hand_left", 5e-4),
        ("allegro_left", "allegro_hand_left", 8e-3),
    ],
)
def test_joints_of_the_packages_hands_are_the_peers(
    built: Any, name: str, theirs: str, apart: float
) -> None:
    """Places of all joints lie on each other in a random posture, by one rigid motion."""
    results, hand = built.results, load_hand(name)
    assert results.peer_robot(hand) == theirs
    joints = {results.peer_joint(hand, joint) for joint in hand.joint_names}
    assert joints <= results._peer_joints(theirs)
    assert len(joints) == len(hand.joint_names)
    postures = np.random.default_rng(0).uniform(
        hand.lower_limits, hand.upper_limits, (3, len(hand.joint_names))
    )
    model = pin.buildModelFromUrdf(str(results._urdf(theirs)))
    data = model.createData()
    ours_in_theirs = results._roots_in_peers(hand, postures, [], np.zeros((3, 0)))
    to_root = np.linalg.inv(results._root_pose(hand))
    for angles, pose in zip(postures, ours_in_theirs, strict=True):
        posture = pin.neutral(model)
        ids = [model.getJointId(results.peer_joint(hand, n)) for n in hand.joint_names]
        posture[[model.joints[k].idx_q for k in ids]] = angles
        pin.forwardKinematics(model, data, posture)
        here = np.array([hand.frame_pose(n, angles)[:3, 3] for n in hand.joint_names])
        there = np.array([data.oMi[k].translation for k in ids])
        found = transform_points(pose @ to_root, here)
        np.testing.assert_allclose(found, there, atol=apart)
    np.testing.assert_allclose(ours_in_theirs[1:], ours_in_theirs[:-1], atol=10 * apart)


def test_a_wrist_that_only_the_peer_has_turns_ours(built: Any, tmp_path: Path) -> None:
    hand = load_hand("shadow_right")
    names = [built.results.peer_joint(hand, name) for name in hand.joint_names]
    q = np.zeros((2, len(names) + 2))
    q[1, 0] = 0.3
    write_result(tmp_path / "made.npz", ["WRJ1", "WRJ2", *names], q)
    recording = recording_of(np.tile(human_landmarks(), (2, 1, 1)))
    method = built.results.METHODS["dex-dexpilot"]
    motion = built.results.read_result(tmp_path / "made.npz", method, recording, hand)
    palms = motion.own_wrist @ hand.wrist_to_palm
    np.testing.assert_allclose(palms[0], motion.palm[0], atol=1e-6)
    turn = motion.palm[1, :3, :3].T @ palms[1, :3, :3]
    # WRJ1 bends the wrist about the axis across the palm.
    np.testing.assert_allclose(
        np.abs(Rotation.from_matrix(turn).as_rotvec()), [0.3, 0.0, 0.0], atol=1e-3
    )


def palm_directions(robot: Hand, q: np.ndarray) -> np.ndarray:
    """Unit vectors from the palm's origin to the tips in palm axes, shape (T, 4, 3)."""
    tips = robot.with_points("fingertips")
    palm = np.linalg.inv(robot.wrist_to_palm)
    points = np.array([transform_points(palm, tips.points(row)) for row in q])
    return points / np.linalg.norm(points, axis=2, keepdims=True)


@pytest.mark.slow
@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("kind", ["vector", "dexpilot"])
def test_real_runs_follow_the_hand(
    built: Any, recordings: Path, kind: str, side: str
) -> None:
    allegro = load_hand(f"allegro_{side}")
    recording = stretch(read_recording(recordings / f"quest3_webxr_{side}.npz"), 0, 200)
    runs = {
        name: built.results.run_peer(f"{name}-{kind}-unfiltered", recording, allegro)
        for name in ("dex", "dexi")
    }
    palms = built.results.measured_palms(recording)
    tips = recording.landmarks[:, [4, 8, 12, 16]] - palms[:, None, :3, 3]
    human = np.einsum("tij,tfi->tfj", palms[:, :3, :3], tips)
    human /= np.linalg.norm(human, axis=2, keepdims=True)
    for motion in runs.values():
        robot = palm_directions(allegro, motion.q)
        angles = np.degrees(np.arccos(np.clip((robot * human).sum(axis=2), -1.0, 1.0)))
        # 6 deg overall and 10 of the thumb; with a mirrored frame, 16 and 37.
        assert angles.mean() < 10.0
        assert angles[:, 0].mean() < 20.0
        # The solver's bounds are the limits and 1 mrad.
        outside = np.maximum(
            allegro.lower_limits - motion.q, motion.q - allegro.upper_limits
        )
        assert 0.0 < outside.max() < 1.001e-3
    # The same method in two languages.
    difference = runs["dex"].q - runs["dexi"].q
    assert np.sqrt(np.mean(difference**2)) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dex-vector", "dexi-dexpilot"])
def test_filter_is_the_outputs_alone(
    built: Any, allegro: Hand, recordings: Path, name: str
) -> None:
    recording = stretch(read_recording(recordings / "quest3_webxr_left.npz"), 330, 120)
    assert not recording.valid.all()
    raw = built.results.run_peer(f"{name}-unfiltered", recording, allegro)
    filtered = built.results.run_peer(name, recording, allegro)
    alpha = filtered.facts["low_pass_alpha"]
    assert (alpha, raw.facts["low_pass_alpha"]) == (0.2, 1.0)
    expected = raw.q.copy()
    for i in range(1, len(expected)):
        step = alpha * (raw.q[i] - expected[i - 1]) if recording.valid[i] else 0.0
        expected[i] = expected[i - 1] + step
    np.testing.assert_allclose(filtered.q, expected, atol=1e-6)
    held = ~recording.valid[1:]
    assert (np.diff(filtered.q, axis=0)[held] == 0.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dex-position", "dexi-position"])
def test_position_method_moves_its_own_wrist(
    built: Any, allegro: Hand, recordings: Path, name: str
) -> None:
    recording = stretch(read_recording(recordings / "quest3_webxr_right.npz"), 0, 150)
    motion = built.results.run_peer(name, recording, allegro)
    tips = allegro.with_points("fingertips")
    rows = range(50, 150, 10)
    reached = np.array([tips.points(motion.q[i], motion.own_wrist[i]) for i in rows])
    wanted = recording.landmarks[50:150:10, [4, 8, 12, 16]]
    # The peer's tips lie 12 mm beyond ours, and it does not scale the human's vectors.
    errors = np.linalg.norm(reached - wanted, axis=2)
    assert np.median(errors) < 0.02


@pytest.mark.slow
def test_run_is_repeatable(
    built: Any, allegro: Hand, recordings: Path, tmp_path: Path
) -> None:
    recording = stretch(read_recording(recordings / "rgb_mediapipe_right.npz"), 0, 60)
    for name in ("dex-dexpilot", "dexi-vector"):
        method = built.results.METHODS[name]
        again = []
        for i in range(2):
            file = tmp_path / f"{name}-{i}.npz"
            built.results._run(method, "allegro_hand_right", recording, file)
            again.append(built.results.read_result(file, method, recording, allegro).q)
        np.testing.assert_array_equal(again[0], again[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot", ["leap_hand_right", "schunk_svh_hand_right", "inspire_hand_right"]
)
@pytest.mark.parametrize(
    "name", ["dex-vector", "dexi-dexpilot", "dex-position", "dexi-position"]
)
def test_other_hands_run_too(
    built: Any, recordings: Path, tmp_path: Path, name: str, robot: str
) -> None:
    recording = stretch(read_recording(recordings / "quest3_webxr_right.npz"), 0, 40)
    file = tmp_path / "out.npz"
    built.results._run(built.results.METHODS[name], robot, recording, file)
    with np.load(file) as arrays:
        names, q = list(arrays["joint_names"]), arrays["q"]
    assert set(names) == built.results._peer_joints(robot)
    assert np.isfinite(q).all()
    assert np.ptp(q, axis=0).max() > 0.05
    if robot == "schunk_svh_hand_right":
        # Mimic joints keep their ratio (`<mimic multiplier="1.01511">` in the URDF).
        follower, leader = (
            q[:, names.index("right_hand_j3")],
            "right_hand_Thumb_Flexion",
        )
        np.testing.assert_allclose(
            follower, 1.01511 * q[:, names.index(leader)], atol=1e-5
        )


@pytest.mark.parametrize("method", ["dexi-dexpilot", "dexi-vector", "dexi-position"])
def test_live_answers_are_those_of_a_recording(
    built: Any, allegro: Hand, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker asked sample by sample gives what a run gives, again after a reset."""
    monkeypatch.syspath_prepend(str(FOLDER))
    live = importlib.import_module("peers.live")
    recording = stretch(read_recording("demo", "right"), 0, 12)
    motion = built.results.run_peer(method, recording, allegro)
    lines = [*recording.landmarks.tolist(), "reset", *recording.landmarks.tolist()]
    done = subprocess.run(
        live.command_of(method, allegro),
        input="".join(json.dumps(line) + "\n" for line in lines),
        capture_output=True,
        text=True,
        check=True,
    )
    ready, *answers = map(json.loads, done.stdout.splitlines())
    assert ready == "ready"
    assert answers[12] == []
    np.testing.assert_allclose(answers[:12], motion.q, atol=1e-12)
    assert answers[13:] == answers[:12]
