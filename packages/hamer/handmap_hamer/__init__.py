"""Hands that HaMeR (Pavlakos et al. 2024) and WiLoR (Potamias et al. 2025) predict in videos.

Facts are from their code, geopavlakos/hamer and rolpotamias/WiLoR: `pred_keypoints_3d` are MANO's
joints and fingertips in OpenPose's order, which is MediaPipe's [m], with the hand near the origin.
The networks know right hands only. A left hand is mirrored before and must be mirrored back: x is
negated, as the demo of HaMeR does with the vertices and that of WiLoR with the joints too. The
translation from the hand to the camera (`pred_cam_t_full`, `cam_t` in the demos) is added
afterwards. Rotation matrices are those of MANO with a flat hand as the identity.
"""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from handmap_core.trackers.hand_geometry import palmar_evidence
from handmap_qp.errors import expect
from handmap_qp.hands import Names, Side, Values
from handmap_qp.human import LANDMARK_COUNT, Recording, finite_samples
from handmap_qp.se3 import Array, as_floats
from handmap_qp.trackers import SIDES, read_archive
from handmap_qp.trackers.formats.archive import OF_MANO, member_names
from handmap_qp.trackers.formats.base import RecordingFormat, side_of
from handmap_qp.trackers.formats.hdf5 import SUFFIXES, numbers, opened
from handmap_qp.trackers.formats.mano import FROM_MANO, HandArrays, ManoFormat
from handmap_qp.trackers.formats.pickled import read_table

KEYPOINTS = "pred_keypoints_3d"
FLAGS = ("right", "is_right")
"""Names of the array that says which hands are right ones."""
SHIFTS = ("pred_cam_t_full", "cam_t")
"""Names of the array that says where the hands are, in the axes of the camera."""
_MAIN = {KEYPOINTS, *OF_MANO}
"""Arrays of which a file has one for each frame."""
_TIMES = {"time", "fps"}
_PARAMETERS = {"global_orient", "betas", "transl", "flat_hand_mean"}
_OWN = {*_MAIN, *FLAGS, *SHIFTS, *_TIMES, *_PARAMETERS, "side"}


class HamerFormat(ManoFormat):
    """Arrays by name in an `.npz`, an HDF5 file or a pickled table, or one array as `.npy`.

    `pred_keypoints_3d` is (T, 21, 3), or (T, n, 21, 3) of n hands in a frame [m]; NaN where a hand
    was not found. Of several hands of a side in a frame, the first one that was found counts. An
    `.npy` file is this array. `right` or `is_right` says by 1 or 0 which hands are right ones,
    shape (), (n,), (T,) or (T, n); `side` says it of all. A file that does not say it is taken for
    the hand that is asked for. `pred_cam_t_full` or `cam_t` is where the hands are in the camera's
    axes [m], shape (T, 3) or (T, n, 3). Without `time (T,)` and `fps`, samples are numbered, for
    `--fps`.

    Without keypoints, `global_orient`, `hand_pose` and `betas` are MANO's, as in the form `mano`;
    turns may be rotation matrices (T, n, 3, 3), of which the identity is the flat hand, and of
    `betas (T, 10)` the mean is taken.
    A pickle is read as in `read_table`, which runs no code.
    """

    name = "hamer"
    suffixes: Names = ()
    named = (".npz", ".npy", ".pkl", *SUFFIXES)
    left_out = ("vertices, boxes and cameras",)

    def recognises(self, path: Path) -> bool:
        """Tell whether the file has keypoints, or parameters in a file that is no archive."""
        suffix = path.suffix.lower()
        if not path.is_file():
            return False
        if suffix == ".npy":
            # ARCTIC has tables of the same suffix.
            with suppress(ValueError):
                array = np.load(path, mmap_mode="r")
                return array.shape[-2:] == (LANDMARK_COUNT, 3)
            return False
        if suffix == ".npz":
            return not member_names(path).isdisjoint((KEYPOINTS, "hand_pose"))
        return not _MAIN.isdisjoint(_read(path))

    def hands(self, path: Path) -> HandArrays:
        """Read each hand."""
        arrays = _read(path)
        if _TIMES.isdisjoint(arrays):
            arrays["fps"] = 1.0
        if KEYPOINTS in arrays:
            return _hands_of(arrays)
        if "betas" in arrays:
            betas = np.atleast_2d(arrays["betas"])
            arrays["betas"] = betas.mean(axis=0)
        for name in ("global_orient", "hand_pose"):
            given = arrays.get(name, 0.0)
            if np.ndim(given) == 4:
                rotations = as_floats(given, name)
                arrays[name] = _vectors_of(rotations)
                arrays["flat_hand_mean"] = True
        return {side: arrays | {"side": side} for side in _sides_of(arrays)}

    def unread(self, path: Path) -> Names:
        """Name the arrays that a recording cannot hold, and the time if there is none."""
        arrays = _read(path)
        others = sorted({*arrays} - _OWN)
        if _TIMES.isdisjoint(arrays):
            others.append("the time, which the file does not have")
        return tuple(others)

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Refuse: write the form `mano` in its place."""
        RecordingFormat.write(self, recordings, path)


FORMAT = HamerFormat()


def _read(path: Path) -> Values:
    """Read the arrays of a file by their names."""
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return read_archive(path)
    if suffix == ".npy":
        return {KEYPOINTS: np.load(path)}
    if suffix == ".pkl":
        return read_table(path)
    with opened(path) as file:
        arrays = dict(file.attrs)
        for name in _OWN.intersection(file):
            if name == "side":
                arrays[name] = file[name].asstr()[()]
            else:
                arrays[name] = numbers(file, name, ())
        return arrays


def _sides_of(arrays: Values) -> Sequence[Side]:
    """Return the side that a file names, or both."""
    if "side" in arrays:
        return [side_of(arrays["side"], "side")]
    return SIDES


def _vectors_of(rotations: Array) -> Array:
    """Return rotation vectors [rad], shape (T, 3 n), of rotations, shape (T, n, 3, 3)."""
    turns = rotations.reshape(-1, 3, 3)
    vectors = np.array([pin.log3(turn) for turn in turns])
    return vectors.reshape(len(rotations), -1)


def _hands_of(arrays: Values) -> HandArrays:
    """Return the hands of predicted keypoints, as arrays of `ManoFormat`."""
    points = as_floats(arrays[KEYPOINTS], KEYPOINTS)
    several = ("n",) if points.ndim == 4 else ()
    as_floats(points, KEYPOINTS, shape=("T", *several, LANDMARK_COUNT, 3))
    frames = points if several else points[:, None]
    is_seen: Any = np.isfinite(frames).all(axis=(2, 3))
    flags = _each(arrays, FLAGS, is_seen.shape)
    shifts = _each(arrays, SHIFTS, is_seen.shape, 3)
    times = {name: arrays[name] for name in _TIMES if name in arrays}
    sides = _sides_of(arrays)
    if flags is not None:
        sides = SIDES
        is_flag = np.isin(flags, (0.0, 1.0)) | ~is_seen
        expect(is_flag.all(), "right", "1 for each right hand and 0 for each left one")
    every = np.arange(len(frames))
    hands: HandArrays = {}
    for side in sides:
        is_own = is_seen
        if flags is not None:
            is_own = is_seen & (flags == float(side == "right"))
        valid = is_own.any(axis=1)
        if not valid.any():
            continue
        first = every, is_own.argmax(axis=1)
        joints = _unmirrored(frames[first], valid, side)
        if shifts is not None:
            joints = joints + shifts[first][:, None]
        hands[side] = {
            **times,
            "side": side,
            "joints": joints[:, np.argsort(FROM_MANO)],
            "valid": valid & finite_samples(joints),
        }
    return hands


def _each(
    arrays: Values, names: Sequence[str], places: tuple[int, ...], *last: int
) -> Array | None:
    """Return the first of some arrays that there is, for each hand in each frame."""
    name = next(filter(arrays.__contains__, names), None)
    if name is None:
        return None
    values = as_floats(arrays[name], name)
    frames, count = places
    of_all = (*places, *last)
    of_one = (frames, *last)
    if count == 1 and values.shape == of_one:
        values = values[:, None]
    is_right = values.shape in (of_all, of_all[1:], last)
    expected = f"a value for each of {count} hands in {frames} frames"
    expect(is_right, name, expected, got=f"shape {values.shape}")
    return np.broadcast_to(values, of_all)


def _unmirrored(joints: Array, valid: Array, side: str) -> Array:
    """Mirror a hand that the file has as the other one.

    The network's own left hands are right ones. A script may have mirrored them already: the bend
    of the fingers and the place of the thumb say which it is.
    """
    evidence = np.median(palmar_evidence(joints[valid]).total)
    is_mirrored = side == "left" and evidence > 0.0
    return joints * [-1.0, 1.0, 1.0] if is_mirrored else joints
