"""Mappings with a known answer.

A hand mapped to itself, hands in other units, hands that rest, real recordings.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from mapping_cases import little_pose, near_rest
from marks import crossed
from strategies import generators, motion_of

from handmap_qp import HandMapper, IkOptions, MappingOptions, load_hand, read_recording
from handmap_qp.hands.hand import Hand
from handmap_qp.human import HumanMotion
from handmap_qp.human.fit import fit_recording
from handmap_qp.mapping import MotionEstimator
from handmap_qp.reference import estimate, polar

# No term pulls away from the targets, there is no speed limit, and time suffices to arrive. The
# damping by the error, zero at the end, keeps a finger from overshooting into the posture that
# reaches the same point with its joints bent the other way.
EXACT = IkOptions(
    rest_weight=0.0,
    damping=0.01,
    error_damping=1.0,
    max_iterations=100,
    step_tolerance=1e-9,
    has_velocity_limits=False,
)
# A joint that turns by more between the samples used here belongs to a hand found again [rad].
JUMP = 1.0
# Partners take over all of the misfit; the wrist's target is the human's own.
ITSELF = MappingOptions(
    rigid_from="wrist",
    pivot="palm",
    residual_gain=1.0,
    ridge=1.0,
    stretch_min=0.0,
    stretch_max=np.inf,
)
TENTH_OF_A_MILLIMETRE = 1e-4


def inside(hand: Hand, q: np.ndarray) -> np.ndarray:
    """Return the nearest posture inside the limits."""
    return np.clip(q, hand.lower_limits, hand.upper_limits)


@cache
def recorded(file: Path) -> HumanMotion:
    """Fit every third sample; fitting takes most of the time."""
    return fit_recording(read_recording(file).part(slice(None, None, 3)))


@pytest.mark.parametrize(
    "points", ["fingertips", "fingertips_middle", "joints", "landmarks"]
)
@settings(max_examples=10)
@given(generator=generators)
def test_a_hand_mapped_to_itself_returns_its_own_points(
    points: str, generator: np.random.Generator
) -> None:
    hand = load_once("human", points)
    mapper = HandMapper(hand, hand, ITSELF, ik=EXACT)
    q, wrist = near_rest(generator), little_pose(generator)
    mapper.reset(q, wrist, robot_q=q, robot_wrist=wrist)
    for _ in range(3):
        step = mapper.map_step(near_rest(generator, 0.3), little_pose(generator))
        np.testing.assert_allclose(step.targets, step.human_points, atol=1e-12)
        # Tip and middle joint allow two postures of a finger, and the limit of its last joint may
        # separate them.
        bound = 1e-3 if step.at_bound.any() else TENTH_OF_A_MILLIMETRE
        np.testing.assert_allclose(step.points, step.human_points, atol=bound)


@pytest.mark.slow
@pytest.mark.parametrize("rigid_from", ["points", "wrist"])
def test_every_recorded_hand_mapped_to_itself_returns_its_own_joints(
    recordings: Path, rigid_from: Any
) -> None:
    # With T_rb from the points the wrist's target is not where the human's wrist is, so the wrist
    # is left to follow the points.
    free = (
        {"wrist_position_weight": 0.0, "wrist_orientation_weight": 0.0}
        if rigid_from == "points"
        else {}
    )
    for file in sorted(recordings.glob("*.npz")):
        motion = recorded(file)
        hand, seen = motion.human.with_points("joints"), np.flatnonzero(motion.valid)
        start = inside(hand, motion.q[seen[0]])
        mapper = HandMapper(
            hand,
            hand,
            ITSELF.replaced(rigid_from=rigid_from),
            ik=EXACT.replaced(**free),
        )
        mapper.reset(
            start,
            motion.wrist[seen[0]],
            robot_q=start,
            robot_wrist=motion.wrist[seen[0]],
        )
        before = start
        for i in seen[::2]:
            q, wrist = inside(hand, motion.q[i]), motion.wrist[i]
            if np.abs(q - before).max() > JUMP:
                # The tracker found the hand again. From far away, the iterations may end in the
                # other of two postures.
                mapper.reset(robot_q=q, robot_wrist=wrist)
            before = q
            step = mapper.map_step(q, wrist)
            error = np.abs(step.points - step.human_points).max()
            assert error < TENTH_OF_A_MILLIMETRE, (
                f"{file.stem}, sample {3 * i}: {1e3 * error:.3f} mm"
            )


@cache
def load_once(name: str, points: str) -> Hand:
    return load_hand(name, points=points)


def in_unit(hand: Hand, unit: float) -> Hand:
    """Return the same hand with all lengths in another unit."""
    robot = ET.fromstring(hand.urdf_text)
    for origin in robot.iter("origin"):
        xyz = [float(number) for number in origin.get("xyz", "0 0 0").split()]
        origin.set("xyz", " ".join(repr(unit * number) for number in xyz))
    spec = hand.spec

    def scaled(xyz: tuple[float, float, float]) -> tuple[float, float, float]:
        x, y, z = xyz
        return unit * x, unit * y, unit * z

    points = tuple(
        msgspec.structs.replace(point, xyz=scaled(point.xyz))
        for point in hand.reference_points
    )
    return Hand(
        msgspec.structs.replace(
            spec,
            mirror=False,
            palm=msgspec.structs.replace(spec.palm, xyz=scaled(spec.palm.xyz)),
            wrist=msgspec.structs.replace(
                spec.wrist, max_linear_speed=unit * spec.wrist.max_linear_speed
            ),
        ),
        points=points,
        mount=hand.mount,
        urdf_text=ET.tostring(robot, encoding="unicode"),
    )


def weights_in_unit(ik: IkOptions, unit: float) -> IkOptions:
    """Return the same weights per length."""
    return ik.replaced(
        point_weight=ik.point_weight / unit,
        wrist_position_weight=ik.wrist_position_weight / unit,
        point_tolerance=ik.point_tolerance * unit,
    )


@pytest.mark.parametrize("unit", [0.1, 39.37])
@settings(max_examples=10)
@given(generator=generators)
def test_a_fixed_hand_in_another_unit_of_length_takes_the_same_steps(
    unit: float, generator: np.random.Generator
) -> None:
    human, robot = (
        load_once("human", "joints"),
        load_hand("allegro_right", points="fingertips", mount="fixed"),
    )
    options = MappingOptions(rigid_from="none", alignment="palm", residual_gain=0.5)
    here = HandMapper(human, robot, options)
    there = HandMapper(
        in_unit(human, unit),
        in_unit(robot, unit),
        options,
        ik=weights_in_unit(IkOptions(), unit),
    )
    for _ in range(3):
        q, wrist = near_rest(generator, 0.1), little_pose(generator, 0.02)
        step, scaled = (
            here.map_step(q, wrist),
            there.map_step(q, motion_of(wrist[:3, :3], unit * wrist[:3, 3])),
        )
        np.testing.assert_allclose(
            scaled.targets, unit * step.targets, atol=1e-12 * unit
        )
        np.testing.assert_allclose(scaled.command.q, step.command.q, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rigid_from", "unit"),
    crossed(["points", "wrist", "none"], [0.1, 39.37], every=2),
)
@settings(max_examples=4)
@given(generator=generators)
def test_a_floating_hand_in_another_unit_of_length_ends_in_the_same_posture(
    rigid_from: Any, unit: float, generator: np.random.Generator
) -> None:
    # Damping weighs a wrist's metres against its radians, so the steps differ, but not the end.
    human, robot = load_once("human", "joints"), load_once("three_finger", "fingertips")
    ik = IkOptions(
        damping=1e-3,  # The iterations converge faster with less damping.
        max_iterations=200,
        step_tolerance=1e-12,
        error_damping=0.0,
        has_velocity_limits=False,
    )
    options = MappingOptions(rigid_from=rigid_from, alignment="palm", residual_gain=0.5)
    here = HandMapper(human, robot, options, ik=ik)
    there = HandMapper(
        in_unit(human, unit),
        in_unit(robot, unit),
        options,
        ik=weights_in_unit(ik, unit),
    )
    for _ in range(2):
        q, wrist = near_rest(generator, 0.1), little_pose(generator, 0.02)
        step, scaled = (
            here.map_step(q, wrist),
            there.map_step(q, motion_of(wrist[:3, :3], unit * wrist[:3, 3])),
        )
        np.testing.assert_allclose(
            scaled.targets, unit * step.targets, atol=1e-12 * unit
        )
        # Where the iterations go round, they have no end to compare.
        assume(max(step.ik.last_step, scaled.ik.last_step) < 1e-9)
        np.testing.assert_allclose(scaled.command.q, step.command.q, atol=1e-8)
        np.testing.assert_allclose(
            scaled.command.wrist[:3, :3], step.command.wrist[:3, :3], atol=1e-8
        )
        np.testing.assert_allclose(
            scaled.command.wrist[:3, 3],
            unit * step.command.wrist[:3, 3],
            atol=1e-9 * unit,
        )


@pytest.mark.parametrize(
    ("rigid_from", "pivot"), [("points", "centroid"), ("wrist", "palm")]
)
@pytest.mark.parametrize(
    ("robot", "share"),
    [
        ("three_finger", 0.25),
        ("three_finger", 1.0),
        ("three_finger", -0.9),
        ("allegro_right", 0.25),
        ("allegro_right", 1.0),
        ("allegro_right", -0.9),
    ],
)
def test_a_robot_comes_to_rest_when_the_human_does(
    rigid_from: Any, pivot: Any, robot: str, share: float
) -> None:
    human = load_once("human", "joints")
    mapper = HandMapper(
        human, load_hand(robot, points="fingertips"), rigid_from=rigid_from, pivot=pivot
    )
    mapper.map_step(human.rest, np.eye(4))
    limits = human.upper_limits if share > 0.0 else human.lower_limits
    held = human.rest + abs(share) * (limits - human.rest)
    *_, last, now = (mapper.map_step(held, np.eye(4)).command.q for _ in range(200))
    # A milliradian per sample is invisible; an oscillation is a hundred times larger.
    np.testing.assert_allclose(now, last, atol=1e-3)


def test_a_ridge_bounds_the_stretch_of_recorded_fingertips_and_none_does_not(
    recordings: Path,
) -> None:
    stretches: dict[float, list[np.ndarray]] = {0.0: [], 0.1: []}
    for file in sorted(recordings.glob("*.npz")):
        recording = read_recording(file)
        tips = recording.landmarks[recording.valid][:, [4, 8, 12, 16, 20]]
        for ridge, found in stretches.items():
            estimator = MotionEstimator(tips[0], ridge=ridge)
            found += [
                polar(estimate(estimator, points).motion[:3, :3]).stretches
                for points in tips[::5]
            ]
    free, held = np.array(stretches[0.0]), np.array(stretches[0.1])
    assert free.max() > 10.0
    assert free.min() < 0.0
    assert held.max() < 3.0
    assert held.min() > 0.0
