"""Files of participants: what is read, and one clear message for each mistake."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from study_cases import plain_result, write_results

from handmap_qp.apps.study.result_file import (
    SCHEMA,
    StudyFile,
    read_result,
    schema_text,
)
from handmap_qp.cli import main
from handmap_qp.errors import InvalidInputError

Change = Callable[[dict[str, Any]], object]


def test_the_schema_is_that_of_the_types() -> None:
    text = SCHEMA.read_text(encoding="utf-8")
    assert text == schema_text(), "write what `handmap study --schema` prints to it"


def test_the_schema_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "--schema"]) == 0
    assert capsys.readouterr().out == schema_text()


def test_a_result_is_read_as_it_was_written(tmp_path: Path) -> None:
    person = plain_result()
    (file,) = write_results(tmp_path, [person])
    result = read_result(Path(file))
    # A mapping without a kind is live.
    person["mappings"]["A"]["kind"] = "live"
    assert msgspec.to_builtins(result) == person | {"order": ("B", "A")}


def test_every_key_but_the_kind_is_needed(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    for where, keys in (
        ((), tuple(plain_result())),
        (("mappings",), ("A", "B")),
        (("mappings", "A"), ("name",)),
        (("trials", 0), tuple(plain_result()["trials"][0])),
        (("workload", 1), tuple(plain_result()["workload"][0])),
    ):
        for key in keys:
            person = plain_result()
            place: Any = person
            for step in where:
                place = place[step]
            del place[key]
            file.write_text(json.dumps(person), encoding="utf-8")
            with pytest.raises(InvalidInputError) as caught:
                read_result(file)
            assert caught.value.argument == str(file)
            assert key in str(caught.value)


def _set(*where: Any, to: Any) -> Change:
    def change(person: dict[str, Any]) -> None:
        place: Any = person
        for step in where[:-1]:
            place = place[step]
        place[where[-1]] = to

    return change


def _trial(key: str, to: Any) -> Change:
    return _set("trials", 1, key, to=to)


def _all_trials_of_b(person: dict[str, Any]) -> None:
    person["trials"] = [t for t in person["trials"] if t["mapping"] == "B"]


BAD: dict[str, tuple[Change, str]] = {
    "other format": (
        _set("format", to="handmap vote"),
        "format is not 'handmap study'",
    ),
    "newer version": (_set("version", to=2), "expected version 1"),
    "version as text": (_set("version", to="1"), "expected version 1"),
    "version true": (_set("version", to=True), "expected version 1"),
    "no name of a person": (_set("participant", to=""), "$.participant"),
    "number as person": (_set("participant", to=7), "$.participant"),
    "line break in a person": (_set("participant", to="a\nb"), "$.participant"),
    "escape in a name": (_set("mappings", "A", "name", to="\x1b[2J"), "$.mappings.A"),
    "no time": (_set("started", to="yesterday"), "$.started"),
    "no time zone": (_set("started", to="2026-12-01T10:00:00"), "$.started"),
    "no consent": (_set("consent", to=False), "consent is false"),
    "consent as text": (_set("consent", to="yes"), "$.consent"),
    "library": (_set("library", to=None), "$.library"),
    "hand": (_set("hand", to=["a"]), "$.hand"),
    "input": (_set("input", to="mouse"), "$.input"),
    "mapping C": (_set("mappings", "C", to={"name": "x"}), "unknown field `C`"),
    "kind": (_set("mappings", "B", "kind", to="film"), "$.mappings.B.kind"),
    "unknown key": (_set("age", to=33), "unknown field `age`"),
    "order of one": (_set("order", to=["A"]), "$.order"),
    "order twice": (_set("order", to=["A", "A"]), "order has mapping A twice"),
    "order of others": (_set("order", to=["A", "C"]), "$.order"),
    "no trials": (_set("trials", to=[]), "$.trials"),
    "trials as object": (_set("trials", to={}), "$.trials"),
    "trial of another": (_trial("mapping", "C"), "$.trials[1].mapping"),
    "task": (_trial("task", ""), "$.trials[1].task"),
    "number below 0": (_trial("number", -1), "$.trials[1].number"),
    "number 0.5": (_trial("number", 0.5), "$.trials[1].number"),
    "limit 0": (_trial("limit", 0.0), "$.trials[1].limit"),
    "negative time": (_trial("seconds", -0.1), "$.trials[1].seconds"),
    "time as text": (_trial("seconds", "12"), "$.trials[1].seconds"),
    "time beyond its limit": (_trial("seconds", 61.5), "longer than its limit of 60 s"),
    "success as number": (_trial("is_success", 1), "$.trials[1].is_success"),
    "half a drop": (_trial("drops", 0.5), "$.trials[1].drops"),
    "drops below 0": (_trial("drops", -1), "$.trials[1].drops"),
    "trial twice": (_trial("number", 0), "with B occurs 2 times"),
    "trial without partner": (_trial("number", 5), "with A and not with B"),
    "one mapping untried": (_all_trials_of_b, "done with B and not with A"),
    "other limit": (_trial("limit", 30.0), "60 s with A and 30 s with B"),
    "one workload": (lambda p: p["workload"].pop(), "$.workload"),
    "workload twice": (
        _set("workload", 0, "mapping", to="A"),
        "workload has mapping A",
    ),
    "workload above": (_set("workload", 0, "effort", to=101), "$.workload[0].effort"),
    "workload below": (_set("workload", 1, "mental", to=-1), "$.workload[1].mental"),
    "preference": (_set("preference", to="both"), "$.preference"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_mistake_in_a_file_is_one_line_that_names_it(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, text = BAD[name]
    person = plain_result()
    change(person)
    (file,) = write_results(tmp_path, [person])
    assert main(["study", file]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert printed.err.startswith(f"handmap: {file}: ")
    assert text in printed.err
    assert printed.err.endswith(": --skip-bad leaves such files out\n") or (
        "; --skip-bad" in printed.err
    )


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 100_000, b'{"version": 1}'],
)
def test_damaged_files_are_one_line(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "damaged.json"
    file.write_bytes(content)
    assert main(["study", str(file)]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"handmap: {file}: is no ")
    assert printed.err.count("\n") == 1


def test_a_result_that_is_cut_anywhere_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "cut.json"
    content = json.dumps(plain_result()).encode()
    for size in range(0, len(content), 37):
        file.write_bytes(content[:size])
        with pytest.raises(InvalidInputError, match="is no JSON object"):
            read_result(file)


def test_missing_folders_and_large_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="cannot be read: No such file"):
        read_result(tmp_path / "none.json")
    with pytest.raises(InvalidInputError, match="cannot be read: Is a directory"):
        read_result(tmp_path)
    large = tmp_path / "large.json"
    with large.open("wb") as stream:
        stream.truncate(11_000_000)
    with pytest.raises(InvalidInputError, match="is larger than 10 MB"):
        read_result(large)


def test_a_timer_may_be_late_by_a_second(tmp_path: Path) -> None:
    person = plain_result()
    person["trials"][0] |= {"seconds": 60.9, "is_success": False}
    (file,) = write_results(tmp_path, [person])
    assert read_result(Path(file)).trials[0].seconds == 60.9


def test_types_take_what_the_example_of_the_page_has() -> None:
    page = Path(__file__).parents[2] / "docs" / "study.md"
    text = page.read_text(encoding="utf-8")
    (example,) = (part.partition("```")[0] for part in text.split("```json\n")[1:])
    one = msgspec.json.decode(example.encode(), type=StudyFile)
    assert {trial.mapping for trial in one.trials} == {"A", "B"}
    assert copy.deepcopy(one) == one
