"""Mappings of a human who holds an object, for a robot that holds one too: `map_grasp`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from experiment_variants import moved_grasp
from scipy.spatial.transform import Rotation, Slerp
from section_four.experiment import HandMotion, Scene

from handmap_core.human.recording import Recording
from handmap_qp.apps.offline.comparison import ComparedMethod, prepare_take
from handmap_qp.hands.library import load_hand
from handmap_qp.se3 import affine

# Samples per second of a mapped grasp [1/s], and time for which the human is still first [s].
_RATE, _SETTLING = 60.0, 1.0


def map_grasp(
    method: ComparedMethod, scene: Scene, human: HandMotion, duration: float
) -> HandMotion:
    """Map the motion of a human who holds an object, for a robot that holds one too.

    A mapping of a whole hand puts the robot's fingers elsewhere than its planned grasp. Therefore
    the displacement of the mapped motion since the start is added to the grasp: of the joints,
    clipped to their limits, and of the wrist. Before the motion the human is still for a while, so
    that filters have settled.

    Args:
        method: The mapping.
        scene: Both grasps, with palms of one orientation (`with_equal_palms`).
        human: The human's motion, with even steps of time.
        duration: Time that it takes [s].

    Returns:
        The robot's motion, at 60 samples a second.

    Raises:
        HandmapError: If the method cannot map this robot.
    """
    count, still = round(duration * _RATE), round(_SETTLING * _RATE)
    places = np.concatenate(
        [np.zeros(still), np.linspace(0.0, len(human.q) - 1.0, count + 1)]
    )
    q, wrist = _resampled(human, places)
    model = load_hand("human", points="landmarks")
    landmarks = np.array(
        [model.points(*sample) for sample in zip(q, wrist, strict=True)]
    )
    time = np.arange(len(places)) / _RATE
    valid = np.ones(len(places), dtype=bool)
    grasp, hand = scene.robot, scene.robot_points
    take = prepare_take(
        Recording("grasp", time, landmarks, valid, "right"), hand.spec.side
    )
    mapped = method.map_take(take, grasp.hand)
    change = mapped.q[still:] - mapped.q[still]
    angles = np.clip(grasp.q + change, hand.lower_limits, hand.upper_limits)
    start = np.eye(4) if grasp.wrist_pose is None else grasp.wrist_pose
    moved = np.tile(start, (count + 1, 1, 1))
    turns = mapped.wrist[still:, :3, :3] @ mapped.wrist[still, :3, :3].T
    moved[:, :3, :3] = turns @ start[:3, :3]
    moved[:, :3, 3] += mapped.wrist[still:, :3, 3] - mapped.wrist[still, :3, 3]
    points = np.array(
        [hand.points(*sample) for sample in zip(angles, moved, strict=True)]
    )
    return HandMotion(angles, moved, points)


def with_equal_palms(scene: Scene) -> Scene:
    """Turn the robot's grasp about its object, so that both palms have one orientation.

    A mapping of a whole hand gives the robot's palm the human's orientation. In a scene that is
    turned so, it moves the object along the axes along which the human does.

    Args:
        scene: Both grasps; both hands float.
    """
    palms = []
    for grasp in (scene.human, scene.robot):
        wrist = np.eye(4) if grasp.wrist_pose is None else grasp.wrist_pose
        palms.append((wrist @ grasp.hand.wrist_to_palm)[:3, :3])
    rotation, centre = palms[0] @ palms[1].T, scene.robot.centre
    robot = moved_grasp(scene.robot, affine(rotation, centre - rotation @ centre))
    return replace(scene, robot=robot)


def _resampled(motion: HandMotion, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return joints and wrists at places between the samples of a motion."""
    before = np.minimum(places.astype(int), len(motion.q) - 2)
    shares = places - before
    q = motion.q[before] + shares[:, None] * (motion.q[before + 1] - motion.q[before])
    wrist = [
        _pose_between(motion.wrist[i], motion.wrist[i + 1], share)
        for i, share in zip(before, shares, strict=True)
    ]
    return q, np.array(wrist)


def _pose_between(start: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """Return the pose at a share of the way: in a line, turned about one axis; shape (4, 4)."""
    turn = Slerp((0.0, 1.0), Rotation.from_matrix([start[:3, :3], end[:3, :3]]))
    way = end[:3, 3] - start[:3, 3]
    return affine(turn(share).as_matrix(), start[:3, 3] + share * way)
