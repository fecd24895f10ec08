"""The order of two mappings by people, beside that by simulated operators and by the score."""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from handmap_core.errors import InvalidInputError, did_you_mean, reason_of
from .analysis import MEASURES, StudyResult
from .statistics import LEVEL, sign_test_p

_SUCCESS, _TIME, _, _WORKLOAD = (measure.name for measure in MEASURES)


class Verdict(msgspec.Struct, frozen=True):
    """How one judge orders the two mappings.

    Attributes:
        judge: `people`, `simulated operators` or `score`.
        scope: What it judged: a measure, or task, hand and operator.
        a: Its value for A; None if there is none.
        b: Its value for B, likewise.
        better: `A`, `B` or `none`.
        apart: Whether the difference is more than chance (5 %); None if the judge does not say.
        same_as_people: Whether the success of people has the same order; None if either has none.
    """

    judge: str
    scope: str
    a: float | None
    b: float | None
    better: str
    apart: bool | None
    same_as_people: bool | None = None


class _Attempt(msgspec.Struct, frozen=True):
    """An attempt of a simulated operator."""

    task: str
    hand: str
    operator: str
    mapping: str
    seed: int
    success: bool


class _Tasks(msgspec.Struct, frozen=True):
    """What `handmap score --tasks --json` prints."""

    attempts: list[_Attempt]


class _Scores(msgspec.Struct, frozen=True):
    """What `handmap score --json` prints; a row for each mapping."""

    overview: list[dict[str, str | float | None]]


def compare_orders(
    result: StudyResult, simulated: Path | None, score: Path | None
) -> list[Verdict]:
    """Return the order of the mappings by each judge, people first.

    Args:
        result: The study.
        simulated: File of `handmap score --tasks --json`; left out if None.
        score: File of `handmap score --json`, likewise.

    Raises:
        InvalidInputError: If a file cannot be used, or has not both mappings by their names.
    """
    people = _verdicts_of_people(result)
    others = _verdicts_of_operators(result, simulated) if simulated else []
    others += _verdicts_of_score(result, score) if score else []
    reference = people[0].better
    return people + [
        msgspec.structs.replace(
            one,
            same_as_people=None
            if "none" in (reference, one.better)
            else one.better == reference,
        )
        for one in others
    ]


def _better(a: float | None, b: float | None, *, is_less_better: bool = False) -> str:
    if a is None or b is None or a == b:
        return "none"
    return "A" if (a < b) == is_less_better else "B"


def _verdicts_of_people(result: StudyResult) -> list[Verdict]:
    a, b = result.mappings
    p = {difference.measure: difference.p for difference in result.differences}

    def verdict(
        name: str, scope: str, one: float | None, other: float | None, *, less: bool
    ) -> Verdict:
        chance = p[name]
        apart = None if chance is None else chance < 1.0 - LEVEL
        better = _better(one, other, is_less_better=less)
        return Verdict("people", scope, one, other, better, apart)

    liked = result.preference
    like_a, like_b = liked.shares["A"].value, liked.shares["B"].value
    return [
        verdict(
            _SUCCESS,
            "success, share of trials",
            a.success_by_person.value,
            b.success_by_person.value,
            less=False,
        ),
        Verdict(
            "people",
            "preference, share of people",
            like_a,
            like_b,
            _better(like_a, like_b),
            liked.p < 1.0 - LEVEL,
        ),
        verdict(_TIME, "median time [s]", a.seconds.value, b.seconds.value, less=True),
        verdict(
            _WORKLOAD,
            "workload, 0 to 100",
            a.workload.value,
            b.workload.value,
            less=True,
        ),
    ]


def _read_bytes(path: Path, option: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        problem = f"{path}: cannot be read: {reason_of(error)}"
        raise InvalidInputError(problem, argument=option) from error


def _check_mappings(
    names: Sequence[str], known: Sequence[str], path: Path, option: str
) -> None:
    """Reject a file that lacks one of the mappings."""
    known = sorted(set(known))
    for name in names:
        if name not in known:
            raise InvalidInputError(
                f"{path} has no mapping {name!r}",
                argument=option,
                advice=did_you_mean(name, known) or f"it has {', '.join(known)}",
            )


def _verdicts_of_operators(result: StudyResult, path: Path) -> list[Verdict]:
    """Return a verdict for each task, hand and operator that has attempts by both mappings."""
    option = "--simulated"
    try:
        tasks = msgspec.json.decode(_read_bytes(path, option), type=_Tasks)
    except (ValueError, RecursionError) as error:
        problem = f"{path}: is no result of tasks: {reason_of(error)}"
        advice = "handmap score --tasks --json prints one"
        raise InvalidInputError(problem, argument=option, advice=advice) from error
    names = [mapping.name for mapping in result.mappings]
    _check_mappings(names, [one.mapping for one in tasks.attempts], path, option)
    cells: dict[tuple[str, str, str], dict[str, dict[int, bool]]] = {}
    for one in tasks.attempts:
        cell = cells.setdefault((one.task, one.hand, one.operator), {})
        cell.setdefault(one.mapping, {})[one.seed] = one.success
    verdicts = []
    for place, by_mapping in cells.items():
        a, b = (by_mapping.get(name, {}) for name in names)
        # Both mappings get the same scenes, unless a run was stopped.
        if not (both := sorted(a.keys() & b.keys())):
            continue
        only_a = sum(a[seed] and not b[seed] for seed in both)
        only_b = sum(b[seed] and not a[seed] for seed in both)
        share_a = sum(a[seed] for seed in both) / len(both)
        share_b = sum(b[seed] for seed in both) / len(both)
        # McNemar's exact test is a sign test over the scenes in which one mapping alone succeeds.
        is_apart = sign_test_p(only_a, only_b) < 1.0 - LEVEL
        better = _better(share_a, share_b)
        scope = ", ".join(place)
        verdicts.append(
            Verdict("simulated operators", scope, share_a, share_b, better, is_apart)
        )
    return verdicts


def _verdicts_of_score(result: StudyResult, path: Path) -> list[Verdict]:
    """Return the verdict over all hands of the score, then that on each hand of the study."""
    option = "--score"
    try:
        scores = msgspec.json.decode(_read_bytes(path, option), type=_Scores)
    except (ValueError, RecursionError) as error:
        problem = f"{path}: is no score: {reason_of(error)}"
        advice = "handmap score --json prints one"
        raise InvalidInputError(problem, argument=option, advice=advice) from error
    rows = {str(row.get("mapping", "")): row for row in scores.overview}
    names = [mapping.name for mapping in result.mappings]
    _check_mappings(names, list(rows), path, option)
    verdicts = []
    for key in ("score", *result.hands):
        a, b = (_number(rows[name].get(key)) for name in names)
        if a is None or b is None:
            continue
        # Places are of the score over all hands.
        places = [rows[name].get("place") for name in names]
        is_apart = places[0] != places[1] if key == "score" else None
        scope = "all hands" if key == "score" else key
        verdicts.append(Verdict("score", scope, a, b, _better(a, b), is_apart))
    return verdicts


def _number(value: str | float | None) -> float | None:
    return float(value) if isinstance(value, int | float) else None
