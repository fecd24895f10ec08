"""Measure the size and the structure of `handmap_qp`, and hold them against a budget.

    python .ci/house.py

It measures the tree that it is in, prints a table, and exits with 1 if a row exceeds its budget.
`BUDGET` changes by hand, and downward only.

- Tokens are those of `tokenize` without comments, docstrings, newlines and indents. A code line has
  at least one of them.
- Samples run on the Python path: it is what people read. The C++ of the core counts in no row.
- The closure is what `from handmap_qp import HandMapper, load_hand` loads of the package.
- The files of a sample are those that run a Python function while a warm mapper or session maps
  landmarks: by `map_landmarks`, by `Follower.map_sample`, which has a guard before it, and by a
  step through the service's dispatcher, all in this process. The motion is made from the human
  model; the union over the samples counts.
- A room of the top view is a folder or a module at the top of the package. An arrow is a room that
  imports another one, inside functions and for type checks too.
- A circle is a group of folders or top-level modules, folders inside folders included, that import
  each other.
- Closure, files of a sample and rooms leave `__init__` modules out. Arrows and circles count them
  where they are imported: they may be the door of a room.
- The paths of a function are 1, and 1 for each condition, loop, exception handler, `and`, `or`,
  assertion, case, and each `for` and `if` of a comprehension: those of radon, which counts more
  than ruff's C901. A function inside another one counts for itself.
- The files of a method are its own module and those that import it, use one of its classes, or have
  its name as a string: those to look at for a method like it. The method with most of them counts.
- Imports inside functions count unless they are of a heavy package, which a plain mapping does not
  need: those of extras, of tools that users run in environments of their own, the solvers and what
  comes with them, and what draws tables, command lines and hulls.
"""

from __future__ import annotations

import ast
import asyncio
import io
import json
import os
import subprocess
import sys
import tokenize
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]


class Limit(NamedTuple):
    """Limits of a row: the most that it may have now, and the most that it is meant to have."""

    budget: float
    goal: float | None


BUDGET = {
    "lines": Limit(44_930, 34_000),
    "tokens": Limit(238_600, 200_000),
    "tokens per code line": Limit(8.51, 8),
    "closure: files": Limit(20, None),
    "closure: lines": Limit(6_840, 7_500),
    "files of a sample: map_landmarks": Limit(10, 10),
    "files of a sample: map_sample": Limit(15, None),
    "files of a sample: service": Limit(22, 20),
    "top view: rooms": Limit(14, 14),
    "top view: arrows": Limit(49, 60),
    "circles": Limit(0, 0),
    "files of a method": Limit(1, 1),
    "functions with more than 10 paths": Limit(20, 40),
    "functions with more than 20 paths": Limit(0, 0),
    "imports inside functions": Limit(0, 0),
}
"""The most that each row may have, and the goal; rows without a goal are for information."""

_LAYOUT_TOKENS = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
HEAVY = {
    "clarabel",
    "cv2",
    "example_robot_data",
    "h5py",
    "imageio",
    "matplotlib",
    "mediapipe",
    "mink",
    "mpl_toolkits",
    "mujoco",
    "osqp",
    "PIL",
    "piqp",
    "prometheus_client",
    "proxsuite",
    "pyarrow",
    "qpsolvers",
    "quadprog",
    "ray",
    "rich",
    "robot_descriptions",
    "rosbags",
    "scipy",
    "trimesh",
    "tyro",
    "viser",
    "websockets",
    "yourdfpy",
    "zmq",
}
"""Packages that are imported when used."""
_Function = ast.FunctionDef | ast.AsyncFunctionDef
PACKAGE, METHODS = "handmap_qp", "mapping.methods"
"""The package, and its folder of mapping methods."""
_WARM, _MEASURED = 60, 60
_HAND_LENGTH = 0.19  # m


class Module(NamedTuple):
    """A module of the package.

    Attributes:
        name: Its dotted name below the package; that of the package itself is empty.
        is_init: Whether it is the `__init__` of a folder.
        text: Its source.
        tree: Its syntax.
    """

    name: str
    is_init: bool
    text: str
    tree: ast.Module


def read_package(folder: Path) -> list[Module]:
    """Read all modules of a package, in the order of their paths."""
    modules = []
    for file in sorted(folder.rglob("*.py")):
        parts = file.relative_to(folder).with_suffix("").parts
        is_init = parts[-1] == "__init__"
        name, text = (
            ".".join(parts[:-1] if is_init else parts),
            file.read_text(encoding="utf-8"),
        )
        modules.append(Module(name, is_init, text, ast.parse(text)))
    return modules


def count_tokens(module: Module) -> tuple[int, int]:
    """Return how many tokens a module has, and how many lines with at least one of them."""
    docstrings: set[int] = set()
    for node in ast.walk(module.tree):
        body = getattr(node, "body", None)
        first = body[0] if isinstance(body, list) and body else None
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
            docstrings.update(
                range(first.lineno, (first.end_lineno or first.lineno) + 1)
            )
    rows = [
        token.start[0]
        for token in tokenize.generate_tokens(io.StringIO(module.text).readline)
        if token.type not in _LAYOUT_TOKENS and token.start[0] not in docstrings
    ]
    return len(rows), len(set(rows))


def count_paths(function: _Function) -> int:
    """Return how many paths a function has, without the functions and classes inside it."""
    return 1 + sum(_forks(node) for node in _inside(function.body))


def _inside(body: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """Walk statements without entering functions and classes."""
    for node in body:
        if not isinstance(node, _Function | ast.ClassDef):
            yield node
            yield from _inside(ast.iter_child_nodes(node))


def _forks(node: ast.AST) -> int:
    """Return how many paths a node adds."""
    match node:
        case ast.If() | ast.IfExp() | ast.Assert():
            return 1
        case ast.For() | ast.While() | ast.AsyncFor():
            return 1 + bool(node.orelse)
        case ast.Try():
            return len(node.handlers) + bool(node.orelse)
        case ast.BoolOp():
            return len(node.values) - 1
        case ast.comprehension():
            return 1 + len(node.ifs)
        case ast.Match():
            return sum(not _is_default(case) for case in node.cases)
    return 0


def _is_default(case: ast.match_case) -> bool:
    return isinstance(case.pattern, ast.MatchAs) and case.pattern.pattern is None


def functions_of(module: Module) -> list[_Function]:
    """Return all functions of a module, methods and inner functions among them."""
    return [node for node in ast.walk(module.tree) if isinstance(node, _Function)]


def imported_names(node: ast.AST) -> list[str]:
    """Return the dotted names that an import loads or may load: modules, and what is in them."""
    if isinstance(node, ast.Import):
        return [item.name for item in node.names]
    if isinstance(node, ast.ImportFrom):
        return [f"{node.module}.{item.name}" for item in node.names]
    return []


def inner_imports(modules: list[Module], heavy: set[str] = HEAVY) -> int:
    """Count the imports inside functions, except those of heavy packages."""
    return sum(
        1
        for module in modules
        for function in functions_of(module)
        for node in _inside(function.body)
        if {name.split(".")[0] for name in imported_names(node)} - heavy
    )


def import_arrows(
    package: str, modules: list[Module], room_of: Callable[[str], str]
) -> set[tuple[str, str]]:
    """Return which rooms import which others; `room_of` gives the room of a module's name."""
    rooms = {module.name: room_of(module.name) for module in modules if module.name}
    arrows = set()
    for module in modules:
        for name in {} if module.is_init else _loaded(package, module):
            target = name if name in rooms else name.rpartition(".")[0]
            if target in rooms and rooms[target] != rooms[module.name]:
                arrows.add((rooms[module.name], rooms[target]))
    return arrows


def _loaded(package: str, module: Module) -> set[str]:
    """Return the names of the package that a module imports, without the package's own name."""
    names = {name for node in ast.walk(module.tree) for name in imported_names(node)}
    return {
        name.removeprefix(f"{package}.")
        for name in names
        if name.startswith(f"{package}.")
    }


def top_room(name: str) -> str:
    """Return the room of a module in the top view."""
    return name.split(".")[0]


def folder_room(name: str) -> str:
    """Return the folder of a module; a module at the top is a room of its own."""
    return name.rpartition(".")[0] or name


def circles(arrows: set[tuple[str, str]]) -> list[set[str]]:
    """Return the groups of rooms that reach each other along arrows."""
    reached = {room: {room} for arrow in arrows for room in arrow}
    for _ in reached:
        for start, end in arrows:
            for seen in reached.values():
                if start in seen:
                    seen.add(end)
    groups = {
        frozenset(other for other in seen if room in reached[other])
        for room, seen in reached.items()
    }
    return [set(group) for group in groups if len(group) > 1]


def files_of_method(package: str, modules: list[Module], folder: str) -> int:
    """Return the most files that a method has.

    A method is a module of the folder that defines a class named like its file, as `FingerVectors`
    in `finger_vectors`.
    """
    counts = []
    words = {module.name: _words(package, module) for module in modules if module.name}
    for module in modules:
        own, _, stem = module.name.rpartition(".")
        classes = {
            node.name for node in module.tree.body if isinstance(node, ast.ClassDef)
        }
        if own == folder and stem.title().replace("_", "") in classes:
            public = {name for name in classes if not name.startswith("_")}
            marks = public | {module.name, f'"{stem}"'}
            counts.append(sum(bool(marks & found) for found in words.values()))
    return max(counts, default=0)


def _words(package: str, module: Module) -> set[str]:
    """Return the names of a module, the modules that it is and imports, and its strings, quoted."""
    words = {module.name, *_loaded(package, module)}
    for node in ast.walk(module.tree):
        if isinstance(node, ast.ImportFrom):
            words.add((node.module or "").removeprefix(f"{package}."))
        elif isinstance(node, ast.Name):
            words.add(node.id)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            words.add(f'"{node.value}"')
    return words


def closure_of(root: Path, package: str, statement: str) -> list[Path]:
    """Return the files of a package that a statement loads in a new process."""
    code = (
        f"import json, sys\n{statement}\n"
        "files = [getattr(module, '__file__', None) for module in sys.modules.values()]\n"
        "print(json.dumps([file for file in files if file]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    files = {Path(file).resolve() for file in json.loads(done.stdout)}
    return sorted(file for file in files if _is_module(file, root / package))


def _is_module(file: Path, folder: Path) -> bool:
    return file.is_relative_to(folder) and file.name != "__init__.py"


def files_passed(calls: Iterable[Callable[[], object]], folder: Path) -> set[Path]:
    """Return the files of a folder that run a Python function during calls."""
    seen: set[str] = set()

    def note(frame: Any, event: str, _: object) -> None:
        if event == "call":
            seen.add(frame.f_code.co_filename)

    for call in calls:
        sys.setprofile(note)
        try:
            call()
        finally:
            sys.setprofile(None)
    return {file for file in map(Path, seen) if _is_module(file, folder)}


def measure_samples(root: Path) -> dict[str, float]:
    """Measure how many files a warm sample of landmarks passes in the library and the service."""
    sys.path.insert(0, str(root))
    import msgspec
    import numpy as np

    from handmap_qp import Follower, HandMapper, HumanLengths, HumanSample, load_hand
    from handmap_qp.apps.service.dispatch import Dispatcher
    from handmap_qp.apps.service.logs import Metrics
    from handmap_qp.apps.service.opening import HandCache
    from handmap_qp.apps.service.sessions import Sessions
    from handmap_qp.apps.service.settings import Settings
    from handmap_qp.client.messages import PROTOCOL, Open, Step

    human = load_hand("human", lengths=HumanLengths.from_hand_length(_HAND_LENGTH))
    tracked, secret = human.with_points("landmarks"), "measures-the-house"
    middle, half = human.rest, 0.2 * (human.upper_limits - human.lower_limits)
    samples = []
    for i in range(_WARM + _MEASURED):
        q = np.clip(
            middle + half * np.sin(0.03 * i), human.lower_limits, human.upper_limits
        )
        wrist = np.eye(4)
        # A height that stays 0 would be that of image coordinates.
        wrist[:3, 3] = 0.1 * np.sin(0.03 * i), 0.0, 1.0
        samples.append(HumanSample(i / 60.0, "right", tracked.points(q, wrist)))
    plain, other = (HandMapper(human, load_hand("three_finger")) for _ in range(2))
    guarded = Follower(other)
    now, answers = 0.0, []
    sessions = Sessions(Settings(rate=1e6), HandCache(), Metrics(), clock=lambda: now)
    dispatcher = Dispatcher(sessions)

    def send(request: Open | Step) -> None:
        dispatcher.receive(msgspec.msgpack.encode(request), "house", answers.append)

    async def open_session() -> None:
        wanted = Open(protocol=PROTOCOL, seq=1, session=secret, robot="three_finger")
        send(
            msgspec.structs.replace(wanted, input="landmarks", hand_length=_HAND_LENGTH)
        )
        while not answers:
            await asyncio.sleep(0.01)

    def step(i: int) -> None:
        nonlocal now
        now, rows = samples[i].time, tuple(map(tuple, samples[i].landmarks.tolist()))
        send(
            Step(protocol=PROTOCOL, seq=2 + i, session=secret, time=now, landmarks=rows)
        )

    asyncio.run(open_session())
    ways: dict[str, Callable[[int], object]] = {
        "map_landmarks": lambda i: plain.map_landmarks(
            samples[i].landmarks, dt=1.0 / 60.0
        ),
        "map_sample": lambda i: guarded.map_sample(samples[i]),
        "service": step,
    }
    counts = {}
    for name, way in ways.items():
        for i in range(_WARM):
            way(i)
        calls = [partial(way, _WARM + i) for i in range(_MEASURED)]
        counts[f"files of a sample: {name}"] = len(files_passed(calls, root / PACKAGE))
    rules = {
        msgspec.msgpack.decode(answer).get("rule") for answer in answers[-_MEASURED:]
    }
    if rules != {""}:
        raise RuntimeError(
            f"expected samples that the service follows, got {answers[-1]!r}"
        )
    return counts


def measure_source(root: Path, package: str) -> dict[str, float]:
    """Measure the rows that the source of a package gives."""
    modules = read_package(root / package)
    tokens, code_lines = map(sum, zip(*map(count_tokens, modules), strict=True))
    paths = [
        count_paths(function) for module in modules for function in functions_of(module)
    ]
    arrows = import_arrows(package, modules, top_room)
    return {
        "lines": sum(module.text.count("\n") for module in modules),
        "tokens": tokens,
        "tokens per code line": round(tokens / code_lines, 2),
        "top view: rooms": len({top_room(m.name) for m in modules if m.name}),
        "top view: arrows": len(arrows),
        "circles": len(circles(import_arrows(package, modules, folder_room))),
        "files of a method": files_of_method(package, modules, METHODS),
        "functions with more than 10 paths": sum(count > 10 for count in paths),
        "functions with more than 20 paths": sum(count > 20 for count in paths),
        "imports inside functions": inner_imports(modules),
    }


def measure_closure(root: Path, package: str) -> dict[str, float]:
    """Measure what the public entry of the package loads."""
    files = closure_of(root, package, f"from {package} import HandMapper, load_hand")
    lines = sum(file.read_text(encoding="utf-8").count("\n") for file in files)
    return {"closure: files": len(files), "closure: lines": lines}


def exceeded(measured: dict[str, float], budget: dict[str, Limit]) -> list[str]:
    """Return a line for each row that exceeds its budget."""
    return [
        f"{row}: {measured[row]:,} exceeds the budget of {limit.budget:,}"
        for row, limit in budget.items()
        if not measured[row] <= limit.budget
    ]


def table(measured: dict[str, float], budget: dict[str, Limit]) -> str:
    """Return an aligned table: row, measured, budget, goal."""
    rows = [("", "measured", "budget", "goal")]
    for row, (most, goal) in budget.items():
        rows.append(
            (
                row,
                f"{measured[row]:,}",
                f"{most:,}",
                "" if goal is None else f"{goal:,}",
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join([name.ljust(widths[0]), *map(str.rjust, numbers, widths[1:])])
        for name, *numbers in rows
    )


def main() -> int:
    """Measure, print the table, and return the exit code."""
    measured = {
        **measure_samples(ROOT),
        **measure_source(ROOT, PACKAGE),
        **measure_closure(ROOT, PACKAGE),
    }
    print(table(measured, BUDGET))
    failures = exceeded(measured, BUDGET)
    print("\n".join(failures), file=sys.stderr, end="\n" if failures else "")
    return bool(failures)


if __name__ == "__main__":
    # The core would hide the files that a sample passes.
    os.environ["HANDMAP_PURE"] = "1"
    sys.exit(main())
