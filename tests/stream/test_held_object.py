"""Robots touch an object where the person does: places of the surface, rows, limits, and files."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from holding import FINGERS, Hold, hold
from pad_places import depth, pads_of

from handmap_core.human.recording import Recording, mirrored, sample_columns
from handmap_core.mapping.step import MapStep
from handmap_qp import Hand, HandMapper, cli, hand_names, load_hand
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands.urdf import parse_urdf
from handmap_qp.mapping.hand_pair import robot_fingers
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.mapping.objects import (
    Box,
    Cylinder,
    MeshShape,
    Shape,
    Sphere,
    geometry_of,
    nearest,
    parse_object,
)
from handmap_qp.se3 import affine, transform_points
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.grip import GripOptions
from handmap_qp.stream.held_object import (
    ObjectFollower,
    ObjectOptions,
    _Touch,
    follow_recording,
)
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats import read_recording, write_recordings

HUMAN = load_hand("human", points="landmarks")
ROBOTS = [name for name in ("allegro_right", "shadow_right") if name in hand_names()]
CUBE = parse_object("box:0.04")


@lru_cache
def held(motion: str = "turn +1z") -> Hold:
    return hold("cube", motion)


def follower(
    robot: str = "allegro_right", grip: GripOptions | None = None
) -> ObjectFollower:
    mapper = HandMapper(HUMAN, load_hand(robot), "teleoperation")
    return ObjectFollower(Follower(mapper, smoothing=None), CUBE, grip=grip)


def samples() -> tuple[Recording, np.ndarray]:
    """The samples of a person who holds an object, and the object's poses, shape (T, 4, 4)."""
    recording = held().recording
    assert recording.object_pose is not None
    return sample_columns(recording), recording.object_pose


@lru_cache
def steps(
    robot: str, grip: GripOptions | None = None
) -> tuple[ObjectFollower, list[MapStep]]:
    columns, poses = samples()
    holding = follower(robot, grip)
    return holding, [
        holding.map_sample(columns.sample(i), pose) for i, pose in enumerate(poses)
    ]


def signed_distance(shape: Shape, points: np.ndarray) -> np.ndarray:
    """How far points are outside a shape, negative inside it [m]."""
    match shape:
        case Box():
            beyond = np.abs(points) - 0.5 * np.array(shape.size)
        case Sphere():
            beyond = np.linalg.norm(points, axis=1, keepdims=True) - shape.radius
        case Cylinder():
            across, along = np.linalg.norm(points[:, :2], axis=1), np.abs(points[:, 2])
            beyond = np.column_stack(
                [across - shape.radius, along - 0.5 * shape.length]
            )
        case _:
            raise NotImplementedError
    outside = np.linalg.norm(beyond.clip(0.0), axis=1)
    return outside + np.minimum(beyond.max(axis=1), 0.0)


@pytest.mark.parametrize(
    "shape", [Box((0.03, 0.05, 0.08)), Sphere(0.02), Cylinder(0.02, 0.08)]
)
def test_the_nearest_place_is_on_the_surface_and_nearest(shape: Shape) -> None:
    random = np.random.default_rng(0)
    points = random.uniform(-0.07, 0.07, (60, 3))
    found = nearest(shape, points)
    # The prism in the place of a cylinder stands out by .2 %.
    tolerance = 1e-4 if isinstance(shape, Cylinder) else 1e-9
    on_surface = signed_distance(shape, found.places)
    np.testing.assert_allclose(on_surface, 0.0, atol=tolerance)
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, atol=1e-9)
    ahead = found.places + found.distances[:, None] * found.normals
    np.testing.assert_allclose(ahead, points, atol=1e-9)
    exact = signed_distance(shape, points)
    np.testing.assert_array_equal(found.distances < 0.0, exact < 0.0)
    np.testing.assert_allclose(found.distances, exact, atol=tolerance)


def test_a_mesh_counts_as_its_hull() -> None:
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    points = np.random.default_rng(1).uniform(-0.06, 0.06, (30, 3))
    box, mesh = Box((0.04, 0.04, 0.04)), MeshShape(0.02 * corners.astype(float))
    for own, other in zip(nearest(box, points), nearest(mesh, points), strict=True):
        np.testing.assert_allclose(own, other, atol=1e-7)


@pytest.mark.parametrize("robot", ROBOTS)
def test_pads_touch_where_the_person_does(robot: str) -> None:
    made = held()
    holding, found = steps(robot)
    recording = made.recording
    plain = map_recording(
        HandMapper(HUMAN, load_hand(robot), "teleoperation"),
        dataclasses.replace(recording, object_pose=None, object_shape=""),
    )
    hand = holding.follower.mapper.robot
    off, without, deep = [], [], []
    for i in range(made.closed, len(found), 7):
        pose = found[i].diagnostics["object_pose"]
        command = found[i].command
        placed, pads = pads_of(hand, command.q, command.wrist)
        radii = holding._radii[:3, None]
        aims = transform_points(pose, made.places + radii * made.normals)
        off.append(np.linalg.norm(pads - aims, axis=1))
        _, others = pads_of(hand, plain.q[i], plain.wrist[i])
        without.append(np.linalg.norm(others - aims, axis=1))
        deep.append(depth(hand, placed, geometry_of(CUBE), pose))
    assert np.median(off) < 0.006 < 0.012 < np.median(without)
    assert np.max(off) < 0.012
    assert np.median(deep) < 0.0005
    assert np.max(deep) < 0.002
    # Fingers that touch do not tremble between their places and the surface.
    q = np.array([step.command.q for step in found])
    used = robot_fingers(hand).used
    columns = np.concatenate([used[finger].columns for finger in FINGERS])
    own, other = (
        np.diff(each[made.closed :, columns], n=2, axis=0) for each in (q, plain.q)
    )
    assert np.sqrt((own**2).mean()) < 1.5 * np.sqrt((other**2).mean())


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("grip", [None, GripOptions(force=4.0)])
def test_limits_hold(robot: str, grip: GripOptions | None) -> None:
    holding, found = steps(robot, grip)
    hand = holding.follower.mapper.robot
    q = np.array([step.command.q for step in found])
    assert (q >= hand.lower_limits).all()
    assert (q <= hand.upper_limits).all()
    speed = np.abs(np.diff(q, axis=0)) * 60.0
    assert (speed <= hand.velocity_limits + 1e-9).all()


@pytest.mark.parametrize("robot", ROBOTS)
def test_pads_press_with_the_force_where_joints_give_way(robot: str) -> None:
    """Torques are the slopes of the pads' distances, and position control makes the same."""
    grip = GripOptions(stiffness=2.0, force=4.0)
    holding, found = steps(robot, grip)
    hand = holding.follower.mapper.robot
    assert not np.any(found[9].command.effort)
    pads = robot_fingers(hand).pads
    places = [pads[name] for name in robot_fingers(hand).names]

    def gaps(q: np.ndarray, wrist: Any) -> np.ndarray:
        """Distances of the pads from the thumb's [m], shape (f - 1,)."""
        placed = hand.configuration()
        placed.place(hand.configuration_vector(q, wrist))
        ends = np.array([placed.data.oMi[p.joint].act(p.offset) for p in places])
        return np.linalg.norm(ends[1:] - ends[0], axis=1)

    for i in (80, 120, len(found) - 1):
        command, effort = found[i].command, found[i].command.effort
        assert effort is not None
        q = command.q - effort / grip.stiffness
        slopes = [
            (gaps(q + way, command.wrist) - gaps(q - way, command.wrist)) / 2e-6
            for way in 1e-6 * np.eye(len(q))
        ]
        forces, *_ = np.linalg.lstsq(-np.array(slopes), effort, rcond=None)
        assert forces.sum() == pytest.approx(4.0, rel=0.05)
        assert (forces > -0.05).all()
        # There the pads are on the surface, and no link is in it.
        assert found[i].diagnostics["touch_error"][:3].max() < 0.012
        assert found[i].diagnostics["clearance"] > -0.003


def test_pads_press_and_let_go_without_a_jump() -> None:
    grip = GripOptions(force=4.0)
    columns, poses = samples()
    holding, plain = follower(grip=grip), follower()
    q, other, efforts = [], [], []
    for i in range(len(poses)):
        # The object is lost from sight for half a second.
        pose = None if 100 <= i < 130 else poses[i]
        command = holding.map_sample(columns.sample(i), pose).command
        q.append(command.q)
        other.append(plain.map_sample(columns.sample(i), pose).command.q)
        none = np.zeros(len(command.q))
        efforts.append(none if command.effort is None else command.effort)
    sizes = np.abs(efforts).max(axis=1)
    assert sizes[95] > 0.1 > 0.01 > sizes[128]
    assert np.abs(np.diff(efforts, axis=0)).max() < 0.25 * sizes.max()
    one, two = (np.abs(np.diff(each, n=2, axis=0)).max() for each in (q, other))
    assert one < 1.5 * two


def test_the_robots_object_moves_as_the_persons() -> None:
    _, found = steps("allegro_right")
    poses = held().recording.object_pose
    assert poses is not None
    own = [step.diagnostics["object_pose"] for step in found]
    turns = [a @ np.linalg.inv(b) for a, b in zip(own, poses, strict=True)]
    np.testing.assert_allclose(
        turns, np.broadcast_to(turns[0], (len(turns), 4, 4)), atol=1e-12
    )


def test_the_rows_have_the_slopes_of_their_errors() -> None:
    holding, found = steps("allegro_right")
    hand = holding.follower.mapper.robot
    columns, poses = samples()
    touch = next(holding._touches(columns.sample(90), poses[90]))
    base = found[90].ik.q
    placed = hand.configuration()
    pads = 3 * len(touch.shares)

    def residual(way: np.ndarray) -> np.ndarray:
        placed.place(pin.integrate(hand.model, base, way))
        gaps, _ = touch.links(placed)
        return np.append(touch.linearise(placed).residual[:pads], gaps)

    placed.place(base)
    rows = touch.linearise(placed)
    _, slopes = touch.links(placed)
    jacobian = np.vstack([rows.jacobian[:pads], slopes])
    size = np.abs(jacobian).max(axis=1) + 1e-9
    for column in range(hand.model.nv):
        way = np.zeros(hand.model.nv)
        way[column] = 1e-6
        slope = (residual(way) - residual(-way)) / 2e-6
        off = np.abs(jacobian[:, column] - slope) / size
        # The nearest point of a face to a face may be any.
        assert np.median(off) < 1e-6
        assert np.mean(off > 1e-3) < 0.1


def test_a_link_in_the_object_is_pushed_out() -> None:
    holding, found = steps("allegro_right")
    hand = holding.follower.mapper.robot
    columns, poses = samples()
    touch = next(holding._touches(columns.sample(90), poses[90]))
    touch = touch._replace(
        pose=touch.pose @ affine(np.eye(3), (0.004, 0.003, 0.002)),
        shares=np.zeros_like(touch.shares),
    )
    placed = hand.configuration()
    q = found[90].ik.q
    placed.place(q)
    before = touch.links(placed)[0].min()
    for _ in range(20):
        rows = touch.linearise(placed)
        normal = rows.jacobian.T @ rows.jacobian + np.diag(rows.damping + 1e-3)
        q = pin.integrate(
            hand.model, q, np.linalg.solve(normal, -rows.jacobian.T @ rows.residual)
        )
        placed.place(q)
    assert before < -0.001 < 0.0 < touch.links(placed)[0].min()


def test_an_object_far_away_changes_nothing() -> None:
    holding = follower()
    plain = Follower(
        HandMapper(HUMAN, load_hand("allegro_right"), "teleoperation"), smoothing=None
    )
    columns = sample_columns(held().recording)
    far = affine(np.eye(3), (2.0, 0.0, 0.0))
    for i in range(60):
        step = holding.map_sample(columns.sample(i), far)
        other = plain.map_sample(columns.sample(i))
        np.testing.assert_allclose(step.command.q, other.command.q, atol=1e-6)
        if i > 1:
            assert not step.diagnostics["touching"].any()


def test_what_cannot_be_touched_is_said() -> None:
    """Joints that hardly move cannot go to where the person's fingers are."""
    holding = follower()
    columns, poses = samples()
    for i in range(100):
        step = holding.map_sample(columns.sample(i), poses[i], dt=1e-4)
    assert "off_object" in step.asked.flags
    _, found = steps("allegro_right")
    assert "off_object" not in found[-1].asked.flags


@pytest.mark.parametrize(
    ("name", "small", "large"), [("touching", 0.002, 0.015), ("near", 0.012, 0.06)]
)
def test_options_have_their_effect(name: str, small: float, large: float) -> None:
    columns, poses = samples()

    def touch(value: float) -> _Touch:
        holding = follower()
        holding.options = ObjectOptions().replaced(**{name: value})
        holding.map_sample(columns.sample(80), poses[80])
        return next(holding._touches(columns.sample(80), poses[80]))

    one, other = touch(small), touch(large)
    if name == "near":
        assert other.shares.sum() > one.shares.sum()
    else:
        assert not np.allclose(one.places, other.places, atol=1e-3)


def test_a_sample_that_is_not_valid_may_have_any_pose() -> None:
    holding = follower()
    columns, poses = samples()
    holding.map_sample(columns.sample(0), poses[0])
    lost = dataclasses.replace(columns.sample(1), valid=False)
    step = holding.map_sample(lost, np.full((4, 4), np.nan))
    assert step.status == "held"
    assert holding.map_sample(columns.sample(2), poses[2]).status != "held"


def test_wrong_input_is_refused() -> None:
    holding = follower()
    sample = sample_columns(held().recording).sample(0)
    with pytest.raises(InvalidInputError, match="object_pose"):
        holding.map_sample(sample, np.zeros((4, 4)))
    robot = load_hand("allegro_right")
    still = load_hand("allegro_right", mount="fixed")
    for mapper in (
        HandMapper(HUMAN, robot, "object"),
        HandMapper(HUMAN, still, "teleoperation"),
        HandMapper(HUMAN, robot, Teleoperation(scale=0.5)),
    ):
        with pytest.raises(InvalidInputError, match="`teleoperation` moves"):
            ObjectFollower(Follower(mapper), CUBE)
    wrong: Any = {"force": 4.0}
    mapper = HandMapper(HUMAN, robot, "teleoperation")
    with pytest.raises(InvalidInputError, match="grip: expected `GripOptions`"):
        ObjectFollower(Follower(mapper), CUBE, grip=wrong)


def test_fingers_are_near_before_they_touch() -> None:
    with pytest.raises(InvalidOptionsError, match="near: expected more than touching"):
        ObjectOptions(touching=0.02)


# Files


@pytest.mark.parametrize("suffix", [".npz", ".hdf5", ".csv"])
def test_files_keep_an_object(tmp_path: Path, suffix: str) -> None:
    poses = np.array(held().recording.object_pose)
    # It is not seen in one sample.
    poses[90, :3] = np.nan
    recording = dataclasses.replace(held().recording, object_pose=poses)
    file = tmp_path / f"held{suffix}"
    write_recordings([recording], file)
    read = read_recording(file)
    assert read.object_pose is not None
    np.testing.assert_array_equal(read.object_pose, poses)
    assert read.object_shape == ("" if suffix == ".csv" else "box:0.04")


def test_a_mirrored_recording_has_the_mirrored_object() -> None:
    recording = held().recording
    other = mirrored(recording)
    assert recording.object_pose is not None
    assert other.object_pose is not None
    # Fingertips are as far from the surface as before.
    for i in (0, 60, 120):
        gaps = [
            nearest(
                CUBE,
                transform_points(np.linalg.inv(poses[i]), hands[i]),
            ).distances
            for poses, hands in (
                (recording.object_pose, recording.landmarks),
                (other.object_pose, other.landmarks),
            )
        ]
        np.testing.assert_allclose(gaps[0], gaps[1], atol=1e-9)
    mesh = dataclasses.replace(recording, object_shape="mug.stl")
    with pytest.raises(InvalidInputError, match="object_shape"):
        mirrored(mesh)


@pytest.mark.parametrize("wrong", [np.zeros((170, 4, 4)), np.eye(4), "there"])
def test_poses_that_are_none_are_refused(wrong: Any) -> None:
    with pytest.raises(InvalidInputError, match="object_pose"):
        dataclasses.replace(held().recording, object_pose=wrong)


def test_the_command_writes_the_robots_object(tmp_path: Path) -> None:
    file, out = tmp_path / "held.npz", tmp_path / "mapped.npz"
    write_recordings([held().recording], file)
    cli.main(["map", str(file), "--robot", "allegro_right", "--out", str(out)])
    with np.load(out) as arrays:
        assert arrays["object_pose"].shape == (len(held().recording), 4, 4)


def test_a_hand_with_an_object_of_no_known_shape_is_mapped_alone() -> None:
    recording = held().recording.part(slice(0, 60))
    robot = load_hand("allegro_right")
    one, other = (
        map_recording(
            HandMapper(HUMAN, robot, "teleoperation"),
            dataclasses.replace(recording, object_shape="", object_pose=pose),
        )
        for pose in (recording.object_pose, None)
    )
    np.testing.assert_array_equal(one.q, other.q)
    with pytest.raises(InvalidInputError, match="object_shape"):
        dataclasses.replace(recording, object_pose=None)
    nonsense = dataclasses.replace(recording, object_shape="x" * 300)
    with pytest.raises(InvalidInputError, match="object_shape: expected box"):
        map_recording(HandMapper(HUMAN, robot, "teleoperation"), nonsense)


def test_the_object_leaves_the_mapper_alone_after_each_sample() -> None:
    holding = follower()
    columns, poses = samples()
    for i in range(90):
        holding.map_sample(columns.sample(i), poses[i])
    mapper = holding.follower.mapper
    assert mapper.tasks == ()
    other = dataclasses.replace(columns.sample(90), side="left")
    with pytest.raises(InvalidInputError, match="side"):
        holding.map_sample(other, poses[90])
    assert mapper.tasks == ()
    mapper.configure("object")
    with pytest.raises(InvalidInputError, match="`teleoperation` moves"):
        holding.map_sample(columns.sample(90), poses[90])


@pytest.mark.parametrize("way", ["loss", "clutch", "late", "unseen"])
def test_nothing_jumps_when_the_object_takes_hold(way: str) -> None:
    """After a loss with a shift of 100 mm, a new reference, and a start with a closed hand."""
    recording = held().recording
    columns = sample_columns(recording)
    poses = np.array(recording.object_pose)
    holding = follower()
    commands = []
    for i in range(80 if way == "late" else 20, 150):
        sample = columns.sample(i)
        if way == "loss" and i >= 90:
            shift = np.array([0.1, 0.0, 0.0])
            sample = dataclasses.replace(sample, landmarks=sample.landmarks + shift)
            poses[i, :3, 3] += shift
        if way == "loss" and 70 <= i < 90:
            sample = dataclasses.replace(sample, valid=False)
        if way == "clutch" and i == 90:
            holding.follower.mapper.clutch()
        is_unseen = way == "unseen" and 70 <= i < 110
        pose = None if is_unseen else poses[i]
        commands.append(holding.map_sample(sample, pose).command.wrist[:3, 3])
    speeds = np.linalg.norm(np.diff(commands, axis=0), axis=1) * 60.0
    assert speeds.max() < 0.7


def test_an_object_that_is_not_seen_lets_go_of_the_hand() -> None:
    recording = held().recording
    # The person stays there for two seconds: a thumb that was led elsewhere looks for its way.
    last = np.append(np.arange(len(recording)), [len(recording) - 1] * 120)
    landmarks = recording.landmarks[last]
    landmarks[:, :, 0] += 1e-6 * np.arange(len(last))[:, None]
    recording = dataclasses.replace(
        recording,
        time=recording.time[0] + np.arange(len(last)) / 60.0,
        landmarks=landmarks,
        valid=recording.valid[last],
        object_pose=np.array(recording.object_pose)[last],
    )
    poses = np.array(recording.object_pose)
    poses[90:] = np.nan
    lost = dataclasses.replace(recording, object_pose=poses)
    columns = sample_columns(lost)
    steps = list(follow_recording(follower().follower, lost))
    plain = Follower(HandMapper(HUMAN, load_hand("allegro_right"), "teleoperation"))
    others = [plain.map_sample(columns.sample(i)) for i in range(len(steps))]
    assert steps[89].diagnostics["touching"].max() == 1.0
    assert "touching" not in steps[-1].diagnostics
    np.testing.assert_allclose(steps[-1].command.q, others[-1].command.q, atol=0.05)


def test_a_hand_without_shapes_touches_too() -> None:
    hand = load_hand("three_finger")
    robot = parse_urdf(hand.urdf_text)
    for link in robot.iterfind("link"):
        for shape in link.findall("collision"):
            link.remove(shape)
    bare = Hand(hand.spec, urdf_text=ElementTree.tostring(robot, "unicode"))
    recording = held().recording.part(slice(0, 60))
    mapped = map_recording(HandMapper(HUMAN, bare, "teleoperation"), recording)
    assert mapped.object_pose is not None


def test_other_presets_map_the_hand_alone() -> None:
    recording = held().recording
    plain = dataclasses.replace(recording, object_pose=None, object_shape="")
    robot = load_hand("allegro_right")
    one, other = (
        map_recording(HandMapper(HUMAN, robot, "object"), each)
        for each in (recording, plain)
    )
    np.testing.assert_array_equal(one.q, other.q)
    assert one.object_pose is None


def test_an_object_that_is_left_out_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["map", "held", "--robot", "allegro_right", "--out"]
    assert cli.main([*words, str(tmp_path / "one.npz")]) == 0
    assert "without the object" not in capsys.readouterr().err
    other = [*words, str(tmp_path / "two.npz"), "--preset", "object"]
    assert cli.main(other) == 0
    assert "allegro_right is mapped without the object" in capsys.readouterr().err


def test_a_recording_with_an_object_comes_with_the_package() -> None:
    recording = read_recording("held")
    assert recording.object_pose is not None
    assert recording.object_shape == "box:0.03x0.06x0.05"
    tips = recording.landmarks[60:, [4, 8, 12]].reshape(-1, 3)
    poses = recording.object_pose[60:].repeat(3, axis=0)
    shape = parse_object(recording.object_shape)
    gaps = [
        nearest(shape, transform_points(np.linalg.inv(pose), tip[None])).distances[0]
        for pose, tip in zip(poses, tips, strict=True)
    ]
    np.testing.assert_allclose(gaps, 0.008, atol=0.002)


def test_people_are_measured_whatever_they_hold() -> None:
    left = mirrored(held().recording)
    alone = dataclasses.replace(left, object_pose=None, object_shape="")
    mesh = dataclasses.replace(left, object_shape="mug.stl")
    one, other = (measure_person(each, each) for each in (alone, mesh))
    assert one.hand_length == other.hand_length
