"""Recordings of the MANO hand model as `.npz`: by its 21 joints, or by its parameters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from handmap_qp.errors import RecordingError
from handmap_qp.human.recording import Recording
from handmap_qp.human.sample import LANDMARK_COUNT
from handmap_qp.output_files import replaced_file
from handmap_qp.se3 import as_floats
from handmap_qp.trackers.formats.archive import member_names, read_archive
from handmap_qp.trackers.formats.base import (
    Entry,
    RecordingFormat,
    build_recording,
    reading,
    side_of,
)
from handmap_qp.trackers.formats.mano_model import load_model

FROM_MANO = np.array(
    [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]
)
"""Index in MANO's order of each landmark.

That order is 16 joints (wrist; index, middle, little, ring and thumb, three each), then the tips
from thumb to little.
"""
_POSES = ("pose", "hand_pose")
_KNOWN = {
    "joints",
    "side",
    "time",
    "fps",
    "valid",
    "betas",
    "transl",
    "global_orient",
} | {*_POSES}


class ManoFormat(RecordingFormat):
    """Arrays of MANO by name.

    Needed: `side` (right or left), `time (T,)` [s] or `fps`, and either `joints (T, 21, 3)` [m] in
    MANO's order (16 joints, then the tips from thumb to little), or parameters: `pose (T, 48)`, or
    `global_orient (T, 3)` and `hand_pose (T, 45)` or fewer principal components, as rotation
    vectors [rad]; `betas (10,)`; `transl (T, 3)` [m]; and `flat_hand_mean`, whether 0 is the flat
    hand. Parameters need the user's copy of the licensed model.

    Args:
        model: File of the model, or its folder; that of `HANDMAP_MANO` if omitted.
    """

    name = "mano"
    suffixes = (".npz",)
    about = "MANO's 21 joints, or its parameters with your copy of the licensed model"
    lacks = ("wrist", "confidence", "source")

    def __init__(self, model: Path | None = None) -> None:
        self._model = model

    def recognises(self, path: Path) -> bool:
        """Tell whether the archive has joints or parameters."""
        return path.is_file() and bool({"joints", *_POSES} & member_names(path))

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the one hand."""
        arrays = read_archive(path)
        if "side" not in arrays:
            raise RecordingError("has no array 'side': right or left", file=path)
        main = next(arrays[name] for name in ("joints", *_POSES) if name in arrays)
        return (
            Entry("", side_of(arrays["side"], path, "side"), len(np.atleast_1d(main))),
        )

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read the hand."""
        arrays, shape = read_archive(path), ("T", LANDMARK_COUNT, 3)
        with reading(path):
            if "joints" in arrays:
                joints = as_floats(arrays["joints"], "joints", shape=shape)
            else:
                joints = self._forward(path, arrays, entry)
            time = self._time(path, arrays, len(joints))
        return build_recording(
            path,
            entry,
            time,
            joints[:, FROM_MANO],
            valid=arrays.get("valid"),
            source="MANO",
        )

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the arrays that a recording cannot hold."""
        return tuple(sorted(member_names(path) - _KNOWN - {"flat_hand_mean"}))

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write the joints of one hand."""
        self.check_one_per_hand([*recordings, *recordings[1:]])
        recording = recordings[0]
        with replaced_file(path, "path") as file:
            np.savez_compressed(
                file,
                allow_pickle=False,
                side=np.array(recording.side),
                time=recording.time,
                joints=recording.landmarks[:, np.argsort(FROM_MANO)],
                valid=recording.valid,
            )

    @staticmethod
    def _time(path: Path, arrays: dict[str, np.ndarray], count: int) -> np.ndarray:
        if "time" in arrays:
            return arrays["time"]
        if "fps" not in arrays:
            raise RecordingError("has neither 'time' nor 'fps'", file=path)
        fps = float(as_floats(arrays["fps"], "fps", shape=(), is_finite=True))
        if not fps > 0.0:
            raise RecordingError(
                f"expected a rate > 0, got {fps:g}", file=path, array="fps"
            )
        return np.arange(count) / fps

    def _forward(
        self, path: Path, arrays: dict[str, np.ndarray], entry: Entry
    ) -> np.ndarray:
        """Return the joints of parameters, by the user's model."""
        if "flat_hand_mean" not in arrays:
            problem = "has no array 'flat_hand_mean'"
            meaning = "which says whether a pose of 0 is the flat hand"
            raise RecordingError(f"{problem}, {meaning}", file=path)
        count = entry.samples
        if "pose" in arrays:
            pose = as_floats(arrays["pose"], "pose", shape=(count, 48), is_finite=True)
            root, fingers = pose[:, :3], pose[:, 3:]
        else:
            root = as_floats(
                arrays.get("global_orient"),
                "global_orient",
                shape=(count, 3),
                is_finite=True,
            )
            fingers = as_floats(
                arrays["hand_pose"], "hand_pose", shape=(count, "k"), is_finite=True
            )
        shape = as_floats(
            arrays.get("betas", np.zeros(10)), "betas", shape=(10,), is_finite=True
        )
        shift = arrays.get("transl", np.zeros((count, 3)))
        shift = as_floats(shift, "transl", shape=(count, 3), is_finite=True)
        model = load_model(entry.side, self._model)
        components = fingers.shape[1]
        if components > len(model.hands_components):
            problem = f"expected at most {len(model.hands_components)} numbers, got {components}"
            raise RecordingError(problem, file=path, array="hand_pose")
        if components < len(model.hands_components):
            fingers = fingers @ model.hands_components[:components]
        if not bool(arrays["flat_hand_mean"]):
            fingers = fingers + model.hands_mean
        turns = np.hstack([root, fingers]).reshape(count, 16, 3)
        return model.joints(turns, shape, shift)
