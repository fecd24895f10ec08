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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from handmap_core.errors import InvalidInputError, expect, require
from handmap_core.se3 import Array, affine
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
    RecordingFormat,
    build_recording,
    column,
    first_of,
    known_columns,
    reading,
    side_of,
)

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
) -> Array:
    """Read an array of numbers, in the type that the file has.

    Args:
        group: The group that holds it.
        name: Its name there.
        shape: Its shape, or the first part of it.

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
    elif item.nbytes > LARGEST_ARCHIVE:
        problem = f"is larger than the {LARGEST_ARCHIVE >> 20} MB that are read"
    if problem:
        raise InvalidInputError(problem, argument=f"{group.name.rstrip('/')}/{name}")
    # By its name, because h5py's own type is no native one to the compiled core.
    return np.array(item[()], item.dtype.str)


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


class _Hdf5Format(RecordingFormat):
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
            for key in ("name", *WORDS):
                columns[key] = str(demo.attrs.get(key, ""))
        return build_recording(path, entry, **columns, prefix=f"data/{entry.name}/obs/")

    def unread(self, path: Path) -> Names:
        """Name the arrays that a recording cannot hold."""
        with opened(path) as file:
            found: set[str] = set()
            for demo in file["data"].values():
                found |= set(demo) - {"obs"}
                found |= {f"obs/{name}" for name in set(demo["obs"]) - set(COLUMNS)}
            return tuple(sorted(found))

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write each recording as a demonstration."""
        expect(recordings, "recordings", "at least one", got="none")
        with created(path) as file:
            data = file.create_group("data")
            data.attrs["total"] = sum(len(recording) for recording in recordings)
            env = {"env_name": "human_hand", "env_type": 2, "env_kwargs": {}}
            data.attrs["env_args"] = json.dumps(env)
            for i, recording in enumerate(recordings):
                demo = data.create_group(f"demo_{i}")
                demo.attrs["num_samples"] = len(recording)
                for key in ("name", "side", *WORDS):
                    demo.attrs[key] = getattr(recording, key)
                for name in known_columns(recording):
                    values = column(recording, name)
                    check_room(file, values.nbytes)
                    demo[f"obs/{name}"] = values


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
        confidence = None
        with opened(path) as file:
            group = file["transforms"]
            poses = stacked_numbers(group, names, (count, 4, 4))
            is_seen = finite_samples(poses[0])
            if "confidences" in file:
                given = file["confidences"]
                shares = stacked_numbers(given, names, (count,))
                is_seen &= shares[0] > 0.0
                confidence = shares.mean(axis=0)
            # The second description is of the same motion the other way round.
            which = file.attrs.get("which_llm_description", "")
            key = f"llm_description{which}".removesuffix("1")
            task = str(file.attrs.get(key, ""))
            time = np.arange(count) / RATE
            time_source = f"{RATE:g} samples/s, as the format says"
            if "time" in file:
                time = numbers(file, "time", (count,))
                time_source = ""
        return build_recording(
            path,
            entry,
            time,
            poses[:, :, :3, 3].swapaxes(0, 1),
            prefix=f"{entry.side} hand: ",
            valid=is_seen,
            source="EgoDex",
            task=task,
            time_source=time_source,
            wrist=poses[0],
            confidence=confidence,
        )

    def unread(self, path: Path) -> Names:
        """Name the joints and groups that a recording cannot hold."""
        with opened(path) as file:
            known = map(joint_names, SIDES)
            others = len(set(file["transforms"]).difference(*known))
            rest = sorted(set(file) - {"transforms", "confidences", "time"})
        poses = (f"{others} other poses",) if others else ()
        return (*poses, *rest, "orientations of the fingers' joints")

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand or both; the fingers' joints have no orientation of their own.

        Where the tracker gave no wrist pose, the wrist's orientation is that of the palm.
        """
        self.check_one_per_hand(recordings)
        expect(
            len({recording.time.tobytes() for recording in recordings}) == 1,
            "recordings",
            "both hands at the same instants, as EgoDex has them",
            got="others",
            advice="write one file for each hand",
        )
        with created(path) as file:
            file["time"] = recordings[0].time
            for recording in recordings:
                given = 1.0 if recording.confidence is None else recording.confidence
                turns = np.tile(np.eye(3), (21, len(recording), 1, 1))
                if recording.wrist is None:
                    seen = recording.valid
                    sign = 1.0 if recording.side == "right" else -1.0
                    turns[0, seen] = palm_axes(recording.landmarks[seen], sign)
                else:
                    turns[0] = recording.wrist[:, :3, :3]
                poses = affine(turns, recording.landmarks.swapaxes(0, 1))
                check_room(file, 2 * poses.nbytes)
                for name, pose in zip(joint_names(recording.side), poses, strict=True):
                    file[f"transforms/{name}"] = pose
                    file[f"confidences/{name}"] = np.where(recording.valid, given, 0.0)
