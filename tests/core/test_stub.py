"""`_core.pyi` says what the compiled module has: the same names, with the same arguments."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path
from types import ModuleType


def _check() -> ModuleType:
    """Return what `make lint` compares the stub by."""
    file = Path(__file__).parents[2] / ".ci" / "core_stub.py"
    spec = importlib.util.spec_from_file_location("core_stub", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


CHECK = _check()


def test_the_stub_has_what_the_module_has() -> None:
    assert CHECK.written_names() == CHECK.compiled_names()


def test_every_argument_has_a_type() -> None:
    for node in ast.walk(ast.parse(CHECK.STUB.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef):
            arguments = [each for each in node.args.args if each.arg != "self"]
            assert all(each.annotation for each in arguments), node.name
            assert node.returns is not None, node.name


def test_a_stub_that_differs_is_noticed() -> None:
    text = CHECK.STUB.read_text(encoding="utf-8")
    right = CHECK.written_names()
    for before, after in (
        ("def forget(self)", "def forget_it(self)"),
        ("time: float, landmarks: Array)", "stamp: float, landmarks: Array)"),
        ("class Stages(Step)", "class Stages"),
        ("share: float = 1.0, stops", "share: float, stops"),
    ):
        assert before in text
        assert CHECK.written_names(text.replace(before, after, 1)) != right
