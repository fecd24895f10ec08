"""Targets and links in the README exist, and its table of equations, which is in the theory.

`test_front_door.py` runs its code and commands.
"""

import re
import runpy
from pathlib import Path

import pytest

import handmap_qp

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "target", re.findall(r"^    make (\w+)", README, flags=re.MULTILINE)
)
def test_make_targets_exist(target: str) -> None:
    assert f"\n{target}:" in (ROOT / "Makefile").read_text(encoding="utf-8")


def test_files_and_names_in_the_table_exist() -> None:
    theory = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
    rows = [
        row for row in theory.splitlines() if row.startswith("| ") and ".py`" in row
    ]
    assert len(rows) >= 8
    for row in rows:
        source = "".join(source_of(path) for path in re.findall(r"`([\w/]+\.py)`", row))
        for name in re.findall(r"`([A-Za-z_.]+)`", row.split("|")[2]):
            if not name.endswith(".py"):
                assert (
                    f" {name.rpartition('.')[2]}(" in source
                    or f"class {name}" in source
                ), row


def source_of(path: str) -> str:
    """Return a file that the table names, by its path in the package or in the tree."""
    is_outside = path.startswith(("benchmarks/", "core/", "tests/"))
    folder = ROOT if is_outside else ROOT / "handmap_qp"
    return (folder / path).read_text(encoding="utf-8")


@pytest.mark.parametrize("address", ["", "https://host/owner/name"])
def test_the_long_description_has_absolute_links(address: str) -> None:
    pytest.importorskip("hatchling")
    hook = runpy.run_path(str(ROOT / ".ci" / "metadata.py"))
    text = hook["long_description"](README, address, "v1.2.3")
    links = re.findall(r"\]\(([^)]*)\)", text)
    assert (len(links) > 5) == bool(address)
    for link in links:
        kind, tag, path = link.removeprefix(f"{address}/").split("/", 2)
        assert (kind in ("raw", "blob"), tag) == (True, "v1.2.3")
        assert (ROOT / path.partition("#")[0]).is_file()


def test_the_first_page_of_the_site_is_the_readme() -> None:
    hook = runpy.run_path(str(ROOT / "docs" / "home.py"))
    page = hook["first_page"](README)
    assert re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", page) == re.sub(
        r"\[([^\]]*)\]\([^)]*\)", r"\1", README
    )
    links = re.findall(r"\]\(([^)#]*)[^)]*\)", page)
    assert len(links) > 10
    for link in links:
        assert (ROOT / "docs" / link).is_file(), link


def test_public_names_exist() -> None:
    for name in handmap_qp.__all__:
        assert hasattr(handmap_qp, name)
