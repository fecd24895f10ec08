"""The command `handmap convert`."""

import json
import os
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from handmap_qp.apps.arguments import FileSide, check_names, hinted
from handmap_qp.errors import expect
from handmap_qp.output_files import check_output, make_folder
from handmap_qp.trackers import FORMATS, format_to_write, list_sources
from handmap_qp.trackers.formats.mano import ENVIRONMENT


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

    Examples:
        handmap convert take.npz take.csv
        handmap convert left.npz right.npz both.hdf5 --format egodex
        handmap convert episode.hdf5 lerobot_set
        handmap convert demos.hdf5 takes --format npz   (a file for each)
        handmap convert demo demo.mcap

    Attributes:
        paths: Files or data sets to read, then the file or folder to write. `FILE::NAME` is one
            recording of several in a file, `demo` the one that comes with the package.
        format: Format to write, where the suffix does not tell it.
        mano: The licensed MANO model: MANO_RIGHT.pkl, or the folder that holds both hands.
        side: Which hand the recordings are of, where the files do not say.
        fps: Samples a second, in place of the time in the files; needed where they have none.
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
        recordings = [source.read() for source in sources]
        contents = {out: recordings}
        if has_files:
            names = [f"{source.name}{form.suffixes[0]}" for source in sources]
            check_names("IN", names, "recordings of different names")
            files = map(out.joinpath, names)
            contents = dict(zip(files, zip(recordings), strict=True))
            make_folder(out, "OUT")
        for file, content in contents.items():
            form.write(content, file)
        self._report(
            recordings=len(recordings),
            samples=sum(map(len, recordings)),
            files=list(map(str, contents)),
            not_read=list(dict.fromkeys(chain.from_iterable(unread.values()))),
            lost=form.losses(recordings),
        )

    def _report(self, **done: Any) -> None:
        """Print what was converted, and what was lost: not read, or not held by the format."""
        if self.json:
            print(json.dumps(done))
            return
        lost = [*done["not_read"], *done["lost"]]
        print(f"{done['recordings']} recordings, {done['samples']} samples")
        print(f"lost: {', '.join(lost)}" if lost else "nothing was lost")
        for file in done["files"]:
            print(f"wrote {file}")
