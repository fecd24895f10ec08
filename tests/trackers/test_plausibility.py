"""Mistakes of users are found and named within a second, and real hands are never refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from pinocchio import exp3

from handmap_core.human.sample import HumanSample, Verdict
from handmap_core.trackers.hand_geometry import misfit, palmar_evidence
from handmap_core.trackers.wrist_axes import palm_axes
from handmap_qp import (
    Follower,
    HandMapper,
    InvalidInputError,
    Recording,
    load_hand,
    read_recording,
)
from handmap_qp.human.measure import scaled_human
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.trackers.plausibility import (
    Finding,
    InputCheck,
    check_recording,
    examine_recording,
)


@pytest.fixture(scope="module")
def take(lies: ModuleType) -> Any:
    """Six seconds of the human model, which bends its fingers in each of them."""
    return lies.model_take("left", 0.185, seed=4, duration=6.0)


def find(take: Any) -> Finding | None:
    check = InputCheck(take.side)
    for time, landmarks, wrist in zip(
        take.time, take.landmarks, take.wrist, strict=True
    ):
        if finding := check.update(time, landmarks, wrist):
            return finding
    return check.finish()


def as_recording(take: Any) -> Recording:
    valid = np.ones(len(take.time), dtype=bool)
    return Recording(
        take.name, take.time, take.landmarks, valid, take.side, wrist=take.wrist
    )


def test_every_mistake_is_found_within_a_second(lies: ModuleType, take: Any) -> None:
    for start in range(5):
        part = take.part(float(start), 1.0)
        assert find(part) is None
        for lie in lies.all_lies():
            if lies.is_visible(lie, part):
                finding = find(lie.tell(part))
                assert finding is not None, lie.name
                # The palm of a mirrored world does not agree with its wrist either.
                assert finding.kind in (lie.kind, "wrist"), (lie.name, finding)
                assert finding.problem
                assert finding.advice


def test_real_hands_pass_and_mistakes_in_them_do_not(
    lies: ModuleType, recordings: Path
) -> None:
    for file in sorted(recordings.glob("*.npz")):
        recording = read_recording(file)
        assert examine_recording(recording) is None, file
        seen = recording.valid
        assert recording.wrist is not None
        whole = lies.Take(
            file.stem,
            recording.time[seen],
            recording.landmarks[seen],
            recording.wrist[seen],
            recording.side,
        )
        part = whole.part(whole.time[0] + 2.0, 1.0)
        for lie in lies.all_lies():
            if lies.is_visible(lie, part):
                assert find(lie.tell(part)) is not None, (file, lie.name)


def test_a_change_in_a_running_session_is_found_and_so_is_its_end(take: Any) -> None:
    check = InputCheck(take.side)
    mirrored = take.landmarks * (-1.0, 1.0, 1.0)
    found = []
    for i, time in enumerate(take.time):
        landmarks = mirrored[i] if 2.0 <= time < 4.0 else take.landmarks[i]
        found.append(check.update(time, landmarks) is not None)
    changes = take.time[1:][np.diff(np.array(found, dtype=int)) != 0]
    assert len(changes) == 2
    assert 2.0 < changes[0] < 3.0
    assert 4.0 < changes[1] < 5.0


def test_few_bad_samples_change_nothing(take: Any) -> None:
    landmarks = take.landmarks.copy()
    landmarks[10] = 0.0  # a zero pose
    landmarks[20, 8] += 0.2  # one landmark far off
    landmarks[30] = -landmarks[30]
    landmarks[50:] += 0.5  # a jump of the whole hand
    check = InputCheck(take.side)
    for i, time in enumerate(take.time):
        assert check.update(time, landmarks[i]) is None


def test_the_measures_do_not_depend_on_place_size_and_rate(
    lies: ModuleType, take: Any
) -> None:
    moved = 3.0 * take.landmarks[:, :, [1, 2, 0]] + (5.0, -2.0, 1.0)
    one, other = palmar_evidence(take.landmarks), palmar_evidence(moved)
    np.testing.assert_allclose(np.array(one), np.array(other), atol=1e-9)
    pair = [misfit(points[:16]) for points in (take.landmarks, moved)]
    assert pair[0] == pytest.approx(pair[1], abs=1e-9)
    # A mirror changes the sign of the evidence and nothing else.
    mirrored = palmar_evidence(take.landmarks * (-1.0, 1.0, 1.0))
    np.testing.assert_allclose(np.array(one), -np.array(mirrored), atol=1e-9)


def test_short_recordings_are_judged_by_what_they_have(take: Any) -> None:
    whole = as_recording(take)
    for count in (1, 5, 12, 20):
        short = replace(
            whole,
            time=whole.time[:count],
            landmarks=whole.landmarks[:count],
            valid=whole.valid[:count],
            wrist=None,
        )
        check_recording(short)
        with pytest.raises(InvalidInputError) as caught:
            check_recording(
                replace(short, landmarks=short.landmarks * 1000.0), name="hand.npz"
            )
        assert caught.value.argument == "hand.npz"
        assert "millimetres" in str(caught.value)
        assert "multiply the landmarks by 0.001" in str(caught.value)


def test_sides_are_told_apart(take: Any) -> None:
    check = InputCheck("right")
    assert check.finding is None
    for i in range(60):
        check.update(take.time[i], take.landmarks[i])
    assert check.finding is not None
    assert check.finding.kind == "side"
    with pytest.raises(InvalidInputError):
        InputCheck("both")


def test_the_robot_holds_while_the_input_is_not_what_it_says(take: Any) -> None:
    human = load_hand("human_left", points="landmarks", hand_length=0.185)
    follower = Follower(HandMapper(human, load_hand("allegro_left")))
    steps = []
    for i, time in enumerate(take.time[:240]):
        is_wrong = 0.5 <= time < 2.0
        landmarks = take.landmarks[i] * (
            (-1.0, 1.0, 1.0) if is_wrong else (1.0, 1.0, 1.0)
        )
        steps.append(follower.map_sample(HumanSample(float(time), "left", landmarks)))
    rules = np.array([step.rule for step in steps])
    time = take.time[:240]
    # The guard holds a flipped hand for half a second at first; from then on it is known.
    assert (rules[(time > 1.3) & (time < 1.99)] == "side").all()
    assert all(
        step.is_held for step, t in zip(steps, time, strict=True) if 0.5 <= t < 2.0
    )
    finding = steps[105].finding
    assert finding is not None
    assert "right hand" in str(finding)
    assert not steps[-1].is_held
    assert steps[-1].finding is None
    assert steps[10].finding is None


def test_the_order_is_named_and_no_order_is_not(lies: ModuleType, take: Any) -> None:
    part = take.part(1.0, 1.0)
    names = {
        lie.name: str(find(lie.tell(part)))
        for lie in lies.all_lies()
        if lie.kind == "order"
    }
    for layout in ("bighand21", "interhand21", "mano21", "rhd21"):
        assert f"that of the layout {layout}" in names[f"order of {layout}"]
    assert "index, middle, ring, little, thumb:" in names["thumb last"]
    assert "thumb, middle, index, ring, little:" in names["index and middle"]
    assert "no hand in any order known here" in names["random order"]


def test_metres_that_were_taken_for_millimetres_are_named(take: Any) -> None:
    finding = find(take.part(0.0, 1.0)._replace(landmarks=take.landmarks[:60] / 1000.0))
    assert finding is not None
    assert finding.advice == "multiply the landmarks by 1000"


@pytest.mark.parametrize(
    ("factor", "name"),
    [(1000.0, "millimetres"), (100.0, "centimetres"), (1 / 0.0254, "inches")],
)
def test_units_of_length_are_named(factor: float, name: str, take: Any) -> None:
    finding = find(take.part(0.0, 1.0)._replace(landmarks=take.landmarks[:60] * factor))
    assert finding is not None
    assert name in finding.problem
    assert finding.advice == f"multiply the landmarks by {1 / factor:g}"


def test_a_wrist_in_another_unit_or_world_is_found(take: Any) -> None:
    part = take.part(0.0, 1.0)
    for shift in (0.3, -1.0):
        wrist = part.wrist.copy()
        wrist[:, 2, 3] += shift
        finding = find(part._replace(wrist=wrist))
        assert finding is not None
        assert finding.kind == "wrist"
        assert f"{abs(shift):g} m from" in finding.problem


def test_one_batch_is_not_enough_and_lost_hands_are_no_mistake(take: Any) -> None:
    landmarks = take.landmarks.copy()
    landmarks[:16] *= (-1.0, 1.0, 1.0)  # exactly the first batch
    landmarks[100:200] = 0.0  # zero poses, in whole batches
    check = InputCheck(take.side)
    for i, time in enumerate(take.time):
        assert check.update(time, landmarks[i]) is None


def test_a_recording_is_refused_for_a_quarter_of_it_and_not_for_a_moment(
    take: Any,
) -> None:
    whole = as_recording(take)
    for start, share, is_refused in (
        (2.0, 0.1, False),
        (0.0, 0.15, False),
        (2.0, 0.2, False),
        (2.0, 0.36, True),
        (2.0, 0.6, True),
    ):
        wrong = (whole.time > start) & (whole.time < start + 6.0 * share)
        landmarks = np.where(wrong[:, None, None], -1.0, 1.0) * whole.landmarks
        finding = examine_recording(replace(whole, landmarks=landmarks, wrist=None))
        assert (finding is not None) == is_refused


def test_the_wrist_tells_the_other_hand_from_a_mirrored_world(
    lies: ModuleType, take: Any
) -> None:
    part = take.part(1.0, 1.0)
    told = {lie.name: lie.tell(part) for lie in lies.all_lies()}
    texts = {
        name: str(find(told[name])) for name in ("the other hand", "mirrored world")
    }
    assert "of a left hand, and so is the wrist's pose" in texts["the other hand"]
    assert (
        "mirrored left hand; the wrist's pose is not: negate" in texts["mirrored world"]
    )
    finding = find_without_wrist(told["mirrored world"])
    assert "of a right hand, or of a mirrored world" in str(finding)


def find_without_wrist(take: Any) -> Finding | None:
    check = InputCheck(take.side)
    for time, landmarks in zip(take.time, take.landmarks, strict=True):
        check.update(time, landmarks)
    return check.finding


def test_real_image_landmarks_are_no_world_landmarks(recordings: Path) -> None:
    file = recordings / "rgb_mediapipe_right.npz"
    recording, image = (
        read_recording(file),
        np.load(file)["image_landmarks"].astype(float),
    )
    for scale, word in (
        ((1.0, 1.0, 1.0), "image coordinates"),
        ((640.0, 480.0, 640.0), "pixels"),
    ):
        finding = examine_recording(
            replace(recording, landmarks=image * scale, wrist=None)
        )
        assert finding is not None
        assert finding.kind == "unit"
        assert word in finding.problem


def guarded(take: Any, *, has_wrist: bool = True) -> list[Verdict]:
    """Judge a take as a live stream of the person in it."""
    guard = StreamGuard(scaled_human(as_recording(take), points="landmarks"))
    return [
        guard.check(
            HumanSample(time, take.side, landmarks, wrist if has_wrist else None)
        )
        for time, landmarks, wrist in zip(
            take.time.tolist(), take.landmarks, take.wrist, strict=True
        )
    ]


@pytest.mark.parametrize("degrees", [10, 20, 30])
@pytest.mark.parametrize(
    ("side", "length"), [("right", None), ("left", 0.16), ("right", 0.21)]
)
def test_people_whose_fingers_bend_back_at_the_knuckles_are_followed(
    lies: ModuleType, degrees: int, side: str, length: float | None
) -> None:
    take = lies.model_take(
        side, length, seed=degrees, duration=8.0, hyperextension=np.radians(degrees)
    )
    assert examine_recording(as_recording(take)) is None
    assert not any(verdict.is_held for verdict in guarded(take))


@pytest.mark.parametrize("start", [0.13, 0.4, 1.0, 1.6])
def test_fingers_that_are_splayed_backwards_for_a_moment_are_followed(
    start: float,
) -> None:
    human, time = (
        load_hand("human", points="landmarks"),
        np.arange(0.0, 3.0, 1.0 / 60.0),
    )
    flared, random = human.rest.copy(), np.random.default_rng(5)
    for i, name in enumerate(human.joint_names):
        if not name.startswith("thumb"):
            flared[i] = {"MCP_f": -0.6, "MCP_a": 1.5 * human.rest[i]}.get(
                name.split("_", 1)[1][:5], 0.0
            )
    shares = np.interp(time - start, [0.0, 0.15, 0.65, 0.8], [0.0, 1.0, 1.0, 0.0])
    shares = shares**2 * (3.0 - 2.0 * shares)
    guard = StreamGuard(human)
    for t, share in zip(time.tolist(), shares, strict=True):
        points = human.points(human.rest + share * (flared - human.rest))
        sample = HumanSample(
            t, "right", points + random.normal(0.0, 3e-4, points.shape)
        )
        assert guard.check(sample).rule == ""


@pytest.mark.parametrize("curls", [True, False])
def test_middle_joints_bent_backwards_are_a_mistake_unless_fingers_curled_before(
    curls: bool,
) -> None:
    human, random = load_hand("human", points="landmarks"), np.random.default_rng(6)
    curled, flared = human.rest.copy(), human.rest.copy()
    for i, name in enumerate(human.joint_names):
        if not name.startswith("thumb") and name.endswith("flexion"):
            curled[i], flared[i] = 0.5, 0.0
    landmarks = human.points(flared)
    turn = exp3(np.array([np.radians(25.0), 0.0, 0.0]))
    for base in (6, 10, 14, 18):
        bones = landmarks[base + 1 : base + 3] - landmarks[base]
        landmarks[base + 1 : base + 3] = landmarks[base] + bones @ turn.T
    first = human.points(curled if curls else flared)
    check, kinds = InputCheck("right"), set()
    for i in range(150):
        points = landmarks if i >= 60 else first
        sample = points + random.normal(0.0, 3e-4, points.shape)
        finding = check.update(i / 60.0, sample)
        kinds.add(finding and finding.kind)
    assert kinds == ({None} if curls else {None, "flexion"})


@pytest.mark.parametrize(("deviation", "is_hand"), [(0.010, True), (0.012, False)])
@pytest.mark.parametrize("seed", range(3))
def test_landmarks_that_lie_more_than_10_mm_off_are_no_hand(
    seed: int, deviation: float, is_hand: bool
) -> None:
    recording = read_recording("demo", "right").part(slice(0, 120))
    wrong = np.random.default_rng(seed).normal(0.0, deviation, (21, 3))
    check = InputCheck("right")
    found = None
    for time, landmarks in zip(recording.time, recording.landmarks, strict=True):
        found = found or check.update(float(time), landmarks + wrong)
    assert (found is None) is is_hand


@pytest.mark.parametrize("seed", range(3))
def test_noise_in_depth_is_no_other_order(lies: ModuleType, seed: int) -> None:
    take = lies.model_take("right", 0.185, seed, duration=6.0)
    noise = np.random.default_rng(seed).normal(0.0, 0.03, take.landmarks.shape)
    noise[..., :2] = 0.0
    check = InputCheck(take.side)
    for time, landmarks in zip(take.time, take.landmarks + noise, strict=True):
        finding = check.update(float(time), landmarks)
        assert finding is None or finding.kind != "order"


@pytest.mark.parametrize("size", [0.5, 1.6])
def test_sizes_that_no_operator_has_are_refused(take: Any, size: float) -> None:
    scaled = take._replace(landmarks=size * take.landmarks, wrist=take.wrist.copy())
    scaled.wrist[:, :3, 3] *= size
    finding = find(scaled)
    assert finding is not None
    assert finding.kind == "unit"
    with pytest.raises(InvalidInputError, match=r"a hand of 0\.12 to 0\.25 m"):
        scaled_human(as_recording(scaled))


@pytest.mark.parametrize("end", [0.6, 1.5])
def test_a_hand_that_changes_its_size_is_held_and_one_that_trembles_is_not(
    lies: ModuleType, end: float
) -> None:
    take = lies.model_take(
        "right", 0.19 if end < 1.0 else 0.16, 2, duration=12.0, noise=0.003
    )
    sizes = np.interp(take.time, [2.0, 8.0], [1.0, end])
    wrist = take.landmarks[:, :1]
    grown = wrist + sizes[:, None, None] * (take.landmarks - wrist)
    verdicts = guarded(take._replace(landmarks=grown), has_wrist=False)
    found = np.array([verdict.finding is not None for verdict in verdicts])
    ratio = np.maximum(sizes, 1.0 / sizes)
    assert not found[ratio < 1.3].any()
    assert found[ratio > 1.46].all()
    kinds = {v.finding.kind for v in verdicts if v.finding is not None}
    assert kinds <= {"size", "unit"}
    assert verdicts[int(found.argmax())].rule == "size"
    assert not any(verdict.finding for verdict in guarded(take, has_wrist=False))


@pytest.mark.parametrize("base", [1, 5, 17])
def test_a_finger_that_repeats_is_found_and_one_that_is_held_still_is_not(
    lies: ModuleType, base: int
) -> None:
    take = lies.model_take("right", 0.185, 6, duration=4.0)
    finding = find(lies._frozen(take, base))
    assert finding is not None
    assert finding.kind == "frozen"
    assert ("thumb", "index", "middle", "ring", "little")[base // 4] in finding.problem
    # Held still, the landmarks of the finger have the noise of the others; rounded, a hand at rest
    # repeats most of the time.
    still = lies._frozen(take, base).landmarks
    still = still + np.random.default_rng(1).normal(0.0, 5e-4, still.shape)
    assert find(take._replace(landmarks=still)) is None
    resting = take.landmarks[:1] + np.random.default_rng(1).normal(
        0.0, 2e-4, still.shape
    )
    for step in (1e-3, 1e-4):
        rounded = np.round(resting / step) * step
        assert (
            find(
                take._replace(
                    landmarks=rounded, wrist=np.tile(take.wrist[0], (240, 1, 1))
                )
            )
            is None
        )


@pytest.mark.parametrize(
    ("bend", "step", "rounding", "kind"),
    [
        (0.0, 0.0, float, None),
        (0.8, 0.0, float, "frozen"),
        (0.8, 0.0, np.float32, "frozen"),
        (0.8, math.radians(2.0), float, None),
    ],
)
def test_a_finger_may_rest_at_a_limit_or_in_a_coarse_glove_and_nowhere_else(
    bend: float, step: float, rounding: type, kind: str | None
) -> None:
    # Bones are rigid and the other fingers move. A joint at its limit repeats, and so does
    # whatever moves slowly if angles come in steps: neither tells that a finger is stuck.
    human = load_hand("human", points="landmarks")
    middle, half = human.rest, 0.1 * (human.upper_limits - human.lower_limits)
    is_index = np.array([name.startswith("index") for name in human.joint_names])
    held = np.array([bend * ("PIP" in name) for name in human.joint_names])
    check = InputCheck("right")
    for i in range(360):
        time = i / 60.0
        q = np.where(is_index, held, middle + half * np.sin(time + np.arange(20)))
        q = np.round(q / step) * step if step else q
        wrist = np.eye(4)
        wrist[:3, :3], wrist[:3, 3] = exp3(np.full(3, 0.3 * np.sin(time))), 0.1 * time
        points = human.points(q, wrist).astype(rounding).astype(float)
        finding = check.update(time, points)
    assert (finding and finding.kind) == kind


def test_a_resting_finger_in_the_middle_of_its_grid_is_not_frozen(take: Any) -> None:
    # Rounded to 1 mm, the landmarks of one finger do not change while the others flicker.
    random, noise = np.random.default_rng(3), np.full((21, 1), 6e-4)
    noise[6:9] = 1e-4
    place = np.round(take.landmarks[0] / 1e-3) * 1e-3
    landmarks = (
        np.round((place + random.normal(size=(240, 21, 3)) * noise) / 1e-3) * 1e-3
    )
    assert (np.ptp(landmarks[:, 6:9], axis=0) == 0.0).all()
    check = InputCheck(take.side)
    for i, own in enumerate(landmarks):
        assert check.update(i / 60.0, own) is None


@pytest.mark.parametrize(("degrees", "is_backwards"), [(45, False), (65, True)])
def test_knuckles_bend_backwards_no_farther_than_peoples(
    degrees: int, is_backwards: bool
) -> None:
    human, random = load_hand("human", points="landmarks"), np.random.default_rng(7)
    straight = human.rest.copy()
    for i, name in enumerate(human.joint_names):
        straight[i] *= name.startswith("thumb")
    landmarks = human.points(straight)
    # The model stops at 45 degrees: turn each finger about the axis of its MCP joint.
    turn = exp3(np.array([np.radians(degrees), 0.0, 0.0]))
    for base in (5, 9, 13, 17):
        bones = landmarks[base + 1 : base + 4] - landmarks[base]
        landmarks[base + 1 : base + 4] = landmarks[base] + bones @ turn.T
    check = InputCheck("right")
    for i in range(90):
        check.update(i / 60.0, landmarks + random.normal(0.0, 3e-4, (21, 3)))
    assert (
        "" if check.finding is None else check.finding.kind
    ) == "flexion" * is_backwards


def test_a_wrist_is_followed_at_full_speed_once_it_has_turned_with_the_palm(
    lies: ModuleType,
) -> None:
    take = lies.model_take("right", 0.185, 3, duration=6.0)
    rules = [verdict.rule for verdict in guarded(take)]
    proven = rules.index("")
    assert set(rules[:proven]) == {"unproven"}
    assert take.time[proven] < 1.5
    assert set(rules[proven:]) == {""}
    # A hand that has not turned proves nothing, and without a wrist there is nothing to prove.
    still = take._replace(
        landmarks=take.landmarks[:1]
        + np.random.default_rng(0).normal(0.0, 5e-4, take.landmarks.shape),
        wrist=np.tile(take.wrist[0], (len(take.time), 1, 1)),
    )
    assert {verdict.rule for verdict in guarded(still)} == {"unproven"}
    assert {verdict.rule for verdict in guarded(take, has_wrist=False)} == {""}


def test_a_wrong_wrist_is_never_followed_at_full_speed(lies: ModuleType) -> None:
    for seed in range(2):
        take = lies.model_take("left", 0.185, seed, duration=4.0)
        for lie in lies.live_lies():
            if lie.kind == "wrist":
                verdicts = guarded(lie.tell(take))
                assert all(v.is_held or v.rule == "unproven" for v in verdicts), (
                    lie.name
                )
                assert any(v.rule == "wrist" for v in verdicts), lie.name


def test_a_wrist_that_follows_half_of_a_turn_or_a_small_one_is_not_proven() -> None:
    human, random = load_hand("human", points="landmarks"), np.random.default_rng(2)
    for share, degrees, is_proven in (
        (0.5, 20.0, False),
        (0.9, 20.0, True),
        (1.0, 8.0, False),
    ):
        check = InputCheck("right")
        for i in range(240):
            # There and back: half of 20 degrees stays within the tolerance of 12.
            angle = np.radians(degrees) * np.sin(np.pi * i / 240.0)
            palm, wrist = np.eye(4), np.eye(4)
            palm[:3, :3] = exp3(np.array([0.0, angle, 0.0]))
            wrist[:3, :3] = exp3(np.array([0.0, share * angle, 0.0]))
            landmarks = human.points(human.rest, palm) + random.normal(
                0.0, 3e-4, (21, 3)
            )
            assert check.update(i / 60.0, landmarks, wrist) is None
        assert check.is_wrist_proven == is_proven


def test_a_wrist_that_stops_turning_is_slowed_down_at_once_and_held(
    lies: ModuleType,
) -> None:
    take = lies.model_take("right", 0.185, 3, duration=6.0)
    wrist = take.wrist.copy()
    wrist[180:, :3, :3] = wrist[180, :3, :3]
    verdicts = guarded(take._replace(wrist=wrist))
    palms = lies.palm_axes(take.landmarks, 1.0)
    turned = np.array(
        [np.arccos(np.clip((np.vdot(p, palms[180]) - 1.0) / 2.0, -1, 1)) for p in palms]
    )
    far = 180 + int(np.argmax(turned[180:] > np.radians(12.0)))
    rules = [verdict.rule for verdict in verdicts]
    # Two batches of 32 samples that show it: the first slows down, the second holds.
    assert rules[170] == ""
    assert rules.index("unproven", 180) <= far + 64
    assert rules.index("wrist", 180) <= far + 96


def test_measures_of_no_samples_are_none() -> None:
    none = np.zeros((0, 21, 3))
    assert palm_axes(none, 1.0).shape == (0, 3, 3)
    assert palmar_evidence(none).total.shape == (0,)
    with pytest.raises(ValueError, match="no samples"):
        misfit(none)
