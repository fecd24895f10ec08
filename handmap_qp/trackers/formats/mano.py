"""Recordings of the MANO hand model as `.npz`: by its 21 joints, or by its parameters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

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
_KNOWN = {"joints", "side", "time", "fps", "valid", "betas", "transl", *_POSES}
_KNOWN |= {"global_orient", "flat_hand_mean"}


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
        arrays = read_archive(path)
        shape = ("T", LANDMARK_COUNT, 3)
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
        return tuple(sorted(member_names(path) - _KNOWN))

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write the joints of one hand."""
        self.check_one_per_hand([*recordings, *recordings[1:]])
        recording = recordings[0]
        arrays = {
            "side": np.array(recording.side),
            "time": recording.time,
            "joints": recording.landmarks[:, np.argsort(FROM_MANO)],
            "valid": recording.valid,
        }
        with replaced_file(path, "path") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    @staticmethod
    def _time(
        path: Path,
        arrays: dict[str, np.ndarray],
        count: int,
    ) -> np.ndarray:
        if "time" in arrays:
            return arrays["time"]
        if "fps" not in arrays:
            raise RecordingError("has neither 'time' nor 'fps'", file=path)
        fps = float(
            as_floats(
                arrays["fps"],
                "fps",
                shape=(),
                is_finite=True,
            )
        )
        if not fps > 0.0:
            raise RecordingError(
                f"expected a rate > 0, got {fps:g}",
                file=path,
                array="fps",
            )
        return np.arange(count) / fps

    def _forward(
        self,
        path: Path,
        arrays: dict[str, np.ndarray],
        entry: Entry,
    ) -> np.ndarray:
        """Return the joints of parameters, by the user's model."""
        if "flat_hand_mean" not in arrays:
            problem = "has no array 'flat_hand_mean'"
            meaning = "which says whether a pose of 0 is the flat hand"
            raise RecordingError(f"{problem}, {meaning}", file=path)
        count = entry.samples

        def given(name: str, *shape: int | str, default: Any = None) -> np.ndarray:
            values = arrays.get(name, default)
            return as_floats(
                values,
                name,
                shape=shape,
                is_finite=True,
            )

        if "pose" in arrays:
            root, fingers = np.split(given("pose", count, 48), [3], axis=1)
        else:
            root = given("global_orient", count, 3)
            fingers = given("hand_pose", count, "k")
        shape = given("betas", 10, default=np.zeros(10))
        shift = given("transl", count, 3, default=np.zeros((count, 3)))
        model = load_model(entry.side, self._model)
        components = fingers.shape[1]
        most = len(model.hands_components)
        if components > most:
            problem = f"expected at most {most} numbers, got {components}"
            raise RecordingError(
                problem,
                file=path,
                array="hand_pose",
            )
        if components < most:
            fingers = fingers @ model.hands_components[:components]
        if not bool(arrays["flat_hand_mean"]):
            fingers = fingers + model.hands_mean
        turns = np.hstack([root, fingers]).reshape(count, 16, 3)
        return model.joints(turns, shape, shift)
