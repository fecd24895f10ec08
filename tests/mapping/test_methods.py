"""The protocol of mapping methods, fingertip vectors, and the arrays of results."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, cast

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from mapping_cases import little_pose, near_rest

from handmap_qp import (
    DegeneratePointsError,
    HandMapper,
    IkOptions,
    InvalidInputError,
    InvalidOptionsError,
    JointToJoint,
    MappingOptions,
    MapStep,
    VirtualEllipsoid,
    VirtualSphere,
    load_hand,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping import get_preset
from handmap_qp.mapping.by_name import METHODS
from handmap_qp.mapping.method import (
    BoundMethod,
    HumanPose,
    RobotPosture,
    TargetMap,
    Targets,
)
from handmap_qp.mapping.methods.fingertip_vectors import FingertipVectors
from handmap_qp.mapping.methods.homogeneous import Homogeneous
from handmap_qp.se3 import affine, transform_points

HUMAN = load_hand("human")
ALLEGRO = load_hand("allegro_right")
THREE = load_hand("three_finger")
SETTLE = IkOptions(
    max_iterations=200,
    step_tolerance=1e-10,
    error_damping=0.0,
    has_velocity_limits=False,
)
CHOICES = [
    MappingOptions(),
    MappingOptions(rigid_from="none"),
    MappingOptions(
        rigid_from="wrist", pivot="palm", alignment="palm", residual_gain=1.0
    ),
    MappingOptions(reference="previous"),
    MappingOptions(pivot="world"),
    FingertipVectors(),
    FingertipVectors(origin="knuckle"),
    JointToJoint(),
    VirtualSphere(),
    VirtualEllipsoid(),
]


def arrays_of(value: Any, seen: set[int] | None = None) -> Iterator[np.ndarray]:
    """Return all arrays reachable from a result, also through properties."""
    seen = set() if seen is None else seen
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple | list):
        for item in value:
            yield from arrays_of(item, seen)
    elif isinstance(value, msgspec.Struct) or is_dataclass(value):
        if id(value) in seen:
            return
        seen.add(id(value))
        names = (
            value.__struct_fields__
            if isinstance(value, msgspec.Struct)
            else [item.name for item in fields(value)]
        )
        properties = [
            name
            for name in dir(type(value))
            if isinstance(getattr(type(value), name), property)
        ]
        for name in (*names, *properties):
            try:
                found = getattr(value, name)
            except InvalidOptionsError:
                continue
            yield from arrays_of(found, seen)


def spoil(value: Any) -> int:
    """Overwrite every writable array."""
    spoilt = 0
    for array in arrays_of(value):
        if array.flags.writeable and array.size:
            array[...] = 7
            spoilt += 1
    return spoilt


@pytest.mark.parametrize("method", CHOICES, ids=str)
def test_writing_into_results_and_arguments_changes_nothing(method: Any) -> None:
    rng = np.random.default_rng(0)
    samples = [(near_rest(rng, hand=HUMAN), little_pose(rng)) for _ in range(6)]
    spoilt, untouched = (HandMapper(HUMAN, ALLEGRO, method) for _ in range(2))
    for i, (q, wrist) in enumerate(samples):
        given = (q.copy(), wrist.copy())
        step = spoilt.map_step(*given)
        expected = untouched.map_step(q, wrist)
        np.testing.assert_array_equal(step.command.q, expected.command.q)
        np.testing.assert_array_equal(step.command.wrist, expected.command.wrist)
        np.testing.assert_array_equal(step.targets, expected.targets)
        assert spoil(step) > 5
        spoil(given)
        if i == 3:
            spoilt.configure(method)
            untouched.configure(method)
    # Other mappers, which share constants, do not change either.
    fresh = HandMapper(HUMAN, ALLEGRO, method).map_step(*samples[0])
    again = HandMapper(HUMAN, ALLEGRO, method).map_step(*samples[0])
    np.testing.assert_array_equal(fresh.wrist_target, again.wrist_target)


def test_points_that_are_written_to_after_the_step_change_nothing() -> None:
    points = HUMAN.points(HUMAN.rest)
    mapper, given = HandMapper(HUMAN, THREE, "paper"), points.copy()
    mapper.map_points(given, np.eye(4))
    given[:] = 5.0
    step = mapper.map_points(points, np.eye(4))
    np.testing.assert_allclose(step.motion, np.eye(4), atol=1e-12)


class Mirror:
    """A method that keeps the robot at the posture of the reference."""

    def bind(self, human: Hand, robot: Hand) -> BoundMethod:
        return StillMethod(robot)


class StillMethod:
    contacts, needs_wrist, reference_needs_wrist = None, "", ""
    renews_reference = False

    def __init__(self, robot: Hand) -> None:
        self.robot = robot

    def start_palm(self, sample: HumanPose) -> np.ndarray:
        return affine(np.eye(3), np.array([0.0, 0.0, 1.0]))

    def start(self, sample: HumanPose, robot: RobotPosture) -> TargetMap:
        return StillMap(robot)


class StillMap:
    def __init__(self, robot: RobotPosture) -> None:
        self.rest, self._robot = robot.q, robot

    def targets(self, sample: HumanPose) -> Targets:
        return Targets(self._robot.points, self._robot.wrist, {"q": self.rest})


def test_a_users_method_needs_no_other_change() -> None:
    mapper = HandMapper(HUMAN, THREE, Mirror())
    for share in (0.0, 0.2):
        step = mapper.map_step(
            HUMAN.rest + share * (HUMAN.upper_limits - HUMAN.rest), np.eye(4)
        )
    np.testing.assert_array_equal(step.diagnostics["q"], THREE.rest)
    assert step.status == "converged"
    np.testing.assert_allclose(step.command.q, THREE.rest, atol=1e-12)
    palm = step.command.wrist @ THREE.wrist_to_palm
    np.testing.assert_allclose(palm[:3, 3], (0.0, 0.0, 1.0), atol=1e-12)
    assert not step.is_clamped
    with pytest.raises(
        InvalidOptionsError, match="diagnostics have no motion: there are q"
    ):
        _ = step.motion


@pytest.mark.parametrize("name", METHODS)
def test_every_method_with_a_name_maps_a_sample(name: str) -> None:
    mapper = HandMapper(HUMAN, ALLEGRO, METHODS[name]())
    mapper.map_step(HUMAN.rest, np.eye(4))
    step = mapper.map_step(0.9 * HUMAN.rest, np.eye(4))
    assert np.isfinite(step.command.q).all()
    assert step.targets.shape == step.points.shape


def test_the_short_form_takes_every_option_and_no_other() -> None:
    assert HandMapper(HUMAN, THREE, ridge=0.4).method == MappingOptions(ridge=0.4)
    both = HandMapper(HUMAN, THREE, MappingOptions(scale=2.0), ridge=0.4)
    assert both.method == Homogeneous(scale=2.0, ridge=0.4)
    with pytest.raises(InvalidOptionsError) as raised:
        HandMapper(HUMAN, THREE, gain=1.0)
    assert raised.value.option == "gain"
    named = HandMapper(HUMAN, THREE, "object", ridge=0.4)
    assert named.method == get_preset("object").method.replaced(ridge=0.4)
    assert named.ik == get_preset("object").ik
    for wrong, option in (
        (3.0, "method"),
        (FingertipVectors, "method"),
        ("paper?", "preset"),
    ):
        with pytest.raises(InvalidOptionsError) as raised:
            HandMapper(HUMAN, THREE, wrong, ridge=0.1)  # ty: ignore[invalid-argument-type]
        assert raised.value.option == option


# -- wrist-to-tip vectors


def test_tip_vectors_of_a_hand_onto_itself_return_its_own_points() -> None:
    rng = np.random.default_rng(1)
    mapper = HandMapper(HUMAN, HUMAN, FingertipVectors(scale=1.0), ik=SETTLE)
    for _ in range(10):
        step = mapper.map_step(near_rest(rng, hand=HUMAN), little_pose(rng))
        np.testing.assert_allclose(step.targets, step.human_points, atol=1e-12)
        np.testing.assert_allclose(
            step.wrist_target[:3, :3] @ step.wrist_target[:3, :3].T,
            np.eye(3),
            atol=1e-12,
        )


def test_tip_vectors_are_scaled_in_the_axes_of_the_palm() -> None:
    rng, pairs = np.random.default_rng(2), {"thumb_tip": 0, "index_tip": 1}
    mapper = HandMapper(HUMAN, ALLEGRO, FingertipVectors(scale=1.5))
    names = [point.name for point in HUMAN.reference_points]
    for _ in range(5):
        q, wrist = near_rest(rng, hand=HUMAN), little_pose(rng)
        step = mapper.map_step(q, wrist)
        human_palm = wrist @ HUMAN.wrist_to_palm
        robot_palm = step.wrist_target @ ALLEGRO.wrist_to_palm
        for name, j in pairs.items():
            k = names.index(name)
            vector = transform_points(
                np.linalg.inv(human_palm), step.human_points[k][None]
            )[0]
            target = transform_points(np.linalg.inv(robot_palm), step.targets[j][None])[
                0
            ]
            np.testing.assert_allclose(target, 1.5 * vector, atol=1e-12)


def test_the_palm_follows_the_wrist_in_world_axes_from_any_start() -> None:
    start = affine(pin.exp3(np.array([0.3, -1.0, 0.2])), np.array([1.0, 2.0, 3.0]))
    mapper = HandMapper(HUMAN, ALLEGRO, FingertipVectors())
    mapper.reset(HUMAN.rest, np.eye(4), robot_wrist=start)
    turn = affine(pin.exp3(np.array([0.0, 0.0, 0.5])), np.array([0.1, 0.0, 0.0]))
    step = mapper.map_step(HUMAN.rest, turn)
    before, after = (
        start @ ALLEGRO.wrist_to_palm,
        step.wrist_target @ ALLEGRO.wrist_to_palm,
    )
    np.testing.assert_allclose(after[:3, :3], turn[:3, :3] @ before[:3, :3], atol=1e-12)
    human = turn @ HUMAN.wrist_to_palm - HUMAN.wrist_to_palm
    np.testing.assert_allclose(after[:3, 3] - before[:3, 3], human[:3, 3], atol=1e-12)


def test_a_fixed_wrist_keeps_its_palm() -> None:
    fixed = load_hand("allegro_right", mount="fixed")
    mapper = HandMapper(HUMAN, fixed, FingertipVectors())
    mapper.map_step(HUMAN.rest, np.eye(4))
    step = mapper.map_step(HUMAN.rest, affine(np.eye(3), np.array([0.5, 0.0, 0.0])))
    np.testing.assert_allclose(step.wrist_target, step.command.wrist, atol=1e-12)
    assert step.status in ("converged", "limited", "unsettled", "unreachable")


def test_tip_vectors_name_their_missing_requirement() -> None:
    with pytest.raises(InvalidInputError) as raised:
        HandMapper(HUMAN, ALLEGRO, FingertipVectors()).map_points(
            HUMAN.points(HUMAN.rest)
        )
    assert raised.value.argument == "wrist_pose"
    with pytest.raises(InvalidOptionsError, match="add `partner`"):
        HandMapper(HUMAN.with_points(("wrist",)), THREE, FingertipVectors())
    with pytest.raises(InvalidOptionsError) as wrong:
        FingertipVectors(scale=-1.0)
    assert wrong.value.option == "scale"


# -- the reference's posture


@pytest.mark.parametrize(
    "method",
    [m for m in CHOICES if not isinstance(m, FingertipVectors | JointToJoint)],
    ids=str,
)
def test_a_still_human_keeps_the_robot_still_from_any_start(method: Any) -> None:
    # The rest term pulls to the posture of the reference. Another posture would move joints with
    # little effect on the points.
    if isinstance(method, MappingOptions) and method.reference == "previous":
        pytest.skip("a chain of references has no posture to come back to")
    rng = np.random.default_rng(3)
    start = rng.uniform(ALLEGRO.lower_limits, ALLEGRO.upper_limits)
    mapper = HandMapper(HUMAN, ALLEGRO, method)
    mapper.reset(robot_q=start)
    steps = [mapper.map_step(HUMAN.rest, np.eye(4)) for _ in range(20)]
    np.testing.assert_allclose(steps[-1].command.q, start, atol=1e-9)


def test_a_clutch_bends_no_joint_that_was_stretched_after_a_point_out_of_reach() -> (
    None
):
    mapper = HandMapper(
        HUMAN, ALLEGRO, MappingOptions(rigid_from="none", stretch_max=np.inf)
    )
    wrist = np.eye(4)
    points = HUMAN.points(HUMAN.rest, wrist)
    mapper.map_points(points, wrist)
    far = points + np.array([0.0, 0.3, 0.05])
    before = [mapper.map_points(far, wrist) for _ in range(120)][-1]
    assert before.point_error.max() > 0.05
    mapper.clutch()
    after = [mapper.map_points(far, wrist) for _ in range(60)][-1]
    np.testing.assert_allclose(after.command.q, before.command.q, atol=1e-6)


def test_the_rest_reference_forgets_the_posture_of_the_first_sample() -> None:
    rng, options = (
        np.random.default_rng(6),
        MappingOptions(reference="rest", rigid_from="wrist"),
    )
    wrist, q = little_pose(rng), near_rest(rng, 0.5, HUMAN)
    targets = []
    for first in (HUMAN.rest, near_rest(rng, 0.8, HUMAN)):
        mapper = HandMapper(HUMAN, ALLEGRO, options)
        mapper.map_step(first, wrist)
        targets.append(mapper.map_step(q, wrist).targets)
    np.testing.assert_allclose(targets[0], targets[1], atol=1e-12)
    # The resting human asks for the resting robot, wherever the robot started.
    mapper = HandMapper(HUMAN, ALLEGRO, options, ik=SETTLE)
    mapper.reset(robot_q=0.5 * (ALLEGRO.lower_limits + ALLEGRO.upper_limits))
    step = [mapper.map_step(HUMAN.rest, wrist) for _ in range(5)][-1]
    np.testing.assert_allclose(step.motion, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(step.command.q, ALLEGRO.rest, atol=1e-4)
    with pytest.raises(InvalidInputError, match="reference='rest'"):
        HandMapper(HUMAN, ALLEGRO, MappingOptions(reference="rest")).map_points(
            HUMAN.points(HUMAN.rest)
        )


def test_the_previous_reference_takes_the_wrist_along() -> None:
    # The wrist moves at a constant speed. If every step referred to the first wrist, displacements
    # would add up quadratically.
    mapper = HandMapper(
        HUMAN,
        THREE,
        MappingOptions(reference="previous", rigid_from="wrist"),
        ik=SETTLE,
        dt=1.0,
    )
    first = mapper.map_step(HUMAN.rest, np.eye(4))
    poses = [affine(np.eye(3), np.array([0.01 * i, 0.0, 0.0])) for i in range(1, 11)]
    last = [mapper.map_step(HUMAN.rest, pose) for pose in poses][-1]
    moved = last.command.wrist[:3, 3] - first.command.wrist[:3, 3]
    np.testing.assert_allclose(moved, (0.1, 0.0, 0.0), atol=1e-5)


def test_after_a_reset_the_next_sample_is_the_reference() -> None:
    mapper = HandMapper(HUMAN, THREE)
    here, there = np.eye(4), affine(np.eye(3), np.array([0.3, -0.2, 0.1]))
    first = mapper.map_step(HUMAN.rest, here)
    mapper.reset()
    assert mapper.reference is None
    again = mapper.map_step(HUMAN.rest, there)
    assert mapper.reference is not None
    np.testing.assert_array_equal(mapper.reference.wrist, there)
    # The robot starts over on the human's palm, with the same fingers.
    np.testing.assert_allclose(again.command.q, first.command.q, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(
        again.command.wrist, there @ first.command.wrist, rtol=0.0, atol=1e-9
    )


def test_points_that_cannot_be_the_next_reference_move_nothing() -> None:
    mapper = HandMapper(HUMAN, THREE, reference="previous")
    mapper.map_step(HUMAN.rest, np.eye(4))
    before = mapper.point_ik.gate.stamp
    line = np.outer(np.linspace(0.0, 0.1, len(HUMAN.reference_points)), [1.0, 0.0, 0.0])
    with pytest.raises(DegeneratePointsError):
        mapper.map_points(line)
    assert mapper.point_ik.gate.stamp == before


@pytest.mark.parametrize(("reference", "left"), [("first", 1.0), ("previous", 0.1)])
def test_a_chain_of_references_rests_in_the_posture_of_the_hand(
    reference: Any, left: float
) -> None:
    # Each sample's targets are where the robot is, and nothing else moves it from its start.
    mapper = HandMapper(
        HUMAN, THREE, reference=reference, ik=IkOptions(rest_weight=1.0)
    )
    away = 0.3 * (THREE.upper_limits - THREE.rest)
    mapper.reset(robot_q=THREE.rest + away)
    for _ in range(200):
        step = mapper.map_step(HUMAN.rest, np.eye(4))
    found = np.linalg.norm(step.command.q - THREE.rest) / np.linalg.norm(away)
    assert found == pytest.approx(left, abs=0.1)


def test_residual_gain_one_cancels_gain_and_clamping() -> None:
    # With residual gain 1 on a hand mapped to itself the targets are the human's points, whatever
    # part of the stretch is imposed.
    rng = np.random.default_rng(5)
    same = MappingOptions(rigid_from="wrist", pivot="palm", residual_gain=1.0)
    for options in (
        same.replaced(deformation_gain=0.3),
        same.replaced(stretch_min=0.95, stretch_max=1.05),
    ):
        mapper = HandMapper(HUMAN, HUMAN, options)
        mapper.reset(HUMAN.rest, np.eye(4), robot_q=HUMAN.rest, robot_wrist=np.eye(4))
        step: MapStep = mapper.map_step(near_rest(rng, 0.6, HUMAN), little_pose(rng))
        np.testing.assert_allclose(step.targets, step.human_points, atol=1e-12)


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda m: m.map_step(["a"] * 20, np.eye(4)), "human_q"),
        (lambda m: m.map_step(["0.1"] * 20, np.eye(4)), "human_q"),
        (lambda m: m.map_step(None, np.eye(4)), "human_q"),
        (lambda m: m.map_step(np.full(20, 1j), np.eye(4)), "human_q"),
        (lambda m: m.map_step([[0.1]] * 20, np.eye(4)), "human_q"),
        (lambda m: m.map_step(np.full(20, np.nan), np.eye(4)), "human_q[0]"),
        (lambda m: m.map_step(HUMAN.rest, "x"), "wrist_pose"),
        (lambda m: m.map_step(HUMAN.rest, np.eye(3)), "wrist_pose"),
        (lambda m: m.map_step(HUMAN.rest, [1.0] * 7), "wrist_pose"),
        (lambda m: m.map_step(HUMAN.rest, np.eye(4), dt="x"), "dt"),
        (lambda m: m.map_step(HUMAN.rest, np.eye(4), dt=0.0), "dt"),
        (lambda m: m.map_step(HUMAN.rest, np.eye(4), dt=np.nan), "dt"),
        (lambda m: m.map_points("x", np.eye(4)), "points"),
        (lambda m: m.map_points([[1.0]] * 20, np.eye(4)), "points"),
        (lambda m: m.map_points(np.full((20, 3), np.inf), np.eye(4)), "points"),
        (lambda m: m.map_points([["1"] * 3] * 20, np.eye(4)), "points"),
        (lambda m: m.reset(robot_q=["a"] * 8), "robot_q"),
        (lambda m: m.reset(robot_q=[9.0] * 8), "robot_q[2]"),
        (lambda m: m.reset(robot_q=0.0), "robot_q"),
        (lambda m: m.reset(robot_wrist="x"), "robot_wrist"),
        (lambda m: m.reset(HUMAN.rest), "wrist_pose"),
        (lambda m: m.reset(wrist_pose=np.eye(4)), "human_q"),
        (lambda m: HandMapper(HUMAN, THREE, "paper", dt=cast(float, "x")), "dt"),
        (
            lambda m: HandMapper(HUMAN, THREE, "paper", joint_tolerance=-1.0),
            "joint_tolerance",
        ),
        (lambda m: HUMAN.points(["a"] * 20), "q"),
    ],
)
def test_an_invalid_argument_is_named_and_changes_nothing(
    call: Any, argument: str
) -> None:
    mapper, untouched = (
        HandMapper(HUMAN, THREE, "paper"),
        HandMapper(HUMAN, THREE, "paper"),
    )
    for each in (mapper, untouched):
        each.map_step(HUMAN.rest, np.eye(4))
    with pytest.raises(InvalidInputError) as raised:
        call(mapper)
    assert raised.value.argument == argument
    after, expected = (
        each.map_step(HUMAN.rest + 0.05, np.eye(4)) for each in (mapper, untouched)
    )
    np.testing.assert_array_equal(after.command.q, expected.command.q)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"damping": "x"}, "damping"),
        ({"damping": 0.0}, "damping"),
        ({"rest_weight": None}, "rest_weight"),
        ({"max_iterations": 1.5}, "max_iterations"),
        ({"max_acceleration": -1.0}, "max_acceleration"),
        ({"solver": 3}, "solver"),
    ],
    ids=str,
)
def test_settings_of_the_qp_without_a_meaning_are_rejected_by_name(
    options: dict[str, Any], name: str
) -> None:
    with pytest.raises(InvalidOptionsError) as raised:
        IkOptions(**options)
    assert raised.value.option == name
