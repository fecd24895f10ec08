"""Teleoperation: the robot's fingers follow those of the human, on several hands."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from mapping_cases import little_pose, near_rest, pinched
from marks import crossed, slow

from handmap_core.ik.tasks import AttachedPoints
from handmap_qp import (
    HandMapper,
    InvalidInputError,
    InvalidOptionsError,
    Teleoperation,
    hand_names,
    load_hand,
)
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.hands.fingers import THUMB
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import PadSpec
from handmap_qp.mapping import PalmMap
from handmap_qp.mapping.hand_pair import hand_pair, resting_posture, robot_fingers
from handmap_qp.mapping.method import HumanPose, RobotPosture
from handmap_qp.mapping.methods.teleoperation import BoundTeleoperation
from handmap_qp.mapping.palm import PalmMethod
from handmap_qp.mapping.presets import PRESETS, default_preset, get_preset
from handmap_qp.reference.estimation import estimate
from handmap_qp.reference.teleoperation_targets import (
    moved_points,
    pinch_shares,
    row_aims,
)
from handmap_qp.se3 import (
    affine,
    inverse_pose,
    rotation_from_rpy,
    smoothstep,
    transform_points,
)

HUMAN = load_hand("human")
LANDMARKS = load_hand("human", points="landmarks")
ALLEGRO = load_hand("allegro_right")
IK = PRESETS["teleoperation"].ik
FINGERS = ("index", "middle", "ring", "little")


def posture(**flexion: float) -> np.ndarray:
    """The human's rest with fingers flexed: 0 is straight, 1 a fist."""
    q = HUMAN.rest.copy()
    for i, name in enumerate(HUMAN.joint_names):
        finger, _, joint = name.partition("_")
        if finger in flexion and "flexion" in joint and finger != THUMB:
            q[i] = flexion[finger] * min(1.5, HUMAN.upper_limits[i])
    return q


OPEN = posture(**dict.fromkeys(FINGERS, 0.0))
FIST = posture(**dict.fromkeys(FINGERS, 1.0))
POINTING = posture(index=0.0, middle=1.0, ring=1.0, little=1.0)


def settled(mapper: HandMapper, q: np.ndarray, wrist: np.ndarray | None = None) -> Any:
    return [
        mapper.map_step(q, np.eye(4) if wrist is None else wrist) for _ in range(80)
    ][-1]


def flexions(robot: Hand, q: np.ndarray) -> dict[str, float]:
    """Extension of every robot finger, as the share of its reach."""
    pair = hand_pair(HUMAN, robot)
    shares = {}
    for finger in pair.fingers:
        chain = pair.chains[finger]
        configuration = robot.configuration()
        configuration.place(robot.configuration_vector(q))
        ends = AttachedPoints(robot, [chain.knuckle, chain.tip]).positions(
            configuration
        )
        shares[finger] = float(np.linalg.norm(ends[1] - ends[0])) / chain.reach
    return shares


def test_it_is_the_default_where_fingers_correspond() -> None:
    expected = dict.fromkeys(hand_names(), "teleoperation")
    for name in hand_names():
        assert default_preset(HUMAN, load_hand(name)) == expected[name], name
    assert isinstance(HandMapper(HUMAN, ALLEGRO).method, Teleoperation)
    assert HandMapper(HUMAN, ALLEGRO).ik == IK
    tips = HUMAN.with_points("fingertips")
    assert default_preset(tips, ALLEGRO) == "object"
    assert (
        default_preset(tips, load_hand("allegro_right", mount="fixed")) == "fixed_wrist"
    )


@pytest.mark.parametrize(
    "robot", ["allegro_right", *map(slow, ["allegro_left", "hey5", "human"])]
)
def test_a_pointing_index_points_and_a_fist_is_a_fist(robot: str) -> None:
    human = load_hand("human_left") if robot == "allegro_left" else HUMAN
    hand = load_hand(robot)
    straight = flexions(hand, settled(HandMapper(human, hand), OPEN).command.q)
    fist = flexions(hand, settled(HandMapper(human, hand), FIST).command.q)
    pointing = flexions(hand, settled(HandMapper(human, hand), POINTING).command.q)
    for finger in straight:
        if finger == THUMB:
            continue
        assert straight[finger] - fist[finger] > 0.2, (finger, straight, fist)
        wanted = straight if finger == "index" else fist
        assert pointing[finger] == pytest.approx(wanted[finger], abs=0.1), finger


def test_whoever_begins_with_a_fist_gets_a_fist() -> None:
    first, later = HandMapper(HUMAN, ALLEGRO), HandMapper(HUMAN, ALLEGRO)
    settled(later, OPEN)
    from_fist, from_open = settled(first, FIST), settled(later, FIST)
    np.testing.assert_allclose(from_fist.targets, from_open.targets, atol=1e-12)
    # The thumb may end in front of the fingers or behind them, depending on which closes first.
    one, other = (flexions(ALLEGRO, step.command.q) for step in (from_fist, from_open))
    for finger in FINGERS[:3]:
        assert one[finger] == pytest.approx(other[finger], abs=0.03)
        assert one[finger] < 0.75


def test_joint_angles_and_landmarks_of_one_hand_give_the_same_targets() -> None:
    rng = np.random.default_rng(0)
    by_joints, by_landmarks, by_both = (HandMapper(HUMAN, ALLEGRO) for _ in range(3))
    for _ in range(10):
        q, wrist = near_rest(rng, 0.8, HUMAN), little_pose(rng, 1.0)
        landmarks = LANDMARKS.points(q, wrist)
        expected = by_joints.map_step(q, wrist)
        fitted = by_landmarks.map_landmarks(landmarks)
        given = by_both.map_landmarks(landmarks, wrist)
        for step in (fitted, given):
            np.testing.assert_allclose(step.targets, expected.targets, atol=1e-9)
            np.testing.assert_allclose(
                step.wrist_target, expected.wrist_target, atol=1e-9
            )
            np.testing.assert_allclose(step.command.q, expected.command.q, atol=1e-7)


def test_moving_the_humans_world_carries_the_wrist_and_leaves_the_joints() -> None:
    rng = np.random.default_rng(1)
    moved = affine(pin.exp3(np.array([0.4, -1.0, 0.7])), np.array([1.0, -2.0, 0.5]))
    here, there = HandMapper(HUMAN, ALLEGRO), HandMapper(HUMAN, ALLEGRO)
    for _ in range(8):
        q, wrist = near_rest(rng, 0.8, HUMAN), little_pose(rng, 0.3)
        one, other = here.map_step(q, wrist), there.map_step(q, moved @ wrist)
        np.testing.assert_allclose(
            other.targets, transform_points(moved, one.targets), atol=1e-9
        )
        np.testing.assert_allclose(other.command.q, one.command.q, atol=1e-6)
        np.testing.assert_allclose(
            other.command.wrist, moved @ one.command.wrist, atol=1e-6
        )


def test_the_resting_human_asks_for_the_matched_posture() -> None:
    pair = hand_pair(HUMAN, ALLEGRO)
    rest = HUMAN.rest.copy()
    for joint, angle in {
        "thumb_TM_abduction": 0.65,
        "thumb_TM_flexion": 0.45,
        "thumb_MCP_flexion": 0.1,
        "thumb_IP_flexion": -0.2,
    }.items():
        rest[HUMAN.joint_names.index(joint)] = angle
    step = settled(HandMapper(HUMAN, ALLEGRO), rest)
    np.testing.assert_allclose(step.motion_deformation, np.eye(4), atol=1e-9)
    palm = step.wrist_target @ ALLEGRO.wrist_to_palm
    # But for what the robot cannot reach of the resting person's places.
    np.testing.assert_allclose(
        transform_points(inverse_pose(palm), step.targets), pair.robot_rest, atol=5e-3
    )
    # A gap of 60 mm between thumb and index already counts a little as a pinch.
    np.testing.assert_allclose(step.command.q, pair.matched, atol=0.25)


def test_a_hand_onto_itself_is_itself() -> None:
    rng = np.random.default_rng(2)
    choices = Teleoperation(pinch_weight=0.0, avoids_contact=False)
    mapper = HandMapper(HUMAN, HUMAN, choices, ik=IK)
    names = [point.name for point in HUMAN.reference_points]
    used = [names.index(point.name) for point in mapper.robot.reference_points]
    for _ in range(5):
        q, wrist = near_rest(rng, 0.6, HUMAN), little_pose(rng, 0.2)
        step = settled(mapper, q, wrist)
        # The matched thumb is placed relative to its pinch, so it differs slightly from its own.
        distance = np.linalg.norm(step.targets - step.human_points[used], axis=1)
        assert distance[1:].max() < 0.004
        assert distance[0] < 0.02


def covered(robot: Hand, thickness: float) -> Hand:
    """The robot with soft covers on its fingertips, which its URDF does not have [m]."""
    pads = hand_pair(HUMAN, robot).measured.pads
    model = robot.model
    points = []
    for point in robot.spec.points:
        frame = model.frames[model.getFrameId(point.link, pin.FrameType.BODY)]
        pad = pads.get(str(point.finger))
        if pad is not None and pad.joint == frame.parentJoint:
            x, y, z = frame.placement.actInv(pad.offset).tolist()
            given = PadSpec(pad.radius + thickness, (x, y, z))
            point = msgspec.structs.replace(point, pad=given)
        points.append(point)
    return Hand(msgspec.structs.replace(robot.spec, points=tuple(points)))


@pytest.mark.parametrize(
    ("finger", "cover"),
    [("index", 0.0), ("middle", 0.0), ("ring", 0.0), ("index", 0.003)],
)
def test_a_pinch_closes_and_an_open_hand_touches_nothing(
    finger: str, cover: float
) -> None:
    robot = covered(ALLEGRO, cover) if cover else ALLEGRO
    mapper = HandMapper(HUMAN, robot, Teleoperation(contact_gap=0.013), ik=IK)
    closed = settled(mapper, pinched(finger, 0.010))
    assert closed.diagnostics["pinching"].max() == 1.0
    # Between the URDF's shapes are both covers; soft ones are pressed by 3 mm at most.
    gaps = GapMeter(ALLEGRO).pinches(closed.command.q[None])
    pressed = 0.003 if cover else 0.002
    assert -pressed < gaps[finger][0] - 2.0 * cover < 0.0015
    opened = settled(mapper, OPEN)
    apart = GapMeter(ALLEGRO).pinches(opened.command.q[None])
    assert min(gap[0] for gap in apart.values()) > 0.01
    # An open hand keeps thumb and fingers farther apart than a pinch, and all other links alike.
    of_thumb = np.array(robot_fingers(robot).contacts.fingers) == finger
    assert (
        opened.asked.margins[of_thumb].min()
        > closed.asked.margins[of_thumb].max() + 0.002
    )
    np.testing.assert_array_equal(
        opened.asked.margins == 0.001, closed.asked.margins == 0.001
    )
    assert GapMeter(ALLEGRO).nearest(opened.command.q[None])[0] > 0.0


@pytest.mark.parametrize(
    ("formulation", "gap"), crossed(["compiled", "direct"], [0.005, 0.012], every=2)
)
def test_a_pinch_that_is_held_stands_still(formulation: str, gap: float) -> None:
    """Fingertips that are pressed flat on each other do not rock from corner to corner."""
    robot = load_hand("hey5")
    ik = IK.replaced(formulation=formulation)
    mapper = HandMapper(HUMAN, robot, Teleoperation(contact_gap=0.013), ik=ik)
    before = settled(mapper, q := pinched("index", gap))
    for _ in range(5):
        after = mapper.map_step(q, np.eye(4))
        steps = after.command.q - before.command.q
        assert np.abs(steps).max() < 2e-3
        before = after
    assert GapMeter(robot).pinches(after.command.q[None])["index"][0] < 0.001


@pytest.mark.parametrize("name", ["allegro_right", "three_finger"])
def test_limits_hold_and_links_stay_apart_on_a_violent_motion(name: str) -> None:
    robot, rng = load_hand(name), np.random.default_rng(3)
    mapper, last, postures = HandMapper(HUMAN, robot, dt=0.02), None, []
    for _ in range(150):
        q = rng.uniform(HUMAN.lower_limits, HUMAN.upper_limits)
        command = mapper.map_step(q, little_pose(rng, 1.0)).command
        assert (command.q >= robot.lower_limits - 1e-12).all()
        assert (command.q <= robot.upper_limits + 1e-12).all()
        if last is not None:
            assert (
                np.abs(command.q - last) <= robot.velocity_limits * 0.02 + 1e-12
            ).all()
        last = command.q
        postures.append(command.q)
    assert (GapMeter(robot).nearest(np.array(postures)) > -0.002).mean() > 0.97


def test_a_real_robot_glides_from_where_it_is() -> None:
    robot, dt = ALLEGRO, 0.02
    start = robot.lower_limits + 0.8 * (robot.upper_limits - robot.lower_limits)
    place = affine(pin.exp3(np.array([0.0, 0.5, 0.0])), np.array([0.3, 0.2, 0.4]))
    mapper = HandMapper(HUMAN, robot, dt=dt)
    mapper.reset(robot_q=start, robot_wrist=place)
    first = mapper.map_step(FIST, np.eye(4))
    assert (np.abs(first.command.q - start) <= robot.velocity_limits * dt + 1e-12).all()
    last = settled(mapper, FIST)
    # The fingers come to a fist, on a palm that stays where the robot was.
    shares = flexions(robot, last.command.q)
    assert max(shares[finger] for finger in FINGERS[:3]) < 0.75
    np.testing.assert_allclose(last.command.wrist, place, atol=0.01)


def test_a_clutch_moves_the_palms_reference_and_leaves_the_fingers() -> None:
    mapper = HandMapper(HUMAN, ALLEGRO)
    before = settled(mapper, FIST)
    mapper.release()
    far = affine(pin.exp3(np.array([0.5, 0.0, 0.0])), np.array([0.4, 0.0, 0.2]))
    held = mapper.map_step(FIST, far)
    np.testing.assert_array_equal(held.command.q, before.command.q)
    mapper.clutch()
    after = settled(mapper, FIST, far)
    np.testing.assert_allclose(after.command.q, before.command.q, atol=0.05)
    np.testing.assert_allclose(after.command.wrist, before.command.wrist, atol=5e-3)


def test_presets_can_be_switched_on_the_way_without_a_jump() -> None:
    mapper, dt = HandMapper(HUMAN, ALLEGRO, dt=0.02), 0.02
    last = settled(mapper, POINTING).command.q
    for preset in ("object", "paper", "teleoperation"):
        mapper.configure(preset)
        assert mapper.ik == PRESETS[preset].ik
        assert type(mapper.method) is type(PRESETS[preset].method)
        now = mapper.map_step(POINTING, np.eye(4)).command.q
        assert (np.abs(now - last) <= ALLEGRO.velocity_limits * dt + 1e-12).all()
        last = settled(mapper, POINTING).command.q


def test_a_fixed_hand_and_a_hand_on_an_arm_follow_with_their_fingers() -> None:
    free = flexions(ALLEGRO, settled(HandMapper(HUMAN, ALLEGRO), POINTING).command.q)
    fixed_hand = load_hand("allegro_right", mount="fixed")
    fixed = settled(HandMapper(HUMAN, fixed_hand), POINTING)
    shares = flexions(fixed_hand, fixed.command.q)
    for finger in FINGERS[:3]:
        assert shares[finger] == pytest.approx(free[finger], abs=0.03)
    arm = load_hand("ur5_allegro")
    on_arm = flexions(arm, settled(HandMapper(HUMAN, arm), POINTING).command.q)
    assert on_arm["index"] > 0.9
    assert on_arm["middle"] < 0.75


def test_a_missing_requirement_is_named() -> None:
    with pytest.raises(InvalidInputError) as missing:
        HandMapper(HUMAN, ALLEGRO).map_points(HUMAN.points(HUMAN.rest))
    assert missing.value.argument == "wrist_pose"
    with pytest.raises(InvalidOptionsError, match="human_points: this method needs"):
        HandMapper(HUMAN.with_points("fingertips"), ALLEGRO, "teleoperation")
    with pytest.raises(
        InvalidOptionsError, match="expected one of teleoperation, paper, object"
    ):
        HandMapper(HUMAN, ALLEGRO, "telepathy")
    contacts = HUMAN.with_points("contacts")
    with pytest.raises(InvalidOptionsError, match="cannot be read from landmarks"):
        HandMapper(contacts, ALLEGRO, "paper").map_landmarks(np.zeros((21, 3)))


@pytest.mark.parametrize(
    "landmarks",
    [np.zeros((20, 3)), np.full((21, 3), np.nan), "x", [["1"] * 3] * 21],
    ids=repr,
)
def test_landmarks_that_cannot_be_used_are_named_and_change_nothing(
    landmarks: Any,
) -> None:
    mapper, untouched = HandMapper(HUMAN, ALLEGRO), HandMapper(HUMAN, ALLEGRO)
    good = LANDMARKS.points(HUMAN.rest)
    mapper.map_landmarks(good)
    untouched.map_landmarks(good)
    with pytest.raises(InvalidInputError) as raised:
        mapper.map_landmarks(landmarks)
    assert raised.value.argument == "landmarks"
    after, expected = mapper.map_landmarks(good), untouched.map_landmarks(good)
    np.testing.assert_array_equal(after.command.q, expected.command.q)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"residual_gain": 1.5}, "residual_gain"),
        ({"contact_gap": 0.5}, "contact_gap"),
        ({"pinch_weight": -1.0}, "pinch_weight"),
        ({"extension_weight": np.nan}, "extension_weight"),
        ({"thumb_extension_weight": "much"}, "thumb_extension_weight"),
        ({"ridge": 0.0}, "ridge"),
    ],
    ids=str,
)
def test_choices_without_a_meaning_are_rejected_by_name(
    options: dict[str, Any], name: str
) -> None:
    with pytest.raises(InvalidOptionsError) as raised:
        Teleoperation(**options)
    assert raised.value.option == name


def test_the_step_from_0_to_1_is_smooth() -> None:
    x = np.linspace(-0.5, 1.5, 2001)
    y = smoothstep(x)
    assert (np.diff(y) >= 0.0).all()
    assert (y[x <= 0.0] == 0.0).all()
    assert (y[x >= 1.0] == 1.0).all()
    assert np.abs(np.diff(y, 2)).max() < 1e-5


def test_scale_shortens_the_way_of_the_palm_and_keeps_its_turn() -> None:
    """A robot's anchor on its palm moves by the scale times the human's anchor."""
    human, robot = load_hand("human"), load_hand("allegro_right")
    anchors = np.array([0.01, 0.09, 0.0]), np.array([0.0, 0.1, 0.01])
    points = human.points(human.rest)
    start = HumanPose(points, np.eye(4))
    turned = affine(
        rotation_from_rpy(np.array([0.3, -0.2, 0.5])), np.array([0.2, 0.1, -0.3])
    )
    posture = RobotPosture(robot.rest, robot.points(robot.rest), np.eye(4))

    def moved(scale: float) -> tuple[np.ndarray, np.ndarray]:
        method = PalmMethod(Teleoperation(), human, robot)
        follower = PalmMap(method, start, posture, *anchors, scale)
        before = follower.follow(start)[1]
        palm = follower.follow(HumanPose(points, turned))[1]
        place, origin = (
            pose[:3, :3] @ anchors[1] + pose[:3, 3] for pose in (palm, before)
        )
        return place - origin, palm[:3, :3]

    (full, rotation), (half, same) = moved(1.0), moved(0.5)
    np.testing.assert_allclose(half, 0.5 * full, atol=1e-12)
    np.testing.assert_allclose(same, rotation, atol=1e-12)
    assert np.linalg.norm(full) > 0.1


@pytest.mark.parametrize("name", ["allegro_right", "three_finger"])
def test_the_knuckles_of_both_hands_begin_in_one_place(name: str) -> None:
    robot = load_hand(name)
    mapper, pair = HandMapper(HUMAN, robot), hand_pair(HUMAN, robot)
    wrist = affine(
        rotation_from_rpy(np.array([0.4, -0.3, 0.8])), np.array([0.3, 0.1, 1.0])
    )
    step = mapper.map_step(OPEN, wrist)
    palm = step.wrist_target @ robot.wrist_to_palm
    human_palm = wrist @ HUMAN.wrist_to_palm
    np.testing.assert_allclose(palm[:3, :3], human_palm[:3, :3], atol=1e-12)
    # The two palms have their knuckles in different places, so one of them has to give way.
    assert np.linalg.norm(pair.human_knuckles - pair.robot_knuckles) > 0.005
    np.testing.assert_allclose(
        transform_points(palm, pair.robot_knuckles[None]),
        transform_points(human_palm, pair.human_knuckles[None]),
        atol=1e-12,
    )


def test_the_weight_of_the_thumbs_extension_counts_for_the_thumb_alone() -> None:
    """The heavier it is, the nearer the thumb's length comes to what the human's asks for."""
    q = OPEN.copy()
    for name, angle in {"thumb_MCP_flexion": 0.6, "thumb_IP_flexion": 0.9}.items():
        q[HUMAN.joint_names.index(name)] = angle
    method = BoundTeleoperation(Teleoperation(pinch_weight=0.0), HUMAN, ALLEGRO)
    pair, points = method.pair, HUMAN.points(q)
    distances = np.zeros(len(method.model.aim_slopes))
    distances[: len(pair.fingers)] = np.linalg.norm(
        points[pair.tips] - points[pair.knuckles], axis=1
    )
    thumb = pair.fingers.index(THUMB)
    asked = row_aims(method.model, distances)[thumb] / pair.robot_reach[thumb]
    shares = []
    for weight in (0.0, 2.5, 10.0):
        choices = Teleoperation(thumb_extension_weight=weight, pinch_weight=0.0)
        shares.append(
            flexions(ALLEGRO, settled(HandMapper(HUMAN, ALLEGRO, choices), q).command.q)
        )
    errors = [abs(share[THUMB] - asked) for share in shares]
    assert errors[0] > 1.5 * errors[1] > 2.0 * errors[2]
    for finger in FINGERS[:3]:
        assert shares[2][finger] == pytest.approx(shares[0][finger], abs=0.01)


@pytest.mark.parametrize("name", ["allegro_right", "romeo_right", "panda_gripper"])
def test_a_gap_to_the_thumb_grows_with_the_hands_but_between_jaws_it_is_the_object(
    name: str,
) -> None:
    method = BoundTeleoperation(Teleoperation(), HUMAN, load_hand(name))
    pair = method.pair
    narrow = np.full(len(method.model.aim_slopes), 0.06)
    grown = (row_aims(method.model, narrow + 0.01) - row_aims(method.model, narrow))[
        len(pair.fingers) :
    ]
    ratio = 1.0 if pair.has_jaws else pair.reach_ratios.mean()
    assert len(grown) > 0
    np.testing.assert_allclose(grown, 0.01 * ratio, rtol=0.0, atol=1e-12)
    assert pair.has_jaws == (name == "panda_gripper")
    assert abs(ratio - 1.0) > 0.02 or pair.has_jaws


def test_no_finger_is_asked_for_more_than_its_reach_and_no_pad_into_another() -> None:
    method = BoundTeleoperation(Teleoperation(), HUMAN, ALLEGRO)
    count = len(method.pair.fingers)
    shortest = row_aims(method.model, np.zeros(len(method.model.aim_slopes)))
    longest = row_aims(method.model, np.full(len(method.model.aim_slopes), 1.0))
    np.testing.assert_array_equal(longest[:count], method.pair.robot_reach)
    assert (shortest[:count] >= 0.0).all()
    assert (shortest[count:] > 0.0).all()
    assert (longest[count:] > shortest[count:] + 0.5).all()


@pytest.mark.parametrize("gain", [0.0, 0.5, 1.0])
def test_a_residual_counts_in_the_proportion_of_the_hands(gain: float) -> None:
    method = BoundTeleoperation(Teleoperation(residual_gain=gain), HUMAN, ALLEGRO)
    pair = method.pair
    still = estimate(method.estimator, pair.human_rest[pair.shape_points])
    bent = pair.human_rest.copy()
    bent[pair.partners[0]] += 0.01, -0.02, 0.03
    # T is the same in both, so only the residual of one point moves its partner.
    moved, unmoved = (
        moved_points(method.model, still, points) for points in (bent, pair.human_rest)
    )
    shift = gain * pair.finger_ratio * np.array([0.01, -0.02, 0.03])
    np.testing.assert_allclose(moved[0] - unmoved[0], shift, rtol=0.0, atol=1e-12)
    assert abs(moved[1:] - unmoved[1:]).max() < 1e-12
    assert abs(pair.finger_ratio - 1.0) > 0.1


@pytest.mark.parametrize(
    ("name", "is_like"), [("g1_right", True), ("allegro_right", False)]
)
def test_a_thumb_that_rests_like_a_persons_points_as_it_does(
    name: str, is_like: bool
) -> None:
    robot = load_hand(name)
    q, wrist = posture(thumb=0.2), np.eye(4)
    pinching = posture(thumb=0.9, index=1.1)
    asked = []
    for share in (0.0, 0.5, 1.0):
        method = Teleoperation(thumb_direction=share)
        mapper = HandMapper(HUMAN.with_points("landmarks"), robot, method)
        asked.append([mapper.map_step(each, wrist) for each in (q, pinching)])
    pair = hand_pair(HUMAN.with_points("landmarks"), robot)
    assert (pair.finger_likeness[0] > 0.5) == is_like
    assert is_like or pair.finger_likeness[0] == 0.0

    def vector(step: Any) -> np.ndarray:
        palm = step.wrist_target @ pair.robot.wrist_to_palm
        return (
            transform_points(inverse_pose(palm), step.targets)[0] - pair.robot_bases[0]
        )

    human = pair.human.points(q)
    palm = pair.human.frame_pose("palm", q)
    thumb = (human[pair.tips[0]] - human[pair.knuckles[0]]) @ palm[:3, :3]
    shares = 1.0 - asked[0][0].diagnostics["pinching"].max(initial=0.0)
    off = []
    for step, _ in asked:
        found = vector(step)
        cosine = found @ thumb / np.linalg.norm(found) / np.linalg.norm(thumb)
        off.append(np.degrees(np.arccos(cosine)))
    assert shares > 0.5
    if is_like:
        assert off[0] > off[1] + 0.5 > off[2] + 1.0
    else:
        np.testing.assert_allclose(off, off[0], atol=1e-9)
    # A thumb in one place has no direction, and its target is finite all the same.
    points = pair.human.points(q)
    points[[pair.tips[0], pair.knuckles[0]]] = points[pair.tips[0]]
    for formulation in ("compiled", "direct"):
        ik = get_preset("teleoperation").ik.replaced(formulation=formulation)
        mapper = HandMapper(pair.human, robot, ik=ik)
        for _ in range(3):
            step = mapper.map_points(points, wrist)
        assert np.isfinite(step.targets).all()
        assert np.isfinite(step.command.q).all()


@pytest.mark.parametrize("name", ["allegro_right", "hey5", "g1_right"])
def test_fingers_point_as_the_persons_away_from_a_pinch(name: str) -> None:
    human = HUMAN.with_points("landmarks")
    robot = load_hand(name)
    pair = hand_pair(human, robot)
    q = posture(index=0.5, middle=0.9)
    ends = human.points(q)[[pair.tips[1], pair.knuckles[1]]]
    palm = human.frame_pose("palm", q)
    wanted = (ends[0] - ends[1]) @ palm[:3, :3]
    off, at_rest, pinched = [], [], []
    for share in (0.0, 0.5, 1.0):
        mapper = HandMapper(human, robot, Teleoperation(finger_direction=share))
        step = mapper.map_step(q, np.eye(4))
        palm = step.wrist_target @ pair.robot.wrist_to_palm
        found = transform_points(inverse_pose(palm), step.targets)[1]
        found = found - pair.robot_bases[1]
        cosine = found @ wanted / np.linalg.norm(found) / np.linalg.norm(wanted)
        off.append(np.degrees(np.arccos(cosine)))
        at_rest.append(mapper.map_step(resting_posture(human), np.eye(4)).targets)
        pinched.append(mapper.map_step(posture(thumb=0.9, index=1.1), np.eye(4)))
    # Fingers rest some degrees off where the robot cannot rest as a person does.
    assert off[2] < max(off[0], 4.0)
    assert np.ptp(off) > 0.05
    # Places at rest are those of the matched posture, but for what the robot cannot reach.
    np.testing.assert_allclose(at_rest[1:], [at_rest[0]] * 2, atol=12e-3)
    closing = pinched[0].diagnostics["pinching"][0]
    moved = np.abs(pinched[2].targets - pinched[0].targets)[1].max()
    assert moved <= (1.0 - closing) * 0.05


@pytest.mark.parametrize("formulation", ["compiled", "direct"])
def test_picking_keeps_a_pinch_closed_while_the_persons_gap_drifts(
    formulation: str,
) -> None:
    """Both touch at the gap of contact; 12 mm more open the hand that shows gestures alone.

    Of the other, the margin between thumb and finger parts the pads by less than 3 mm.
    """
    robot = load_hand("leap_right")
    ik = IK.replaced(formulation=formulation)
    apart = {}
    for picking in (0.0, 1.0):
        choices = Teleoperation(picking=picking, contact_gap=0.013)
        mapper = HandMapper(HUMAN, robot, choices, ik=ik)
        closed = settled(mapper, pinched("index", 0.013)).command.q
        drifted = settled(mapper, pinched("index", 0.025)).command.q
        gaps = GapMeter(robot).pinches(np.array([closed, drifted]))["index"]
        assert gaps[0] < 0.001
        apart[picking] = gaps[1]
    assert apart[1.0] < 0.003
    assert apart[0.0] > 0.006


def test_picking_opens_the_hand_farther() -> None:
    robot = load_hand("leap_right")
    opened = {}
    for picking in (0.0, 0.5, 1.0):
        mapper = HandMapper(HUMAN, robot, Teleoperation(picking=picking), ik=IK)
        q = settled(mapper, pinched("index", 0.080)).command.q
        opened[picking] = GapMeter(robot).pinches(q[None])["index"][0]
    assert opened[0.0] + 0.002 < opened[0.5]
    assert opened[0.5] + 0.002 < opened[1.0]


def test_picking_changes_rows_in_proportion_and_of_jaws_no_ratio() -> None:
    """Aims are between those of both ends, and an object is as large between jaws as before."""
    ends = [
        BoundTeleoperation(Teleoperation(picking=share), HUMAN, ALLEGRO)
        for share in (0.0, 1.0)
    ]
    half = BoundTeleoperation(Teleoperation(picking=0.5), HUMAN, ALLEGRO)
    slopes = np.array([method.model.aim_slopes for method in ends])
    np.testing.assert_allclose(half.model.aim_slopes, slopes.mean(axis=0), rtol=1e-12)
    assert half.model.pinch_from == pytest.approx(
        np.mean([m.model.pinch_from for m in ends])
    )
    gripper = load_hand("panda_gripper")
    jaws = BoundTeleoperation(Teleoperation(picking=1.0), HUMAN, gripper)
    np.testing.assert_array_equal(jaws.model.aim_slopes[len(jaws.pair.fingers) :], 1.0)
    # They follow a gap of any size.
    assert pinch_shares(jaws.model, np.array([0.5])) == 1.0


def test_each_constant_of_picking_is_that_of_its_end() -> None:
    gestures, objects = (
        BoundTeleoperation(Teleoperation(picking=share), HUMAN, ALLEGRO)
        for share in (0.0, 1.0)
    )
    # Gaps at which rows of pinches begin, have half of their weight, and all of it.
    for method, gaps in (
        (gestures, (0.07, 0.045, 0.02)),
        (objects, (0.2, 0.125, 0.05)),
    ):
        shares = pinch_shares(method.model, np.array(gaps))
        np.testing.assert_allclose(shares, (0.0, 0.5, 1.0), atol=1e-12)
    # The thumb's extension counts half; others as before.
    halves = [0.5 if name == THUMB else 1.0 for name in gestures.pair.fingers]
    weights = gestures.model.extension_weights
    np.testing.assert_allclose(objects.model.extension_weights, halves * weights)
    # Pads of a closed pinch overlap by 4 mm more, and are closed from a gap of 12 mm more on.
    rows = slice(len(halves), None)
    deeper = gestures.model.least_aims - objects.model.least_aims
    np.testing.assert_allclose(deeper[rows], 0.004, atol=1e-12)
    lengths = np.full(len(weights) + len(gestures.pinched), 0.013 + 0.012)
    closed = row_aims(objects.model, lengths)[rows]
    np.testing.assert_allclose(closed, objects.model.least_aims[rows], atol=1e-12)
    assert (row_aims(objects.model, lengths + 0.002)[rows] > closed + 0.002).all()


def test_a_hand_like_the_persons_does_the_same_whatever_picking_is() -> None:
    """Corrections end where places agree."""
    for share in (0.0, 1.0):
        mapper = HandMapper(HUMAN, HUMAN, Teleoperation(picking=share), ik=IK)
        q = pinched("index", 0.04)
        assert np.abs(settled(mapper, q).command.q - q).max() < np.deg2rad(1.0)


def test_links_that_nothing_keeps_apart_cannot_be_squeezed() -> None:
    with pytest.raises(InvalidOptionsError, match="avoids_contact") as raised:
        Teleoperation(squeeze=2.0, avoids_contact=False)
    assert raised.value.option == "squeeze"
    assert raised.value.value == 2.0
    assert Teleoperation(avoids_contact=False).squeeze == 0.0
