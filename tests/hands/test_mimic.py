"""Mimic joints.

The map from actuated joints to all joints, Jacobians, limits, and invalid rules.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import generators

from handmap_qp import Hand, HandError, HandSpec, PointSpec
from handmap_qp.hands.model import read_mimic_rules, tighten_model
from handmap_qp.hands.spec import LimitSpec, MimicSpec, Mount, PalmSpec, WristSpec

URDF = Path(__file__).parents[1] / "data" / "urdf" / "chained_mimics.urdf"
ACTIVE = ("a_j1", "c_j1", "c_j2", "z_j1")
# Derived by hand from the file: b follows c, which comes later; a_j3 and b_j3 follow mimics.
FOLLOWERS = {
    "a_j2": lambda q: 0.9 * q["a_j1"] + 0.05,
    "a_j3": lambda q: 0.7 * (0.9 * q["a_j1"] + 0.05),
    "b_j1": lambda q: q["c_j1"],
    "b_j2": lambda q: 1.1 * q["c_j2"],
    "b_j3": lambda q: 0.5 * 1.1 * q["c_j2"] - 0.02,
    "c_j3": lambda q: 0.8 * q["c_j2"],
    "z_j2": lambda q: -q["z_j1"],
}
SPEC = HandSpec(
    name="chained",
    urdf=str(URDF),
    side="right",
    palm=PalmSpec(link="palm", distal=(1.0, 0.0, 0.0), dorsal=(0.0, 0.0, 1.0)),
    wrist=WristSpec(link="palm"),
    joints=ACTIVE,
    rest=dict.fromkeys(ACTIVE, 0.5),
    points=tuple(
        PointSpec(name=f"{finger}_tip", link=f"{finger}_tip") for finger in "abcz"
    ),
    sets={"fingertips": ("a_tip", "b_tip", "c_tip", "z_tip")},
    reference="fingertips",
)
HANDS: dict[Mount, Hand] = {"floating": Hand(SPEC), "fixed": Hand(SPEC, mount="fixed")}
HAND = HANDS["fixed"]
shares = st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4).map(np.array)
angles = shares.map(
    lambda share: HAND.lower_limits + share * (HAND.upper_limits - HAND.lower_limits)
)
every_mount = pytest.mark.parametrize("hand", HANDS.values(), ids=HANDS.keys())


def changed(**changes: object) -> HandSpec:
    return msgspec.structs.replace(SPEC, **changes)


@given(q=angles)
def test_all_joints_follow_the_rules(q: np.ndarray) -> None:
    by_name = dict(zip(HAND.all_joint_names, HAND.all_joints(q), strict=True))
    expected = dict(zip(ACTIVE, q, strict=True))
    expected |= {name: rule(expected) for name, rule in FOLLOWERS.items()}
    assert by_name.keys() == expected.keys()
    for name, value in expected.items():
        assert by_name[name] == pytest.approx(value, abs=1e-14), name


def test_followers_are_flagged() -> None:
    roles = dict(zip(HAND.all_joint_names, HAND.all_joint_roles, strict=True))
    assert HAND.joint_names == ACTIVE == HAND.all_joint_names[:4]
    assert {
        name for name, role in roles.items() if role == "follower"
    } == FOLLOWERS.keys()


def test_a_motion_has_all_joints_in_every_row() -> None:
    q = np.array([HAND.rest, HAND.lower_limits, HAND.upper_limits])
    np.testing.assert_array_equal(
        HAND.all_joints(q), [HAND.all_joints(row) for row in q]
    )


@given(q=angles)
def test_points_are_those_of_the_plain_model_with_every_joint_set(
    q: np.ndarray,
) -> None:
    model = pin.buildModelFromUrdf(str(URDF))
    data, full = model.createData(), np.zeros(model.nq)
    for name, value in zip(HAND.all_joint_names, HAND.all_joints(q), strict=True):
        full[model.joints[model.getJointId(name)].idx_q] = value
    pin.framesForwardKinematics(model, data, full)
    expected = [
        data.oMf[model.getFrameId(f"{finger}_tip", pin.FrameType.BODY)].translation
        for finger in "abcz"
    ]
    np.testing.assert_allclose(HAND.points(q), expected, atol=1e-15)


@every_mount
@given(q=angles)
def test_the_jacobian_holds_the_followers_motion(hand: Hand, q: np.ndarray) -> None:
    step = 1e-6
    slopes = [
        (hand.points(q + step * e) - hand.points(q - step * e)).ravel() / (2 * step)
        for e in np.eye(4)
    ]
    # Central differences: rounding error 1e-16 / 1e-6 of metres, truncation 1e-12.
    np.testing.assert_allclose(
        hand.point_jacobian(q), np.column_stack(slopes), atol=3e-9
    )


@every_mount
@given(q=angles, generator=generators)
def test_a_step_in_the_active_coordinates_keeps_every_rule(
    hand: Hand, q: np.ndarray, generator: np.random.Generator
) -> None:
    matrix = hand.spread
    assert matrix.shape == (hand.model.nv, len(hand.active_columns))
    np.testing.assert_array_equal(
        matrix[hand.active_columns], np.eye(len(hand.active_columns))
    )
    step = 0.1 * generator.normal(size=len(hand.active_columns))
    start = hand.configuration_vector(q)
    there = pin.integrate(hand.model, start, matrix @ step)
    np.testing.assert_allclose(
        there[hand.q_indices], q + step[hand.joint_columns], atol=1e-15
    )
    moved = hand.configuration_vector(there[hand.q_indices])
    first = 7 if hand.is_floating else 0
    np.testing.assert_allclose(there[first:], moved[first:], atol=1e-15)


@every_mount
@given(q=angles, generator=generators)
def test_the_jacobian_of_the_active_coordinates_moves_the_points(
    hand: Hand, q: np.ndarray, generator: np.random.Generator
) -> None:
    workspace = hand.configuration()
    workspace.place(hand.configuration_vector(q))
    slope = workspace.point_jacobian() @ (
        step := generator.normal(size=len(hand.active_columns))
    )
    ends = []
    for sign in (1e-6, -1e-6):
        workspace.place(
            pin.integrate(
                hand.model,
                hand.configuration_vector(q),
                hand.spread @ (sign * step),
            )
        )
        ends.append(workspace.points.copy())
    np.testing.assert_allclose(slope, (ends[0] - ends[1]).ravel() / 2e-6, atol=3e-8)


def test_the_coordinates_of_a_hand_without_followers_are_the_models() -> None:
    hand = Hand(
        changed(
            mimic=dict.fromkeys(FOLLOWERS),
            joints=(*ACTIVE, *FOLLOWERS),
            rest=dict.fromkeys((*ACTIVE, *FOLLOWERS), 0.0),
        )
    )
    assert not hand.rules
    np.testing.assert_array_equal(hand.spread, np.eye(hand.model.nv))
    assert hand.all_joint_names == hand.joint_names
    np.testing.assert_array_equal(hand.joint_columns, hand.v_indices)


@given(q=angles)
def test_inside_the_leaders_limits_no_follower_leaves_its_own(q: np.ndarray) -> None:
    model = HANDS["fixed"].model
    for name, value in zip(HAND.all_joint_names, HAND.all_joints(q), strict=True):
        at = model.joints[model.getJointId(name)].idx_q
        assert (
            model.lowerPositionLimit[at] - 1e-12
            <= value
            <= model.upperPositionLimit[at] + 1e-12
        ), name


def test_limits_are_the_tightest_of_leader_and_followers() -> None:
    by_name = dict(
        zip(
            ACTIVE,
            zip(
                HAND.lower_limits, HAND.upper_limits, HAND.velocity_limits, strict=True
            ),
            strict=True,
        )
    )
    # The lower limits of a_j2 = 0.9 q + 0.05 >= -0.2 and of a_j3 are not active. 0.9 q + 0.05 <=
    # 1.6 allows more than q = 1.6.
    assert by_name["a_j1"] == pytest.approx((-0.2, 1.6, 5.0))
    assert by_name["c_j1"] == pytest.approx((-0.2, 1.5, 4.0))
    # c_j3 = 0.8 q <= 1.3 does not bind 1.4; b_j2 = 1.1 q may go at 5 rad/s.
    assert by_name["c_j2"] == pytest.approx((0.0, 1.4, 5.0 / 1.1))
    assert by_name["z_j1"] == pytest.approx((0.0, 1.2, 5.0))


def test_a_leaders_speed_is_its_followers_too() -> None:
    # b_j2 and c_j3 follow c_j2, and b_j3 follows b_j2: with speeds of the file they would bind it.
    fast = {"c_j2": LimitSpec(velocity=50.0)}
    hand = Hand(changed(limits=fast))
    assert hand.velocity_limits[2] == pytest.approx(50.0)
    # A follower with a speed of its own binds.
    slow = fast | {"b_j3": LimitSpec(velocity=11.0)}
    hand = Hand(changed(limits=slow))
    assert hand.velocity_limits[2] == pytest.approx(11.0 / (0.5 * 1.1))
    np.testing.assert_allclose(
        np.delete(hand.velocity_limits, 2), np.delete(HAND.velocity_limits, 2)
    )


def test_a_followers_limit_that_contradicts_its_rule_is_dropped_with_a_warning() -> (
    None
):
    with pytest.warns(UserWarning, match="'z_j2' are ignored"):
        hand = Hand(changed(mimic={"z_j2": MimicSpec("z_j1", 1.0)}))
    assert (hand.lower_limits[3], hand.upper_limits[3]) == (0.0, 1.2)
    assert len(hand.notes) == 1


@pytest.mark.parametrize("multiplier", [2.0, -2.0, 0.5, -0.5])
@given(generator=generators)
def test_tightened_limits_map_into_the_followers(
    multiplier: float, generator: np.random.Generator
) -> None:
    low, offset = generator.uniform(-1.0, 0.0), generator.uniform(-0.2, 0.2)
    ends, model = np.sort(generator.uniform(-2.0, 2.0, 2)), pin.Model()
    for name, lower, upper, speed in (("l", low, low + 1.5, 2.0), ("f", *ends, 3.0)):
        limits = [np.array([number]) for number in (1.0, speed, lower, upper)]
        model.addJoint(0, pin.JointModelRX(), pin.SE3.Identity(), name, *limits)
    dropped = tighten_model(model, {"f": MimicSpec("l", multiplier, offset)})
    lower, upper = model.lowerPositionLimit[0], model.upperPositionLimit[0]
    assert low <= lower < upper <= low + 1.5
    assert model.velocityLimit[0] == pytest.approx(min(2.0, 3.0 / abs(multiplier)))
    if not dropped:
        reached = multiplier * np.array([lower, upper]) + offset
        assert ends[0] - 1e-12 <= reached.min() <= reached.max() <= ends[1] + 1e-12


@given(generator=generators, count=st.integers(1, 12))
def test_any_forest_of_rules_resolves(
    generator: np.random.Generator, count: int
) -> None:
    """Draw joints that follow an earlier joint of a random order, or none.

    The file lists them in another order.
    """
    names = [f"j{i}" for i in range(count + 1)]
    direct = {
        names[i]: (names[generator.integers(i)], *generator.normal(size=2))
        for i in range(1, count + 1)
        if generator.random() < 0.7
    }
    robot = ET.Element("robot")
    for i in generator.permutation(count + 1):
        joint = ET.SubElement(robot, "joint", {"name": names[i], "type": "revolute"})
        if names[i] in direct:
            leader, multiplier, offset = direct[names[i]]
            values = {
                "joint": leader,
                "multiplier": repr(float(multiplier)),
                "offset": repr(float(offset)),
            }
            ET.SubElement(joint, "mimic", values)
    rules = read_mimic_rules(robot)
    assert rules.keys() == direct.keys()
    q = {name: generator.normal() for name in names if name not in direct}
    q |= {n: rule.multiplier * q[rule.joint] + rule.offset for n, rule in rules.items()}
    for follower, (leader, multiplier, shift) in direct.items():
        assert q[follower] == pytest.approx(multiplier * q[leader] + shift, abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mimic": {"a_j2": MimicSpec("a_j3")}}, "in a circle: a_j"),
        ({"mimic": {"a_j2": MimicSpec("elbow")}}, "'elbow', which does not exist"),
        ({"mimic": {"elbow": MimicSpec("a_j1")}}, "no movable joint 'elbow'"),
        (
            {
                "root": "b_l1",
                "palm": PalmSpec("b_l1", (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            },
            "'c_j2', which does not exist",
        ),
        (
            {
                "joints": (*ACTIVE, "a_j2"),
                "rest": dict.fromkeys((*ACTIVE, "a_j2"), 0.5),
            },
            "'a_j2' mimics 'a_j1'",
        ),
        ({"mimic": {"a_j2": MimicSpec("a_j1", float("nan"))}}, "finite"),
    ],
    ids=[
        "circle",
        "no leader",
        "no follower",
        "leader cut off",
        "follower set",
        "no number",
    ],
)
def test_rules_that_cannot_be(changes: dict, message: str) -> None:
    with pytest.raises(HandError, match=message):
        Hand(changed(**changes))


def test_followers_of_a_locked_leader_are_locked_where_they_then_stand() -> None:
    kept = tuple(name for name in ACTIVE if name != "a_j1")
    hand = Hand(
        changed(joints=kept, rest=dict.fromkeys(kept, 0.5), locked={"a_j1": 0.4})
    )
    np.testing.assert_allclose(
        hand.points(hand.rest)[0], HAND.points([0.4, 0.5, 0.5, 0.5])[0], atol=1e-14
    )
    still = [i for i, role in enumerate(hand.all_joint_roles) if role == "locked"]
    positions = {hand.all_joint_names[i]: hand.all_joints(hand.rest)[i] for i in still}
    assert positions == pytest.approx(
        {"a_j1": 0.4, "a_j2": 0.9 * 0.4 + 0.05, "a_j3": 0.7 * (0.9 * 0.4 + 0.05)}
    )


def test_a_followers_speed_of_zero_means_none_given() -> None:
    hand = Hand(changed(limits={"c_j3": LimitSpec(velocity=0.0)}))
    np.testing.assert_array_equal(hand.velocity_limits, HAND.velocity_limits)
