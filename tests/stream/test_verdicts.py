"""What the guard and the input check say of faults and mistakes stays what they have said."""

from __future__ import annotations

import math
from pickle import dumps, loads

import pytest
import verdict_cases
from faulty_recordings import faulty
from msgspec import structs
from verdict_cases import record, streams

from handmap_core.core import core
from handmap_core.human.findings import WORDS
from handmap_core.human.recording import sample_columns
from handmap_core.human.sample import RULES, HumanSample
from handmap_qp import load_hand
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.trackers.plausibility import InputCheck

HUMAN = load_hand("human", points="landmarks")
KNOWN = verdict_cases.read()


def samples_of(name: str) -> list[HumanSample]:
    return [*streams()[name].samples]


def test_every_stream_has_the_verdicts_that_it_had() -> None:
    assert KNOWN.keys() == streams().keys()
    for name, stream in streams().items():
        found, expected = record(stream), KNOWN[name]
        assert found.runs == expected.runs, name
        assert found.checked == expected.checked, name
        assert math.isclose(found.granted, expected.granted, rel_tol=1e-12), name
        assert math.isclose(found.consistency, expected.consistency, rel_tol=1e-9), name


def test_the_streams_have_every_rule_and_every_mistake() -> None:
    runs = [run for each in KNOWN.values() for run in each.runs]
    assert {rule for _, rule, *_ in runs} == {"", *RULES}
    said = {text for *_, text in runs}
    said |= {text for each in KNOWN.values() for _, text in each.checked}
    assert {text.split()[0] for text in said if text} == {*core.MISTAKES}


def test_rules_and_mistakes_of_the_core_have_words() -> None:
    assert ("", *RULES) == core.RULES
    assert tuple(WORDS) == core.MISTAKES


@pytest.mark.parametrize(
    "name", ["fault mirror", "small for a while", "milliseconds for a while, wrist"]
)
def test_a_copy_goes_on_with_what_was_seen(name: str) -> None:
    guard, check = StreamGuard(HUMAN), InputCheck("right")
    copied_guard, copied_check = loads(dumps((guard, check)))
    for k, sample in enumerate(samples_of(name)):
        if k % 23 == 0:
            copied_guard, copied_check = loads(dumps((copied_guard, copied_check)))
        expected = guard.check(sample)
        assert repr(copied_guard.check(sample)) == repr(expected)
        finding = check.update(sample.time, sample.landmarks, sample.wrist)
        found = copied_check.update(sample.time, sample.landmarks, sample.wrist)
        assert repr(found) == repr(finding)
        assert copied_check.is_wrist_proven == check.is_wrist_proven


def test_a_sample_that_is_forgotten_leaves_no_trace() -> None:
    samples = samples_of("fault jump")
    guard, other = StreamGuard(HUMAN), StreamGuard(HUMAN)
    for k, sample in enumerate(samples[:90]):
        if k % 7 == 0:
            guard.check(sample)
            guard.forget()
        # The same stamp again is new.
        found, expected = guard.check(sample), other.check(sample)
        # The input check counts a forgotten sample, so findings may come earlier.
        assert structs.astuple(found)[:5] == structs.astuple(expected)[:5]


@pytest.mark.parametrize(
    "fault", ["flip@0.7+0.4", "noise@0.7+0.4:0.02", "dropout@0.7+0.3", "clock@0.7:5"]
)
def test_a_recording_is_judged_at_once_as_sample_by_sample(fault: str) -> None:
    recording = faulty(fault)
    guard = StreamGuard(HUMAN)
    expected = [guard.check(sample).is_held for sample in sample_columns(recording)]
    assert StreamGuard(HUMAN).holds(recording).tolist() == expected
