"""Examples, commands, files and names in the README exist and work."""

import re
import shlex
from contextlib import nullcontext
from pathlib import Path

import pytest
from service_tools import address_of, serving

import handmap_qp
from handmap_qp import cli

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("block", re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL))
def test_python_examples_run(block: str, capsys: pytest.CaptureFixture[str]) -> None:
    needs_server = "Client()" in block
    with serving() if needs_server else nullcontext() as server:
        code = (
            block
            if server is None
            else block.replace("Client()", f"Client({address_of(server)!r})")
        )
        exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out


@pytest.mark.parametrize(
    "line", re.findall(r"^    handmap (.*?)(?:  #.*)?$", README, flags=re.MULTILINE)
)
def test_commands_are_understood(line: str) -> None:
    assert cli.parse(shlex.split(line))


@pytest.mark.parametrize("target", re.findall(r"^    make (\w+)", README, flags=re.MULTILINE))
def test_make_targets_exist(target: str) -> None:
    assert f"\n{target}:" in (ROOT / "Makefile").read_text(encoding="utf-8")


def test_files_and_names_in_the_table_exist() -> None:
    rows = [row for row in README.splitlines() if row.startswith("| ") and ".py`" in row]
    assert len(rows) >= 8
    for row in rows:
        path = next(name for name in re.findall(r"`([\w/]+\.py)`", row))
        source = (ROOT / "handmap_qp" / path.removeprefix("handmap_qp/")).read_text(
            encoding="utf-8"
        )
        for name in re.findall(r"`([A-Za-z_.]+)`", row.split("|")[2]):
            if not name.endswith(".py"):
                assert f" {name.rpartition('.')[2]}(" in source or f"class {name}" in source, row


@pytest.mark.parametrize("picture", re.findall(r"!\[.*?\]\((.*?)\)", README))
def test_pictures_exist(picture: str) -> None:
    assert (ROOT / picture).is_file()


def test_public_names_exist() -> None:
    for name in handmap_qp.__all__:
        assert hasattr(handmap_qp, name)
