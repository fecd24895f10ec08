"""Memory of the commands that take recordings of hours, by their length.

    python benchmarks long_recordings --hours 0.167 1
    python benchmarks long_recordings --hours 1 24 --both
    python benchmarks long_recordings --hours 1 --robot g1
    python benchmarks long_recordings --hours 1 --form csv
    python benchmarks long_recordings --hours 1 --command batch --look-ahead
    python benchmarks long_recordings --hours 1 --command batch --format lerobot
    python benchmarks long_recordings --hours 1 24 --layout angles20
    python benchmarks long_recordings --hours 1 --layout manus --form csv
    python benchmarks long_recordings --hours 1 24 --command convert --to csv

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
from handmap_qp.trackers import SIDES, Layout, load_layout

FPS = 30
COMMANDS = ("retarget", "batch", "convert")
_SUFFIXES = {
    "npz": ".npz",
    "csv": ".csv",
    "robomimic": ".hdf5",
    "egodex": ".hdf5",
    "mcap": ".mcap",
    "lerobot": "",
}
"""Suffixes of files by their forms."""
_READ = ("npz", "csv", "robomimic", "egodex")
"""Forms of files that are read."""
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
    """Make recordings, map or convert them, and print the table."""
    given = _arguments()
    layout = load_layout(given.layout) if given.layout else None
    rows = []
    with tempfile.TemporaryDirectory(dir=given.folder) as temporary:
        folder = Path(temporary)
        demo = folder / "demo.npz"
        make_hours(demo, 120)
        for command in given.command:
            least, _ = _peak(_words(command, demo, folder / "least", given, None))
            for hours in given.hours:
                frames = round(3600 * FPS * hours)
                file = _made(folder, frames, given.form, layout)
                out = folder / f"{command}{hours:g}"
                peak, seconds = _peak(_words(command, file, out, given, layout))
                rows.append(
                    {
                        "command": command,
                        "robot": "" if command == "convert" else given.robot,
                        "form": given.form,
                        "layout": given.layout or "",
                        "to": given.to if command == "convert" else "",
                        "hours": hours,
                        "frames": frames,
                        "file [MB]": file.stat().st_size / 1e6,
                        "peak [MB]": peak,
                        "above [MB]": peak - least,
                        "time [s]": seconds,
                    }
                )
    print_table("Peak resident memory by length", rows)


def _arguments() -> argparse.Namespace:
    """Read the arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0 / 6.0, 1.0])
    parser.add_argument("--command", choices=COMMANDS, nargs="+", default=["retarget"])
    parser.add_argument(
        "--robot",
        default="allegro",
        help="a family of hands, one of which follows, or a robot with both "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--both",
        action="store_true",
        help="let the left and the right hand of the family follow (`retarget`)",
    )
    parser.add_argument(
        "--form", choices=_READ, default="npz", help="form of the files"
    )
    parser.add_argument(
        "--to", choices=_SUFFIXES, default="npz", help="form that `convert` writes"
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
        help="layout of a recording of the right hand; as .npz or .csv (`retarget`)",
    )
    parser.add_argument("--folder", type=Path, help="where the files are made")
    return parser.parse_args()


def make_hours(file: Path, frames: int, layout: Layout | None = None) -> None:
    """Write a recording by pieces: of both hands, or of the right one in a layout."""
    time = np.arange(frames) / FPS
    columns: dict[str, Iterator[Array]] = {}
    if layout:
        columns["time"] = iter([time])
        name = layout.arrays[0] if layout.arrays else "values"
        columns[name] = _repeated(layout_values(layout), frames)
    else:
        right = _played()
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


def _played() -> Array:
    """Return the landmarks of the right hand of the demo, played to and fro, (T, 21, 3) [m]."""
    hand = read_recording("demo", "right")
    seen = hand.landmarks[hand.valid]
    return np.concatenate([seen, seen[::-1]])


def layout_values(layout: Layout) -> Array:
    """Return the same hand in a layout, shape (T, ...)."""
    samples = [HumanSample(0.0, "right", points) for points in _played()]
    return np.array([layout.write(sample) for sample in samples])


def _repeated(rows: Array, count: int) -> Iterator[Array]:
    """Repeat rows until there are so many."""
    for start in range(0, count, len(rows)):
        yield rows[: count - start]


def _made(folder: Path, frames: int, form: str, layout: Layout | None) -> Path:
    """Make a file of so many frames."""
    file = folder / "hours.npz"
    if layout and form == "csv":
        return make_table(file.with_suffix(".csv"), frames, layout)
    make_hours(file, frames, layout)
    if form == "npz":
        return file
    converted = file.with_suffix(_SUFFIXES[form])
    _peak(["convert", str(file), str(converted), "--format", form])
    return converted


def make_table(file: Path, frames: int, layout: Layout) -> Path:
    """Write a recording of the right hand as a table of a layout's columns."""
    values = layout_values(layout)
    if values[0].size > len(layout.columns):
        # Tables of joints have their positions.
        is_matrix = values.shape[2:] == (4, 4)
        values = values[..., :3, 3] if is_matrix else values[..., :3]
    rows = values.reshape(len(values), -1).tolist()
    texts = [",".join(map(repr, row)) for row in rows]
    with file.open("w") as stream:
        stream.write(f"time,{','.join(layout.columns)}\n")
        for i in range(frames):
            stream.write(f"{i / FPS!r},{texts[i % len(texts)]}\n")
    return file


def _words(
    command: str,
    file: Path,
    out: Path,
    given: argparse.Namespace,
    layout: Layout | None,
) -> list[str]:
    """Return the words of a command.

    Args:
        command: One of `COMMANDS`.
        file: The recording.
        out: What to write, without its suffix.
        given: The arguments of this program.
        layout: The layout of the file; None if it has both hands.
    """
    words = [command, str(file)]
    if command == "convert":
        return [*words, f"{out}{_SUFFIXES[given.to]}", "--format", given.to]
    if given.both and layout is None:
        words += ["--robots", f"{given.robot}_left", f"{given.robot}_right"]
        words += ["--out", str(out)]
    elif command == "retarget":
        words += ["--robot", given.robot, "--out", f"{out}.out.npz"]
    else:
        words += ["--robot", given.robot, "--out", str(out), "--workers", "0"]
        words += ["--look-ahead"] if given.look_ahead else []
        words += ["--format", given.format] if given.format else []
    if layout:
        words += ["--layout", layout.name, "--side", "right"]
    return words


def _peak(words: Sequence[str]) -> tuple[float, float]:
    """Run a command; return its peak resident memory [MB] and its time [s]."""
    started = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", _RUN, *words],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"{words[0]} failed: {done.stderr[-2000:]}")
    return int(done.stderr.split("VmHWM")[-1]) / 1024.0, time.monotonic() - started


if __name__ == "__main__":
    main()
