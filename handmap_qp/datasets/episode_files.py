"""The file of an episode: written so that its digest is known, and verified before it is used."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import file_digest, sha256
from io import BytesIO
from pathlib import Path

import numpy as np

from handmap_qp.datasets.manifest import Line
from handmap_qp.errors import RecordingError
from handmap_qp.offline.trajectory import Trajectory
from handmap_qp.output_files import make_folder, replaced_file, sync_all, writing
from handmap_qp.trackers.formats.archive import read_archive

_COLUMNS = ("time", "q", "wrist", "valid")
"""What a data set for training is made of."""


def save_episode(file: Path, trajectory: Trajectory, side: str) -> str:
    """Write the columns of an episode, without those that a reader can compute again; see `synced`.

    They are not compressed: that would save a fifth of the space, and take as long as reading the
    recording.

    Args:
        file: The file; its folder is made.
        trajectory: What the robot does.
        side: Which hand.

    Returns:
        SHA-256 of the file, as `sha256sum` prints it.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    left_out = {"versions", "all_q", "all_joint_names", "all_joint_roles"}
    columns = {name: a for name, a in trajectory.columns.items() if name not in left_out}
    # Written at once: the parts of an archive, one by one, take twice as long.
    archive = BytesIO()
    np.savez(archive, allow_pickle=False, **columns, side=np.array(side))
    make_folder(file.parent, "--out")
    with replaced_file(file, "--out", is_synced=False) as stream:
        stream.write(archive.getbuffer())
    return sha256(archive.getbuffer()).hexdigest()


def synced(folder: Path, lines: Sequence[Line]) -> Sequence[Line]:
    """Return lines for the manifest when their episodes are on the disk.

    Raises:
        DiskFullError: If the disk is full.
        InvalidInputError: If they cannot be written for another reason.
    """
    with writing(folder, "--out"):
        sync_all([folder / line.out for line in lines if line.out])
    return lines


def read_episode(folder: Path, line: Line) -> dict[str, np.ndarray]:
    """Verify an episode, and read what a data set for training needs of it.

    Args:
        folder: Folder of the batch.
        line: The episode's line in the manifest. Where it has no digest, as up to version 0.2, all
            arrays are read, because the archive has a checksum of each.

    Returns:
        `time`, `q`, `wrist` and `valid`, each with `line.frames` rows.

    Raises:
        RecordingError: If the file is missing, or is not what was written.
    """
    file = folder / line.out
    try:
        with file.open("rb") as stream:
            is_same = line.sha256 in ("", file_digest(stream, "sha256").hexdigest())
    except OSError as error:
        raise RecordingError(f"cannot be read: {error.strerror or error}", file=file) from error
    if not is_same:
        raise RecordingError("is not what was written: its digest differs", file=file)
    arrays = read_archive(file, _COLUMNS if line.sha256 else None)
    for name in _COLUMNS:
        if name not in arrays or arrays[name].shape[:1] != (line.frames,):
            raise RecordingError("is missing or torn", file=file, array=name)
    return {name: arrays[name] for name in _COLUMNS}


def is_intact(folder: Path, line: Line) -> bool:
    """Return whether an episode is what was written; see `read_episode`."""
    try:
        read_episode(folder, line)
    except RecordingError:
        return False
    return True
