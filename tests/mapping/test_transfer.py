"""Transfer of a motion.

Effect of its parts on pivots and points; clamping, gain, mirrored motions and units.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import affine_motions, generators, motion_of, poses

from handmap_qp import InvalidInputError, MappingOptions, load_hand
from handmap_qp.mapping.estimation import MotionEstimate, MotionEstimator
from handmap_qp.mapping.method import HumanPose, RobotPosture
from handmap_qp.mapping.reference import Reference, make_reference, partner_pairs
from handmap_qp.mapping.transfer import Transfer, transfer_motion
from handmap_qp.transform import transform_points

HUMAN = load_hand("human", points="fingertips_middle")
ROBOT = load_hand("three_finger", points="fingertips_middle")
POINT = (0.3, -0.2, 0.5)
OPEN: dict[str, Any] = {"stretch_min": 0.0, "stretch_max": np.inf}

rigid_froms = pytest.mark.parametrize("rigid_from", ["points", "wrist", "none"])
pivots = pytest.mark.parametrize("pivot", ["centroid", "palm", "point", "world"])
alignments = pytest.mark.parametrize("alignment", ["world", "palm"])


def options_of(**choices: Any) -> MappingOptions:
    return MappingOptions(**choices, pivot_point=POINT if choices.get("pivot") == "point" else None)


def reference_of(
    options: MappingOptions, human_wrist: np.ndarray, robot_wrist: np.ndarray
) -> Reference:
    """Return the reference of both hands at rest with given wrists."""
    points = HUMAN.points(HUMAN.rest, human_wrist)
    robot = ROBOT.configuration()
    robot.place_frames(ROBOT.configuration_vector(ROBOT.rest, robot_wrist))
    estimator = MotionEstimator(
        points, ridge=options.ridge, has_prior=options.rigid_from == "wrist"
    )
    posture = RobotPosture(ROBOT.rest, robot.points.copy(), robot_wrist)
    partners = partner_pairs(HUMAN, ROBOT) if options.residual_gain > 0.0 else []
    sample = HumanPose(points, human_wrist)
    return make_reference(HUMAN, ROBOT, options, estimator, sample, posture, partners)


def exact(motion: np.ndarray) -> MotionEstimate:
    """Return the estimate of points that a motion moves exactly."""
    none = np.zeros((len(HUMAN.reference_points), 3))
    return MotionEstimate(motion[:3, :3], np.zeros(3), motion[:3, 3], none, none, np.ones(3))


def transfer_of(
    estimate: MotionEstimate,
    reference: Reference,
    wrist: np.ndarray | None,
    options: MappingOptions,
    points: np.ndarray | None = None,
) -> Transfer:
    """Transfer a motion; the current points affect the residual alone."""
    now = np.zeros((len(HUMAN.reference_points), 3)) if points is None else points
    return transfer_motion(estimate, reference, HumanPose(now, wrist), options)


def image(motion: np.ndarray, point: np.ndarray) -> np.ndarray:
    return transform_points(motion, point[None])[0]


@rigid_froms
@pivots
@given(motion=affine_motions(), wrist=poses, start=poses)
def test_the_parts_multiply_to_the_motion(
    rigid_from: Any, pivot: Any, motion: np.ndarray, wrist: np.ndarray, start: np.ndarray
) -> None:
    options = options_of(rigid_from=rigid_from, pivot=pivot, **OPEN)
    transfer = transfer_of(exact(motion), reference_of(options, start, np.eye(4)), wrist, options)
    np.testing.assert_allclose(
        transfer.motion_deformation @ transfer.motion_rigid, motion, atol=1e-12
    )


@pivots
@given(motion=affine_motions(), start=poses)
def test_the_rigid_part_carries_the_pivot_and_the_deformation_leaves_it(
    pivot: Any, motion: np.ndarray, start: np.ndarray
) -> None:
    options = options_of(pivot=pivot, **OPEN)
    reference = reference_of(options, start, np.eye(4))
    transfer = transfer_of(exact(motion), reference, None, options)
    moved = image(motion, reference.human_pivot)
    np.testing.assert_allclose(
        image(transfer.motion_rigid, reference.human_pivot), moved, atol=1e-12
    )
    np.testing.assert_allclose(image(transfer.motion_deformation, moved), moved, atol=1e-12)


@pivots
@alignments
@given(pose=poses, start=poses, robot_wrist=poses)
def test_a_rigid_motion_deforms_nothing(
    pivot: Any, alignment: Any, pose: np.ndarray, start: np.ndarray, robot_wrist: np.ndarray
) -> None:
    options = options_of(pivot=pivot, alignment=alignment)
    reference = reference_of(options, start, robot_wrist)
    transfer = transfer_of(exact(pose), reference, None, options)
    np.testing.assert_allclose(transfer.motion_deformation, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(transfer.stretches, 1.0, atol=1e-12)
    # The robot's points and wrist move as one body.
    body = transfer.wrist_target @ np.linalg.inv(robot_wrist)
    shift_map = np.eye(3) if reference.shift_map is None else reference.shift_map
    robot_pivot = reference.robot_origin + shift_map @ reference.human_pivot
    start_points = reference.robot_rows[:, :3] + robot_pivot
    np.testing.assert_allclose(transfer.targets, transform_points(body, start_points), atol=1e-12)


@rigid_froms
@given(pose=poses, start=poses)
def test_a_rigid_motion_of_points_and_wrist_is_all_rigid_unless_the_wrist_is_to_stay(
    rigid_from: Any, pose: np.ndarray, start: np.ndarray
) -> None:
    options = options_of(rigid_from=rigid_from)
    transfer = transfer_of(
        exact(pose), reference_of(options, start, np.eye(4)), pose @ start, options
    )
    rigid, rest = (np.eye(4), pose) if rigid_from == "none" else (pose, np.eye(4))
    np.testing.assert_allclose(transfer.motion_rigid, rigid, atol=1e-12)
    np.testing.assert_allclose(transfer.motion_deformation, rest, atol=1e-12)


@rigid_froms
@given(motion=affine_motions(mirrored=True), wrist=poses, start=poses)
def test_a_mirrored_motion_never_yields_a_reflection(
    rigid_from: Any, motion: np.ndarray, wrist: np.ndarray, start: np.ndarray
) -> None:
    options = options_of(rigid_from=rigid_from)
    transfer = transfer_of(exact(motion), reference_of(options, start, np.eye(4)), wrist, options)
    assert transfer.is_clamped
    assert transfer.stretches[2] < 0.0
    for proper in (transfer.motion_rigid, transfer.wrist_target):
        np.testing.assert_allclose(proper[:3, :3] @ proper[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(proper[:3, :3]) > 0.0
    # The mirrored direction is clamped to 0.2, the smallest stretch that is imposed.
    assert np.linalg.det(transfer.motion_deformation[:3, :3]) >= options.stretch_min**3 - 1e-12


@given(
    points=generators.map(lambda generator: generator.normal(scale=0.05, size=(10, 3))), wrist=poses
)
def test_mirrored_points_never_turn_the_robots_wrist_inside_out(
    points: np.ndarray, wrist: np.ndarray
) -> None:
    options = options_of()
    estimator = MotionEstimator(points, ridge=options.ridge)
    estimate = estimator.estimate(points * (-1.0, 1.0, 1.0))
    transfer = transfer_of(estimate, reference_of(options, wrist, wrist), None, options)
    assert np.linalg.det(transfer.wrist_target[:3, :3]) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.det(transfer.motion_deformation[:3, :3]) > 0.0


@given(motion=affine_motions(largest=8.0), low=st.floats(0.2, 1.0), high=st.floats(1.0, 4.0))
def test_stretches_are_clamped_to_their_range(motion: np.ndarray, low: float, high: float) -> None:
    options = options_of(stretch_min=low, stretch_max=high)
    transfer = transfer_of(
        exact(motion), reference_of(options, np.eye(4), np.eye(4)), None, options
    )
    passed = np.linalg.svd(transfer.motion_deformation[:3, :3], compute_uv=False)
    np.testing.assert_allclose(passed, np.clip(transfer.stretches, low, high), atol=1e-12)
    np.testing.assert_allclose(
        transfer.stretches, np.linalg.svd(motion[:3, :3], compute_uv=False), atol=1e-12
    )
    assert transfer.is_clamped == bool(
        (transfer.stretches < low).any() or (transfer.stretches > high).any()
    )


@given(motion=affine_motions())
def test_half_the_deformation_gain_is_the_root_of_the_stretch(motion: np.ndarray) -> None:
    def deformation(gain: float) -> np.ndarray:
        options = options_of(deformation_gain=gain, stretch_min=0.01, stretch_max=np.inf)
        return transfer_of(
            exact(motion), reference_of(options, np.eye(4), np.eye(4)), None, options
        ).motion_deformation

    np.testing.assert_allclose(deformation(0.5) @ deformation(0.5), deformation(1.0), atol=1e-10)
    np.testing.assert_allclose(deformation(0.0), np.eye(4), atol=1e-12)


@alignments
@given(motion=affine_motions(), start=poses, robot_wrist=poses)
def test_the_robots_points_see_the_motion_in_their_own_axes(
    alignment: Any, motion: np.ndarray, start: np.ndarray, robot_wrist: np.ndarray
) -> None:
    # Stretches do not depend on the frame: the robot's offsets are stretched by the same factors as
    # the human's.
    options = options_of(alignment=alignment, **OPEN)
    reference = reference_of(options, start, robot_wrist)
    transfer = transfer_of(exact(motion), reference, None, options)
    arms = transfer.targets - transfer.targets.mean(axis=0)
    offsets = reference.robot_rows[:, :3]
    linear = np.linalg.lstsq(offsets - offsets.mean(axis=0), arms, rcond=None)[0].T
    np.testing.assert_allclose(np.linalg.svd(linear)[1], np.abs(transfer.stretches), atol=1e-8)


@pytest.mark.parametrize("residual_gain", [0.0, 1.0])
@rigid_froms
@pivots
@settings(max_examples=15)
@given(generator=generators, wrist=poses, start=poses, unit=st.sampled_from([1e-3, 39.37, 1000.0]))
def test_other_units_of_length_scale_lengths_and_nothing_else(
    residual_gain: float,
    rigid_from: Any,
    pivot: Any,
    generator: np.random.Generator,
    wrist: np.ndarray,
    start: np.ndarray,
    unit: float,
) -> None:
    options = options_of(rigid_from=rigid_from, pivot=pivot, residual_gain=residual_gain)
    reference = reference_of(options, start, np.eye(4))
    now = HUMAN.points(HUMAN.rest, start) + generator.normal(scale=0.02, size=(10, 3))
    prior = np.eye(3) if rigid_from == "wrist" else None
    scaled = _in_unit(reference, options, unit)
    here = transfer_of(reference.estimator.estimate(now, prior), reference, wrist, options, now)
    there = transfer_of(
        scaled.estimator.estimate(unit * now, prior),
        scaled,
        _pose_in_unit(wrist, unit),
        options,
        unit * now,
    )
    np.testing.assert_allclose(there.targets, unit * here.targets, rtol=1e-9, atol=1e-9 * unit)
    np.testing.assert_allclose(
        there.wrist_target, _pose_in_unit(here.wrist_target, unit), rtol=1e-9, atol=1e-9 * unit
    )
    np.testing.assert_allclose(there.stretches, here.stretches, atol=1e-9)


def _pose_in_unit(pose: np.ndarray, unit: float) -> np.ndarray:
    return motion_of(pose[:3, :3], unit * pose[:3, 3])


def _in_unit(reference: Reference, options: MappingOptions, unit: float) -> Reference:
    """Return the same reference measured in another unit of length."""
    human_wrist = np.eye(4) if reference.human_wrist is None else reference.human_wrist
    points = unit * HUMAN.points(HUMAN.rest, human_wrist)
    return msgspec.structs.replace(
        reference,
        estimator=MotionEstimator(
            points, ridge=options.ridge, has_prior=options.rigid_from == "wrist"
        ),
        human_wrist=_pose_in_unit(human_wrist, unit),
        human_offsets=unit * reference.human_offsets,
        human_pivot=unit * reference.human_pivot,
        robot_rows=reference.robot_rows * (unit, unit, unit, 1.0),
        robot_wrist=_pose_in_unit(reference.robot_wrist, unit),
        robot_origin=unit * reference.robot_origin,
    )


def test_a_wrist_is_needed_where_it_gives_the_rigid_part() -> None:
    options = options_of(rigid_from="wrist")
    with pytest.raises(InvalidInputError, match="wrist_pose"):
        transfer_of(exact(np.eye(4)), reference_of(options, np.eye(4), np.eye(4)), None, options)
