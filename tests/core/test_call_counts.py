"""What was made fast stays fast: bounds of the calls that each step of the work takes.

Counts do not depend on the load of the machine. Bounds are a little above what is counted, since
versions of Python, numpy and h5py differ by a few calls.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from call_counts import count_calls
from mapping_cases import pinched
from marks import rotated
from verdict_cases import streams

from handmap_core.human.recording import sample_columns
from handmap_core.mapping.step import MapStep
from handmap_qp import (
    Follower,
    Hand,
    HandMapper,
    HumanSample,
    Recording,
    hand_names,
    load_hand,
)
from handmap_qp.apps.datasets.batch import plan_batch
from handmap_qp.apps.datasets.episodes import run_job
from handmap_qp.apps.datasets.sources import JobOptions
from handmap_qp.human.measure import scaled_human
from handmap_qp.stream.grip import GripFollower
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers import check_recording, hints, recording_facts
from handmap_qp.trackers.formats import (
    list_sources,
    read_recording,
    write_recordings,
)
from handmap_qp.trackers.formats.hdf5 import EgoDexFormat

ALLEGRO = load_hand("allegro_right")
FRAMES = 265
"""Frames of a recording of EgoDex, in the middle."""


def recorded(size: float = 1.0) -> Recording:
    """Return a recording of a person whose hand is so many times as large."""
    whole = read_recording("demo", "right")
    return Recording(
        "take",
        np.arange(FRAMES) / 30.0,
        size * whole.landmarks[:FRAMES],
        whole.valid[:FRAMES],
        "right",
    )


@pytest.fixture(scope="module")
def people() -> Iterator[Hand]:
    """Yield people, each of whom nothing has seen before."""

    def measured() -> Iterator[Hand]:
        for size in np.linspace(0.95, 1.05, 200):
            recording = recorded(size)
            lengths = measure_person(recording).lengths
            yield scaled_human(recording, points="landmarks", lengths=lengths)

    return measured()


@pytest.fixture(scope="module")
def samples() -> list[HumanSample]:
    return list(recorded())


@pytest.fixture
def egodex(tmp_path: Path) -> Path:
    file = tmp_path / "take.hdf5"
    write_recordings([recorded(0.98)], file, EgoDexFormat())
    return file


def bind_count(people: Iterator[Hand], robot: Hand, preset: str | None = None) -> int:
    """Count the calls of a mapper for a new person, after one for another person."""
    HandMapper(next(people), robot, preset)
    human = next(people)
    return count_calls(lambda: HandMapper(human, robot, preset))


@pytest.mark.parametrize("name", rotated(hand_names(), 3, 2))
def test_binding_a_mapper_to_a_new_person(people: Iterator[Hand], name: str) -> None:
    """Arms, jaws and hands whose joints follow others too; each has a matched posture to solve."""
    assert bind_count(people, load_hand(name)) <= 1_350


BINDS = {"object": 170, "fingertip-vectors": 230, "joint-to-joint": 2_800}


@pytest.mark.parametrize("preset", BINDS)
def test_binding_a_preset_to_a_new_person(people: Iterator[Hand], preset: str) -> None:
    assert bind_count(people, ALLEGRO, preset) <= BINDS[preset]


def test_scaling_a_hand_to_a_person() -> None:
    recording = recorded(1.02)
    lengths = measure_person(recorded(1.03)).lengths
    assert count_calls(lambda: scaled_human(recording, lengths=lengths)) <= 130


def test_measuring_a_person() -> None:
    measure_person(recorded())
    recording = recorded(1.01)
    assert count_calls(lambda: measure_person(recording)) <= 600


def test_reading_a_recording_of_hdf5(egodex: Path) -> None:
    (source,) = list_sources(egodex)
    source.read()
    assert count_calls(source.read) <= 1_750


def test_reading_a_recording_for_a_data_set(egodex: Path) -> None:
    """It is read and checked, and what is unusual in it is named."""
    (source,) = list_sources(egodex)

    def read() -> None:
        recording = source.read()
        check_recording(recording)
        hints(recording_facts(recording))

    read()
    assert count_calls(read) <= 2_500


def test_a_followed_sample(people: Iterator[Hand], samples: list[HumanSample]) -> None:
    """Guard, filter and mapping are one call of the core, as a mapping alone is."""
    follower = Follower(HandMapper(next(people), ALLEGRO))
    first, second, *others = samples[:50]
    follower.map_sample(first)
    follower.map_sample(second)
    counts = [count_calls(partial(follower.map_sample, sample)) for sample in others]
    assert max(counts) <= LANDMARKS["teleoperation"] + 1


@pytest.mark.parametrize(
    "name",
    [
        "mirrored for a while, wrist",
        "millimetres for a while",
        "other order for a while",
        "no hand for a while",
        "milliseconds for a while",
        "wrist elsewhere for a while, wrist",
        "wrist of another convention for a while, wrist",
        "fault flip",
    ],
)
def test_a_sample_that_is_wrong_costs_no_more_than_others(name: str) -> None:
    """Words about it are made when they are read, and then alone."""
    human = load_hand("human", points="landmarks")
    guard = StreamGuard(human)
    follower = Follower(HandMapper(human, ALLEGRO))
    judged, held = [], []
    for sample in streams()[name].samples[:200]:
        judged.append(count_calls(partial(guard.check, sample)))
        steps: list[MapStep] = []
        calls = count_calls(partial(map_into, steps, follower, sample))
        if steps[0].is_held:
            held.append(calls)
    assert max(judged) <= 4
    assert held
    # The robot brakes, and the step says so.
    assert max(held) <= 55


def map_into(steps: list[MapStep], follower: Follower, sample: HumanSample) -> None:
    steps.append(follower.map_sample(sample))


LANDMARKS = {
    "teleoperation": 8,
    "object": 8,
    "fingertip-vectors": 70,
    "joint-to-joint": 290,
    "virtual-sphere": 220,
}


@pytest.mark.parametrize("preset", LANDMARKS)
def test_a_sample_of_landmarks(
    people: Iterator[Hand], samples: list[HumanSample], preset: str
) -> None:
    mapper = HandMapper(next(people), ALLEGRO, preset)
    for sample in samples[:3]:
        mapper.map_landmarks(sample.landmarks)
    landmarks = samples[3].landmarks
    assert count_calls(lambda: mapper.map_landmarks(landmarks)) <= LANDMARKS[preset]


def test_a_recording_that_is_followed(people: Iterator[Hand]) -> None:
    columns = sample_columns(recorded())
    Follower(HandMapper(next(people), ALLEGRO)).map_samples(columns)
    follower = Follower(HandMapper(next(people), ALLEGRO))
    # Most of them prepare the first sample: a call for each array of the model.
    assert count_calls(lambda: follower.map_samples(columns)) <= 493


def test_pads_that_are_pressed_on_each_other() -> None:
    """They take further QPs with more rows, which share the cost of the first one."""
    recording = read_recording("pinch", "right")
    lengths = measure_person(recording).lengths
    human = scaled_human(recording, points="landmarks", lengths=lengths)
    # Its fingertips are flat: they lie on each other.
    mapper = HandMapper(human, load_hand("hey5"))
    ik = mapper.point_ik.core
    assert ik is not None
    count = len(recording)
    before = ik.costs
    solved = sum(
        mapper.map_landmarks(landmarks, dt=1 / 60).ik.iterations
        for landmarks in recording.landmarks
    )
    assert solved <= 1.9 * count
    # Searches for a way around links take costs too, and count no iterations.
    assert ik.costs - before < 0.8 * solved


def test_looking_for_another_way_takes_few_qps() -> None:
    recording = read_recording("demo", "right")
    mapper = HandMapper(load_hand("human", points="landmarks"), ALLEGRO)
    ik = mapper.point_ik.core
    work = [(ik.costs, ik.queries)]
    for landmarks in recording.landmarks[recording.valid]:
        mapper.map_landmarks(landmarks, dt=1 / 60)
        work.append((ik.costs, ik.queries))
    costs, queries = np.diff(work, axis=0).T
    assert costs.mean() < 2.7
    # Those of the hand and of its look ahead.
    assert costs.max() <= 6 + 8
    assert queries.max() < 80


def test_the_worst_sample_is_bounded(recordings: Path) -> None:
    """LEAP's fingers fold over each other: without bounds, a sample took 13,700 distances."""
    recording = read_recording(recordings / "leap_pinch_move_right.npz")
    lengths = measure_person(recording).lengths
    human = scaled_human(recording, points="landmarks", lengths=lengths)
    mapper = HandMapper(human, load_hand("leap_right"))
    ik = mapper.point_ik.core
    work = [(ik.costs, ik.queries)]
    for landmarks, time in zip(recording.landmarks, recording.time, strict=True):
        mapper.map_landmarks(landmarks, time=float(time))
        work.append((ik.costs, ik.queries))
    costs, queries = np.diff(work, axis=0).T
    assert costs.max() <= 6 + 8
    # A proof measures what no direction shows to stay apart; it may measure 700 and 500.
    assert queries.max() < 150


@pytest.mark.parametrize("name", ["allegro_right", "hey5"])
def test_a_pinch_that_is_held_looks_for_no_other_way(name: str) -> None:
    mapper = HandMapper(load_hand("human", points="landmarks"), load_hand(name))
    q = pinched("index", 0.010)
    for _ in range(60):
        mapper.map_step(q, np.eye(4), dt=1 / 60)
    ik = mapper.point_ik.core
    before = ik.costs
    iterations = sum(
        mapper.map_step(q, np.eye(4), dt=1 / 60).iterations for _ in range(300)
    )
    assert ik.costs - before <= iterations


def test_a_sample_with_a_grip(
    people: Iterator[Hand], samples: list[HumanSample]
) -> None:
    follower = GripFollower(Follower(HandMapper(next(people), ALLEGRO)))
    q = ALLEGRO.rest
    for sample in samples[:3]:
        follower.map_sample(sample, q)
    counts = [
        count_calls(partial(follower.map_sample, sample, q)) for sample in samples[3:60]
    ]
    # Most where pads close.
    assert max(counts) <= 320
    assert np.median(counts) <= 131


def test_a_recording_of_a_batch(tmp_path: Path) -> None:
    """All of it: read, checked, measured, mapped, judged and written."""
    for i in range(3):
        recording = recorded(0.96 + 0.01 * i)
        write_recordings([recording], tmp_path / f"{i}.hdf5", EgoDexFormat())
    options = JobOptions({"right": "allegro_right"})
    first, second, third = plan_batch([tmp_path], tmp_path / "out", options).jobs
    run_job(first)
    run_job(second)
    lines = []
    assert count_calls(lambda: lines.append(run_job(third))) <= 9_700
    assert lines[0].status == "done"


def test_loading_a_hand() -> None:
    """Its URDF, of an installed package, names each mesh twice."""
    load_hand("allegro_right")
    # How many folders are searched for the package depends on the environment.
    assert count_calls(lambda: load_hand("allegro_right")) <= 38_000
