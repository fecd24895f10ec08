"""What a study shows: each mapping, their differences by person, and what people prefer."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec

from handmap_qp.apps.success_rate import success_rate
from .pool import Pool
from .result_file import LABELS, Label, StudyFile
from .statistics import (
    Interval,
    mean_interval,
    median_interval,
    order_effect,
    order_effect_p,
    sign_flip_p,
    sign_test_p,
    wilcoxon_p,
)

FEW = 12
"""People below whom a study is too small to tell usual differences."""
_LEAST_SHARE = 1.0 / 3.0
"""Share of people who begin with the rarer first mapping, below which the order is unbalanced."""


class MappingResult(msgspec.Struct, frozen=True):
    """What people did with one mapping.

    Attributes:
        label: A or B.
        name: Name of the mapping.
        kind: `live` or `recorded`.
        trials: Number of trials.
        successes: How many of them succeeded.
        success: Share of successes over all trials (Wilson), which takes trials as independent.
        success_by_person: Mean of the people's shares (Student's t), which does not.
        seconds: Median time of successful trials, bootstrap by person [s].
        drops: Drops per trial, mean over people (Student's t).
        workload: Raw TLX, mean over people (Student's t).
        scales: Mean answer to each question of NASA-TLX.
    """

    label: Label
    name: str
    kind: str
    trials: int
    successes: int
    success: Interval
    success_by_person: Interval
    seconds: Interval
    drops: Interval
    workload: Interval
    scales: dict[str, float]


class Difference(msgspec.Struct, frozen=True):
    """How the mappings, or the first and the second half of a session, differ by person.

    Attributes:
        measure: What was measured.
        people: Number of people who have the measure with both mappings.
        difference: Mean difference, with its interval.
        p: Two-sided p by permutation; None if it cannot be computed.
        p_wilcoxon: Two-sided p of Wilcoxon's signed-rank test; None where it is not used.
    """

    measure: str
    people: int
    difference: Interval
    p: float | None
    p_wilcoxon: float | None = None


class Preference(msgspec.Struct, frozen=True):
    """What people prefer.

    Attributes:
        A: How many prefer A.
        B: How many prefer B.
        none: How many prefer neither.
        shares: Share of all people for each answer, with its interval (Wilson).
        p: Two-sided p of the sign test among those who prefer one.
    """

    A: int
    B: int
    none: int
    shares: dict[str, Interval]
    p: float


class StudyResult(msgspec.Struct, frozen=True):
    """A whole study.

    Attributes:
        people: Number of people.
        trials: Number of trials with both mappings.
        orders: How many people used the mappings in each order, `A first` and `B first`.
        hands: How many people used each robot hand.
        inputs: How many people used each input.
        libraries: How many people used each version of handmap_qp.
        mappings: A, then B.
        differences: B minus A, by measure.
        order_effects: Second minus first, by measure.
        preference: What people prefer.
        notes: Reasons for caution.
        skipped: Files that were left out, and why.
    """

    people: int
    trials: int
    orders: dict[str, int]
    hands: dict[str, int]
    inputs: dict[str, int]
    libraries: dict[str, int]
    mappings: tuple[MappingResult, MappingResult]
    differences: list[Difference]
    order_effects: list[Difference]
    preference: Preference
    notes: list[str]
    skipped: list[str]


class Measure(NamedTuple):
    """A measure that each person has with both mappings.

    Attributes:
        name: Name, with its unit.
        low: Smallest possible difference.
        high: Largest possible difference.
        has_wilcoxon: Whether Wilcoxon's test is used beside the permutation test.
        values: Values of a person with A and B; None if one is missing.
    """

    name: str
    low: float
    high: float
    has_wilcoxon: bool
    values: Callable[[StudyFile], tuple[float, float] | None]


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)


def success_share(result: StudyFile, label: Label) -> float:
    """Return the share of a person's trials with a mapping that succeeded, from 0 to 1."""
    return _mean([float(trial.is_success) for trial in result.trials_of(label)])


def drops_per_trial(result: StudyFile, label: Label) -> float:
    """Return a person's drops per trial with a mapping."""
    return _mean([float(trial.drops) for trial in result.trials_of(label)])


def times_of(result: StudyFile, label: Label) -> list[float]:
    """Return the times of a person's successful trials with a mapping [s]."""
    return [trial.seconds for trial in result.trials_of(label) if trial.is_success]


def _shares(result: StudyFile) -> tuple[float, float]:
    return success_share(result, "A"), success_share(result, "B")


def _drops(result: StudyFile) -> tuple[float, float]:
    return drops_per_trial(result, "A"), drops_per_trial(result, "B")


def _workloads(result: StudyFile) -> tuple[float, float]:
    return result.workload_of("A").raw(), result.workload_of("B").raw()


def paired_times(result: StudyFile) -> tuple[float, float] | None:
    """Return a person's mean times with A and B [s], over trials that succeeded with both.

    A mapping with which people complete more of the hard tasks would look slow otherwise.

    Returns:
        Times with A and B; None if no trial succeeded with both.
    """
    a, b = (
        {(t.task, t.number): t.seconds for t in result.trials_of(label) if t.is_success}
        for label in LABELS
    )
    if not (both := sorted(a.keys() & b.keys())):
        return None
    return _mean([a[key] for key in both]), _mean([b[key] for key in both])


MEASURES = (
    Measure("success, share of trials", -1.0, 1.0, False, _shares),
    Measure("time, successful with both [s]", -math.inf, math.inf, True, paired_times),
    Measure("drops per trial", -math.inf, math.inf, False, _drops),
    Measure("workload, 0 to 100", -100.0, 100.0, True, _workloads),
)
"""What is compared by person."""


def analyse(pool: Pool) -> StudyResult:
    """Return what a study shows.

    Args:
        pool: Results of at least one person.
    """
    results = pool.results
    firsts = Counter(result.order[0] for result in results)
    return StudyResult(
        people=len(results),
        trials=sum(len(result.trials) for result in results),
        orders={f"{label} first": firsts[label] for label in LABELS},
        hands=_counts([result.hand for result in results]),
        inputs=_counts([result.input for result in results]),
        libraries=_counts([result.library for result in results]),
        mappings=(_mapping_result(results, "A"), _mapping_result(results, "B")),
        differences=[_difference(results, measure) for measure in MEASURES],
        order_effects=[_order_effect(results, measure) for measure in MEASURES],
        preference=_preference(results),
        notes=_notes(results),
        skipped=pool.skipped,
    )


def _counts(values: Sequence[str]) -> dict[str, int]:
    return dict(sorted(Counter(values).items()))


def _rate(successes: int, count: int) -> Interval:
    return Interval(*map(float, success_rate(successes, count)))


def _mapping_result(results: Sequence[StudyFile], label: Label) -> MappingResult:
    trials = [trial for result in results for trial in result.trials_of(label)]
    successes = sum(trial.is_success for trial in trials)
    answers = [result.workload_of(label) for result in results]
    scales = [answer.scales() for answer in answers]
    mapping = results[0].mappings.of(label)
    return MappingResult(
        label=label,
        name=mapping.name,
        kind=mapping.kind,
        trials=len(trials),
        successes=successes,
        success=_rate(successes, len(trials)),
        success_by_person=mean_interval(
            [success_share(result, label) for result in results], 0.0, 1.0
        ),
        seconds=median_interval([times_of(result, label) for result in results]),
        drops=mean_interval(
            [drops_per_trial(result, label) for result in results], 0.0, math.inf
        ),
        workload=mean_interval([answer.raw() for answer in answers], 0.0, 100.0),
        scales={name: _mean([one[name] for one in scales]) for name in scales[0]},
    )


def differences_of(
    results: Sequence[StudyFile], measure: Measure
) -> tuple[list[float], list[bool]]:
    """Return B minus A of each person who has a measure, and whether they began with A."""
    differences, is_a_first = [], []
    for result in results:
        if values := measure.values(result):
            differences.append(values[1] - values[0])
            is_a_first.append(result.order[0] == "A")
    return differences, is_a_first


def _difference(results: Sequence[StudyFile], measure: Measure) -> Difference:
    differences, _ = differences_of(results, measure)
    return Difference(
        measure.name,
        len(differences),
        mean_interval(differences, measure.low, measure.high),
        sign_flip_p(differences) if differences else None,
        wilcoxon_p(differences) if differences and measure.has_wilcoxon else None,
    )


def _order_effect(results: Sequence[StudyFile], measure: Measure) -> Difference:
    differences, is_a_first = differences_of(results, measure)
    return Difference(
        measure.name,
        len(differences),
        order_effect(differences, is_a_first),
        order_effect_p(differences, is_a_first),
    )


def _preference(results: Sequence[StudyFile]) -> Preference:
    counts = Counter(result.preference for result in results)
    a, b, none = counts["A"], counts["B"], counts["none"]
    shares = {
        name: _rate(count, len(results))
        for name, count in (("A", a), ("B", b), ("none", none))
    }
    return Preference(a, b, none, shares, sign_test_p(a, b))


def _notes(results: Sequence[StudyFile]) -> list[str]:
    """Return reasons for caution, in the order of their weight."""
    notes = []
    people = len(results)
    if people < FEW:
        notes.append(
            f"{people} people are too few to tell: only large differences would show, and a "
            f"missing difference means nothing. Take at least {FEW}"
        )
    firsts = Counter(result.order[0] for result in results)
    if people > 1 and min(firsts["A"], firsts["B"]) < _LEAST_SHARE * people:
        notes.append(
            f"the order is unbalanced: {firsts['A']} began with A and {firsts['B']} with B. "
            "Practice may look like a difference between the mappings"
        )
    if len({frozenset((t.task, t.number) for t in r.trials) for r in results}) > 1:
        notes.append("people did different trials")
    for what, values in (
        ("robot hands", [result.hand for result in results]),
        ("inputs", [result.input for result in results]),
        ("versions of handmap_qp", [result.library for result in results]),
    ):
        counts = _counts(values)
        if len(counts) > 1:
            text = ", ".join(f"{value} ({count})" for value, count in counts.items())
            notes.append(f"people used different {what}: {text}")
    if missing := sum(paired_times(result) is None for result in results):
        notes.append(
            f"{missing} of {people} people completed no trial with both mappings: their times "
            "are not compared"
        )
    return notes
