"""Transfer of a motion.

Effect of its parts on pivots and points; clamping, gain, mirrored motions and units.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marks import crossed
from strategies import affine_motions, generators, motion_of, poses

from handmap_qp import Homogeneous, load_hand
from handmap_qp.mapping.method import HumanPose, RobotPosture
from handmap_qp.se3 import transform_points

HUMAN = load_hand("human", points="fingertips_middle")
ROBOT = load_hand("three_finger", points="fingertips_middle")
HERE = np.eye(4)
POINT = (0.3, -0.2, 0.5)
OPEN: dict[str, Any] = {"stretch_min": 0.0, "stretch_max": np.inf}

RIGID_FROMS = ["points", "wrist", "none"]
PIVOTS = ["centroid", "palm", "point", "world"]
rigid_froms = pytest.mark.parametrize("rigid_from", RIGID_FROMS)
pivots = pytest.mark.parametrize("pivot", PIVOTS)
alignments = pytest.mark.parametrize("alignment", ["world", "palm"])


def options_of(**choices: Any) -> Homogeneous:
    """Return least squares with some choices: motions of the points are found exactly."""
    point = POINT if choices.get("pivot") == "point" else None
    defaults: dict[str, Any] = {"ridge": 0.0, "pivot_point": point}
    return Homogeneous(**(defaults | choices))


class Transfer:
    """A motion of the human's points and wrist, carried to the robot; both hands start at rest.

    Args:
        options: The choices.
        moved: The human's points now, or the motion that takes them there exactly, shape (4, 4).
        wrist: The human's wrist now.
        start: The human's wrist at the reference.
        robot_wrist: The robot's.
        unit: Units of length in a metre.
    """

    def __init__(
        self,
        options: Homogeneous,
        moved: np.ndarray,
        wrist: np.ndarray | None = None,
        start: np.ndarray = HERE,
        robot_wrist: np.ndarray = HERE,
        unit: float = 1.0,
    ) -> None:
        self.before = unit * HUMAN.points(HUMAN.rest, start)
        self.placed = unit * ROBOT.points(ROBOT.rest, robot_wrist)
        now = transform_points(moved, self.before) if moved.shape == (4, 4) else moved
        posture = RobotPosture(ROBOT.rest, self.placed, in_unit(robot_wrist, unit))
        sample = HumanPose(self.before, in_unit(start, unit))
        self.map = options.bind(HUMAN, ROBOT).start(sample, posture)
        self.targets = self.map.targets(HumanPose(now, wrist))
        self.results = self.targets.diagnostics

    def __getattr__(self, name: str) -> np.ndarray:
        """Return a result by name."""
        return self.results[name]

    @property
    def is_clamped(self) -> bool:
        """Whether a stretch was outside its range."""
        return "stretch_clamped" in self.targets.flags

    @property
    def human_pivot(self) -> np.ndarray:
        """The human's pivot, from where T takes it."""
        inverse = np.linalg.inv(self.results["motion"])
        return transform_points(inverse, self.results["pivot_image"][None])[0]


def in_unit(pose: np.ndarray, unit: float) -> np.ndarray:
    return motion_of(pose[:3, :3], unit * pose[:3, 3])


def image(motion: np.ndarray, point: np.ndarray) -> np.ndarray:
    return transform_points(motion, point[None])[0]


@pytest.mark.parametrize(("rigid_from", "pivot"), crossed(RIGID_FROMS, PIVOTS, every=2))
@settings(max_examples=15)
@given(motion=affine_motions(), wrist=poses, start=poses)
def test_the_parts_multiply_to_the_motion(
    rigid_from: Any,
    pivot: Any,
    motion: np.ndarray,
    wrist: np.ndarray,
    start: np.ndarray,
) -> None:
    options = options_of(rigid_from=rigid_from, pivot=pivot, **OPEN)
    transfer = Transfer(options, motion, wrist, start)
    np.testing.assert_allclose(
        transfer.motion_deformation @ transfer.motion_rigid, motion, atol=1e-9
    )


@pivots
@given(motion=affine_motions(), start=poses)
def test_the_rigid_part_carries_the_pivot_and_the_deformation_leaves_it(
    pivot: Any, motion: np.ndarray, start: np.ndarray
) -> None:
    options = options_of(pivot=pivot, **OPEN)
    transfer = Transfer(options, motion, None, start)
    moved = transfer.pivot_image
    np.testing.assert_allclose(
        image(transfer.motion_rigid, transfer.human_pivot), moved, atol=1e-8
    )
    np.testing.assert_allclose(
        image(transfer.motion_deformation, moved), moved, atol=1e-9
    )


@pivots
@alignments
@settings(max_examples=15)
@given(pose=poses, start=poses, robot_wrist=poses)
def test_a_rigid_motion_deforms_nothing(
    pivot: Any,
    alignment: Any,
    pose: np.ndarray,
    start: np.ndarray,
    robot_wrist: np.ndarray,
) -> None:
    options = options_of(pivot=pivot, alignment=alignment)
    transfer = Transfer(options, pose, None, start, robot_wrist)
    np.testing.assert_allclose(transfer.motion_deformation, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(transfer.stretches, 1.0, atol=1e-9)
    # The robot's points and wrist move as one body.
    body = transfer.targets.wrist @ np.linalg.inv(robot_wrist)
    moved = transform_points(body, transfer.placed)
    np.testing.assert_allclose(transfer.targets.points, moved, atol=1e-9)


@rigid_froms
@given(pose=poses, start=poses)
def test_a_rigid_motion_of_points_and_wrist_is_all_rigid_unless_the_wrist_is_to_stay(
    rigid_from: Any, pose: np.ndarray, start: np.ndarray
) -> None:
    options = options_of(rigid_from=rigid_from)
    transfer = Transfer(options, pose, pose @ start, start)
    rigid, rest = (np.eye(4), pose) if rigid_from == "none" else (pose, np.eye(4))
    np.testing.assert_allclose(transfer.motion_rigid, rigid, atol=1e-9)
    np.testing.assert_allclose(transfer.motion_deformation, rest, atol=1e-9)


@rigid_froms
@given(motion=affine_motions(mirrored=True), wrist=poses, start=poses)
def test_a_mirrored_motion_never_yields_a_reflection(
    rigid_from: Any, motion: np.ndarray, wrist: np.ndarray, start: np.ndarray
) -> None:
    options = options_of(rigid_from=rigid_from)
    transfer = Transfer(options, motion, wrist, start)
    assert transfer.is_clamped
    assert transfer.stretches[2] < 0.0
    for proper in (transfer.motion_rigid, transfer.targets.wrist):
        np.testing.assert_allclose(
            proper[:3, :3] @ proper[:3, :3].T, np.eye(3), atol=1e-12
        )
        assert np.linalg.det(proper[:3, :3]) > 0.0
    # The mirrored direction is clamped to 0.2, the smallest stretch that is imposed.
    assert (
        np.linalg.det(transfer.motion_deformation[:3, :3])
        >= options.stretch_min**3 - 1e-12
    )


@given(
    points=generators.map(lambda generator: generator.normal(scale=0.05, size=(10, 3))),
    wrist=poses,
)
def test_mirrored_points_never_turn_the_robots_wrist_inside_out(
    points: np.ndarray, wrist: np.ndarray
) -> None:
    mirrored = HUMAN.points(HUMAN.rest, wrist) + points
    transfer = Transfer(
        options_of(ridge=0.1), mirrored * (-1.0, 1.0, 1.0), None, wrist, wrist
    )
    assert np.linalg.det(transfer.targets.wrist[:3, :3]) == pytest.approx(
        1.0, abs=1e-12
    )
    assert np.linalg.det(transfer.motion_deformation[:3, :3]) > 0.0


@given(
    motion=affine_motions(largest=8.0),
    low=st.floats(0.2, 1.0),
    high=st.floats(1.0, 4.0),
)
def test_stretches_are_clamped_to_their_range(
    motion: np.ndarray, low: float, high: float
) -> None:
    options = options_of(stretch_min=low, stretch_max=high)
    transfer = Transfer(options, motion)
    passed = np.linalg.svd(transfer.motion_deformation[:3, :3], compute_uv=False)
    np.testing.assert_allclose(
        passed, np.clip(transfer.stretches, low, high), atol=1e-9
    )
    np.testing.assert_allclose(
        transfer.stretches, np.linalg.svd(motion[:3, :3], compute_uv=False), atol=1e-9
    )
    assert transfer.is_clamped == bool(
        (transfer.stretches < low).any() or (transfer.stretches > high).any()
    )


@given(motion=affine_motions())
def test_half_the_deformation_gain_is_the_root_of_the_stretch(
    motion: np.ndarray,
) -> None:
    def deformation(gain: float) -> np.ndarray:
        options = options_of(
            deformation_gain=gain, stretch_min=0.01, stretch_max=np.inf
        )
        return Transfer(options, motion).motion_deformation

    np.testing.assert_allclose(
        deformation(0.5) @ deformation(0.5), deformation(1.0), atol=1e-10
    )
    np.testing.assert_allclose(deformation(0.0), np.eye(4), atol=1e-12)


@alignments
@given(motion=affine_motions(), start=poses, robot_wrist=poses)
def test_the_robots_points_see_the_motion_in_their_own_axes(
    alignment: Any, motion: np.ndarray, start: np.ndarray, robot_wrist: np.ndarray
) -> None:
    # Stretches do not depend on the frame: the robot's offsets are stretched by the same factors as
    # the human's.
    options = options_of(alignment=alignment, **OPEN)
    transfer = Transfer(options, motion, None, start, robot_wrist)
    arms = transfer.targets.points - transfer.targets.points.mean(axis=0)
    offsets = transfer.placed
    linear = np.linalg.lstsq(offsets - offsets.mean(axis=0), arms, rcond=None)[0].T
    np.testing.assert_allclose(
        np.linalg.svd(linear)[1], np.abs(transfer.stretches), atol=1e-8
    )


@pytest.mark.parametrize(
    ("residual_gain", "rigid_from", "pivot"),
    crossed([0.0, 1.0], RIGID_FROMS, PIVOTS, every=2),
)
@settings(max_examples=15)
@given(
    generator=generators,
    wrist=poses,
    start=poses,
    unit=st.sampled_from([1e-3, 39.37, 1000.0]),
)
def test_other_units_of_length_scale_lengths_and_nothing_else(
    residual_gain: float,
    rigid_from: Any,
    pivot: Any,
    generator: np.random.Generator,
    wrist: np.ndarray,
    start: np.ndarray,
    unit: float,
) -> None:
    # The pivot's point is at the origin, which is the same in all units.
    options = options_of(
        ridge=0.1,
        rigid_from=rigid_from,
        pivot=pivot,
        residual_gain=residual_gain,
        pivot_point=(0.0, 0.0, 0.0) if pivot == "point" else None,
    )
    now = HUMAN.points(HUMAN.rest, start) + generator.normal(scale=0.02, size=(10, 3))
    here = Transfer(options, now, wrist, start)
    there = Transfer(options, unit * now, in_unit(wrist, unit), start, unit=unit)
    one, two = here.targets, there.targets
    np.testing.assert_allclose(
        two.points, unit * one.points, rtol=1e-9, atol=1e-9 * unit
    )
    np.testing.assert_allclose(
        two.wrist, in_unit(one.wrist, unit), rtol=1e-9, atol=1e-9 * unit
    )
    np.testing.assert_allclose(there.stretches, here.stretches, atol=1e-9)
