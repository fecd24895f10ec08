"""What the paths of new users type is what the pages print; `make paths` goes them for real."""

from __future__ import annotations

import re

import pytest
from paths import live_leap, own_method, own_urdf
from paths.fresh import ROOT
from paths.newcomer import code_of, is_printed

COMMANDS = own_urdf.COMMANDS | live_leap.COMMANDS | own_method.COMMANDS


@pytest.mark.parametrize("line", COMMANDS)
def test_each_command_stands_on_its_page(line: str) -> None:
    assert is_printed(line, COMMANDS[line])


def test_a_part_of_a_command_is_not_printed() -> None:
    assert not is_printed(f"{own_urdf.INIT} --root palm", "docs/own_hand.md")
    assert not is_printed("handmap hands init my_hand", "docs/own_hand.md")


def test_the_file_of_the_page_is_a_method() -> None:
    names: dict[str, object] = {}
    exec(code_of(own_method.PAGE, "mine.py"), names)
    assert callable(names["joints"])


def test_make_paths_goes_all_of_them() -> None:
    loop = re.search(
        r"for name in ([\w ]+); do", (ROOT / "Makefile").read_text("utf-8")
    )
    assert loop
    here = {file.stem for file in (ROOT / "tests" / "paths").glob("*.py")}
    parts = {"fresh", "headset", "needed", "newcomer"}
    assert {*loop[1].split()} == here - parts
