"""Results of many people as one study: the same two mappings, and each person once."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from handmap_core.errors import InvalidInputError, expect
from .result_file import StudyFile, read_result

_ADVICE = "--skip-bad leaves such files out"


class Pool(NamedTuple):
    """The results of a study.

    Attributes:
        results: One for each person, sorted by `participant`, so that the order of the files has no
            effect.
        skipped: Why files were left out, one line for each.
    """

    results: list[StudyFile]
    skipped: list[str]


class _Read(NamedTuple):
    path: Path
    result: StudyFile


def read_pool(paths: Sequence[Path], *, skip_bad: bool = False) -> Pool:
    """Read the files of a study.

    Args:
        paths: One file for each person.
        skip_bad: Leave out files that cannot be used, in place of an error. Results of one person
            that differ are all left out, because nothing says which one counts.

    Raises:
        InvalidInputError: If there is no file, if the files are of several studies, or if a file
            cannot be used and `skip_bad` is false. The text names the first such file.
    """
    expect(paths, "FILE", "at least one result of a study", got="none")
    read, problems = [], []
    for path in paths:
        try:
            read.append(_Read(path, read_result(path)))
        except InvalidInputError as error:
            problems.append(error)
    kept, repeated = _without_repeated(read)
    problems += repeated
    if problems and not skip_bad:
        raise _with_count(problems, len(paths))
    if not kept:
        raise InvalidInputError(
            f"none of {len(paths)} files can be used, the first because of: {problems[0]}",
            argument="FILE",
        )
    _reject_mixture(kept)
    results = sorted((one.result for one in kept), key=lambda r: r.participant)
    return Pool(results, [str(problem) for problem in problems])


def _with_count(problems: list[InvalidInputError], count: int) -> InvalidInputError:
    """Return the first problem, and how many more there are."""
    first, number = problems[0], len(problems)
    advice = _ADVICE
    if number > 1:
        advice = f"{number} of {count} files cannot be used, {_ADVICE}"
    both = f"{first.advice}; {advice}" if first.advice else advice
    return replace(first, advice=both)


def _without_repeated(
    read: Sequence[_Read],
) -> tuple[list[_Read], list[InvalidInputError]]:
    """Return the files of people who have one result, and what is wrong with the others.

    Of files with the same content one is kept.
    """
    by_person: dict[str, list[_Read]] = defaultdict(list)
    for one in read:
        by_person[one.result.participant].append(one)
    kept, problems = [], []
    for person, those in by_person.items():
        first, *others = those
        is_same = all(other.result == first.result for other in others)
        if is_same:
            kept.append(first)
        for other in others if is_same else those:
            partner = first if is_same or other is not first else others[0]
            text = "the same" if is_same else "a different"
            problems.append(
                InvalidInputError(
                    f"participant {person!r} has {text} result in {partner.path}",
                    argument=str(other.path),
                )
            )
    return kept, problems


def _reject_mixture(read: Sequence[_Read]) -> None:
    """Reject files whose mappings differ: which study is meant, only the user knows.

    Raises:
        InvalidInputError: If they differ. The text names a file of the rarer study.
    """
    studies = Counter(one.result.mappings for one in read)
    if len(studies) == 1:
        return

    def text(one: _Read) -> str:
        a, b = one.result.mappings.A, one.result.mappings.B
        return f"A {a.name!r} ({a.kind}) and B {b.name!r} ({b.kind})"

    ranked = sorted(read, key=lambda one: (-studies[one.result.mappings], text(one)))
    usual, other = ranked[0], ranked[-1]
    raise InvalidInputError(
        f"compares {text(other)}, but {usual.path} compares {text(usual)}",
        argument=str(other.path),
        advice="pool each study by itself",
    )
