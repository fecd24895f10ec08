"""Replayed people: they see the object once, close as recorded, and are lifted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from handmap_score.tasks import person
from handmap_score.tasks.attempt import attempt
from handmap_score.tasks.lifting import LiftTask
from handmap_score.tasks.mapping import Straight, Unmapped
from handmap_score.tasks.person import RECORDINGS, own_hand, people
from handmap_score.tasks.replaying import Replay, pads_on_palm, replayed_people

from handmap_qp import read_recording
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands import load_hand

pytestmark = pytest.mark.slow


def test_the_own_hand_lifts_what_the_person_did() -> None:
    """Open loop, the person's own hand lifts every object, and straight fingers lift none."""
    task = LiftTask(own_hand())
    operator = Replay(task.robot)
    for seed in range(len(task.things)):
        assert attempt(task, operator, Unmapped(), seed).is_success
    done = attempt(task, operator, Straight(task.robot), 1)
    assert not done.is_success
    # It ends long before the time limit, because nothing more comes.
    assert done.time < 10.0


def test_only_the_first_scene_is_seen() -> None:
    """The hand's motion is the same wherever the object goes."""
    task = LiftTask(own_hand())
    operator = Replay(task.robot)
    first = task.reset(2)
    away = {**first.poses, "object": np.eye(4)}
    points = {name: place + 1.0 for name, place in first.points.items()}
    shown = []
    for is_moved in (False, True):
        operator.reset(2)
        hands = [operator.see(first)]
        for time in (1.0, 2.6, 4.0):
            scene = replace(first, time=time)
            if is_moved:
                scene = replace(scene, poses=away, points=points)
            hands.append(operator.see(scene))
        shown.append(np.array([hand.landmarks for hand in hands]))
    assert np.array_equal(shown[0], shown[1])


def test_pads_are_beside_the_landmarks_of_the_tips() -> None:
    """Where the fitted hand has its pads is where the tracker saw the tips."""
    closing = Replay(load_hand("allegro_right")).closing
    for sample in (0, -1):
        tips = closing.landmarks[sample, [4, 8]]
        off = np.linalg.norm(pads_on_palm(closing, sample) - tips, axis=1)
        assert (off < 0.012).all()


def test_recordings_of_a_folder_are_operators(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """People of a folder have their files' names; a recording without a pick says so."""
    for name in ("mine_right", "other_left"):
        (tmp_path / f"{name}.npz").touch()
    monkeypatch.setenv(RECORDINGS, str(tmp_path))
    assert {*people()} == {"person", "mine_right"}
    assert {*replayed_people()} == {"replay", "replay-mine_right"}
    robot = load_hand("allegro_right")
    demo = read_recording(Path("demo"), "right")
    still = replace(demo, landmarks=np.repeat(demo.landmarks[:1], len(demo.time), 0))
    with pytest.raises(InvalidInputError):
        person.Person(robot, still)
