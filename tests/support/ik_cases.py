"""Hands, postures and targets for the tests of the inverse kinematics."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import msgspec
import numpy as np
import pinocchio as pin
import pytest

from handmap_core.core import core
from handmap_core.ik.gate import Gate
from handmap_core.ik.motion import SHORTEST_DT, Motion
from handmap_core.ik.options import IkOptions
from handmap_core.ik.tasks import Goal, Task
from handmap_qp import MissingExtraError, hand_names, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import hand_files
from handmap_qp.hands.sources import read_urdf, urdf_directory
from handmap_qp.hands.spec import (
    CollisionSpec,
    HandSpec,
    PalmSpec,
    PointSpec,
    WristSpec,
    read_hand_spec,
)
from handmap_qp.hands.urdf import parse_urdf
from handmap_qp.ik.qp import PointIk
from handmap_qp.reference.problem import direct_cost

ARM_JOINTS = ("arm_turn", "arm_lift", "arm_roll")
_ARM = """
<robot name="arm">
  <link name="base"/><link name="turret"/><link name="upper"/><link name="flange"/>
  <joint name="arm_turn" type="revolute">
    <parent link="base"/><child link="turret"/><origin xyz="0 0 0.2"/>
    <axis xyz="0 0 1"/><limit lower="-2.5" upper="2.5" effort="10" velocity="3"/></joint>
  <joint name="arm_lift" type="revolute">
    <parent link="turret"/><child link="upper"/><origin xyz="0.05 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-1.5" upper="1.5" effort="10" velocity="3"/></joint>
  <joint name="arm_roll" type="revolute">
    <parent link="upper"/><child link="flange"/><origin xyz="0.3 0 0"/>
    <axis xyz="1 0 0"/><limit lower="-2" upper="2" effort="10" velocity="5"/></joint>
  <joint name="mount" type="fixed">
    <parent link="flange"/><child link="palm"/><origin xyz="0.05 0 0" rpy="0 1.5708 0"/></joint>
</robot>
"""


def _ways_to_hold(name: str) -> Iterator[tuple[str, str, str | None]]:
    spec = read_hand_spec(hand_files()[name])
    for mount in (
        ("floating", "fixed")
        if spec.wrist.mount == "floating" and spec.arm is None
        else ("fixed",)
    ):
        for points in (None, "fingertips_middle"):
            if points is None or points in spec.sets:
                yield name, mount, points


# The hands of the G1 by their own name.
_TWICE = ("dex3_left", "dex3_right")
# Every hand of the repository with a floating and a fixed wrist, and a hand on an arm; each with
# one or two sets of points.
HANDS: tuple[tuple[str, str, str | None], ...] = (
    *(
        way
        for name in hand_names()
        if name not in _TWICE
        for way in _ways_to_hold(name)
    ),
    ("arm", "fixed", None),
    ("arm", "fixed", "fingertips_middle"),
)
each_hand = pytest.mark.parametrize(
    "which", HANDS, ids=lambda which: "-".join(filter(None, which))
)
_TWINS = ("allegro_left", "g1_right", "human_left", "romeo_right")
# One hand of each mirrored pair. A hand that may float does so with its default points, and has a
# fixed wrist with the other set. A hand with a fixed wrist takes both sets.
DISTINCT_HANDS: tuple[tuple[str, str, str | None], ...] = tuple(
    (name, mount, points)
    for name, mount, points in HANDS
    if name not in _TWINS
    and (
        (name, "floating", None) not in HANDS
        or (mount == "floating") == (points is None)
        or (name, mount, "fingertips_middle") not in HANDS
    )
)
each_distinct_hand = pytest.mark.parametrize(
    "which",
    [
        pytest.param(which, marks=pytest.mark.slow if which[0] == "ur5_allegro" else ())
        for which in DISTINCT_HANDS
    ],
    ids=lambda which: "-".join(filter(None, which)),
)
_KINDS = ("allegro_right", "arm", "hey5", "human", "panda_gripper", "three_finger")
# One hand of each kind: jaws, followers, an arm; floating and fixed.
each_kind_of_hand = pytest.mark.parametrize(
    "which",
    [which for which in DISTINCT_HANDS if which[0] in _KINDS],
    ids=lambda which: "-".join(filter(None, which)),
)
# Without mimic joints, and without an arm: its levers of half a metre make the weighted task too
# badly conditioned for statements about vanishing weights.
_PLAIN = ("human", "three_finger", "allegro_right", "g1_left", "arm")
each_plain_hand = pytest.mark.parametrize(
    "which",
    [which for which in DISTINCT_HANDS if which[0] in _PLAIN],
    ids=lambda which: "-".join(filter(None, which)),
)


def arm_hand(points: str | None = None) -> Hand:
    """Return the three-fingered hand at the end of an arm with three joints."""
    spec = read_hand_spec(urdf_directory() / "three_finger" / "hand.yaml")
    robot = parse_urdf(read_urdf(spec))
    robot.extend(list(parse_urdf(_ARM)))
    on_arm = msgspec.structs.replace(
        spec,
        name="arm",
        joints=(*ARM_JOINTS, *spec.joints),
        rest={"arm_turn": 0.3, "arm_lift": -0.2, "arm_roll": 0.1, **spec.rest},
        wrist=WristSpec(link="palm", mount="fixed"),
    )
    return Hand(on_arm, points=points, urdf_text=ET.tostring(robot, encoding="unicode"))


@cache
def hand_of(which: tuple[str, str, str | None]) -> Hand:
    """Return one of `HANDS`; skip the test if its URDF is not installed."""
    name, mount, points = which
    if name == "arm":
        return arm_hand(points)
    try:
        return load_hand(
            name, mount="floating" if mount == "floating" else "fixed", points=points
        )
    except MissingExtraError:
        pytest.skip("example-robot-data is not installed")


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A posture and its targets."""

    q: np.ndarray
    point_targets: np.ndarray
    wrist_target: np.ndarray | None
    dt: float


def random_cases(
    hand: Hand, count: int, *, seed: int = 0, is_inside: bool = False
) -> Iterator[Case]:
    """Draw postures inside, at and outside limits and stretched out.

    Targets near and far, or none for the wrist; short and long times.

    Args:
        hand: The hand.
        count: How many.
        seed: Of the random numbers.
        is_inside: Whether to leave out postures outside the limits.
    """
    rng = np.random.default_rng(seed)
    configuration = hand.configuration()
    for i in range(count):
        vector = hand.configuration_vector(
            _posture(hand, i % 4, rng, is_inside),
            _pose(rng) if hand.is_floating else None,
        )
        configuration.place(vector)
        reach = 10.0 ** rng.uniform(-4, 0)
        targets = configuration.points + reach * rng.normal(
            size=(len(hand.reference_points), 3)
        )
        # At least 1e-3 rad: mink on MuJoCo rounds smaller ones off (see
        # oracles.mujoco_ik).
        offset = pin.exp6(
            np.concatenate(
                [
                    reach * rng.normal(size=3),
                    10.0 ** rng.uniform(-3, 0.3) * _direction(rng),
                ]
            )
        )
        wrist = None if i % 5 == 0 else (configuration.wrist * offset).homogeneous
        yield Case(vector, targets, wrist, 10.0 ** rng.uniform(-3, -1))


def _posture(
    hand: Hand, kind: int, rng: np.random.Generator, is_inside: bool
) -> np.ndarray:
    q = rng.uniform(hand.lower_limits, hand.upper_limits)
    if kind == 1:
        side = rng.integers(0, 3, len(q))
        q = np.select([side == 0, side == 1], [hand.lower_limits, hand.upper_limits], q)
    elif kind == 2:
        q = np.zeros(len(q))
    elif kind == 3:
        q = q + rng.uniform(-0.5, 0.5, len(q))
    return np.clip(q, hand.lower_limits, hand.upper_limits) if is_inside else q


def _pose(rng: np.random.Generator) -> np.ndarray:
    return (pin.SE3(pin.Quaternion(_unit(rng)), rng.normal(size=3))).homogeneous


def _unit(rng: np.random.Generator) -> np.ndarray:
    quat = rng.normal(size=4)
    return quat / np.linalg.norm(quat)


def _direction(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def problem_of(
    ik: PointIk,
    points: np.ndarray,
    wrist: np.ndarray | None,
    dt: float,
    *,
    tasks: tuple[Task, ...] = (),
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return H, c and both bounds of the first iteration of `PointIk.solve`."""
    dt = max(dt, SHORTEST_DT)
    goal = Goal(points, None if wrist is None else wrist[None], ik.hand.rest, tasks, dt)
    cost = direct_cost(ik.gate, ik.configuration, goal)
    return *cost, *ik.gate.bounds(dt)


def two_joint_hand(
    urdf: str,
    joints: tuple[str, str],
    tip: PointSpec,
    distal: tuple[float, float, float],
    collision: CollisionSpec | None = None,
) -> Hand:
    """Return a fixed hand of two joints on the link `palm`, with one point, at rest at zero."""
    spec = HandSpec(
        name="two_joints",
        urdf="",
        side="right",
        palm=PalmSpec("palm", distal=distal, dorsal=(0.0, 0.0, 1.0)),
        wrist=WristSpec("palm", mount="fixed"),
        joints=joints,
        rest=dict.fromkeys(joints, 0.0),
        points=(tip,),
        sets={"tips": (tip.name,)},
        reference="tips",
        collision=collision,
    )
    return Hand(spec, urdf_text=urdf)


def box_of(
    hand: Hand,
    q: np.ndarray,
    dt: float,
    velocity: np.ndarray | None = None,
    options: IkOptions = IkOptions(),
) -> np.ndarray:
    """Return the bounds of a displacement, shape (2, nv), behind a last velocity."""
    size = len(hand.active_columns)
    last = np.zeros(size) if velocity is None else velocity
    motion = Motion(q, last, 1.0, np.zeros(size))
    return Gate(hand, motion, options).bounds(dt)


Rows = tuple[np.ndarray, np.ndarray]
"""G, shape (r, n), and h, shape (r,), of `G x <= h`."""


def loosened(
    rows: Rows,
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    stopping: float = 0.0,
    so_far: np.ndarray | None = None,
) -> Rows:
    """Return rows that do not contradict each other or a box, as the core loosens them."""
    G, h = rows
    before = np.zeros(len(lower)) if so_far is None else so_far
    return G, core.loosened(np.ascontiguousarray(G), h, lower, upper, stopping, before)
