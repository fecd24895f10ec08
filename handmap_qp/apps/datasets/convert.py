"""The command `handmap convert`."""

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from handmap_core.errors import expect
from handmap_qp.apps.arguments import FileSide, check_names, hinted
from handmap_qp.apps.tables import progress
from handmap_qp.hands import Names
from handmap_qp.human import Recording
from handmap_qp.output_files import check_output, make_folder
from handmap_qp.trackers import (
    FORMATS,
    LongRecording,
    Source,
    format_to_write,
    in_pieces,
    list_sources,
)
from handmap_qp.trackers.formats.base import RecordingFormat
from handmap_qp.trackers.formats.mano import ENVIRONMENT
from .robot_log import is_robot_log, read_robot_log, write_robot_logs

_FASTEST = 10_000.0
"""Most frames a second of a data set of robots' logs: a mistyped rate must not fill the memory."""


@dataclass(frozen=True)
class Convert:
    """Convert recordings of human hands between file formats.

    The suffix of OUT tells its format; a name without suffix is a LeRobot data set. Says in one
    line what the new format cannot hold.

      npz        arrays of numpy by name; lossless, one of each hand
      npy        one array of landmarks; read, not written; needs --side and --fps
      csv        a text table, numbers kept exactly; one of each hand
      lerobot    a folder, LeRobot v3 (parquet); any number; written, not read
      robomimic  HDF5 as of robomimic; lossless, any number
      egodex     HDF5 as of EgoDex, poses of joints; one of each hand
      mcap       ROS 2 bag, JointState and landmarks; one of each hand
      mano       npz of MANO's joints; reads parameters with your model
      dexycb     folder of a camera or sequence of DexYCB; read, not written
      arctic     ARCTIC's .mano.npy, by your model of MANO; read, not written
      grab       GRAB's .npz, by your model of MANO; read, not written
      hot3d      folder of a sequence of HOT3D, by your model of MANO; read, not written

    Of these, lerobot, robomimic, egodex and mcap need `handmap-qp[files]`.

    Logs of a robot (`handmap drive --log`, or a bag with joint_states and joint_commands) become
    data sets of lerobot or robomimic: measured joints, commands, and efforts in N m where known. A
    bag with landmarks of a hand is a recording all the same.

    Examples:
        handmap convert take.npz take.csv
        handmap convert left.npz right.npz both.hdf5 --format egodex
        handmap convert episode.hdf5 lerobot_set
        handmap convert demos.hdf5 takes --format npz   (a file for each)
        handmap convert demo demo.mcap
        handmap convert drive.npz robot_set --fps 30

    Attributes:
        paths: Files or data sets to read, then the file or folder to write. `FILE::NAME` is one
            recording of several in a file, `demo` the one that comes with the package.
        format: Format to write, where the suffix does not tell it.
        mano: The licensed MANO model: MANO_RIGHT.pkl, or the folder that holds both hands.
        side: Which hand the recordings are of, where the files do not say.
        fps: Samples a second, in place of the time in the files; needed where they have none. Of a
            robot's logs, the frames a second to write; their own rate if omitted.
        json: Print one JSON object.
    """

    paths: Positional[Annotated[tuple[Path, ...], hinted("IN... OUT", "(required)")]]
    format: Annotated[
        str | None,
        hinted(f"{{{','.join(FORMATS)}}}", "(default: by the suffix of OUT)"),
    ] = None
    mano: Annotated[Path | None, hinted("FILE", "(default: $HANDMAP_MANO)")] = None
    side: FileSide = None
    fps: float | None = None
    json: bool = False

    def run(self) -> None:
        """Read, write, and say what was lost."""
        expect(
            len(self.paths) > 1,
            "IN OUT",
            "a file to read and one to write",
            got="one path",
        )
        *inputs, out = self.paths
        form = format_to_write(out, self.format)
        if any(map(is_robot_log, inputs)):
            self._convert_logs(inputs, out, form)
            return
        has_files = bool(form.suffixes) and not out.suffix
        if form.suffixes and not has_files:
            check_output("OUT", out, form.suffixes)
        if self.mano:
            os.environ[ENVIRONMENT] = str(self.mano)
        sources = [
            source
            for file in inputs
            for source in list_sources(file, self.side, fps=self.fps)
        ]
        unread = {source.path: source.format.unread(source.path) for source in sources}
        with progress("reading"):
            recordings = [_opened(source) for source in sources]
        contents = {out: recordings}
        if has_files:
            names = [f"{source.name}{form.suffixes[0]}" for source in sources]
            check_names("IN", names, "recordings of different names")
            files = map(out.joinpath, names)
            contents = dict(zip(files, zip(recordings), strict=True))
            make_folder(out, "OUT")
        samples = sum(map(len, recordings))
        with progress("converting", samples) as advance:
            written = _Written(form, advance)
            for file, content in contents.items():
                form.write_long([*map(written.watched, content)], file)
        self._report(
            recordings=len(recordings),
            samples=samples,
            files=list(map(str, contents)),
            not_read=list(dict.fromkeys(chain.from_iterable(unread.values()))),
            lost=written.losses,
        )

    def _convert_logs(
        self, inputs: Sequence[Path], out: Path, form: RecordingFormat
    ) -> None:
        """Write logs of a robot as a data set."""
        is_set = form.name in ("lerobot", "robomimic")
        wanted = (
            "a data set for logs of a robot: a folder for lerobot, .hdf5 for robomimic"
        )
        expect(is_set, "OUT", wanted, value=str(out))
        for file in inputs:
            alike = "logs of a robot alone, or none"
            expect(is_robot_log(file), "IN", alike, value=str(file))
        of_hands = "not for logs of a robot: it is for recordings of hands"
        expect(self.side is None, "--side", of_hands, got=f"{self.side}")
        expect(self.mano is None, "--mano", of_hands, got=f"{self.mano}")
        if self.fps is not None:
            is_rate = 0.0 < self.fps <= _FASTEST
            wanted = f"frames a second, more than 0 and at most {_FASTEST:g}"
            expect(is_rate, "--fps", wanted, value=self.fps)
        if form.suffixes:
            check_output("OUT", out, form.suffixes)
        logs = [read_robot_log(file) for file in inputs]
        kind = "robomimic" if form.name == "robomimic" else "lerobot"
        unknown = write_robot_logs(logs, out, kind, self.fps)
        self._report(
            what="logs",
            recordings=len(logs),
            samples=sum(map(len, logs)),
            files=[str(out)],
            not_read=[],
            lost=[f"efforts of {', '.join(unknown)}, not known"] if unknown else [],
        )

    def _report(self, what: str = "recordings", **done: Any) -> None:
        """Print what was converted, and what was lost: not read, or not held by the format."""
        if self.json:
            print(json.dumps(done))
            return
        lost = [*done["not_read"], *done["lost"]]
        print(f"{done['recordings']} {what}, {done['samples']} samples")
        print(f"lost: {', '.join(lost)}" if lost else "nothing was lost")
        for file in done["files"]:
            print(f"wrote {file}")


def _opened(source: Source) -> LongRecording:
    """Open a recording; if it is long, keep its first samples alone in memory."""
    found = source.read_long()
    if isinstance(found, LongRecording):
        return found.without_overview()
    return in_pieces(found)


class _Written:
    """What has been written of recordings, and what their new form does not hold.

    Args:
        form: The new form.
        advance: Called with the number of samples done.
    """

    def __init__(self, form: RecordingFormat, advance: Callable[[int], object]) -> None:
        self._form = form
        self._advance = advance
        self._done: list[int] = []
        self._lost: set[str] = set()

    @property
    def losses(self) -> Names:
        """What the form does not hold of all that was written, in words."""
        return self._form.in_order(self._lost)

    def watched(self, recording: LongRecording) -> LongRecording:
        """Return a recording whose samples are counted when they are read."""
        index = len(self._done)
        self._done.append(0)
        if recording.has_all:
            # It may be written from the memory.
            self._count(index, recording.overview)
            return recording

        def parts() -> Iterator[Recording]:
            # Some forms read all parts twice.
            self._done[index] = 0
            for part in recording.parts():
                yield part
                self._count(index, part)

        return replace(recording, parts=parts)

    def _count(self, index: int, part: Recording) -> None:
        """Count samples of a recording that are written."""
        self._done[index] += len(part)
        self._lost.update(self._form.losses([part]))
        self._advance(sum(self._done))
