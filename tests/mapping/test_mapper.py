"""The mapper as a whole: exactness, invariance, limits, and invalid inputs."""

from typing import Any

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import poses, rotations

from handmap_qp import (
    HandMapper,
    IkOptions,
    InvalidInputError,
    InvalidOptionsError,
    MappingOptions,
    load_hand,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.method import HumanPose
from handmap_qp.se3 import affine, transform_points

HUMAN = load_hand("human")
THREE = load_hand("three_finger")
ROBOTS = ("three_finger", "allegro_right", "allegro_left")
# Enough iterations to converge and no speed limits, for statements about the end of a motion.
SETTLE = IkOptions(
    max_iterations=200,
    step_tolerance=1e-10,
    error_damping=0.0,
    has_velocity_limits=False,
)


def posture(share: np.ndarray | float, hand: Hand = HUMAN) -> np.ndarray:
    """Return a posture part of the way from rest to the upper limits."""
    return hand.rest + np.asarray(share) * (hand.upper_limits - hand.rest)


def small_postures(amount: float = 0.3) -> st.SearchStrategy[np.ndarray]:
    """Draw human postures near rest."""
    share = st.lists(st.floats(-amount, amount), min_size=20, max_size=20).map(np.array)
    return share.map(
        lambda x: (
            HUMAN.rest
            + x
            * np.minimum(
                HUMAN.upper_limits - HUMAN.rest, HUMAN.rest - HUMAN.lower_limits
            )
        )
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_without_human_motion_the_robot_stays(name: str) -> None:
    robot = load_hand(name)
    mapper = HandMapper(HUMAN, robot, "paper", ik=IkOptions(rest_weight=0.0))
    first = mapper.map_step(HUMAN.rest, np.eye(4))
    step = [mapper.map_step(HUMAN.rest, np.eye(4)) for _ in range(5)][-1]
    assert step.status == "converged"
    np.testing.assert_allclose(step.command.q, first.command.q, atol=1e-12)
    np.testing.assert_allclose(step.command.q, robot.rest, atol=1e-12)
    np.testing.assert_allclose(step.motion, np.eye(4), atol=1e-12)


@given(pose=poses)
def test_rigid_motion_of_the_human_moves_the_robot_rigidly(pose: np.ndarray) -> None:
    mapper = HandMapper(HUMAN, THREE, ik=SETTLE, pivot="world")
    before = mapper.map_step(HUMAN.rest, np.eye(4))
    after = mapper.map_step(HUMAN.rest, pose)
    np.testing.assert_allclose(after.motion_deformation, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(after.motion_rigid, pose, atol=1e-9)
    np.testing.assert_allclose(
        after.targets, transform_points(pose, before.targets), atol=1e-9
    )
    np.testing.assert_allclose(
        after.wrist_target, pose @ before.wrist_target, atol=1e-9
    )


@given(pose=poses, q=small_postures())
def test_moving_the_humans_world_carries_the_wrist_and_leaves_the_joints(
    pose: np.ndarray, q: np.ndarray
) -> None:
    here, there = HandMapper(HUMAN, THREE, "paper"), HandMapper(HUMAN, THREE, "paper")
    here.map_step(HUMAN.rest, np.eye(4))
    there.map_step(HUMAN.rest, pose)
    moved = affine(pin.exp3(np.array([0.1, -0.2, 0.05])), np.array([0.02, 0.01, -0.03]))
    for _ in range(3):
        step_here = here.map_step(q, moved)
        step_there = there.map_step(q, pose @ moved)
        # Every iterate is the same, not only the end: 1e-9 leaves room for rounding near singular
        # postures.
        np.testing.assert_allclose(step_there.command.q, step_here.command.q, atol=1e-9)
        np.testing.assert_allclose(
            step_there.command.wrist, pose @ step_here.command.wrist, atol=1e-9
        )


@pytest.mark.parametrize("pivot", ["centroid", "palm"])
@given(rotation=rotations, q=small_postures())
def test_palm_alignment_makes_the_joints_independent_of_where_the_robot_stands(
    pivot: Any, rotation: np.ndarray, q: np.ndarray
) -> None:
    commands = []
    for wrist in (np.eye(4), affine(rotation, np.array([0.3, -1.0, 0.5]))):
        mapper = HandMapper(HUMAN, THREE, alignment="palm", pivot=pivot)
        mapper.reset(HUMAN.rest, np.eye(4), robot_wrist=wrist)
        commands.append((wrist, mapper.map_step(q, np.eye(4)).command))
    np.testing.assert_allclose(commands[0][1].q, commands[1][1].q, atol=1e-9)
    np.testing.assert_allclose(
        commands[1][0] @ commands[0][1].wrist, commands[1][1].wrist, atol=1e-9
    )


@given(q=small_postures())
def test_initial_reference_returns_home_when_the_human_does(q: np.ndarray) -> None:
    mapper = HandMapper(HUMAN, THREE, "paper", ik=SETTLE)
    home = mapper.map_step(HUMAN.rest, np.eye(4))
    mapper.map_step(q, affine(np.eye(3), np.array([0.1, 0.0, 0.05])))
    back = mapper.map_step(HUMAN.rest, np.eye(4))
    np.testing.assert_allclose(back.points, home.points, atol=1e-5)


@pytest.mark.parametrize("name", ROBOTS)
def test_limits_hold_on_a_violent_motion(name: str) -> None:
    robot, rng = load_hand(name), np.random.default_rng(0)
    mapper = HandMapper(HUMAN, robot, "paper", dt=0.01)
    last = None
    for _ in range(300):
        q = rng.uniform(HUMAN.lower_limits, HUMAN.upper_limits)
        pose = affine(pin.exp3(rng.normal(size=3)), rng.normal(size=3) * 0.3)
        command = mapper.map_step(q, pose).command
        assert (command.q >= robot.lower_limits - 1e-12).all()
        assert (command.q <= robot.upper_limits + 1e-12).all()
        if last is not None:
            # 1e-12 rad: the difference of two rounded sums.
            assert (
                np.abs(command.q - last.q) <= robot.velocity_limits * 0.01 + 1e-12
            ).all()
            twist = pin.log6(pin.SE3(last.wrist).actInv(pin.SE3(command.wrist))).vector
            assert (
                np.linalg.norm(twist[3:])
                <= np.sqrt(3) * robot.spec.wrist.max_angular_speed * 0.01 + 1e-12
            )
        last = command


def test_map_points_agrees_with_map_step() -> None:
    by_joints, by_points = (
        HandMapper(HUMAN, THREE, "paper"),
        HandMapper(HUMAN, THREE, "paper"),
    )
    for share in (0.0, 0.1, 0.2):
        pose = affine(
            pin.exp3(np.array([0.0, share, 0.0])), np.array([share, 0.0, 0.0])
        )
        expected = by_joints.map_step(posture(share), pose)
        step = by_points.map_points(HUMAN.points(posture(share), pose), pose)
        np.testing.assert_allclose(step.command.q, expected.command.q, atol=1e-12)


def test_released_robot_holds_still_and_goes_on_from_there() -> None:
    mapper = HandMapper(HUMAN, THREE, "paper", ik=IkOptions(rest_weight=0.0))
    mapper.map_step(HUMAN.rest, np.eye(4))
    before = mapper.map_step(posture(0.2), np.eye(4))
    mapper.release()
    held = mapper.map_step(posture(-0.2), affine(np.eye(3), np.array([1.0, 0.0, 0.0])))
    assert held.status == "released"
    np.testing.assert_array_equal(held.command.q, before.command.q)
    np.testing.assert_allclose(
        held.command.wrist, before.command.wrist, rtol=0.0, atol=1e-15
    )
    mapper.clutch()
    after = mapper.map_step(posture(-0.2), affine(np.eye(3), np.array([1.0, 0.0, 0.0])))
    np.testing.assert_allclose(after.command.q, before.command.q, atol=1e-12)
    np.testing.assert_allclose(after.motion, np.eye(4), atol=1e-12)


def test_wrist_pose_is_taken_in_every_form() -> None:
    pose = pin.SE3(pin.exp3(np.array([0.1, 0.2, 0.3])), np.array([0.1, 0.2, 0.3]))
    xyz_quat_xyzw = pin.SE3ToXYZQUAT(pose)
    commands = [
        HandMapper(HUMAN, THREE, "paper", quat_order="xyzw")
        .map_step(HUMAN.rest, form)
        .command
        for form in (pose, pose.homogeneous, pose.homogeneous.tolist(), xyz_quat_xyzw)
    ]
    for command in commands[1:]:
        np.testing.assert_allclose(command.wrist, commands[0].wrist, atol=1e-12)


BAD_Q = {
    "shape": np.zeros(19),
    "nan": np.full(20, np.nan),
    "infinite": np.full(20, np.inf),
    "far outside": HUMAN.upper_limits + 0.26,
    "words": ["a"] * 20,
}
BAD_WRIST = {
    "shape": np.eye(3),
    "no rotation": np.diag([1.0, 1.0, 2.0, 1.0]),
    "mirrored": np.diag([1.0, 1.0, -1.0, 1.0]),
    "nan": np.full((4, 4), np.nan),
    "7 numbers without an order": np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("bad", BAD_Q.values(), ids=BAD_Q.keys())
def test_bad_joint_angles_are_refused_and_change_nothing(bad: np.ndarray) -> None:
    _assert_refused_without_a_trace(bad, np.eye(4))


@pytest.mark.parametrize("bad", BAD_WRIST.values(), ids=BAD_WRIST.keys())
def test_bad_wrist_poses_are_refused_and_change_nothing(bad: np.ndarray) -> None:
    _assert_refused_without_a_trace(HUMAN.rest, bad)


def _assert_refused_without_a_trace(q: np.ndarray, wrist: np.ndarray) -> None:
    disturbed, calm = (
        HandMapper(HUMAN, THREE, "paper"),
        HandMapper(HUMAN, THREE, "paper"),
    )
    for mapper in (disturbed, calm):
        mapper.map_step(HUMAN.rest, np.eye(4))
    with pytest.raises(InvalidInputError):
        disturbed.map_step(q, wrist)
    steps = [mapper.map_step(posture(0.1), np.eye(4)) for mapper in (disturbed, calm)]
    np.testing.assert_array_equal(steps[0].command.q, steps[1].command.q)
    np.testing.assert_array_equal(steps[0].command.wrist, steps[1].command.wrist)


def test_angles_a_little_outside_are_used_and_named() -> None:
    mapper = HandMapper(HUMAN, THREE, "paper")
    q = HUMAN.rest.copy()
    q[5] = HUMAN.upper_limits[5] + 0.2
    step = mapper.map_step(q, np.eye(4))
    assert step.out_of_range == (HUMAN.joint_names[5],)
    np.testing.assert_allclose(step.human_points, HUMAN.points(q), atol=1e-12)


def test_arguments_are_copied_and_not_changed() -> None:
    mapper, pose, q = (
        HandMapper(HUMAN, THREE, rigid_from="wrist"),
        np.eye(4),
        HUMAN.rest.copy(),
    )
    mapper.map_step(q, pose)
    pose[0, 3] = 0.1
    step = mapper.map_step(q, pose)
    np.testing.assert_allclose(step.motion_rigid[:3, 3], [0.1, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    "options",
    [
        {"ridge": -1.0},
        {"ridge": float("nan")},
        {"rigid_from": "palm"},
        {"pivot": "point"},
        {"pivot_point": (0.0, 0.0, 0.0)},
        {"alignment": ((1, 0, 0), (0, 1, 0), (0, 0, -1))},
        {"residual_gain": 1.5},
        {"residual_gain": 1.0},
        {"no_such_option": 1},
        {"stretch_min": 2.0},
    ],
    ids=str,
)
def test_options_that_make_no_sense_are_refused(options: dict) -> None:
    robot = load_hand("allegro_right", points=("index_tip", "middle_tip"))
    human = load_hand(
        "human", points=("thumb_tip", "ring_tip", "little_tip", "thumb_ip")
    )
    with pytest.raises(InvalidOptionsError):
        HandMapper(human, robot, **options)


def test_the_centroids_of_both_hands_are_weighted() -> None:
    # A human who turns about the weighted centroid turns the robot about its own.
    def weighted(name: str) -> Hand:
        hand = load_hand(name, points="fingertips")
        points = hand.reference_points
        return hand.with_points(
            tuple(
                msgspec.structs.replace(p, weight=1.0 + 2.0 * k)
                for k, p in enumerate(points)
            )
        )

    human, robot = weighted("human"), weighted("three_finger")
    mapper = HandMapper(human, robot, MappingOptions())
    points = human.points(human.rest)
    first = mapper.map_points(points, np.eye(4))
    centre = human.point_weights @ points / human.point_weights.sum()
    turn = pin.exp3(np.array([0.2, -0.3, 0.5]))
    step = mapper.map_points((points - centre) @ turn.T + centre, np.eye(4))
    shift = step.targets - first.points
    np.testing.assert_allclose(robot.point_weights @ shift, 0.0, atol=1e-9)
    assert np.abs(shift).max() > 0.005


def test_a_fixed_wrist_takes_no_rigid_part() -> None:
    with pytest.raises(InvalidOptionsError, match="mount='floating'"):
        HandMapper(HUMAN, load_hand("three_finger", mount="fixed"), "paper")
    mapper = HandMapper(
        HUMAN,
        load_hand("three_finger", mount="fixed"),
        rigid_from="none",
        alignment="palm",
    )
    mapper.map_step(HUMAN.rest, np.eye(4))
    step = mapper.map_step(posture(0.2), np.eye(4))
    np.testing.assert_allclose(step.command.wrist, np.eye(4), atol=1e-12)
    assert np.abs(step.command.q - THREE.rest).max() > 1e-3


@pytest.mark.parametrize("dt", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_step_must_be_positive(dt: float) -> None:
    HandMapper(HUMAN, THREE, "paper", dt=np.float32(0.01))  # ty: ignore[invalid-argument-type]
    with pytest.raises(InvalidInputError):
        HandMapper(HUMAN, THREE, "paper").map_step(HUMAN.rest, np.eye(4), dt=dt)


def test_reset_puts_the_robot_where_it_is_told() -> None:
    mapper = HandMapper(HUMAN, THREE, "paper", ik=IkOptions(rest_weight=0.0))
    q, wrist = (
        0.5 * (THREE.rest + THREE.upper_limits),
        affine(np.eye(3), np.array([0.0, 0.5, 0.0])),
    )
    mapper.reset(HUMAN.rest, np.eye(4), robot_q=q, robot_wrist=wrist)
    step = mapper.map_step(HUMAN.rest, np.eye(4))
    np.testing.assert_allclose(step.command.q, q, atol=1e-12)
    np.testing.assert_allclose(step.command.wrist, wrist, atol=1e-12)
    with pytest.raises(InvalidInputError):
        mapper.reset(robot_q=THREE.upper_limits + 0.1)
    np.testing.assert_allclose(
        mapper.map_step(HUMAN.rest, np.eye(4)).command.q, q, atol=1e-12
    )


@pytest.mark.parametrize(
    "choice", [{"pivot": "palm"}, {"alignment": "palm"}, {"reference": "rest"}], ids=str
)
def test_a_reference_without_wrist_is_refused_by_what_needs_it(
    choice: dict[str, Any],
) -> None:
    mapper = HandMapper(HUMAN, load_hand("allegro_right"), **choice)
    [(name, value)] = choice.items()
    with pytest.raises(InvalidInputError, match=f"needed for {name}='{value}'"):
        mapper.map_points(HUMAN.points(HUMAN.rest))


@pytest.mark.parametrize(
    ("options", "needed"),
    [({"rigid_from": "wrist"}, "rigid_from='wrist'"), ({}, "the pose of the palm")],
    ids=str,
)
def test_every_sample_without_a_wrist_is_refused_by_what_needs_it(
    options: dict[str, Any], needed: str
) -> None:
    human = load_hand("human", points="landmarks")
    mapper = HandMapper(human, load_hand("allegro_right"), **options)
    sample = HumanPose(human.points(human.rest), None)
    for _ in range(2):
        with pytest.raises(InvalidInputError, match=f"wrist_pose: needed for {needed}"):
            mapper.map(sample)
        mapper.map_points(sample.points, np.eye(4))
