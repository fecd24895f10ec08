"""`.ci/house.py` counts a planted package right, and fails where a budget is exceeded."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[2] / ".ci" / "house.py"
# A circle of `high` and `low`, and one of `mapping` and `mapping.methods`.
FILES = {
    "__init__.py": '"""Left out of rooms."""\n\nfrom planted.low import load_hand\n'
    "from planted.high import HandMapper\n",
    "high.py": "from planted.low import late\nfrom planted.mapping import seam\n\n"
    "class HandMapper: ...\n",
    "low/__init__.py": "def load_hand():\n    from planted.low import late\n    late.passed()\n",
    "low/late.py": '"""Two\nlines."""\n\n# A comment.\nWAY = "fine_way"\n\n\n'
    "def passed():\n    import json, scipy\n"
    "    import scipy.linalg\n    from planted import high\n",
    "mapping/__init__.py": "",
    "mapping/seam.py": "def choose(name):\n    return name\n\n\n"
    "def is_fine(method):\n    from planted.mapping.methods import fine_way\n"
    "    return type(method) is fine_way.FineWay\n",
    "mapping/methods/fine_way.py": "from planted.mapping import seam\n\nclass FineWay:\n    pass\n",
    "mapping/methods/other_way.py": "class OtherWay:\n    pass\n",
}


@pytest.fixture(scope="module")
def house() -> ModuleType:
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("house", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def planted(tmp_path: Path) -> Path:
    """A folder with a small package, named `planted`."""
    for name, text in FILES.items():
        file = tmp_path / "planted" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    return tmp_path


def test_rows_of_the_source_are_counted(house: ModuleType, planted: Path) -> None:
    measured = house.measure_source(planted, "planted")
    assert measured["lines"] == sum(text.count("\n") for text in FILES.values())
    assert measured["top view: rooms"] == 3
    # high and low import each other, and high imports mapping; `__init__` modules do not count.
    assert measured["top view: arrows"] == 3
    assert measured["circles"] == 2
    # Its own, `seam`, which imports it, and `late`, which names it.
    assert measured["files of a method"] == 3
    # Two statements of `late` beside the heavy one, `load_hand` and `is_fine`.
    assert measured["imports inside functions"] == 4
    assert measured["functions with more than 10 paths"] == 0


def test_circles_are_of_folders_and_modules_at_the_top(
    house: ModuleType, planted: Path
) -> None:
    modules = house.read_package(planted / "planted")
    found = house.circles(house.import_arrows("planted", modules, house.folder_room))
    assert sorted(map(sorted, found)) == [
        ["high", "low"],
        ["mapping", "mapping.methods"],
    ]


def test_tokens_leave_out_comments_docstrings_and_layout(
    house: ModuleType, tmp_path: Path
) -> None:
    (tmp_path / "planted").mkdir()
    (tmp_path / "planted" / "high.py").write_text(
        '"""Not\nthis."""\n\n# Nor this.\nx = f(\n    1,\n)  # y\n\n\ndef g():\n'
        '    """Nor this."""\n    return x\n',
        encoding="utf-8",
    )
    measured = house.measure_source(tmp_path, "planted")
    # x = f ( | 1 , | ) | def g ( ) : | return x
    assert measured["tokens"] == 4 + 2 + 1 + 5 + 2
    assert measured["tokens per code line"] == pytest.approx(14 / 5)


@pytest.mark.parametrize(
    ("body", "paths"),
    [
        ("pass", 1),
        ("if a and b and c or d: pass\nelif e: pass\nelse: pass", 6),
        ("for a in b: pass\nelse: pass\nwhile c: pass", 4),
        ("try: pass\nexcept A: pass\nexcept B: pass\nelse: pass\nfinally: pass", 4),
        ("return [a if b else c for d in e for f in g if h]", 5),
        ("assert a", 2),
        ("match a:\n    case 1: pass\n    case 2: pass\n    case _: pass", 3),
        ("def inner():\n    if a: pass\nreturn inner", 1),
    ],
)
def test_paths_are_those_of_radon(house: ModuleType, body: str, paths: int) -> None:
    text = "def f():\n" + "".join(f"    {line}\n" for line in body.splitlines())
    (function,) = (node for node in house.ast.parse(text).body)
    assert house.count_paths(function) == paths


@pytest.mark.parametrize("conditions", [9, 10, 19, 20])
def test_long_functions_are_counted(
    house: ModuleType, planted: Path, conditions: int
) -> None:
    text = "def long(a):\n" + conditions * "    if a: pass\n"
    (planted / "planted" / "low" / "long.py").write_text(text, encoding="utf-8")
    measured = house.measure_source(planted, "planted")
    assert measured["functions with more than 10 paths"] == (conditions >= 10)
    assert measured["functions with more than 20 paths"] == (conditions >= 20)


def test_closure_is_what_the_public_names_load(
    house: ModuleType, planted: Path
) -> None:
    measured = house.measure_closure(planted, "planted")
    # `fine_way` and `other_way` wait until they are used.
    loaded = ("high.py", "low/late.py", "mapping/seam.py")
    assert measured["closure: files"] == len(loaded)
    assert measured["closure: lines"] == sum(FILES[name].count("\n") for name in loaded)


@pytest.fixture
def importable(planted: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The planted package on the path."""
    monkeypatch.syspath_prepend(str(planted))
    yield planted
    for name in [name for name in sys.modules if name.split(".")[0] == "planted"]:
        del sys.modules[name]


def test_files_that_calls_pass(house: ModuleType, importable: Path) -> None:
    seam: Any = importlib.import_module("planted.mapping.seam")
    calls = [lambda: seam.choose("fine_way"), lambda: seam.choose("other")]
    passed = house.files_passed(calls, importable / "planted")
    assert passed == {importable / "planted" / "mapping" / "seam.py"}
    # An import runs a file too.
    assert house.files_passed([lambda: seam.is_fine(1)], importable / "planted") == {
        importable / "planted" / "mapping" / name
        for name in ("seam.py", "methods/fine_way.py")
    }
    assert sys.getprofile() is None


def test_packages_that_are_imported_when_used_are_no_ground_of_the_core(
    house: ModuleType,
) -> None:
    assert {"viser", "zmq", "matplotlib", "scipy"} <= house.HEAVY
    assert not house.HEAVY & {
        "numpy",
        "pinocchio",
        "daqp",
        "msgspec",
        "yaml",
        "handmap_qp",
    }


def test_rows_above_their_budget_are_named(house: ModuleType) -> None:
    budget = {
        "a": house.Limit(3, 1),
        "b": house.Limit(8.5, None),
        "c": house.Limit(1, 0),
    }
    assert house.exceeded({"a": 3, "b": 8.5, "c": 0}, budget) == []
    (line,) = house.exceeded({"a": 1, "b": 8.51, "c": 1}, budget)
    assert line == "b: 8.51 exceeds the budget of 8.5"
    assert len(house.exceeded({"a": 1, "b": float("nan"), "c": 1}, budget)) == 1
    rows = house.table({"a": 3, "b": 8.5, "c": 0}, budget).splitlines()
    assert [row.split() for row in rows[1:]] == [
        ["a", "3", "3", "1"],
        ["b", "8.5", "8.5"],
        list("c010"),
    ]
    assert len({len(row) for row in rows}) == 1


@pytest.mark.parametrize("change", [0, -1])
def test_an_exceeded_budget_fails(
    house: ModuleType,
    planted: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: int,
) -> None:
    (planted / "pyproject.toml").write_text(
        '[project]\nname = "planted"\ndependencies = []\n[project.optional-dependencies]\n'
    )
    monkeypatch.setattr(house, "ROOT", planted)
    monkeypatch.setattr(house, "PACKAGE", "planted")
    monkeypatch.setattr(house, "measure_samples", lambda root: {})
    monkeypatch.setattr(house, "BUDGET", {"circles": house.Limit(2 + change, 0)})
    assert house.main() == (change < 0)
    printed = capsys.readouterr()
    assert "circles" in printed.out
    assert printed.err == ("circles: 2 exceeds the budget of 1\n" if change else "")
