"""The page of symptoms has every status, rule, flag, code and line of the motors, and no other."""

from __future__ import annotations

import ast
import inspect
import re
import runpy
import textwrap
from pathlib import Path

import pytest

from handmap_core.human.sample import RULES
from handmap_core.ik import IkOptions
from handmap_core.stream import following
from handmap_core.stream.step_table import STATUS_NAMES
from handmap_qp.apps.service.opening import CALIBRATION_SAMPLES
from handmap_qp.apps.service.safety import SessionState
from handmap_qp.client.messages import PROTOCOL, Open

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
MESSAGES = runpy.run_path(str(ROOT / "docs" / "messages.py"))


def rows_of(section: str) -> list[list[str]]:
    """Return the cells of the rows of a section's table, without its head."""
    (text,) = re.findall(
        rf"^## {section}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE
    )
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [
        [cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[2:]
    ]


def statuses() -> set[str]:
    """Return every value of `status`: of a step, and of what a session does."""
    marks = {mark for one in MESSAGES["STOPPING"] for mark in one.marks + one.modes}
    modes = {state.mode for state in SessionState}
    return {*STATUS_NAMES} | marks | modes


WORDS = {
    "Statuses": statuses(),
    "Rules of the guard": {*RULES},
    "Flags of a command": {*MESSAGES["FLAGS"]},
    "Codes of an error": {*MESSAGES["CODES"]},
}


@pytest.mark.parametrize("section", WORDS)
def test_a_table_has_all_words_of_the_code_and_no_other(section: str) -> None:
    first = [row[0].strip("`") for row in rows_of(section)]
    assert sorted(first) == sorted(WORDS[section])


LIMITS = {
    "converged": 1e3 * IkOptions().point_tolerance,
    "unsettled": IkOptions().max_iterations,
    "hold": Open(protocol=PROTOCOL, seq=1, robot="three_finger").watchdog,
    "not_following": 1e3 * following._SILENCE,
    "calibrating": CALIBRATION_SAMPLES,
}
"""The number in the row of a status, in the row's unit."""


@pytest.mark.parametrize("status", LIMITS)
def test_a_status_states_the_limit_of_the_code(status: str) -> None:
    (row,) = (row for row in rows_of("Statuses") if row[0] == f"`{status}`")
    (number,) = re.findall(r"\d+(?:\.\d+)?", " ".join(row[1:]))
    assert float(number) == pytest.approx(LIMITS[status])


def test_statuses_have_all_links() -> None:
    rows = {row[0].strip("`"): " ".join(row[1:]) for row in rows_of("Statuses")}
    for status, links in MESSAGES["LINKS"].items():
        for phrase, target in links.items():
            assert f"[{phrase}]({target})" in rows[status]


def test_every_row_says_why_and_what_to_do() -> None:
    sections = re.findall(r"^## (.+)$", PAGE, re.MULTILINE)
    rows = [row for section in sections for row in rows_of(section)]
    assert len(rows) > 100
    for row in rows:
        assert len(row) == 3, row
        assert all(row), row


def test_every_line_of_the_motors_is_in_the_table() -> None:
    drive = pytest.importorskip("handmap_drive.drive")
    tree = ast.parse(textwrap.dedent(inspect.getsource(drive.Loop._find_problem)))
    (reasons,) = (node for node in ast.walk(tree) if isinstance(node, ast.Dict))
    first = {row[0].strip("`") for row in rows_of("Motors")}
    for key in reasons.keys:
        assert isinstance(key, ast.Constant | ast.JoinedStr)
        text = key if isinstance(key, ast.Constant) else key.values[0]
        assert isinstance(text, ast.Constant)
        assert str(text.value).strip(" :") in first


def test_flags_that_the_code_gives_are_described() -> None:
    sources = [
        *(ROOT / "handmap_qp" / "apps" / "service").glob("*.py"),
        ROOT / "handmap_qp" / "stream" / "held_object.py",
    ]
    given = set()
    for source in sources:
        text = source.read_text(encoding="utf-8")
        lines = [line for line in text.splitlines() if re.search(r"\bflags\b", line)]
        given |= {*re.findall(r'"(\w+)"', "\n".join(lines))}
    assert "off_object" in given
    assert given <= {*MESSAGES["FLAGS"], "flags"}
