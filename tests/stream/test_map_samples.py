"""A recording in one go: the same steps as one by one, in threads too."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from faulty_recordings import DEMO
from injection import inject, parse_faults
from oracles.alpha_beta import ReferenceSmoother

from handmap_core.human.recording import Recording, sample_columns
from handmap_core.human.sample import HumanSample
from handmap_core.stream.rejoin import Rejoin
from handmap_core.stream.step_table import StepTable
from handmap_qp import Follower, HandMapper, HumanLengths, IkOptions, Smoothing
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.library import load_hand

HUMAN = load_hand(
    "human", points="landmarks", lengths=HumanLengths.from_hand_length(0.19)
)
ROBOT = load_hand("three_finger")
FAULTS = (
    "",
    "dropout@0.5+0.4",
    "zero@0.3+0.2,jump@1.2+0.3:0.2",
    "flip@0.6+0.2",
    "outlier@0.5+0.1:0.1,silence@1.3+0.5",
    "frozen@0.5+0.6",
)


def columns_of(samples: list[HumanSample]) -> Recording:
    time, landmarks, valid, confidence = (
        np.array([getattr(sample, name) for sample in samples])
        for name in ("time", "landmarks", "valid", "confidence")
    )
    plain = Recording("samples", time, landmarks, valid, "right")
    return replace(plain, confidence=confidence)


def samples_with(faults: str) -> list[HumanSample]:
    columns = sample_columns(DEMO.part(slice(0, 150)))
    plain = [columns.sample(i) for i in range(150)]
    return list(inject(plain, parse_faults(faults))) if faults else plain


def one_by_one(follower: Follower, columns: Recording) -> StepTable:
    table = StepTable(follower.mapper.robot, len(columns.time))
    for i in range(len(columns.time)):
        table.write(i, follower.map_sample(columns.sample(i)), 0.0)
    return table


def assert_same(one: StepTable, other: StepTable) -> None:
    # The last column is CPU time.
    np.testing.assert_allclose(
        one.rows[:, :-1], other.rows[:, :-1], rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize("limit", [None, 40.0], ids=["free", "accelerating"])
@pytest.mark.parametrize("faults", FAULTS)
def test_a_recording_is_mapped_as_its_samples_are(
    faults: str, limit: float | None
) -> None:
    columns = columns_of(samples_with(faults))
    ik = IkOptions(max_acceleration=limit)
    whole, single = (Follower(HandMapper(HUMAN, ROBOT, ik=ik)) for _ in range(2))
    table = whole.map_samples(columns)
    assert_same(table, one_by_one(single, columns))
    assert bool(table.columns[8].any()) == bool(faults)
    # Both go on alike.
    last = columns.sample(-1)
    later = HumanSample(last.time + 0.02, "right", last.landmarks)
    one, other = (each.map_sample(later).command.q for each in (whole, single))
    np.testing.assert_allclose(one, other, atol=1e-12)


@pytest.mark.parametrize(
    "choice",
    [{"smoothing": Smoothing()}, {"rejoin": "clutch"}],
    ids=["smooth", "clutch"],
)
def test_what_the_core_does_not_do_is_done_all_the_same(choice: dict) -> None:
    columns = columns_of(samples_with("dropout@0.5+0.4"))
    whole, single = (Follower(HandMapper(HUMAN, ROBOT), **choice) for _ in range(2))
    assert_same(whole.map_samples(columns), one_by_one(single, columns))


class PlainFollower(Follower):
    """Judges, smooths and maps each sample by calls of their own."""

    @property
    def _is_plain(self) -> bool:
        return False


@pytest.mark.parametrize("noise", [0.0, 2e-3, 5e-3])
@pytest.mark.parametrize("lost", [0.0, 0.2])
@pytest.mark.parametrize("copies", [1, 3])
def test_noise_losses_and_repetition_are_met_at_once_as_one_by_one(
    noise: float, lost: float, copies: int
) -> None:
    random, columns = np.random.default_rng(4), columns_of(samples_with(""))
    landmarks = columns.landmarks[np.arange(150) // copies * copies]
    noisy = (
        landmarks
        + random.normal(scale=noise, size=(150, 21, 3))[np.arange(150) // copies]
    )
    columns = replace(columns, landmarks=noisy, valid=random.random(150) >= lost)
    whole = Follower(HandMapper(HUMAN, ROBOT))
    single: Any = PlainFollower(HandMapper(HUMAN, ROBOT))
    single._smoother = ReferenceSmoother(Smoothing())
    found, expected = whole.map_samples(columns), one_by_one(single, columns)
    np.testing.assert_allclose(
        found.rows[:, :-1], expected.rows[:, :-1], rtol=0.0, atol=1e-9
    )
    # Little else is held than what was lost.
    is_held = found.columns[8] > 0.0
    assert (is_held & columns.valid).mean() < 0.05


def test_threads_map_recordings_side_by_side() -> None:
    columns = [columns_of(samples_with(faults)) for faults in FAULTS]

    def run(samples: Recording) -> StepTable:
        return Follower(HandMapper(HUMAN, ROBOT)).map_samples(samples)

    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(run, columns))
    for table, samples in zip(found, columns, strict=True):
        assert_same(table, run(samples))


def test_progress_tells_of_all_samples() -> None:
    told: list[int] = []
    columns = columns_of(samples_with(""))
    Follower(HandMapper(HUMAN, ROBOT)).map_samples(columns, told.append)
    assert told == sorted(told)
    assert told[-1] == 150


def test_a_sample_far_away_is_an_error_that_names_it() -> None:
    columns = columns_of(samples_with(""))
    far = columns.landmarks.copy()
    far[100, 4] = 1e12
    bad = replace(columns, landmarks=far, valid=np.arange(150) == 100)
    with pytest.raises(InvalidInputError) as caught:
        Follower(HandMapper(HUMAN, ROBOT)).map_samples(bad)
    assert caught.value.argument == "landmarks"


def test_a_sample_at_fault_is_forgotten() -> None:
    columns = columns_of(samples_with(""))
    far = columns.landmarks.copy()
    far[100, 4] = 1e12
    bad = replace(columns, landmarks=far, valid=np.arange(150) == 100)
    whole, single = (Follower(HandMapper(HUMAN, ROBOT)) for _ in range(2))
    with pytest.raises(InvalidInputError, match="landmarks"):
        whole.map_samples(bad)
    for i in range(100):
        single.map_sample(bad.sample(i))
    rest = columns.part(slice(101, None))
    assert_same(whole.map_samples(rest), one_by_one(single, rest))


def test_samples_of_the_other_hand_are_an_error_and_change_nothing() -> None:
    columns = columns_of(samples_with(""))
    whole, single = (Follower(HandMapper(HUMAN, ROBOT)) for _ in range(2))
    for follower in (whole, single):
        follower.map_samples(columns.part(slice(60)))
    rest = columns.part(slice(60, None))
    with pytest.raises(InvalidInputError, match="side: expected samples of a right"):
        whole.map_samples(replace(rest, side="left"))
    with pytest.raises(InvalidInputError, match="side: expected samples of a right"):
        whole.map_sample(replace(rest.sample(0), side="left"))
    assert_same(whole.map_samples(rest), single.map_samples(rest))


def test_a_return_at_fault_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = columns_of(samples_with("dropout@0.5+0.4"))

    def fail(*_: object) -> None:
        raise InvalidInputError("no way back", argument="landmarks")

    verdicts = []
    for maps in (Follower.map_samples, one_by_one):
        follower = Follower(HandMapper(HUMAN, ROBOT, dt=1.0 / 60.0))
        with monkeypatch.context() as patched:
            patched.setattr(Rejoin, "start", fail)
            with pytest.raises(InvalidInputError, match="no way back"):
                maps(follower, columns)
        verdicts.append(follower.map_sample(columns.sample(149)).verdict)
    assert verdicts[0] == verdicts[1]
