"""Every hand of the package and every own test hand follows a person's hand.

No limit broken, no exception, no standing still.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from marks import rotated
from oracles.shape_distances import MeasuredPairs

from handmap_qp import Hand, HandMapper, hand_names, load_hand, read_recording
from handmap_qp.apps.onboarding.collision_pairs import find_collision_pairs
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.fingers import find_fingers
from handmap_qp.hands.shape_pairs import all_pairs
from handmap_qp.hands.spec import HandSpec
from handmap_qp.human import HumanMotion
from handmap_qp.human.fit import fit_recording

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

DATA = Path(__file__).parents[1] / "data" / "urdf"
OWN = (
    "chained_mimics",
    "prismatic_fingers",
    "continuous_joints",
    "absent_limits",
    "one_finger",
    "seven_fingers",
)
ROBOTS = [name for name in hand_names() if name not in ("human", "human_left")]
every_hand = pytest.mark.parametrize("name", [*ROBOTS, *OWN])
_DT = 1.0 / 60.0
# Tolerance of the QP's solver; results are clipped into the box afterwards.
_TOLERANCE = 1e-9


@cache
def hand_of(name: str) -> Hand:
    spec: str | HandSpec = (
        name if name in ROBOTS else detect(DATA / f"{name}.urdf").spec
    )
    return load_hand(spec)


def follow(
    human: Hand, robot: Hand, q: np.ndarray, wrist: np.ndarray, dt: np.ndarray
) -> np.ndarray:
    """Map a motion and return the robot's joint angles, shape (T, n).

    The first sample is the reference.
    """
    mapper = HandMapper(
        human, robot, rigid_from="wrist" if robot.has_moving_wrist else "none", dt=_DT
    )
    angles, last = [], None
    for sample, pose, step in zip(q, wrist, dt, strict=True):
        result = mapper.map_step(
            np.clip(sample, human.lower_limits, human.upper_limits),
            pose,
            dt=float(step),
        )
        assert result.status != "failed"
        for values in (
            result.command.q,
            result.command.wrist,
            result.points,
            result.targets,
        ):
            assert np.isfinite(values).all()
        angles.append(result.command.q)
        last = result
    assert last is not None
    # Followers follow while it moves.
    alone = robot.points(
        last.command.q, last.command.wrist if robot.is_floating else None
    )
    np.testing.assert_allclose(last.points, alone, atol=1e-9)
    return np.array(angles)


def check_limits(robot: Hand, q: np.ndarray, dt: np.ndarray) -> None:
    """Return positions and speeds of all joints of the URDF, mimic joints included."""
    assert (q >= robot.lower_limits - _TOLERANCE).all()
    assert (q <= robot.upper_limits + _TOLERANCE).all()
    speeds = np.abs(np.diff(q, axis=0)) / dt[1:, None]
    assert (speeds <= robot.velocity_limits * (1.0 + _TOLERANCE)).all()
    plain = pin.buildModelFromXML(robot.urdf_text)
    every = robot.all_joints(q)
    for i, (joint, role) in enumerate(
        zip(robot.all_joint_names, robot.all_joint_roles, strict=True)
    ):
        if role == "follower" and not any(joint in note for note in robot.notes):
            at = plain.joints[plain.getJointId(joint)].idx_q
            assert (every[:, i] >= plain.lowerPositionLimit[at] - _TOLERANCE).all(), (
                joint
            )
            assert (every[:, i] <= plain.upperPositionLimit[at] + _TOLERANCE).all(), (
                joint
            )


@cache
def lively_motion(side: str) -> tuple[Hand, np.ndarray, np.ndarray]:
    """Return a second of motion: each joint at its own frequency, the wrist on a circle."""
    human = load_hand("human" if side == "right" else "human_left")
    time = _DT * np.arange(60)
    pace = np.random.default_rng(7).uniform(0.4, 1.6, len(human.rest))
    share = 0.5 - 0.5 * np.cos(2.0 * np.pi * time[:, None] * pace)
    goal = np.where(np.arange(len(pace)) % 2, human.upper_limits, human.lower_limits)
    q = human.rest + 0.8 * share * (goal - human.rest)
    wrist = np.tile(np.eye(4), (len(time), 1, 1))
    wrist[:, :3, 3] = 0.08 * np.column_stack(
        [np.sin(3.0 * time), 1.0 - np.cos(3.0 * time), np.sin(5.0 * time)]
    )
    for i, t in enumerate(time):
        wrist[i, :3, :3] = pin.exp3(0.6 * np.sin(2.0 * t) * np.array([0.6, 0.0, 0.8]))
    return human, q, wrist


@pytest.mark.parametrize("name", rotated([*ROBOTS, *OWN], 3))
def test_it_follows_a_lively_hand_within_all_limits(name: str) -> None:
    robot = hand_of(name)
    human, q, wrist = lively_motion(robot.side)
    dt = np.full(len(q), _DT)
    angles = follow(human, robot, q, wrist, dt)
    check_limits(robot, angles, dt)
    # A hand that does not move would pass the rest of this test.
    assert (
        np.ptp(angles, axis=0).max()
        > 0.05 * (robot.upper_limits - robot.lower_limits).min()
    )


@pytest.fixture(scope="module")
def recorded(recordings: Path) -> dict[str, HumanMotion]:
    """Fit a short part of one recording of each side, once."""
    motions = {}
    for side in ("right", "left"):
        recording = read_recording(recordings / f"quest3_webxr_{side}.npz")
        first = int(np.argmax(recording.valid))
        motions[side] = fit_recording(recording.part(slice(first, first + 60)))
    return motions


@pytest.mark.parametrize(
    "name", ["allegro_left", "hey5", "tiago_arm", "prismatic_fingers"]
)
def test_it_follows_a_recorded_hand_within_all_limits(
    name: str, recorded: dict[str, HumanMotion]
) -> None:
    robot = hand_of(name)
    motion = recorded[robot.side]
    check_limits(
        robot, follow(motion.human, robot, motion.q, motion.wrist, motion.dt), motion.dt
    )


@pytest.mark.parametrize("name", hand_names())
def test_links_that_are_to_stay_apart_are_apart_at_rest(name: str) -> None:
    hand = load_hand(name)
    if hand.spec.collision is None:
        pytest.skip("names no pairs of links")
    placed = hand.configuration()
    placed.place(hand.configuration_vector(hand.rest))
    limit = MeasuredPairs(hand)
    assert limit.within(placed.q).found[:, 0].min() > limit.margin


@pytest.mark.parametrize("name", ["hey5", "romeo_right"])
def test_the_pairs_of_a_description_are_those_that_are_found(name: str) -> None:
    hand = load_hand(name)
    found = find_collision_pairs(hand, all_pairs(hand))
    assert found is not None
    assert hand.spec.collision is not None
    assert set(hand.spec.collision.pairs) == set(found.pairs)


@pytest.mark.parametrize("name", hand_names())
def test_fingertips_lie_in_the_shapes_of_their_links(name: str) -> None:
    """A model had one finger's tip 18 mm beside the finger, seen and felt."""
    hand = load_hand(name)
    shapes = read_collision_shapes(hand).geometryObjects
    for finger, chain in find_fingers(hand).items():
        joint, tip = chain.tip
        ball = coal.Sphere(1e-6)
        place = coal.Transform3s(np.eye(3), tip)
        gaps = []
        for shape in (shape for shape in shapes if shape.parentJoint == joint):
            pose = shape.placement
            own = coal.Transform3s(pose.rotation, pose.translation)
            request, result = coal.DistanceRequest(), coal.DistanceResult()
            gaps.append(
                coal.distance(shape.geometry, own, ball, place, request, result)
            )
        assert min(gaps, default=0.0) < 2e-3, finger
