"""Memory of `handmap retarget` and `handmap batch` for recordings of both hands, by their length.

    python benchmarks long_recordings --hours 0.167 1
    python benchmarks long_recordings --hours 24 --command retarget
    python benchmarks long_recordings --hours 1 --command retarget --robot g1
    python benchmarks long_recordings --hours 1 --form csv
    python benchmarks long_recordings --hours 1 --command batch --look-ahead
    python benchmarks long_recordings --hours 1 --command batch --format lerobot
    python benchmarks long_recordings --hours 1 --layout openxr26

Each command runs in a process of its own, which prints its peak resident memory (VmHWM of the
kernel: code, libraries and all arrays). `above` is what that is over the same command on a
recording of 4 s. The recordings are made of the one that comes with the package, played to and fro,
by pieces, at 30 Hz in double precision.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from common import print_table
from numpy.lib import format as npy

from handmap_core.se3 import Array
from handmap_qp import read_recording
from handmap_qp.human import HumanSample
from handmap_qp.trackers import FORMATS, SIDES, Layout, load_layout, read_hands

FPS = 30
_SUFFIXES = {"npz": ".npz", "csv": ".csv", "robomimic": ".hdf5", "egodex": ".hdf5"}
"""Suffixes of files by their forms."""
_RUN = """
import sys
from pathlib import Path
from handmap_qp.cli import main

code = main(sys.argv[1:])
status = Path("/proc/self/status").read_text()
print("VmHWM", status.split("VmHWM:")[1].split()[0], file=sys.stderr)
sys.exit(code)
"""


def main() -> None:
    """Make recordings, map them, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0 / 6.0, 1.0])
    parser.add_argument(
        "--command", choices=("retarget", "batch"), nargs="+", default=["retarget"]
    )
    parser.add_argument(
        "--robot",
        default="allegro",
        help="a family of hands, one of which follows, or a robot with both "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--form", choices=_SUFFIXES, default="npz", help="form of the files"
    )
    parser.add_argument(
        "--look-ahead", action="store_true", help="of `handmap batch` alone"
    )
    parser.add_argument(
        "--format",
        choices=("lerobot", "robomimic"),
        help="data set of `handmap batch` besides its episodes",
    )
    parser.add_argument(
        "--layout",
        help="layout of `handmap retarget` for a recording of the right hand",
    )
    parser.add_argument("--folder", type=Path, help="where the files are made")
    given = parser.parse_args()
    layout = load_layout(given.layout) if given.layout else None
    rows = []
    with tempfile.TemporaryDirectory(dir=given.folder) as temporary:
        folder = Path(temporary)
        for command in given.command:
            least, _ = _peak(command, None, folder / "demo", given.robot)
            for hours in given.hours:
                frames = round(3600 * FPS * hours)
                file = folder / "hours.npz"
                make_hours(file, frames, layout)
                file = _converted(file, given.form)
                words = ["--look-ahead"] if given.look_ahead else []
                words += ["--format", given.format] if given.format else []
                if layout:
                    words += ["--layout", layout.name, "--side", "right"]
                out = folder / f"{hours:g}"
                peak, seconds = _peak(command, file, out, given.robot, words)
                rows.append(
                    {
                        "command": command,
                        "robot": given.robot,
                        "form": given.form,
                        "hours": hours,
                        "frames": frames,
                        "file [MB]": file.stat().st_size / 1e6,
                        "peak [MB]": peak,
                        "above [MB]": peak - least,
                        "time [s]": seconds,
                    }
                )
    print_table("Peak resident memory by length", rows)


def make_hours(file: Path, frames: int, layout: Layout | None = None) -> None:
    """Write a recording by pieces: of both hands, or of the right one in a layout."""
    hand = read_recording("demo", "right")
    seen = hand.landmarks[hand.valid]
    right = np.concatenate([seen, seen[::-1]])
    time = np.arange(frames) / FPS
    columns: dict[str, Iterator[Array]] = {}
    if layout:
        values = [layout.write(HumanSample(0.0, "right", points)) for points in right]
        columns["time"] = iter([time])
        columns[layout.arrays[0]] = _repeated(np.array(values), frames)
    else:
        hands = {"left": right * (-1.0, 1.0, 1.0), "right": right}
        for side in SIDES:
            columns[f"{side}_time"] = iter([time])
            columns[f"{side}_landmarks"] = _repeated(hands[side], frames)
    with zipfile.ZipFile(file, "w") as archive:
        for name, pieces in columns.items():
            first = next(pieces)
            header = {
                "descr": "<f8",
                "fortran_order": False,
                "shape": (frames, *first.shape[1:]),
            }
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                npy.write_array_header_1_0(member, header)
                member.write(first.tobytes())
                for piece in pieces:
                    member.write(piece.tobytes())


def _repeated(rows: Array, count: int) -> Iterator[Array]:
    """Repeat rows until there are so many."""
    for start in range(0, count, len(rows)):
        yield rows[: count - start]


def _converted(file: Path, form: str) -> Path:
    """Return a file of both hands in another form."""
    if form == "npz":
        return file
    hands = [*read_hands([file]).values()]
    converted = file.with_suffix(_SUFFIXES[form])
    FORMATS[form].write(hands, converted)
    return converted


def _peak(
    command: str, file: Path | None, out: Path, robot: str, words: Sequence[str] = ()
) -> tuple[float, float]:
    """Run a command; return its peak resident memory [MB] and its time [s].

    Args:
        command: `retarget` or `batch`.
        file: The recording; one of 4 s if omitted.
        out: What to write; `retarget` adds a suffix.
        robot: The robot.
        words: Further options.
    """
    usual = {
        "retarget": ["--robot", robot, "--out", f"{out}.out.npz"],
        "batch": ["--robot", robot, "--out", str(out), "--workers", "0"],
    }
    if file is None:
        file = out.with_suffix(".npz")
        make_hours(file, 120)
    started = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", _RUN, command, str(file), *usual[command], *words],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"{command} failed: {done.stderr[-2000:]}")
    return int(done.stderr.split("VmHWM")[-1]) / 1024.0, time.monotonic() - started


if __name__ == "__main__":
    main()
