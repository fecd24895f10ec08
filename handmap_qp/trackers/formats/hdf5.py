"""Recordings as HDF5, in the forms of robomimic and of EgoDex; and opening HDF5 files.

Written from the documentation of robomimic (robomimic.github.io/docs/datasets/overview.html): the
group `data` has the attributes `total` and `env_args` (JSON); `data/demo_0` has the attribute
`num_samples`, and `obs` with an array (N, ...) for each observation.

And from that of EgoDex (Hoque et al. 2025, arXiv 2505.11709, and the README of apple/ml-egodex):
`transforms/NAME (N, 4, 4)` has the pose of a joint in the world of the session [m],
`confidences/NAME (N,)` its confidence from 0 to 1, and a frame is 1/30 s. Names are those of ARKit:
`leftHand` is the wrist, `leftIndexFingerKnuckle` the MCP joint, `...IntermediateBase` the PIP and
`...IntermediateTip` the DIP joint; the thumb's knuckle is its CMC joint.
"""

import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from handmap_core.errors import InvalidInputError, expect, require
from handmap_core.se3 import Array, Arrays, affine
from handmap_core.trackers.wrist_axes import palm_axes
from handmap_qp.hands import Names, Side, Values
from handmap_qp.human import Recording, finite_samples
from handmap_qp.output_files import replaced_path
from .archive import LARGEST_ARCHIVE
from .base import (
    COLUMNS,
    SIDES,
    WORDS,
    Entry,
    WrittenByPieces,
    build_recording,
    column,
    first_of,
    known_columns,
    reading,
    side_of,
)
from .long import LongRecording, pieces_of
from .pieces import OPTIONAL, open_pieces

SUFFIXES = (".hdf5", ".h5")
RATE = 30.0
"""Frames per second of EgoDex."""
_LINKS = ("Knuckle", "IntermediateBase", "IntermediateTip", "Tip")
_FINGERS = ("Thumb", "IndexFinger", "MiddleFinger", "RingFinger", "LittleFinger")
_OVERHEAD = 1 << 20
"""Room for names, attributes and tables of what `check_room` is asked for [bytes]."""


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a file for reading, and turn what h5py raises inside the block into `RecordingError`.

    Yields:
        The `h5py.File`.

    Raises:
        RecordingError: If the file is damaged.
        MissingExtraError: If h5py is not installed.
    """
    h5py = require("h5py", "files")
    with reading(path, "cannot be read as HDF5"), h5py.File(path, "r") as file:
        yield file


def numbers(
    group: Any,
    name: str,
    shape: tuple[int, ...],
    samples: slice | None = None,
) -> Array:
    """Read an array of numbers, in the type that the file has.

    Args:
        group: The group that holds it.
        name: Its name there.
        shape: Its shape, or the first part of it.
        samples: Which rows to read; all if omitted.

    Raises:
        InvalidInputError: If it is missing, of another shape or type, or impossibly large.
    """
    item = group.get(name)
    size = getattr(item, "shape", None)
    problem = ""
    if size is None:
        problem = f"is missing; there are {first_of(sorted(group), 6) or 'none'}"
    elif size[: len(shape)] != shape or item.dtype.kind not in "biuf":
        got = f"{item.dtype} of shape {size}"
        problem = f"expected numbers of shape {shape}, got {got}"
    elif samples is None and item.nbytes > LARGEST_ARCHIVE:
        problem = f"is larger than the {LARGEST_ARCHIVE >> 20} MB that are read"
    if problem:
        raise InvalidInputError(problem, argument=f"{group.name.rstrip('/')}/{name}")
    # By its name, because h5py's own type is no native one to the compiled core.
    return np.array(item[() if samples is None else samples], item.dtype.str)


def stacked_numbers(group: Any, names: Sequence[str], shape: tuple[int, ...]) -> Array:
    """Read arrays that have one shape, as floats.

    Returns:
        Shape (len(names), *shape).

    Raises:
        InvalidInputError: See `numbers`.
    """
    # Its size is checked before room for all of them is taken.
    first = numbers(group, names[0], shape)
    stacked = np.empty((len(names), *first.shape))
    stacked[0] = first
    # Use the lower layer of h5py. The upper one takes 150 calls an array, and EgoDex has 42 arrays
    # a hand.
    h5py = require("h5py", "files")
    everything = h5py.h5s.ALL
    for name, row in zip(names[1:], stacked[1:], strict=True):
        try:
            item = h5py.h5d.open(group.id, name.encode())
            is_alike = item.shape == row.shape
            if is_alike:
                item.read(everything, everything, row, h5py.h5t.NATIVE_DOUBLE)
        # There is no such array, or it has no numbers.
        except (KeyError, TypeError, OSError):
            is_alike = False
        if not is_alike:
            row[...] = numbers(group, name, row.shape)
    return stacked


@contextmanager
def created(path: Path, argument: str = "path") -> Iterator[Any]:
    """Open a file for writing that takes the place of `path` when the block has succeeded.

    Args:
        path: The file; its folder must exist.
        argument: Argument or option that names it.

    Yields:
        The `h5py.File`; it keeps no times, so that the same content is the same bytes.

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If h5py is not installed.
    """
    h5py = require("h5py", "files")
    with replaced_path(path, argument) as temporary, h5py.File(temporary, "w") as file:
        yield file


def write_rows(file: Any, count: int, parts: Iterable[Arrays]) -> None:
    """Write arrays side by side, some rows at once.

    Args:
        file: The `h5py.File`, open for writing.
        count: Number of rows of all parts.
        parts: The next rows of each array, by the name of its data set in the file.

    Raises:
        OSError: If the disk is full.
    """
    start = 0
    for part in parts:
        if not start:
            row = sum(values[0].nbytes for values in part.values())
            check_room(file, count * row)
            for name, values in part.items():
                file.create_dataset(name, (count, *values.shape[1:]), values.dtype)
        stop = start + len(next(iter(part.values())))
        for name, values in part.items():
            file[name][start:stop] = values
        start = stop
    assert start == count


def check_room(file: Any, size: int) -> None:
    """See that the disk has room for what is written next: libhdf5 crashes where it is full.

    Args:
        file: The `h5py.File`, open for writing.
        size: Most that is written until the next call [bytes].

    Raises:
        OSError: If the disk is full.
    """
    file.flush()
    with tempfile.TemporaryFile(dir=Path(file.filename).parent) as room:
        os.posix_fallocate(room.fileno(), 0, size + _OVERHEAD)


class _Hdf5Format(WrittenByPieces):
    suffixes = SUFFIXES
    group: str
    """The group that files of this form have."""

    def recognises(self, path: Path) -> bool:
        """Tell whether the file has the group."""
        if not path.is_file():
            return False
        with opened(path) as file:
            return self.group in file


class RobomimicFormat(_Hdf5Format):
    """A file with one demonstration for each hand and recording; lossless.

    `obs` of each demonstration has `landmarks (N, 63)` [m], `time (N,)` [s], `valid (N,)`, and
    where they are known `confidence (N,)` and `wrist (N, 12)`, the upper three rows of its pose.
    Name, side, source and the axes that are up and forward are attributes.
    """

    name = "robomimic"
    group = "data"

    def entries(self, path: Path) -> Sequence[Entry]:
        """List the demonstrations by their numbers."""
        with opened(path) as file:
            entries = []
            # demo_2 is before demo_10.
            for name in sorted(file["data"], key=lambda name: (len(name), name)):
                demo = file["data"][name]
                place = f"data/{name}"
                if "obs/landmarks" not in demo:
                    problem = f"has no obs/landmarks; it has {', '.join(sorted(demo))}"
                    raise InvalidInputError(problem, argument=place)
                side = side_of(demo.attrs.get("side"), place)
                entries.append(Entry(name, side, len(demo["obs/landmarks"])))
            return entries

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one demonstration."""
        with opened(path) as file:
            demo = file["data"][entry.name]
            obs = demo["obs"]
            columns: Values = {
                name: numbers(obs, name, (entry.samples,))
                for name in COLUMNS
                if name in obs or name == "time"
            }
            words = self._words(demo)
        return build_recording(
            path, entry, **columns, **words, prefix=self._prefix(entry)
        )

    def open_long(self, path: Path, entry: Entry) -> LongRecording | None:
        """Open one demonstration, unless it has an object with a shape or another rate."""
        with opened(path) as file:
            demo = file["data"][entry.name]
            names = [name for name in COLUMNS if name in demo["obs"] or name == "time"]
            words = self._words(demo)
        if words["object_shape"] or self.hints.fps is not None:
            return None
        return open_pieces(
            path,
            entry,
            lambda: self._pieces(path, entry, names),
            [name for name in OPTIONAL if name in names],
            prefix=self._prefix(entry),
            **words,
        )

    def _pieces(
        self, path: Path, entry: Entry, names: Sequence[str]
    ) -> Iterator[Values]:
        """Read columns of one demonstration by pieces."""
        for samples in pieces_of(entry.samples):
            with opened(path) as file:
                obs = file["data"][entry.name]["obs"]
                yield {
                    name: numbers(obs, name, (entry.samples,), samples)
                    for name in names
                }

    @staticmethod
    def _prefix(entry: Entry) -> str:
        """Return what the names of the arrays of a demonstration begin with."""
        return f"data/{entry.name}/obs/"

    @staticmethod
    def _words(demo: Any) -> dict[str, str]:
        """Return the name of a demonstration, and the words about it."""
        return {key: str(demo.attrs.get(key, "")) for key in ("name", *WORDS)}

    def unread(self, path: Path) -> Names:
        """Name the arrays that a recording cannot hold."""
        with opened(path) as file:
            found: set[str] = set()
            for demo in file["data"].values():
                found |= set(demo) - {"obs"}
                found |= {f"obs/{name}" for name in set(demo["obs"]) - set(COLUMNS)}
            return tuple(sorted(found))

    def write_long(self, recordings: Sequence[LongRecording], path: Path) -> None:
        """Write each recording as a demonstration."""
        expect(recordings, "recordings", "at least one", got="none")
        with created(path) as file:
            data = file.create_group("data")
            data.attrs["total"] = sum(len(recording) for recording in recordings)
            env = {"env_name": "human_hand", "env_type": 2, "env_kwargs": {}}
            data.attrs["env_args"] = json.dumps(env)
            for i, recording in enumerate(recordings):
                head = recording.overview
                demo = data.create_group(f"demo_{i}")
                demo.attrs["num_samples"] = len(recording)
                for key in ("name", "side", *WORDS):
                    demo.attrs[key] = getattr(head, key)
                names = known_columns(head)
                write_rows(
                    file,
                    len(recording),
                    (
                        {
                            f"{demo.name}/obs/{name}": column(part, name)
                            for name in names
                        }
                        for part in recording.parts()
                    ),
                )


def joint_names(side: Side) -> Names:
    """Return the names of the 21 landmarks of a hand."""
    return (
        f"{side}Hand",
        *(f"{side}{finger}{link}" for finger in _FINGERS for link in _LINKS),
    )


class EgoDexFormat(_Hdf5Format):
    """Both hands as poses of ARKit's joints.

    A sample is valid where all 21 poses are finite and the wrist's confidence is above 0. Its
    confidence is the mean over the 21 joints. The task is `llm_description`, or the second one if
    `which_llm_description` says so. Files of this package have the tracker's instants in a further
    array `time (N,)`; others have 30 frames a second.
    """

    name = "egodex"
    group = "transforms"
    lacks = (
        "source",
        "upright",
        "task",
        "time_source",
        "object_pose",
        "no wrist",
        "wrist position",
        "no confidence",
    )

    def entries(self, path: Path) -> Sequence[Entry]:
        """List the hands whose wrist the file has."""
        with opened(path) as file:
            group = file["transforms"]
            found = [side for side in SIDES if f"{side}Hand" in group]
            if not found:
                problem = "has neither 'leftHand' nor 'rightHand'"
                raise InvalidInputError(problem, argument="transforms")
            return [Entry(side, side, len(group[f"{side}Hand"])) for side in found]

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one hand."""
        names = joint_names(entry.side)
        count = entry.samples
        shares = None
        with opened(path) as file:
            poses = stacked_numbers(file["transforms"], names, (count, 4, 4))
            if "confidences" in file:
                shares = stacked_numbers(file["confidences"], names, (count,))
            time = np.arange(count) / RATE
            if "time" in file:
                time = numbers(file, "time", (count,))
            words = self._words(file)
        columns = self._columns(time, poses, shares)
        return build_recording(
            path, entry, **columns, **words, prefix=self._prefix(entry)
        )

    def open_long(self, path: Path, entry: Entry) -> LongRecording | None:
        """Open one hand, unless it is to have another rate."""
        if self.hints.fps is not None:
            return None
        with opened(path) as file:
            words = self._words(file)
            has_shares = "confidences" in file
        return open_pieces(
            path,
            entry,
            lambda: self._pieces(path, entry),
            ["wrist", "confidence"] if has_shares else ["wrist"],
            prefix=self._prefix(entry),
            **words,
        )

    def _pieces(self, path: Path, entry: Entry) -> Iterator[Values]:
        """Read columns of one hand by pieces."""
        names = joint_names(entry.side)
        count = entry.samples
        for samples in pieces_of(count):
            shares = None
            with opened(path) as file:
                group = file["transforms"]
                poses = np.array(
                    [numbers(group, n, (count, 4, 4), samples) for n in names], float
                )
                if "confidences" in file:
                    given = file["confidences"]
                    shares = np.array(
                        [numbers(given, n, (count,), samples) for n in names], float
                    )
                time = np.arange(samples.start, samples.stop) / RATE
                if "time" in file:
                    time = numbers(file, "time", (count,), samples)
            yield self._columns(time, poses, shares)

    @staticmethod
    def _prefix(entry: Entry) -> str:
        """Return what errors of one hand begin with."""
        return f"{entry.side} hand: "

    @staticmethod
    def _words(file: Any) -> dict[str, str]:
        """Return the words about the hands of a file."""
        # The second description is of the same motion the other way round.
        which = file.attrs.get("which_llm_description", "")
        key = f"llm_description{which}".removesuffix("1")
        by_rate = f"{RATE:g} samples/s, as the format says"
        return {
            "source": "EgoDex",
            "task": str(file.attrs.get(key, "")),
            "time_source": "" if "time" in file else by_rate,
        }

    @staticmethod
    def _columns(time: Array, poses: Array, shares: Array | None) -> Values:
        """Return the columns of one hand.

        Args:
            time: Instants [s], shape (T,).
            poses: Poses of the 21 joints, shape (21, T, 4, 4).
            shares: Their confidences, shape (21, T); None if there are none.
        """
        is_seen = finite_samples(poses[0])
        columns: Values = {
            "time": time,
            "landmarks": poses[:, :, :3, 3].swapaxes(0, 1),
            "valid": is_seen,
            "wrist": poses[0],
        }
        if shares is not None:
            is_seen &= shares[0] > 0.0
            columns["confidence"] = shares.mean(axis=0)
        return columns

    def unread(self, path: Path) -> Names:
        """Name the joints and groups that a recording cannot hold."""
        with opened(path) as file:
            known = map(joint_names, SIDES)
            others = len(set(file["transforms"]).difference(*known))
            rest = sorted(set(file) - {"transforms", "confidences", "time"})
        poses = (f"{others} other poses",) if others else ()
        return (*poses, *rest, "orientations of the fingers' joints")

    def write_long(self, recordings: Sequence[LongRecording], path: Path) -> None:
        """Write one hand or both; the fingers' joints have no orientation of their own.

        Where the tracker gave no wrist pose, the wrist's orientation is that of the palm.
        """
        self.check_one_per_hand(recordings)
        times = [recording.instants() for recording in recordings]
        expect(
            len({time.tobytes() for time in times}) == 1,
            "recordings",
            "both hands at the same instants, as EgoDex has them",
            got="others",
            advice="write one file for each hand",
        )
        with created(path) as file:
            file["time"] = times[0]
            for recording in recordings:
                write_rows(
                    file, len(recording), map(self._joints_of, recording.parts())
                )

    @staticmethod
    def _joints_of(part: Recording) -> Arrays:
        """Return pose and confidence of each joint by the names of their data sets."""
        given = 1.0 if part.confidence is None else part.confidence
        turns = np.tile(np.eye(3), (21, len(part), 1, 1))
        if part.wrist is None:
            seen = part.valid
            sign = 1.0 if part.side == "right" else -1.0
            turns[0, seen] = palm_axes(part.landmarks[seen], sign)
        else:
            turns[0] = part.wrist[:, :3, :3]
        poses = affine(turns, part.landmarks.swapaxes(0, 1))
        shares = np.where(part.valid, given, 0.0)
        names = joint_names(part.side)
        return {
            f"transforms/{name}": pose for name, pose in zip(names, poses, strict=True)
        } | {f"confidences/{name}": shares for name in names}
