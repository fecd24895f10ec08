"""The human hand: FK, limits, scaling to a person, synergies."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from functools import lru_cache
from typing import Any
from xml.etree import ElementTree as ET

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from handmap_qp import Hand, load_hand
from handmap_qp.errors import HandError, InvalidInputError
from handmap_qp.hands import FINGERS
from handmap_qp.hands.human import HUMAN_JOINTS, HumanLengths, scaled_human_urdf
from handmap_qp.hands.sources import urdf_directory
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.hands.urdf import mirror, parse_urdf
from handmap_qp.se3 import rigid_fit, unit

HUMAN = (urdf_directory() / "human" / "hand.urdf").read_text(encoding="utf-8")
MODEL = pin.buildModelFromXML(HUMAN)
DEFAULT = HumanLengths.from_urdf(HUMAN)
UNSCALED = scaled_human_urdf(HUMAN, DEFAULT)


model_of = lru_cache(maxsize=4)(pin.buildModelFromXML)


def tip_and_joint_positions(text: str, angles: np.ndarray) -> np.ndarray:
    """Return joints 2, 3, 4 and tip of each finger (joint 1 is at joint 2), shape (5, 4, 3)."""
    model = model_of(text)
    data = model.createData()
    q = np.zeros(model.nq)
    for name, angle in zip(HUMAN_JOINTS, angles, strict=True):
        q[model.joints[model.getJointId(name)].idx_q] = angle
    pin.framesForwardKinematics(model, data, q)
    names = [
        [*HUMAN_JOINTS[4 * i + 1 : 4 * i + 4], f"{finger}_tip"]
        for i, finger in enumerate(FINGERS)
    ]
    return np.array(
        [
            [data.oMf[model.getFrameId(name)].translation for name in row]
            for row in names
        ]
    )


def limits(name: str) -> tuple[float, float]:
    index = MODEL.joints[MODEL.getJointId(name)].idx_q
    return MODEL.lowerPositionLimit[index], MODEL.upperPositionLimit[index]


@st.composite
def persons(draw: st.DrawFn) -> HumanLengths:
    """Draw hands of any size from a small child's, with knuckles out of line and plane."""
    bases = np.array(DEFAULT.bases) * draw(st.floats(0.5, 1.6))
    bases += draw(arrays(float, (5, 3), elements=st.floats(-0.008, 0.008)))
    segments = draw(arrays(float, (5, 3), elements=st.floats(0.006, 0.07)))
    rolls = draw(arrays(float, 5, elements=st.floats(-0.7, 0.7)))
    return HumanLengths(bases=bases, segments=segments, rolls=rolls)


def test_joints_are_named_in_order() -> None:
    assert len(set(HUMAN_JOINTS)) == 20
    assert HUMAN_JOINTS[:5] == (
        "thumb_TM_abduction",
        "thumb_TM_flexion",
        "thumb_MCP_flexion",
        "thumb_IP_flexion",
        "index_MCP_abduction",
    )
    assert set(HUMAN_JOINTS) == set(MODEL.names) - {"universe"}


def test_limits_hold_grasp_mean_posture_and_first_synergies(
    load_data: Callable[[str], dict[str, Any]],
) -> None:
    synergies = load_synergies()
    grasp = np.array(load_data("fk_reference")["cube_grasp"]["human"]["q"])
    start = np.zeros(20)
    start[[0, 16]] = 2 * np.pi / 3, -np.pi / 12
    needed = [grasp, start, synergies.mean]
    needed += [
        q + sign * synergies.matrix[:, k]
        for q in (grasp, synergies.mean)
        for k in range(3)
        for sign in (-1, 1)
    ]
    lower, upper = np.array([limits(name) for name in HUMAN_JOINTS]).T
    assert (np.min(needed, axis=0) - lower >= 0.02).all()
    assert (upper - np.max(needed, axis=0) >= 0.02).all()


@pytest.mark.parametrize("finger", FINGERS[1:])
def test_limits_allow_the_motions_of_a_finger(finger: str) -> None:
    for name, least_lower, least_upper in (
        ("MCP_flexion", -45, 90),
        ("PIP_flexion", -10, 100),
        ("DIP_flexion", -10, 80),
        ("MCP_abduction", -30, 30),
    ):
        lower, upper = np.degrees(limits(f"{finger}_{name}"))
        assert lower <= least_lower
        assert upper >= least_upper


def test_every_joint_has_speed_and_effort_limits() -> None:
    for joint in ET.fromstring(HUMAN).iterfind("joint[@type='revolute']"):
        limit = joint.find("limit")
        assert limit is not None
        assert {"lower", "upper", "effort", "velocity"} <= set(limit.attrib)
    assert (MODEL.velocityLimit == 20.0).all()


def test_default_lengths() -> None:
    np.testing.assert_allclose(DEFAULT.bases[2], [-0.008, 0.073, 0.0])
    np.testing.assert_allclose(DEFAULT.segments[0], [0.025, 0.015, 0.010])
    np.testing.assert_allclose(DEFAULT.segments[4], [0.027, 0.025, 0.010])


@given(angles=arrays(float, 20, elements=st.floats(-1.5, 1.5)))
def test_scaling_by_own_lengths_changes_no_kinematics(angles: np.ndarray) -> None:
    np.testing.assert_array_equal(
        tip_and_joint_positions(UNSCALED, angles),
        tip_and_joint_positions(HUMAN, angles),
    )


def test_scaling_by_own_lengths_changes_no_shape() -> None:
    for path, key in (
        ("cylinder", "length"),
        ("cylinder", "radius"),
        ("sphere", "radius"),
        ("box", "size"),
    ):
        before, after = (
            np.array(
                [
                    [float(x) for x in e.attrib[key].split()]
                    for e in ET.fromstring(text).iter(path)
                ]
            )
            for text in (HUMAN, UNSCALED)
        )
        # The file writes some lengths with nine digits, and centres to the micrometre.
        np.testing.assert_allclose(after, before, atol=1e-8)
    before, after = (shape_poses(text) for text in (HUMAN, UNSCALED))
    np.testing.assert_allclose(after[0], before[0], atol=1e-8)
    np.testing.assert_allclose(after[1], before[1], atol=1e-8)


def test_thickness_follows_the_length_of_the_hand() -> None:
    long = HumanLengths(bases=1.3 * DEFAULT.bases, segments=1.3 * DEFAULT.segments)
    for path, key in (("cylinder", "radius"), ("sphere", "radius"), ("box", "size")):
        before, after = (
            [
                float(x)
                for e in ET.fromstring(text).iter(path)
                for x in e.attrib[key].split()
            ]
            for text in (HUMAN, scaled_human_urdf(HUMAN, long))
        )
        np.testing.assert_allclose(after, 1.3 * np.array(before), rtol=1e-6)


def shape_poses(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and z axes of all shapes, in the frames of their joints."""
    model = pin.buildModelFromXML(text)
    geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.VISUAL)
    placements = [item.placement for item in geometry.geometryObjects]
    return np.array([p.translation for p in placements]), np.array(
        [p.rotation[:, 2] for p in placements]
    )


@settings(max_examples=15)
@given(person=persons(), angles=arrays(float, 20, elements=st.floats(-1.5, 1.5)))
def test_scaled_hand_has_the_lengths_asked_for(
    person: HumanLengths, angles: np.ndarray
) -> None:
    positions = tip_and_joint_positions(scaled_human_urdf(HUMAN, person), angles)
    np.testing.assert_allclose(positions[:, 0], person.bases, atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(positions, axis=1), axis=2), person.segments, atol=1e-9
    )


@settings(max_examples=6)
@given(person=persons(), name=st.sampled_from(["human", "human_left"]))
def test_a_person_is_the_hand_of_the_scaled_urdf(
    person: HumanLengths, name: str
) -> None:
    hand = load_hand(name, lengths=person, points="landmarks")
    text = scaled_human_urdf(HUMAN, person)
    read = Hand(hand.spec, points="landmarks", urdf_text=text)
    assert hand.urdf_text == read.urdf_text
    for own, other in (
        (hand.model.jointPlacements, read.model.jointPlacements),
        (
            [f.placement for f in hand.model.frames],
            [f.placement for f in read.model.frames],
        ),
    ):
        np.testing.assert_allclose(
            [place.homogeneous for place in own],
            [p.homogeneous for p in other],
            atol=1e-15,
        )
    assert [*hand.model.names] == [*read.model.names]
    assert hand.model.parents.tolist() == read.model.parents.tolist()
    for own, other in zip(hand.model.frames, read.model.frames, strict=True):
        assert (own.name, own.type) == (other.name, other.type)
        assert own.parentJoint == other.parentJoint
        assert own.parentFrame == other.parentFrame
    for name in ("lowerPositionLimit", "upperPositionLimit", "velocityLimit"):
        own, other = getattr(hand.model, name), getattr(read.model, name)
        np.testing.assert_array_equal(own, other)
    q = 0.5 * (hand.lower_limits + hand.upper_limits)
    np.testing.assert_allclose(hand.points(q), read.points(q), atol=1e-15)
    np.testing.assert_array_equal(
        hand.with_points("landmarks").points(q), hand.points(q)
    )


@settings(max_examples=6)
@given(first=persons(), second=persons())
def test_a_scaled_hand_is_scaled_again(
    first: HumanLengths, second: HumanLengths
) -> None:
    """Whether or not its model was needed in between."""
    whole = load_hand("human", points="landmarks")
    wanted = whole.with_lengths(second)
    again = whole.with_lengths(first).with_lengths(second)
    np.testing.assert_allclose(
        again.points(whole.rest), wanted.points(whole.rest), atol=1e-12
    )
    assert again.model.names.tolist() == whole.model.names.tolist()


@settings(max_examples=15)
@given(person=persons(), angles=arrays(float, 20, elements=st.floats(-1.5, 1.5)))
def test_a_rolled_finger_is_the_finger_turned_about_the_axis_of_the_palm(
    person: HumanLengths, angles: np.ndarray
) -> None:
    straight = HumanLengths(bases=person.bases, segments=person.segments)
    rolled, unrolled = (
        tip_and_joint_positions(scaled_human_urdf(HUMAN, lengths), angles)
        for lengths in (person, straight)
    )
    for i, roll in enumerate(person.rolls):
        turn = pin.exp3(np.array([0.0, roll, 0.0]))
        expected = person.bases[i] + (unrolled[i] - person.bases[i]) @ turn.T
        np.testing.assert_allclose(rolled[i], expected, atol=1e-12)


@settings(max_examples=15)
@given(person=persons())
def test_scaling_forgets_earlier_scaling(person: HumanLengths) -> None:
    again = scaled_human_urdf(scaled_human_urdf(HUMAN, person), DEFAULT)
    back = HumanLengths.from_urdf(again)
    np.testing.assert_array_equal(back.bases, DEFAULT.bases)
    np.testing.assert_array_equal(back.segments, DEFAULT.segments)
    np.testing.assert_array_equal(back.rolls, np.zeros(5))


@settings(max_examples=15)
@given(person=persons())
def test_capsules_and_metacarpals_still_end_at_their_joints(
    person: HumanLengths,
) -> None:
    text = scaled_human_urdf(HUMAN, person)
    model = pin.buildModelFromXML(text)
    collision = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    for i, finger in enumerate(FINGERS):
        bones = (
            ("metacarpal", "proximal", "distal")
            if finger == "thumb"
            else ("proximal", "middle", "distal")
        )
        for k, bone in enumerate(bones):
            capsule = collision.geometryObjects[
                collision.getGeometryId(f"{finger}_{bone}_0")
            ]
            half = capsule.geometry.halfLength * capsule.placement.rotation[:, 2]
            start, end = (
                capsule.placement.translation - half,
                capsule.placement.translation + half,
            )
            np.testing.assert_allclose(start, 0.0, atol=1e-9)
            np.testing.assert_allclose(
                end, [person.segments[i, k], 0.0, 0.0], atol=1e-9
            )
    knuckle = ET.fromstring(text).find(".//visual[@name='middle_knuckle']/origin")
    assert knuckle is not None
    np.testing.assert_allclose(
        [float(x) for x in knuckle.attrib["xyz"].split()], person.bases[2], atol=0.002
    )


@settings(max_examples=15)
@given(length=st.floats(0.12, 0.24))
def test_typical_hand_follows_the_ratios(length: float) -> None:
    person = HumanLengths.from_hand_length(length)
    positions = tip_and_joint_positions(scaled_human_urdf(HUMAN, person), np.zeros(20))
    middle_tip = positions[FINGERS.index("middle"), -1]
    # Third MCP joint at 0.446 of the length, then 0.266, 0.170 and 0.108.
    assert np.linalg.norm(person.bases[2]) == pytest.approx(0.446 * length)
    finger = middle_tip - person.bases[2]
    np.testing.assert_allclose(finger, [0.0, 0.544 * length, 0.0], atol=1e-9)
    assert person.hand_length == pytest.approx(0.990 * length)


def test_typical_hand_has_the_palm_axes_of_measured_people() -> None:
    person = HumanLengths.from_hand_length(0.19)
    own, standard = (
        np.vstack([np.zeros(3), lengths.bases[1:]]) for lengths in (person, DEFAULT)
    )
    np.testing.assert_allclose(rigid_fit(own, standard)[:3, :3], np.eye(3), atol=1e-4)


def test_breadth_moves_knuckles_apart_and_nothing_else() -> None:
    slim, broad = (
        HumanLengths.from_hand_length(0.19, 0.08),
        HumanLengths.from_hand_length(0.19, 0.10),
    )
    np.testing.assert_array_equal(slim.segments, broad.segments)
    # The radial direction of the source is at right angles to the third metacarpal.
    distal = unit(slim.bases[2])
    radial = np.cross([0.0, 0.0, 1.0], distal)
    for axis, ratio in ((radial, 1.25), (distal, 1.0)):
        np.testing.assert_allclose(
            broad.bases @ axis, ratio * (slim.bases @ axis), atol=1e-12
        )


def test_default_breadth_sets_knuckles_as_trackers_do() -> None:
    person = HumanLengths.from_hand_length(0.19)
    ratio = np.linalg.norm(person.bases[1] - person.bases[4]) / person.hand_length
    assert ratio == pytest.approx(0.347, abs=0.001)


def test_left_hand_is_the_scaled_right_hand_mirrored() -> None:
    person = HumanLengths.from_hand_length(0.18)
    right = scaled_human_urdf(HUMAN, person)
    angles = np.linspace(-0.4, 0.7, 20)
    mirrored = tip_and_joint_positions(right, angles) * [-1.0, 1.0, 1.0]
    robot = parse_urdf(right)
    mirror(robot)
    left = ET.tostring(robot, encoding="unicode")
    np.testing.assert_allclose(
        tip_and_joint_positions(left, angles), mirrored, atol=1e-12
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bases": np.zeros((4, 3))}, "bases: expected finite numbers of shape"),
        ({"bases": np.full((5, 3), np.nan)}, "bases: expected finite"),
        ({"bases": DEFAULT.bases * [-1, 1, 1]}, "a left one: mirror it"),
        ({"bases": DEFAULT.bases * [1, -1, 1]}, "distal"),
        ({"bases": "wide"}, "bases: expected finite numbers"),
        ({"segments": np.zeros((5, 3))}, "bones of 0.1 mm to 1 m"),
        ({"segments": np.full((5, 3), np.inf)}, "segments: expected finite"),
        ({"segments": np.ones((3, 5))}, "segments: expected finite numbers of shape"),
        ({"rolls": np.zeros(4)}, "rolls: expected finite numbers of shape"),
        (
            {"rolls": [0, 0, 0, 0, 12]},
            "rolls: expected angles within 45 degrees of 0, got 12 rad",
        ),
    ],
)
def test_bad_lengths(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        msgspec.structs.replace(DEFAULT, **change)


@pytest.mark.parametrize(
    "lengths",
    [
        (0.0,),
        (1e-320,),
        (190.0,),
        (-0.19,),
        (np.nan,),
        (np.inf,),
        (0.19, 0.0),
        (0.19, np.nan),
    ],
)
def test_bad_hand_length(lengths: tuple[float, ...]) -> None:
    with pytest.raises(InvalidInputError, match="metres"):
        HumanLengths.from_hand_length(*lengths)


@pytest.mark.parametrize(
    "text",
    [
        "not xml",
        "<robot/>",
        HUMAN.replace("index_PIP_flexion", "j7"),
        HUMAN.replace('<link name="palm">', '<link name="hand">'),
        HUMAN.replace("<sphere radius", "<torus radius"),
    ],
    ids=["text", "empty", "joint", "palm", "shape"],
)
def test_not_a_human_hand(text: str) -> None:
    with pytest.raises(HandError):
        scaled_human_urdf(text, DEFAULT)


def test_lengths_are_values() -> None:
    bases = np.array(DEFAULT.bases)
    person = HumanLengths(bases=bases, segments=DEFAULT.segments)
    bases[:] = 0.0
    for value in (person, pickle.loads(pickle.dumps(person))):
        np.testing.assert_array_equal(value.bases, DEFAULT.bases)
        assert not value.bases.flags.writeable
        assert not value.segments.flags.writeable
        assert not value.rolls.flags.writeable
    assert not load_synergies().matrix.flags.writeable


def test_synergies_are_the_published_ones() -> None:
    synergies = load_synergies()
    # Figures of the SynGrasp 2.2 toolbox.
    np.testing.assert_allclose(
        (synergies.matrix[:, :3] ** 2).sum(axis=0), [1.264, 1.189, 1.622], atol=5e-4
    )
    file = urdf_directory() / "human" / "synergies.json"
    assert tuple(json.loads(file.read_text())["joint_names"]) == HUMAN_JOINTS
    dip = [HUMAN_JOINTS.index(f"{finger}_DIP_flexion") for finger in FINGERS[1:]]
    pip = [HUMAN_JOINTS.index(f"{finger}_PIP_flexion") for finger in FINGERS[1:]]
    np.testing.assert_allclose(
        synergies.matrix[dip], 2 / 3 * synergies.matrix[pip], atol=1e-12
    )
    np.testing.assert_allclose(
        synergies.mean[[0, 1]], [-0.98258657, 1.75956782], atol=1e-8
    )


def test_first_synergy_opens_the_fingers() -> None:
    synergies = load_synergies()
    wrist_to_tip = [
        np.linalg.norm(
            tip_and_joint_positions(HUMAN, synergies.posture([z]))[1:, -1], axis=1
        )
        for z in (0, 0.5)
    ]
    assert (wrist_to_tip[1] > wrist_to_tip[0]).all()


@given(z=arrays(float, 15, elements=st.floats(-2.0, 2.0)))
def test_coordinates_invert_posture(z: np.ndarray) -> None:
    synergies = load_synergies()
    np.testing.assert_allclose(
        synergies.coordinates(synergies.posture(z)), z, atol=1e-10
    )


def test_left_out_coordinates_are_zero() -> None:
    synergies = load_synergies()
    np.testing.assert_array_equal(synergies.posture([]), synergies.mean)
    np.testing.assert_allclose(
        synergies.posture([0.3, -0.2]),
        synergies.posture([0.3, -0.2] + [0.0] * 13),
        atol=1e-15,
    )


@given(q=arrays(float, 20, elements=st.floats(-1.5, 1.5)))
def test_coordinates_are_the_nearest(q: np.ndarray) -> None:
    synergies = load_synergies()
    misfit = q - synergies.posture(synergies.coordinates(q))
    np.testing.assert_allclose(synergies.matrix.T @ misfit, 0.0, atol=1e-9)


def test_bad_synergy_input() -> None:
    synergies = load_synergies()
    for z in ([0.0] * 16, [[0.0]], [np.nan]):
        with pytest.raises(InvalidInputError, match="z: "):
            synergies.posture(z)
    with pytest.raises(InvalidInputError, match="q: "):
        synergies.coordinates([0.0] * 19)
