"""Recordings as episodes of a LeRobot v3 data set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.errors import InvalidInputError, RecordingError
from handmap_qp.trackers.formats.base import SIDES, Entry, reading
from handmap_qp.trackers.formats.columns import (
    LANDMARK_COLUMNS,
    POSE_COLUMNS,
    landmark_rows,
    pose_rows,
    recording_of_rows,
)
from handmap_qp.trackers.formats.lerobot_v3 import Feature, LeRobotReader, LeRobotWriter
from handmap_qp.trackers.recording import Recording

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
_INDICES = {"timestamp", "frame_index", "episode_index", "index", "task_index"}


class LeRobotFormat:
    """A folder with one episode for each hand and recording; lossless.

    LeRobot's own `timestamp` is the frame over `fps`; the tracker's instants are in
    `observation.time` [s]. Name, side and source of a recording are columns of `meta/episodes`.
    """

    name = "lerobot"
    suffixes: tuple[str, ...] = ()
    about = "a folder in the form of LeRobot v3 (parquet); lossless, any number of recordings"

    def recognises(self, path: Path) -> bool:
        """Tell whether the folder has the description of a data set."""
        return (path / "meta" / "info.json").is_file()

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the episodes."""
        reader = LeRobotReader(path)
        if _LANDMARKS not in reader.features:
            known = ", ".join(name for name in reader.features if name not in _INDICES)
            problem = f"has no feature {_LANDMARKS!r}; it has {known or 'none'}"
            raise RecordingError(problem, file=path)
        return tuple(
            Entry(str(episode.index), _side(path, episode.about), episode.length)
            for episode in reader.episodes()
        )

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one episode."""
        reader = LeRobotReader(path)
        episode = reader.episodes(int(entry.name))[0]
        columns = reader.read(episode, tuple(_FEATURES))
        for name, feature in _FEATURES.items():
            if name in columns and reader.features[name].size != feature.size:
                problem = f"expected {feature.size} numbers, got {reader.features[name].size}"
                raise RecordingError(problem, file=path, array=name)
        frames = np.arange(episode.length) / reader.fps
        with reading(path, f"episode {episode.index}: "):
            return recording_of_rows(
                str(episode.about.get("name") or f"{path.name}_{episode.index}"),
                entry.side,
                columns.get(_TIME, frames),
                columns[_LANDMARKS],
                valid=columns.get(_VALID),
                confidence=columns.get(_CONFIDENCE),
                wrist=columns.get(_WRIST),
                source=str(episode.about.get("source") or ""),
            )

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the features that a recording cannot hold."""
        names = LeRobotReader(path).features
        return tuple(name for name in names if name not in _FEATURES and name not in _INDICES)

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


def _columns(recording: Recording) -> dict[str, np.ndarray]:
    count, wrist, confidence = len(recording), recording.wrist, recording.confidence
    return {
        _LANDMARKS: landmark_rows(recording),
        _WRIST: np.full((count, 12), np.nan) if wrist is None else pose_rows(wrist),
        _VALID: recording.valid,
        _CONFIDENCE: np.full(count, np.nan) if confidence is None else confidence,
        _TIME: recording.time,
    }


def _side(path: Path, about: dict[str, Any]) -> Any:
    for side in SIDES:
        if about.get("side") == side:
            return side
    problem = f"expected right or left in column 'side' of episode {about.get('episode_index')}"
    raise RecordingError(problem, file=path, array="meta/episodes")
