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

from handmap_qp.errors import InvalidInputError, expect
from handmap_qp.hands import Names, Side, Values
from handmap_qp.human import LANDMARK_COUNT, Recording, finite_samples
from handmap_qp.se3 import Array, as_floats
from handmap_qp.trackers import SIDES, read_archive
from handmap_qp.trackers.formats.archive import OF_MANO, member_names
from handmap_qp.trackers.formats.base import RecordingFormat, side_of
from handmap_qp.trackers.formats.hdf5 import SUFFIXES, numbers, opened
from handmap_qp.trackers.formats.mano import (
    FROM_MANO,
    HandArrays,
    ManoFormat,
    read_table,
)
from handmap_qp.trackers.hand_geometry import palmar_evidence

KEYPOINTS = "pred_keypoints_3d"
FLAGS = ("right", "is_right")
"""Names of the array that says which hands are right ones."""
SHIFTS = ("pred_cam_t_full", "cam_t")
"""Names of the array that says where the hands are, in the axes of the camera."""
_MAIN = {KEYPOINTS, *OF_MANO}
"""Arrays of which a file has one for each frame."""
_OWN = {*_MAIN, *FLAGS, *SHIFTS, "global_orient", "betas", "transl"}
_TIMES = {"time", "fps"}
_OWN |= {"flat_hand_mean", "side", *_TIMES}


class HamerFormat(ManoFormat):
    """Arrays by name in an `.npz`, an HDF5 file or a pickled table, or one array as `.npy`.

    `pred_keypoints_3d` is (T, 21, 3), or (T, n, 21, 3) of n hands in a frame [m]; NaN where a hand
    was not found. Of several hands of a side in a frame the first one counts. An `.npy` file is
    this array. `right` or `is_right` says by 1 or 0 which hands are right ones, shape (), (n,),
    (T,) or (T, n); `side` says it of all. A file that does not say it is taken for the hand that is
    asked for. `pred_cam_t_full` or `cam_t` is where the hands are in the camera's axes [m], shape
    (T, 3) or (T, n, 3). Without `time (T,)` and `fps`, samples are numbered, for `--fps`.

    Without keypoints, `global_orient`, `hand_pose` and `betas` are MANO's, as of the form `mano`;
    turns may be rotation matrices (T, n, 3, 3), of which the identity is the flat hand, and of
    `betas (T, 10)` the mean is taken.
    A pickle is read as of `read_table`, which runs no code.
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
                return np.load(path, mmap_mode="r").shape[-2:] == (LANDMARK_COUNT, 3)
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
            arrays["betas"] = np.atleast_2d(arrays["betas"]).mean(axis=0)
        for name in ("global_orient", "hand_pose"):
            if np.ndim(arrays.get(name, 0.0)) == 4:
                arrays[name] = _vectors_of(as_floats(arrays[name], name))
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
        arrays = {name: numbers(file, name, ()) for name in _OWN if name in file}
        return {**file.attrs, **arrays}


def _sides_of(arrays: Values) -> Sequence[Side]:
    """Return the side that a file names, or both."""
    return [side_of(arrays["side"], "side")] if "side" in arrays else SIDES


def _vectors_of(rotations: Array) -> Array:
    """Return rotation vectors [rad], shape (T, 3 n), of rotations, shape (T, n, 3, 3)."""
    vectors = [*map(pin.log3, rotations.reshape(-1, 3, 3))]
    return np.reshape(vectors, (len(rotations), -1))


def _hands_of(arrays: Values) -> HandArrays:
    """Return the hands of predicted keypoints, as arrays of `ManoFormat`."""
    points = as_floats(arrays[KEYPOINTS], KEYPOINTS)
    shape = (
        ("T", LANDMARK_COUNT, 3) if points.ndim == 3 else ("T", "n", LANDMARK_COUNT, 3)
    )
    as_floats(points, KEYPOINTS, shape=shape)
    frames = points.reshape(len(points), -1, LANDMARK_COUNT, 3)
    places = frames.shape[:2]
    shifts = _each(arrays, SHIFTS, places, 3)
    flags = _each(arrays, FLAGS, places)
    if flags is not None:
        is_flag = np.isin(flags, (0.0, 1.0)) | ~np.isfinite(frames).all(axis=(2, 3))
        expect(is_flag.all(), "right", "1 for each right hand and 0 for each left one")
    hands: HandArrays = {}
    for side in SIDES if flags is not None else _sides_of(arrays):
        own: Array = np.ones(places, dtype=bool)
        if flags is not None:
            own = np.equal(flags, float(side == "right"))
        chosen = np.arange(len(frames)), own.argmax(axis=1)
        is_there: Any = own.any(axis=1)
        joints = _unmirrored(frames[chosen], is_there, side)
        if joints is None:
            continue
        if shifts is not None:
            joints = joints + shifts[chosen][:, None]
        hands[side] = {
            **{name: arrays[name] for name in ("time", "fps") if name in arrays},
            "side": side,
            "joints": joints[:, np.argsort(FROM_MANO)],
            "valid": is_there & finite_samples(joints),
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
    wanted = (*places, *last)
    if values.size == np.prod(wanted):
        return values.reshape(wanted)
    if values.size == np.prod((count, *last)):
        return np.broadcast_to(values.reshape(count, *last), wanted)
    if values.size == 1 and not last:
        return np.broadcast_to(values.reshape(()), wanted)
    expected = f"a value for each of {count} hands in {frames} frames"
    raise InvalidInputError(
        argument=name, expected=expected, value=values, got=f"shape {values.shape}"
    )


def _unmirrored(joints: Array, is_there: Array, side: str) -> Array | None:
    """Mirror a hand that the file has as the other one; None where the hand is never seen.

    The network's own left hands are right ones. A script may have mirrored them already: the bend
    of the fingers and the place of the thumb say which it is.
    """
    seen = is_there & finite_samples(joints)
    if not seen.any():
        return None
    evidence: Any = np.median(palmar_evidence(joints[seen]).total)
    is_right = evidence > 0.0
    return joints * [-1.0, 1.0, 1.0] if side == "left" and is_right else joints
