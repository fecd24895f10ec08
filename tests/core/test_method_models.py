"""Models of methods, persons and robots: the core refuses what would lead out of its arrays."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from msgspec import structs

from handmap_core.core import core
from handmap_core.mapping.homogeneous import HomogeneousMap
from handmap_core.mapping.teleoperation import TeleoperationMap
from handmap_qp import HandMapper, load_hand
from handmap_qp.hands import HumanLengths, core_tree
from handmap_qp.hands.robot import load_robot
from handmap_qp.mapping.method import HumanPose
from handmap_qp.mapping.methods.teleoperation import (
    BoundTeleoperation,
    Teleoperation,
)
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.models import GuardModel, LandmarkReaderModel, PairsModel, encode
from handmap_qp.se3 import inverse_pose, transform_points
from handmap_qp.trackers.plausibility import known_orders

HUMAN = load_hand("human", points="landmarks")
ALLEGRO = load_hand("allegro_right")
BOUND = BoundTeleoperation(Teleoperation(), HUMAN, ALLEGRO)
REST = HumanPose(HUMAN.points(HUMAN.rest), np.eye(4))
SEGMENTS = ("segment_starts", "segment_ends", "segment_from", "segment_to")


VIEWS: Any = core.StepViews(*[cast("Any", list)] * 4)


def map_of(preset: str) -> Any:
    """Return the target map of a preset at a first sample."""
    mapper = HandMapper(HUMAN, ALLEGRO, preset)
    mapper.map(REST)
    return mapper.target_map


TELEOPERATED: TeleoperationMap = map_of("teleoperation")
IMPOSED: HomogeneousMap = map_of("object")


def test_a_model_of_two_hands_is_one_for_all_references() -> None:
    content = BOUND.model_bytes
    assert encode(BOUND.model) == content
    mapper = HandMapper(HUMAN, ALLEGRO, "teleoperation")
    for turn in (0.0, 0.3):
        wrist = np.eye(4)
        wrist[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        mapper.clutch()
        mapper.map(HumanPose(HUMAN.points(HUMAN.rest, wrist), wrist))
        assert isinstance(mapper.bound, BoundTeleoperation)
        assert mapper.bound.model_bytes == content


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"human_points": 20}, "points of the human: expected indices below 20"),
        ({"human_points": -1}, r"human_points: expected a number of points"),
        ({"shape_points": np.array([99] * 20)}, "TeleoperationModel"),
        ({"to_points": BOUND.model.to_points[1:]}, "to_points: expected 7 of them"),
        ({"aim_slopes": np.zeros(3)}, "aims: expected 7 of them, got 3"),
        ({"human_reach": np.zeros(9)}, "from_points: expected a distance of each"),
        ({"bases": np.zeros((2, 3))}, "points of the robot: expected"),
        ({"finger_of": BOUND.model.finger_of + 9}, "finger_of: expected indices below"),
        ({"finger_of": BOUND.model.finger_of - 1}, "finger_of: expected indices below"),
        ({"pinch_pairs": BOUND.model.pinch_pairs + 9999}, "pinch_pairs: expected"),
        ({"pinch_of_pair": BOUND.model.pinch_of_pair + 9}, "pinch_of_pair: expected"),
        ({"open_over": 0.0}, "open_over: expected a length above 0"),
        ({"rest_over": 0.0}, "rest_over: expected a length above 0"),
        ({"straight_over": 0.0}, "straight_over: expected a share above 0"),
        ({"straight_less": 0.06}, "pinch_over: expected more than straight_less"),
        ({"lying_over": 0.0}, "lying_over: expected a length above 0"),
        ({"tips_over": -1.0}, "tips_over: expected a length above 0"),
        (dict.fromkeys(SEGMENTS, np.zeros(0, int)), "expected segments of the"),
        ({"segment_ends": BOUND.model.segment_ends[1:]}, "segments: expected 9"),
        ({"segment_starts": BOUND.model.segment_starts + 20}, "points of the human"),
        ({"segment_from": BOUND.model.segment_from - 1}, "segment_from: expected"),
        ({"segment_from": BOUND.model.segment_from + 11}, "segment_from: expected"),
        ({"segment_to": BOUND.model.segment_to + 11}, "segment_to: expected"),
        ({"pinch_rests": np.zeros((3, 2))}, "pinch_rests: expected a posture of each"),
        ({"pinch_rests": np.zeros((2, 16))}, "pinch_rests: expected a posture of each"),
        ({"regularisation": np.zeros(2)}, "regularisation: expected 16 of them, got 2"),
        ({"rest": None}, r"rest: expected an array of floats \(n\), got None"),
    ],
)
def test_a_model_of_teleoperation_is_checked(
    changes: dict[str, Any], problem: str
) -> None:
    palm = encode(TELEOPERATED.palm_model())
    core.TeleoperationMap(BOUND.model_bytes, palm)
    wrong = structs.replace(BOUND.model, **changes)
    with pytest.raises(ValueError, match=problem):
        core.TeleoperationMap(encode(wrong), palm)


def test_parts_of_a_model_are_checked() -> None:
    model = BOUND.model
    palm = encode(TELEOPERATED.palm_model())
    estimator = structs.replace(model.estimator, gain=np.zeros((2, 20)))
    distances = structs.replace(model.distances, first=model.distances.first + 99)
    for part, problem in (
        ({"estimator": estimator}, r"EstimatorModel\.gain: expected 3 rows"),
        ({"distances": distances}, "DistancesModel: first, second: expected indices"),
    ):
        wrong = structs.replace(model, **part)
        with pytest.raises(ValueError, match=problem):
            core.TeleoperationMap(encode(wrong), palm)
    still = structs.replace(TELEOPERATED.palm_model(), start=np.eye(3))
    with pytest.raises(ValueError, match=r"PalmModel\.start: expected .*\(4, 4\)"):
        core.TeleoperationMap(BOUND.model_bytes, encode(still))


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"rigid_from": "palm"}, "rigid_from: expected points, wrist or none"),
        ({"human_wrist": None}, "human_wrist: expected a pose"),
        ({"human_offsets": np.zeros((2, 3))}, "human_offsets: expected"),
        ({"share": np.zeros((1, 1))}, "share: expected a number for each point"),
    ],
)
def test_a_model_of_the_paper_is_checked(changes: dict[str, Any], problem: str) -> None:
    model = IMPOSED.model()
    core.HomogeneousMap(encode(model))
    with pytest.raises(ValueError, match=rf"HomogeneousModel\.{problem}"):
        core.HomogeneousMap(encode(structs.replace(model, **changes)))


def test_a_map_of_another_hand_moves_none() -> None:
    mapper = HandMapper(HUMAN, load_hand("three_finger"), "object")
    mapper.map(REST)
    with pytest.raises(ValueError, match="the map is of another robot"):
        core.HandMapper(mapper.point_ik.core, IMPOSED.make_core(), VIEWS)
    distances = structs.replace(
        BOUND.model.distances, joints=BOUND.model.distances.joints + 99
    )
    model = structs.replace(BOUND.model, distances=distances)
    away = core.TeleoperationMap(encode(model), encode(TELEOPERATED.palm_model()))
    solver = HandMapper(HUMAN, ALLEGRO, "teleoperation").point_ik.core
    with pytest.raises(ValueError, match="points of another hand"):
        core.HandMapper(solver, away, VIEWS)


def test_a_model_may_have_arrays_without_rows() -> None:
    # A hand whose shapes never meet has no pairs, of as many coordinates as its array has bytes.
    none = np.zeros(0, dtype=int)
    levers = np.zeros((0, 60))
    pairs = PairsModel(
        bodies=(), first=none, second=none, levers=levers, turns=levers, signs=levers
    )
    core.PairBounds(encode(pairs))
    with pytest.raises(ValueError, match=r"PairsModel\.levers"):
        core.PairBounds(encode(structs.replace(pairs, levers=np.zeros((0, 2**40)))))


def test_a_hand_scaled_before_it_was_given_points_has_those() -> None:
    lengths = HumanLengths.from_hand_length(0.2)
    human = HUMAN.with_lengths(lengths).with_points("joints")
    in_palm = core_tree(human).points(human.rest[None])
    assert len(in_palm) == len(human.reference_points) != len(HUMAN.reference_points)
    palm = human.frame_pose("palm", human.rest)
    expected = transform_points(inverse_pose(palm), human.points(human.rest))
    np.testing.assert_allclose(in_palm, expected, atol=1e-12)


def test_models_of_a_person_are_checked() -> None:
    orders = known_orders().core
    landmarks = np.zeros((21, 3))
    for model, problem in (
        (GuardModel(side="left", landmarks=landmarks[:20]), "landmarks: expected 21"),
        (GuardModel(side="both", landmarks=landmarks), "side: expected right or left"),  # ty: ignore[invalid-argument-type]
    ):
        with pytest.raises(ValueError, match=rf"GuardModel\.{problem}"):
            core.StreamGuard(encode(model), orders)
    for changes, problem in (
        ({"used": np.array([21])}, "used: expected indices below 21, got 21"),
        ({"used": np.array([-1])}, "used: expected indices below 21, got -1"),
        ({"palm": np.zeros((4, 3))}, "palm: expected 5 of them, got 4"),
        ({"weights": np.zeros(6)}, "weights: expected 5 of them, got 6"),
    ):
        right = LandmarkReaderModel(
            used=np.arange(21), palm=np.zeros((5, 3)), weights=np.ones(5)
        )
        core.LandmarkReader(encode(right))
        wrong: Any = structs.replace(right, **changes)
        with pytest.raises(ValueError, match=rf"LandmarkReaderModel\.{problem}"):
            core.LandmarkReader(encode(wrong))


def test_a_model_of_a_robot_is_checked() -> None:
    mapper = RobotMapper(load_robot("g1"))
    solver = mapper.point_ik.core
    model = mapper.model()
    core.RobotMapper(solver, encode(model), VIEWS)
    first, other = model.hands
    for hands, problem in (
        ((), "expected a hand at least"),
        ((first,), "expected 2 of them, got 1"),
        ((structs.replace(first, palm_joint=999), other), "palm_joint: expected a jo"),
        ((structs.replace(first, among_own=first.among_own[1:]), other), "among_own"),
        ((structs.replace(first, pinching=first.pinching + 9999), other), "pinching"),
    ):
        with pytest.raises(ValueError, match=rf"RobotModel\.hands.*{problem}"):
            core.RobotMapper(solver, encode(structs.replace(model, hands=hands)), VIEWS)
