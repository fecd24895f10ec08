"""Recordings as episodes of a LeRobot v3 data set, which is written and not read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from handmap_qp.errors import InvalidInputError, RecordingError
from handmap_qp.human.recording import Recording
from handmap_qp.trackers.formats.base import Entry
from handmap_qp.trackers.formats.columns import (
    LANDMARK_COLUMNS,
    POSE_COLUMNS,
    landmark_rows,
    pose_rows,
)
from handmap_qp.trackers.formats.lerobot_v3 import Feature, LeRobotWriter

_LANDMARKS, _WRIST = "observation.landmarks", "observation.wrist"
_VALID, _CONFIDENCE = "observation.valid", "observation.confidence"
_TIME = "observation.time"
_FEATURES = {
    _LANDMARKS: Feature("float64", LANDMARK_COLUMNS),
    _WRIST: Feature("float64", POSE_COLUMNS),
    _VALID: Feature("bool"),
    _CONFIDENCE: Feature("float64"),
    _TIME: Feature("float64"),
}


class LeRobotFormat:
    """A folder with one episode for each hand and recording; lossless.

    LeRobot's own `timestamp` is the frame over `fps`; the tracker's instants are in
    `observation.time` [s]. Name, side and source of a recording are columns of `meta/episodes`.
    """

    name = "lerobot"
    suffixes: tuple[str, ...] = ()
    about = "a folder in the form of LeRobot v3 (parquet); written, not read; any number"

    def recognises(self, path: Path) -> bool:
        """Tell whether the folder has the description of a data set."""
        return (path / "meta" / "info.json").is_file()

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """Refuse: no data set is read."""
        raise _written_only(path)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Refuse: no data set is read."""
        raise _written_only(path)

    def unread(self, path: Path) -> tuple[str, ...]:
        """Refuse: no data set is read."""
        raise _written_only(path)

    def losses(self, recordings: Sequence[Recording]) -> tuple[str, ...]:
        """Name nothing: the form is lossless."""
        return ()

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write each recording as an episode."""
        if not recordings:
            raise InvalidInputError(argument="recordings", expected="at least one", got="none")
        features = dict(_FEATURES)
        if all(recording.confidence is None for recording in recordings):
            del features[_CONFIDENCE]
        if all(recording.wrist is None for recording in recordings):
            del features[_WRIST]
        steps = np.concatenate([recording.steps for recording in recordings])
        fps = max(1.0, float(np.round(1.0 / np.median(steps))))
        with LeRobotWriter(path, fps=fps, features=features, robot_type="human_hand") as writer:
            for recording in recordings:
                writer.add(
                    _columns(recording),
                    f"{recording.side} human hand",
                    {"name": recording.name, "side": recording.side, "source": recording.source},
                )


def _written_only(path: Path) -> RecordingError:
    problem = "is a LeRobot data set, which is written and not read"
    return RecordingError(f"{problem}: read the recordings that it was made from", file=path)


def _columns(recording: Recording) -> dict[str, np.ndarray]:
    count, wrist, confidence = len(recording), recording.wrist, recording.confidence
    return {
        _LANDMARKS: landmark_rows(recording),
        _WRIST: np.full((count, 12), np.nan) if wrist is None else pose_rows(wrist),
        _VALID: recording.valid,
        _CONFIDENCE: np.full(count, np.nan) if confidence is None else confidence,
        _TIME: recording.time,
    }
