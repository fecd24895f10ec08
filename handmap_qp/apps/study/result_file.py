"""The file that a participant of a user study hands in: its format, version 1.

A page in the browser writes one file for each person. `result_file.json` is the JSON Schema of
these types, for tests of that page; `handmap study --schema` prints it. The types check each value
by itself. `read_result` also rejects files whose values contradict each other.
"""

import json
from collections import Counter
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from handmap_core.errors import InvalidInputError, reason_of

FORMAT = "handmap study"
VERSION = 1
SCHEMA = Path(__file__).with_name("result_file.json")
"""JSON Schema of the format: `handmap study --schema`."""
_LARGEST = 10_000_000
"""Size above which a file is not read [bytes]. A thousand trials take 150 kB."""
_SLACK = 1.0
"""Time by which a trial may exceed its limit [s]: a browser's timer is late under load."""

Label = Literal["A", "B"]
"""One of the two mappings of a study."""
LABELS: tuple[Label, Label] = ("A", "B")
Text = Annotated[
    str, Meta(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f-\x9f]+$")
]
"""Text that can be printed on one line."""
Scale = Annotated[float, Meta(ge=0.0, le=100.0)]
"""Answer to a question of NASA-TLX, from 0 to 100."""
Count = Annotated[int, Meta(ge=0, le=1_000_000)]


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the types: a key that is not in the format is an error."""


class StudiedMapping(_Part, frozen=True):
    """One of the two mappings.

    Attributes:
        name: Preset or method, as `handmap score` names it, or a description.
        kind: Whether the mapping ran in front of the person, or recorded motion of it was shown.
    """

    name: Text
    kind: Literal["live", "recorded"] = "live"


class StudiedMappings(_Part, frozen=True):
    """The two mappings, under the labels that the rest of the file uses.

    The labels are the same in all files of a study. The person does not see them.
    """

    A: StudiedMapping
    B: StudiedMapping

    def of(self, label: Label) -> StudiedMapping:
        """Return the mapping with a label."""
        return self.A if label == "A" else self.B


class Trial(_Part, frozen=True):
    """One attempt at a task.

    Attributes:
        mapping: Label of the mapping.
        task: What the person was asked to do.
        number: Counts the trials of this task with this mapping, from 0.
        limit: Time after which a trial ends without success [s].
        seconds: Duration [s], at most `limit`; a second more is tolerated.
        is_success: Whether the task was completed.
        drops: How often the object was lost.
    """

    mapping: Label
    task: Text
    number: Count
    limit: Annotated[float, Meta(gt=0.0, le=86400.0)]
    seconds: Annotated[float, Meta(ge=0.0)]
    is_success: bool
    drops: Count


class Workload(_Part, frozen=True):
    """The six questions of NASA-TLX about one mapping, each from 0 (low) to 100 (high).

    Their unweighted mean is the "Raw TLX" (Hart, 2006).

    Attributes:
        mapping: Label of the mapping.
        mental: Mental demand.
        physical: Physical demand.
        temporal: Temporal demand.
        performance: 0 is perfect, 100 is failure.
        effort: Effort.
        frustration: Frustration.
    """

    mapping: Label
    mental: Scale
    physical: Scale
    temporal: Scale
    performance: Scale
    effort: Scale
    frustration: Scale

    def scales(self) -> dict[str, float]:
        """Return the six answers by their names."""
        answers = msgspec.structs.asdict(self)
        del answers["mapping"]
        return answers

    def raw(self) -> float:
        """Return the Raw TLX, from 0 to 100."""
        answers = self.scales().values()
        return sum(answers) / len(answers)


class StudyFile(_Part, frozen=True):
    """What one person did and answered.

    Attributes:
        format: Name of the format.
        version: Version of the format.
        participant: Random text that identifies the person in this study only.
        started: Time of the start, with its time zone.
        consent: Whether the person agreed to take part. Files without consent are rejected.
        library: Version of handmap_qp.
        hand: Name of the robot hand.
        input: How the person's hand reached the page.
        mappings: The two mappings.
        order: Labels in the order in which the person used the mappings.
        trials: All trials: the same tasks, with the same numbers and limits, with both mappings.
        workload: Answers about both mappings.
        preference: The mapping that the person prefers.
    """

    format: Literal["handmap study"]
    version: Literal[1]
    participant: Text
    started: Annotated[datetime, Meta(tz=True)]
    consent: bool
    library: Text
    hand: Text
    input: Literal["drag", "recording", "webcam", "headset"]
    mappings: StudiedMappings
    order: tuple[Label, Label]
    trials: Annotated[list[Trial], Meta(min_length=2, max_length=10_000)]
    workload: Annotated[list[Workload], Meta(min_length=2, max_length=2)]
    preference: Literal["A", "B", "none"]

    def trials_of(self, label: Label) -> list[Trial]:
        """Return the trials with one mapping."""
        return [trial for trial in self.trials if trial.mapping == label]

    def workload_of(self, label: Label) -> Workload:
        """Return the answers about one mapping."""
        return next(answer for answer in self.workload if answer.mapping == label)


class _Header(msgspec.Struct):
    """The keys by which a file says what it is."""

    format: Any = None
    version: Any = None


def schema_text() -> str:
    """Return the JSON Schema of the format as text."""
    return json.dumps(msgspec.json.schema(StudyFile), indent=1) + "\n"


def read_result(path: Path) -> StudyFile:
    """Read the file of one person.

    Args:
        path: The file.

    Raises:
        InvalidInputError: If it cannot be read, is no result of a study, has another version, lacks
            the person's consent, or contradicts itself; `argument` is then the file.
    """
    content = _read_bytes(path)
    try:
        header = msgspec.json.decode(content, type=_Header)
    except (ValueError, RecursionError) as error:
        problem = f"is no JSON object: {reason_of(error)}"
        raise InvalidInputError(problem, argument=str(path)) from error
    if header.format != FORMAT:
        problem = f"is no result of a study: format is not {FORMAT!r}"
        raise InvalidInputError(problem, argument=str(path))
    if isinstance(header.version, bool) or header.version != VERSION:
        problem = f"expected version {VERSION} of the format"
        advice = "a newer handmap reads newer versions"
        raise InvalidInputError(
            problem, argument=str(path), value=header.version, advice=advice
        )
    try:
        result = msgspec.json.decode(content, type=StudyFile)
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(reason_of(error), argument=str(path)) from error
    if problem := _contradiction(result):
        raise InvalidInputError(problem, argument=str(path))
    return result


def _read_bytes(path: Path) -> bytes:
    """Return the content of a file that is not too large for a result."""
    try:
        # One byte more than allowed shows that there is more.
        with path.open("rb") as stream:
            content = stream.read(_LARGEST + 1)
    except OSError as error:
        problem = f"cannot be read: {reason_of(error)}"
        raise InvalidInputError(problem, argument=str(path)) from error
    if len(content) > _LARGEST:
        problem = f"is larger than {_LARGEST // 1_000_000} MB: no result of a study is"
        raise InvalidInputError(problem, argument=str(path))
    return content


def _contradiction(result: StudyFile) -> str:
    """Return what is wrong with values that are right by themselves; empty if nothing is."""
    if not result.consent:
        return "consent is false: this person did not agree to take part"
    if result.order[0] == result.order[1]:
        return f"order has mapping {result.order[0]} twice"
    answered = [answer.mapping for answer in result.workload]
    if answered[0] == answered[1]:
        return f"workload has mapping {answered[0]} twice, and lacks the other one"
    return _contradiction_of_trials(result)


def _contradiction_of_trials(result: StudyFile) -> str:
    """Return what is wrong with the trials of a person; empty if nothing is."""
    for i, trial in enumerate(result.trials):
        if trial.seconds > trial.limit + _SLACK:
            took = f"{trial.seconds:g} s, longer than its limit of {trial.limit:g} s"
            return f"trials[{i}].seconds: trial took {took}"
    counts = Counter((t.mapping, t.task, t.number) for t in result.trials)
    for (label, task, number), count in counts.items():
        if count > 1:
            return (
                f"trials: number {number} of {task!r} with {label} occurs {count} times"
            )
    a, b = (
        {(t.task, t.number): t.limit for t in result.trials_of(label)}
        for label in LABELS
    )
    for task, number in sorted(a.keys() ^ b.keys()):
        has, lacks = LABELS if (task, number) in a else reversed(LABELS)
        what = f"number {number} of {task!r}"
        return f"trials: {what} was done with {has} and not with {lacks}"
    for key in sorted(a):
        if a[key] != b[key]:
            limits = f"{a[key]:g} s with A and {b[key]:g} s with B"
            return f"trials: the limit of {key[0]!r} is {limits}"
    return ""
