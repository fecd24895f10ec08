"""`handmap videos`: the videos beside recordings, such as EgoDex's, in a LeRobot data set.

Written from the documentation of LeRobotDataset v3.0 and its `meta/info.json`: a video is a feature
of the type `video`, its file is `videos/KEY/chunk-000/file-000.mp4`, and `meta/episodes` says of
each episode which file and which part of it are its own.
"""

import json
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from tyro.conf import Positional, arg

from handmap_qp.apps.datasets.manifest import read_manifests
from handmap_qp.apps.tables import print_result
from handmap_qp.errors import expect, require
from handmap_qp.hands import Values
from handmap_qp.output_files import make_folder, replaced_file, replaced_path
from handmap_qp.se3 import Array
from handmap_qp.trackers.formats.base import reading
from handmap_qp.trackers.formats.lerobot import (
    CHUNK_FILES,
    EPISODES_PATH,
    Stats,
    episode_stats,
    joined_stats,
)

KEY = "observation.images.camera"
"""Name of the video among the features."""
PLACE = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_FRAMES, _PIXELS = 16, 8
"""Statistics are of that many frames, and of each eighth pixel in a row and a column."""


class Video(NamedTuple):
    """What a data set says of a video.

    Attributes:
        fps: Frames per second.
        frames: Number of frames.
        about: Its size and coding by LeRobot's names.
        stats: Statistics of its colours from 0 to 1.
    """

    fps: Fraction
    frames: int
    about: Values
    stats: Stats


@dataclass(frozen=True)
class Videos:
    """Add the videos beside recordings to the LeRobot data set of a batch.

    The video of `task/0.hdf5` is `task/0.mp4`, as in EgoDex, with a frame for each sample. Each is
    copied once, or linked where the disk is the same, and becomes the feature
    `observation.images.camera`. The data set must have the videos' frames per second.

    Examples:
        handmap batch egodex/part1 --robot allegro_left allegro_right --out mapped --format lerobot
        handmap videos mapped

    Attributes:
        folder: Folder of the batch.
        json: Print one JSON object.
    """

    folder: Positional[Annotated[Path, arg(metavar="DIR")]]
    json: bool = False

    def run(self) -> None:
        """Add the videos, and say how many."""
        root = self.folder / "lerobot"
        count = add_videos(root, _files_of(self.folder))
        done = {"videos": count, "data_set": str(root)}
        print_result(done, {str(root): {"videos": f"{count}"}}, as_json=self.json)


def add_videos(root: Path, videos: Mapping[str, Path]) -> int:
    """Add a video to each episode of a LeRobot data set; what describes the set is written last.

    Args:
        root: Folder of the data set.
        videos: Files by the keys of recordings, as in the column `source` of `meta/episodes`.

    Returns:
        Number of files that were added.

    Raises:
        RecordingError: If the data set or a video cannot be read.
        InvalidInputError: If a video is missing, is too short, or has another rate than the set.
        MissingExtraError: If pyarrow is not installed.
    """
    parquet = require("pyarrow.parquet", "files")
    place = root / EPISODES_PATH
    with reading(root, "is not a LeRobot data set"):
        info = json.loads((root / "meta/info.json").read_bytes())
        stats = json.loads((root / "meta/stats.json").read_bytes())
        table = parquet.read_table(place)
        episodes = table.select(["source", "length"]).to_pylist()
    expect(KEY not in info["features"], "DIR", "a data set without videos", got=KEY)
    rows: list[Values] = []
    found: dict[Path, Video] = {}
    numbers: dict[Path, int] = {}
    total: Stats | None = None
    for episode in episodes:
        source = episode["source"].partition(", ")[0]
        file = videos.get(source, Path(f"{source}.mp4"))
        expect(file.is_file(), "DIR", "a video beside each recording", got=f"no {file}")
        if file not in found:
            numbers[file] = len(found)
            found[file] = read_video(file)
        video = found[file]
        length = episode["length"]
        _check(file, video, info["fps"], length)
        total = joined_stats(total, video.stats)
        duration = length / info["fps"]
        rows.append(_row(numbers[file], duration, video))
    for file, number in numbers.items():
        _copy(file, root / _place(number))
    # Columns that are there are of a run that was cut off.
    table = table.drop_columns([*rows[0].keys() & {*table.column_names}])
    for name in rows[0]:
        values = [row[name] for row in rows]
        table = table.append_column(name, [values])
    with replaced_path(place, "DIR") as temporary:
        parquet.write_table(table, temporary)
    stats[KEY] = _per_colour(total or {})
    first = next(iter(found.values()))
    info["video_path"] = PLACE
    info["features"][KEY] = first.about
    for name, content in (("stats", stats), ("info", info)):
        with replaced_file(root / f"meta/{name}.json", "DIR") as stream:
            stream.write(f"{json.dumps(content, indent=1)}\n".encode())
    return len(found)


def read_video(file: Path) -> Video:
    """Read rate, length, size and colours of a video.

    Raises:
        RecordingError: If it cannot be read.
    """
    # Imported here, so that `handmap --help` stays quick.
    av: Any = import_module("av")
    with reading(file, "is not a video"), av.open(str(file)) as opened:
        stream = opened.streams.video[0]
        fps = stream.average_rate or Fraction(0)
        # Frames that need no others: to decode all takes as long as to watch them.
        stream.codec_context.skip_frame = "NONKEY"
        colours = []
        for frame in islice(opened.decode(stream), _FRAMES):
            image = frame.to_ndarray(format="rgb24")
            some = image[::_PIXELS, ::_PIXELS]
            colours.append(some.reshape(-1, 3))
        about = {
            "dtype": "video",
            "shape": [stream.height, stream.width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": stream.height,
                "video.width": stream.width,
                "video.codec": stream.codec.canonical_name,
                "video.pix_fmt": stream.pix_fmt,
                "video.is_depth_map": False,
                "video.fps": int(fps),
                "video.channels": 3,
                "has_audio": bool(opened.streams.audio),
            },
        }
        stats = episode_stats(np.concatenate(colours) / 255.0)
        return Video(fps, stream.frames, about, stats)


def _files_of(folder: Path) -> dict[str, Path]:
    """Return the video beside each recording of a batch, by its key."""
    lines = read_manifests(folder)
    return {key: Path(line.path).with_suffix(".mp4") for key, line in lines.items()}


def _check(file: Path, video: Video, fps: float, length: int) -> None:
    own = float(video.fps)
    is_same = abs(own - fps) < 1e-3 * fps
    advice = f"write it by --fps {own:g} of `handmap batch`"
    wanted = f"a data set of {own:g} frames per second, as {file} has"
    expect(is_same, "DIR", wanted, got=f"{fps:g}", advice=advice)
    wanted = f"{length} frames in {file}"
    expect(video.frames >= length, "DIR", wanted, got=f"{video.frames}")


def _place(number: int) -> str:
    chunk, file = divmod(number, CHUNK_FILES)
    return PLACE.format(video_key=KEY, chunk_index=chunk, file_index=file)


def _row(number: int, duration: float, video: Video) -> Values:
    """Return what `meta/episodes` says of a video."""
    chunk, file = divmod(number, CHUNK_FILES)
    row: Values = {
        f"videos/{KEY}/chunk_index": chunk,
        f"videos/{KEY}/file_index": file,
        f"videos/{KEY}/from_timestamp": 0.0,
        f"videos/{KEY}/to_timestamp": duration,
    }
    for name, values in _per_colour(video.stats).items():
        row[f"stats/{KEY}/{name}"] = values
    return row


def _per_colour(stats: Mapping[str, Array]) -> dict[str, Any]:
    """Return statistics as LeRobot has those of images, shape (3, 1, 1) each."""
    own = {}
    for name, values in stats.items():
        is_count = name == "count"
        shaped = values if is_count else values[:, None, None]
        own[name] = shaped.tolist()
    return own


def _copy(file: Path, out: Path) -> None:
    """Link a file to a new place, or copy it to another disk."""
    make_folder(out.parent, "DIR")
    out.unlink(missing_ok=True)
    with suppress(OSError):
        os.link(file, out)
        return
    with replaced_path(out, "DIR") as temporary:
        shutil.copyfile(file, temporary)
