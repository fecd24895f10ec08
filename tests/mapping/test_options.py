"""Every option has the effect of its definition.

T_rb, T_def and the targets, written out here as 4x4 matrices.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marks import crossed
from strategies import generators, motion_of, rotations

from handmap_qp import (
    HandMapper,
    IkOptions,
    InvalidOptionsError,
    MappingOptions,
    MapStep,
    estimate_motion,
    load_hand,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.se3 import transform_points

HUMAN = load_hand("human", points="fingertips_middle")
ROBOT = load_hand("allegro_right", points="fingertips_middle")
QUARTER = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
POINT = (0.3, -0.2, 0.5)

RIGID_FROMS = ["points", "wrist", "none"]
PIVOTS = ["centroid", "palm", "point", "world"]
rigid_froms = pytest.mark.parametrize("rigid_from", RIGID_FROMS)
pivots = pytest.mark.parametrize("pivot", PIVOTS)


class Situation:
    """Draw both hands at a reference, and the human hand at a later sample."""

    def __init__(self, generator: np.random.Generator) -> None:
        self.human_q = [self._posture(HUMAN, generator) for _ in range(2)]
        self.human_wrist = [self._pose(generator) for _ in range(2)]
        self.robot_q, self.robot_wrist = (
            self._posture(ROBOT, generator),
            self._pose(generator),
        )

    @staticmethod
    def _posture(hand: Hand, generator: np.random.Generator) -> np.ndarray:
        return generator.uniform(hand.lower_limits, hand.upper_limits)

    @staticmethod
    def _pose(generator: np.random.Generator) -> np.ndarray:
        return motion_of(
            pin.exp3(generator.uniform(-1.5, 1.5, size=3)),
            generator.uniform(-1.0, 1.0, size=3),
        )

    def step(self, options: MappingOptions) -> MapStep:
        """Return the mapper's step at the later sample."""
        mapper = HandMapper(HUMAN, ROBOT, options)
        mapper.reset(
            self.human_q[0],
            self.human_wrist[0],
            robot_q=self.robot_q,
            robot_wrist=self.robot_wrist,
        )
        return mapper.map_step(self.human_q[1], self.human_wrist[1])

    def palms(self) -> tuple[np.ndarray, np.ndarray]:
        """Return palm poses of human and robot at the reference."""
        return self.human_wrist[
            0
        ] @ HUMAN.wrist_to_palm, self.robot_wrist @ ROBOT.wrist_to_palm


def about(linear: np.ndarray, centre: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return the 4x4 matrix of `s -> linear (s - centre) + image`."""
    return (
        motion_of(np.eye(3), image)
        @ motion_of(linear, np.zeros(3))
        @ motion_of(np.eye(3), -centre)
    )


def definition(at: Situation, options: MappingOptions) -> dict[str, np.ndarray]:
    """Compute the mapping by its definition: estimation, decomposition about the pivot, eq. (7)."""
    before, now = (
        HUMAN.points(q, wrist)
        for q, wrist in zip(at.human_q, at.human_wrist, strict=True)
    )
    robot_points = ROBOT.points(at.robot_q, at.robot_wrist)
    human_palm, robot_palm = at.palms()
    displacement = at.human_wrist[1] @ np.linalg.inv(at.human_wrist[0])
    prior = displacement[:3, :3] if options.rigid_from == "wrist" else None
    T = estimate_motion(before, now, ridge=options.ridge, prior=prior).motion

    # A = U R, left polar, with a proper rotation; the stretch is clamped and raised to the gain.
    left, values, right = np.linalg.svd(T[:3, :3])
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    R = (left * flip) @ right
    stretches = (
        np.clip(values * flip, options.stretch_min, options.stretch_max)
        ** options.deformation_gain
    )
    U = (left * stretches) @ left.T

    world = np.array(options.pivot_point or np.zeros(3))
    c_h = {"centroid": before.mean(axis=0), "palm": human_palm[:3, 3]}.get(
        options.pivot, world
    )
    c_r = {"centroid": robot_points.mean(axis=0), "palm": robot_palm[:3, 3]}.get(
        options.pivot, world
    )
    T_c = transform_points(T, c_h[None])[0]
    T_rb = {"points": about(R, c_h, T_c), "wrist": displacement, "none": np.eye(4)}[
        options.rigid_from
    ]
    T_rb_c = transform_points(T_rb, c_h[None])[0]
    T_def = about(U @ R, c_h, T_c) @ np.linalg.inv(T_rb)

    named = {
        "world": np.eye(3),
        "palm": robot_palm[:3, :3] @ human_palm[:3, :3].T,
        "y-up": np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    }
    Q = (
        named[options.alignment]
        if isinstance(options.alignment, str)
        else np.array(options.alignment)
    )
    image = c_r + options.scale * Q @ (T_rb_c - c_h)
    T_rb_r = about(Q @ T_rb[:3, :3] @ Q.T, c_r, image)
    T_def_r = about(
        Q @ T_def[:3, :3] @ Q.T, image, image + options.scale * Q @ (T_c - T_rb_c)
    )
    targets = transform_points(T_def_r @ T_rb_r, robot_points)

    # The residual of the human point of the same name to the imposed motion, in proportion to the
    # sizes of the two sets of partners.
    names = [point.name for point in HUMAN.reference_points]
    partners = [names.index(point.name) for point in ROBOT.reference_points]
    misfit = now - transform_points(about(U @ R, c_h, T_c), before)
    sizes = [
        np.linalg.norm(points - points.mean(axis=0))
        for points in (robot_points, before[partners])
    ]
    targets = (
        targets + options.residual_gain * sizes[0] / sizes[1] * misfit[partners] @ Q.T
    )
    return {
        "motion": T,
        "motion_rigid": T_rb,
        "motion_deformation": T_def,
        "targets": targets,
        "wrist_target": T_rb_r @ at.robot_wrist,
    }


def options_of(**choices: Any) -> MappingOptions:
    """Draw options, with the pivot's point where one is needed."""
    return MappingOptions(
        **choices, pivot_point=POINT if choices.get("pivot") == "point" else None
    )


@pytest.mark.parametrize(
    ("rigid_from", "pivot", "alignment"),
    crossed(RIGID_FROMS, PIVOTS, ["world", "palm", "y-up", QUARTER], every=4),
)
@settings(max_examples=8)
@given(
    generator=generators,
    scale=st.floats(0.0, 3.0),
    deformation_gain=st.sampled_from([0.0, 0.5, 1.0, 1.7]),
    residual_gain=st.floats(0.0, 1.0),
    ridge=st.sampled_from([0.0, 0.1, 1.0]),
)
def test_a_step_equals_the_definition(
    rigid_from: Any,
    pivot: Any,
    alignment: Any,
    generator: np.random.Generator,
    scale: float,
    deformation_gain: float,
    residual_gain: float,
    ridge: float,
) -> None:
    options = options_of(
        rigid_from=rigid_from,
        pivot=pivot,
        alignment=alignment,
        scale=scale,
        deformation_gain=deformation_gain,
        residual_gain=residual_gain,
        ridge=ridge,
    )
    at = Situation(generator)
    step = at.step(options)
    for name, expected in definition(at, options).items():
        # 1e-9 m, where numbers are near one and the points' condition is near 1e2.
        np.testing.assert_allclose(
            getattr(step, name), expected, atol=1e-9, err_msg=name
        )


@rigid_froms
@given(generator=generators)
def test_the_parts_multiply_to_the_motion_when_nothing_is_clamped(
    rigid_from: Any, generator: np.random.Generator
) -> None:
    step = Situation(generator).step(
        MappingOptions(rigid_from=rigid_from, stretch_min=0.0, stretch_max=np.inf)
    )
    if step.stretches[2] > 0.0:
        np.testing.assert_allclose(
            step.motion_deformation @ step.motion_rigid, step.motion, atol=1e-9
        )
        assert not step.is_clamped


@given(rotation=rotations, generator=generators)
def test_any_rotation_can_be_the_alignment(
    rotation: np.ndarray, generator: np.random.Generator
) -> None:
    rows = tuple(tuple(row) for row in rotation.tolist())
    at, options = Situation(generator), MappingOptions(alignment=rows, pivot="palm")  # ty: ignore[invalid-argument-type]
    np.testing.assert_allclose(
        at.step(options).targets, definition(at, options)["targets"], atol=1e-9
    )


@given(generator=generators)
def test_palm_alignment_is_the_rotation_between_the_palms(
    generator: np.random.Generator,
) -> None:
    at = Situation(generator)
    human_palm, robot_palm = at.palms()
    rows = tuple(
        tuple(row) for row in (robot_palm[:3, :3] @ human_palm[:3, :3].T).tolist()
    )
    by_name = at.step(MappingOptions(alignment="palm"))
    by_rotation = at.step(MappingOptions(alignment=rows))  # ty: ignore[invalid-argument-type]
    np.testing.assert_allclose(by_name.targets, by_rotation.targets, atol=1e-12)
    np.testing.assert_allclose(
        by_name.wrist_target, by_rotation.wrist_target, atol=1e-12
    )


@pivots
@given(generator=generators, scale=st.floats(0.0, 5.0))
def test_scale_multiplies_translations_and_nothing_else(
    pivot: Any, generator: np.random.Generator, scale: float
) -> None:
    at = Situation(generator)
    none, one, scaled = (
        at.step(options_of(pivot=pivot, scale=factor)) for factor in (0.0, 1.0, scale)
    )
    np.testing.assert_allclose(
        scaled.targets - none.targets, scale * (one.targets - none.targets), atol=1e-9
    )
    np.testing.assert_allclose(
        scaled.wrist_target[:3, :3], one.wrist_target[:3, :3], atol=1e-12
    )


@pytest.mark.parametrize("residual_gain", [0.25, 1.0])
@given(generator=generators)
def test_the_residual_grows_in_proportion_to_its_gain(
    residual_gain: float, generator: np.random.Generator
) -> None:
    at = Situation(generator)
    none, full, some = (
        at.step(MappingOptions(residual_gain=gain))
        for gain in (0.0, 1.0, residual_gain)
    )
    np.testing.assert_allclose(
        some.targets - none.targets,
        residual_gain * (full.targets - none.targets),
        atol=1e-12,
    )


@given(generator=generators)
def test_the_paper_can_be_had(generator: np.random.Generator) -> None:
    # Eqs. (5)-(7) as printed: least squares, no residual, no gain, one world, its origin for a
    # pivot.
    paper = MappingOptions(
        ridge=0.0,
        rigid_from="points",
        pivot="world",
        residual_gain=0.0,
        deformation_gain=1.0,
        reference="previous",
        stretch_min=0.0,
        stretch_max=np.inf,
    )
    at = Situation(generator)
    step = at.step(paper)
    if not step.is_clamped:  # A mirrored T is clamped as well.
        robot_points = ROBOT.points(at.robot_q, at.robot_wrist)
        np.testing.assert_allclose(
            step.targets, transform_points(step.motion, robot_points), atol=1e-9
        )
        np.testing.assert_allclose(
            step.wrist_target, step.motion_rigid @ at.robot_wrist, atol=1e-9
        )
        np.testing.assert_allclose(
            step.motion_rigid[:3, 3], step.motion[:3, 3], atol=1e-12
        )


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({"pivot": "point"}, "pivot_point: goes together"),
        ({"pivot_point": POINT}, "pivot_point: goes together"),
        ({"pivot": "point", "pivot_point": (0.0, 1.0)}, "3 finite numbers"),
        (
            {"pivot": "point", "pivot_point": (0.0, 1.0, float("nan"))},
            "3 finite numbers",
        ),
        ({"pivot": "wrist"}, "centroid, palm, point, world"),
        ({"rigid_from": "palm"}, "points, wrist, none"),
        ({"reference": "last"}, "first, rest, previous"),
        ({"alignment": "robot"}, "one of world, palm, y-up"),
        ({"alignment": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))}, "matrix of shape (3, 3)"),
        (
            {"alignment": ((2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
            "rotation",
        ),
        (
            {"alignment": ((float("nan"), 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
            "matrix of shape (3, 3)",
        ),
        (
            {"alignment": ((float("inf"), 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
            "matrix of shape (3, 3)",
        ),
        ({"alignment": ((1.0, 0.0), (0.0, 1.0, 0.0))}, "matrix of shape (3, 3)"),
        ({"alignment": 1.0}, "matrix of shape (3, 3)"),
        (
            {"alignment": ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
            "mirrors: map a left hand",
        ),
        ({"deformation_gain": 0.5, "stretch_min": 0.0}, "give stretch_min > 0"),
        ({"deformation_gain": -1.0}, "deformation_gain"),
        ({"deformation_gain": 11.0}, "deformation_gain"),
        ({"residual_gain": 1.01}, "residual_gain: expected a number in [0, 1]"),
        ({"residual_gain": -0.1}, "residual_gain: expected a number in [0, 1]"),
        ({"scale": -1.0}, "scale"),
        ({"scale": float("inf")}, "scale"),
        ({"ridge": float("inf")}, "ridge"),
        ({"ridge": float("nan")}, "ridge"),
        ({"ridge": "little"}, "ridge: expected a finite number"),
        ({"pivot": "point", "pivot_point": ("here", 0.0, 0.0)}, "3 finite numbers"),
        ({"stretch_min": 1.1}, "stretch_min: expected a number in [0, 1]"),
        ({"stretch_max": 0.9}, "stretch_max"),
    ],
    ids=str,
)
def test_values_without_a_meaning_are_refused_by_name(
    choices: dict[str, Any], words: str
) -> None:
    with pytest.raises(InvalidOptionsError, match=re.escape(words)):
        MappingOptions(**choices)


@pytest.mark.parametrize(
    ("human", "robot", "choices", "words"),
    [
        ({"mount": "fixed"}, {}, {}, "mount='floating'"),
        ({}, {"mount": "fixed"}, {"rigid_from": "wrist"}, "give rigid_from='none'"),
        (
            {"points": ("thumb_tip", "ring_tip", "little_tip")},
            {},
            {"ridge": 0.0},
            "choose more points, or ridge > 0",
        ),
        ({}, {}, {"gain": 1.0}, "there are ridge, rigid_from"),
        (
            {"points": ("little_tip", "little_pip", "little_mcp", "wrist")},
            {},
            {"residual_gain": 0.5},
            "add `partner` to its points, or give residual_gain=0",
        ),
    ],
    ids=["human fixed", "robot fixed", "three points", "no such option", "no partners"],
)
def test_options_that_contradict_the_hands_are_rejected_with_advice(
    human: dict[str, Any], robot: dict[str, Any], choices: dict[str, Any], words: str
) -> None:
    with pytest.raises(InvalidOptionsError, match=re.escape(words)):
        HandMapper(
            load_hand("human", **human), load_hand("allegro_right", **robot), **choices
        )


def test_options_that_are_lists_say_so() -> None:
    wrong: Any = 3
    words = "tasks: expected a list, each a name, got 3"
    with pytest.raises(InvalidOptionsError, match=words):
        IkOptions(tasks=wrong)


def test_numbers_of_numpy_are_taken_as_pythons() -> None:
    point = tuple(np.array([0.0, 1.0, 0.5]))
    options = MappingOptions(ridge=np.float64(2.0), pivot="point", pivot_point=point)
    assert options.pivot_point == (0.0, 1.0, 0.5)
    values = (options.ridge, *options.pivot_point)
    assert {type(value) for value in values} == {float}
