"""One page of figures: speed and exactness, each beside its aim.

    make peers
    python benchmarks figures
    python benchmarks figures --only speed batch --markdown page.md

It runs the other benchmarks, one after the other, and prints a line a figure. `speed` is landmarks
to command beside dexi-rs; `step` is `map_step` in Jacobians; `batch`, `service`, `solvers` and
`hostile` are the scripts of these names; `size` is the compiled library. Speed was tuned on
the recordings of `TUNED_ON`; `HELD_OUT` was not looked at until the code was ready.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import json
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

TUNED_ON = ("quest3_webxr_right", "leap_pinch_move_right")
"""Free motion, and constant pinching."""
HELD_OUT = ("rgb_mediapipe_right",)
"""A recording that the speed was not tuned on."""
_OURS = ("teleoperation", "teleoperation:guard")
_PEER = "dexi-rs vector"
_SHARE = 0.35
"""Aim of a sample's time over dexi-rs vector's; that of the Inspire hand is .6."""
_INSPIRE = 0.6
_GUARDED = 1.3
"""Aim of the guarded time over the aim without the guard."""


class Figure(NamedTuple):
    """A figure.

    Attributes:
        part: Which benchmark it is from.
        what: What was measured.
        value: The figure.
        aim: The most that it is meant to be; None for none.
    """

    part: str
    what: str
    value: float
    aim: float | None = None

    @property
    def row(self) -> dict[str, Any]:
        """Columns of the table."""
        verdict = "" if self.aim is None else "yes" if self.value <= self.aim else "no"
        aim = "" if self.aim is None else f"{self.aim:g}"
        value = f"{self.value:.3g}" if self.value < 1e4 else f"{self.value:,.0f}"
        return {"part": self.part, "figure": self.what, "value": value, "aim": aim} | {
            "met": verdict
        }


def run(where: str, script: str, *words: str) -> dict[str, Any]:
    """Run a script of `benchmarks` or `tests/judges`; return what it writes as JSON.

    A failure counts in its figures.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "results.json"
        command = [sys.executable, str(common.ROOT / where), script, *words]
        subprocess.run([*command, "--json", str(file)], stdout=sys.stderr, check=False)
        return json.loads(file.read_text(encoding="utf-8"))


def speed(quick: bool) -> Iterator[Figure]:
    """Landmarks to command, with contacts and through the guard, as shares of dexi-rs vector."""
    names = TUNED_ON[:1] if quick else (*TUNED_ON, *HELD_OUT)
    words = ["--names", *names, "--only", *_OURS, _PEER]
    found = run("benchmarks", "bench_end_to_end", *words, *_quick(quick))
    for case, rows in found["robots"].items():
        aim = _INSPIRE if case.startswith("inspire") else _SHARE
        held = " (not tuned on)" if any(name in case for name in HELD_OUT) else ""
        for row in rows:
            if row["program"] not in _OURS or "of dexi" not in row:
                continue
            is_guarded = row["program"].endswith(":guard")
            most = aim * _GUARDED if is_guarded else aim
            text = f"{case}{held}{', guarded' if is_guarded else ''}"
            yield Figure("speed", f"{text}, median", row["of dexi"], most)
            yield Figure("speed", f"{text}, p99", row["of dexi p99"], most)


def step(quick: bool) -> Iterator[Figure]:
    """`map_step` of the preset `paper`, in `pin.computeJointJacobians` of the same robot."""
    for row in run("benchmarks", "bench_step", *_quick(quick))["robots"]:
        yield Figure("step", f"{row['robot']}, Jacobians", row["ratio"], 12.0)


def batch(quick: bool) -> Iterator[Figure]:
    """Mapping a data set."""
    for name, result in run("benchmarks", "bench_batch", *_quick(quick))[
        "results"
    ].items():
        frame, recording = 1e3 * result["frame"], 1e3 * result["recording"]
        yield Figure("batch", f"{name}, ms a frame", frame, 0.04)
        yield Figure("batch", f"{name}, ms a recording", recording, 3.0)
        yield Figure("batch", f"{name}, EgoDex core-hours", result["egodex_hours"], 2.0)


def service(quick: bool) -> Iterator[Figure]:
    """Landmarks at 90 Hz."""
    seconds = [] if quick else ["--duration", "20"]
    for row in run("benchmarks", "bench_service", *seconds, *_quick(quick))["rows"]:
        if "landmarks" not in row["load"]:
            continue
        load = row["load"]
        yield Figure("service", f"{load}, CPU ms", 1e-3 * row["server_us"], 0.4)
        is_inside = "in process" in load
        aim = 0.4 if is_inside else 1e-3 * row["echo_p50_us"] + 0.15
        yield Figure("service", f"{load}, p50 ms", 1e-3 * row["p50_us"], round(aim, 2))


def solvers(quick: bool) -> Iterator[Figure]:
    """The core's QP against DAQP, ProxQP and OSQP."""
    for name, rows in run("benchmarks", "bench_solvers", *_quick(quick)).items():
        for row in rows if isinstance(rows, list) else ():
            if "core worse" in row:
                text = f"{name}, against {row['solver']}"
                yield Figure("solvers", f"{text}, core worse", row["core worse"], 0)
                yield Figure("solvers", f"{text}, core failed", row["core failed"], 0)


def hostile(quick: bool) -> Iterator[Figure]:
    """Hostile steps of ten hands."""
    count = "20000" if quick else "2000000"
    found = run("tests/judges", "exactness", "--steps", count)
    yield Figure("hostile", "steps", found["steps"])
    for what in ("position", "speed", "acceleration", "overlap"):
        yield Figure("hostile", what, found["violations"].get(what, 0), 0)


def size(quick: bool) -> Iterator[Figure]:
    """The compiled library, as it is compressed in a wheel."""
    del quick
    for file in (common.ROOT / "core" / "handmap_core").glob("_core.*.so"):
        yield Figure(
            "size", "library, MB", len(zlib.compress(file.read_bytes())) / 1e6, 3
        )


PARTS: dict[str, Callable[[bool], Iterator[Figure]]] = {
    part.__name__: part
    for part in (speed, step, batch, service, solvers, hostile, size)
}
"""The parts of the page, by name."""


def _quick(quick: bool) -> list[str]:
    return ["--quick"] if quick else []


def main(words: Sequence[str] | None = None) -> None:
    """Print the page."""
    parser = common.make_parser("One page of figures, each beside its aim.")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--markdown", metavar="FILE", type=Path, help="write the page")
    arguments = common.parse_arguments(parser, words)
    rows = []
    for name in arguments.only:
        rows += [figure.row for figure in PARTS[name](arguments.quick)]
    caption = ", ".join(f"{name}: {value}" for name, value in common.facts().items())
    common.print_table("Figures", rows, caption=caption)
    met = [row["met"] == "yes" for row in rows if row["met"]]
    print(f"{int(np.sum(met))} of {len(met)} aims are met.")
    if arguments.markdown:
        lines = ["| figure | value | aim | met |", "|---|---|---|---|"]
        lines += [
            f"| {row['part']}: {row['figure']} | {row['value']} | {row['aim']} | {row['met']} |"
            for row in rows
        ]
        arguments.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")
    common.write_json(arguments.json, "figures", {"rows": rows})


if __name__ == "__main__":
    main()
