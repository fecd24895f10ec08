"""The command `handmap convert`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from handmap_qp.errors import InvalidInputError

FormatName = Literal["npz", "csv", "lerobot", "robomimic", "egodex", "mcap", "mano"]


@dataclass(frozen=True)
class Convert:
    """Convert recordings of human hands between file formats.

    The suffix of OUT tells its format; a name without suffix is a LeRobot data set. Says in one
    line what the new format cannot hold.

      npz        arrays of numpy by name; lossless, one of each hand
      csv        a text table, numbers kept exactly; one of each hand
      lerobot    a folder, LeRobot v3 (parquet); lossless, any number
      robomimic  HDF5 as of robomimic; lossless, any number
      egodex     HDF5 as of EgoDex, poses of joints; one of each hand
      mcap       ROS 2 bag, JointState and landmarks; one of each hand
      mano       npz of MANO's joints; reads parameters with your model

    All but npz, csv and mano need the extra `handmap-qp[files]`.

    Examples:
        handmap convert take.npz take.csv
        handmap convert left.npz right.npz both.hdf5 --format egodex
        handmap convert episode.hdf5 lerobot_set
        handmap convert lerobot_set takes --format npz   (a file for each)
        handmap convert demo demo.mcap

    Attributes:
        paths: Files or data sets to read, then the file or folder to write. `FILE::NAME` is one
            recording of several in a file, `demo` the one that comes with the package.
        format: Format to write, where the suffix does not tell it.
        mano: The licensed MANO model: MANO_RIGHT.pkl, or the folder that holds both hands.
        json: Print one JSON object.
    """

    paths: tyro.conf.Positional[
        Annotated[
            tuple[Path, ...], tyro.conf.arg(metavar="IN... OUT", help_behavior_hint="(required)")
        ]
    ]
    format: Annotated[
        FormatName | None, tyro.conf.arg(help_behavior_hint="(default: by the suffix of OUT)")
    ] = None
    mano: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: $HANDMAP_MANO)")
    ] = None
    json: bool = False

    def run(self) -> None:
        """Read, write, and say what was lost."""
        from handmap_qp.datasets.convert import convert

        if len(self.paths) < 2:
            raise InvalidInputError(
                argument="IN OUT", expected="a file to read and one to write", got="one path"
            )
        done = convert(self.paths[:-1], self.paths[-1], self.format, self.mano)
        if self.json:
            result = {
                "recordings": done.recordings,
                "samples": done.samples,
                "files": [str(file) for file in done.files],
                "not_read": list(done.unread),
                "lost": list(done.losses),
            }
            print(json.dumps(result))
            return
        lost = [*done.unread, *done.losses]
        print(f"{done.recordings} recordings, {done.samples} samples")
        print(f"lost: {', '.join(lost)}" if lost else "nothing was lost")
        for file in done.files:
            print(f"wrote {file}")
