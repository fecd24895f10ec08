"""Files of many people as one study."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from study_cases import made_people, plain_result, write_results

from handmap_qp.apps.study.pool import read_pool
from handmap_qp.cli import main
from handmap_qp.errors import InvalidInputError


def _paths(files: list[str]) -> list[Path]:
    return [Path(file) for file in files]


def test_people_are_sorted_whatever_the_order_of_files(tmp_path: Path) -> None:
    files = _paths(write_results(tmp_path, made_people(6, [1])))
    pool = read_pool(files)
    assert [one.participant for one in pool.results] == [f"p{i:04}" for i in range(6)]
    assert read_pool(files[::-1]) == pool


def test_no_files_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study"]) == 2
    expected = "handmap: FILE: expected at least one result of a study, got none\n"
    assert capsys.readouterr().err == expected


def test_bad_files_stop_unless_they_may_be_skipped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    people = made_people(5, [2])
    people[1]["trials"][0]["seconds"] = -1.0
    people[3]["version"] = 2
    files = write_results(tmp_path, people)
    assert main(["study", *files]) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1
    assert printed.err.startswith(f"handmap: {files[1]}: ")
    assert "2 of 5 files cannot be used" in printed.err
    assert main(["study", *files, "--skip-bad", "--json"]) == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert result["people"] == 3
    assert [line.partition(": ")[0] for line in result["skipped"]] == [
        files[1],
        files[3],
    ]
    assert printed.err.count("left out: ") == 2


def test_only_bad_files_are_an_error_with_skip_bad_too(tmp_path: Path) -> None:
    people = [plain_result() | {"version": 3}]
    files = _paths(write_results(tmp_path, people))
    with pytest.raises(InvalidInputError, match="none of 1 files can be used"):
        read_pool(files, skip_bad=True)


def test_a_person_counts_once(tmp_path: Path) -> None:
    people = made_people(3, [3])
    files = _paths(write_results(tmp_path, [*people, people[0]]))
    with pytest.raises(InvalidInputError, match=r"'p0000' has the same result in"):
        read_pool(files)
    pool = read_pool(files, skip_bad=True)
    assert [one.participant for one in pool.results] == ["p0000", "p0001", "p0002"]
    assert len(pool.skipped) == 1
    with pytest.raises(InvalidInputError, match="the same result"):
        read_pool([files[1], files[1]])


def test_different_results_of_a_person_are_all_left_out(tmp_path: Path) -> None:
    people = made_people(3, [4])
    other = people[1] | {"preference": "none"}
    other |= {"hand": "leap_right"}
    files = _paths(write_results(tmp_path, [*people, other]))
    with pytest.raises(InvalidInputError, match=r"'p0001' has a different result in"):
        read_pool(files)
    for order in (files, files[::-1]):
        pool = read_pool(order, skip_bad=True)
        assert [one.participant for one in pool.results] == ["p0000", "p0002"]
        assert {line.partition(": ")[0] for line in pool.skipped} == {
            str(files[1]),
            str(files[3]),
        }


@pytest.mark.parametrize("skip_bad", [False, True])
def test_files_of_two_studies_are_not_pooled(tmp_path: Path, skip_bad: bool) -> None:
    people = made_people(4, [5])
    labels = people[2]["mappings"]
    people[2]["mappings"] = {"A": labels["B"], "B": labels["A"]}
    files = _paths(write_results(tmp_path, people))
    for order in (files, files[::-1]):
        with pytest.raises(InvalidInputError, match="pool each study") as caught:
            read_pool(order, skip_bad=skip_bad)
        # The rarer one is named first.
        assert str(caught.value).startswith(f"{files[2]}: compares A 'finger-vectors'")
