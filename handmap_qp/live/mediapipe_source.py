"""`MediapipeSource`: a hand in a camera's picture or a video, tracked by a process of its own."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.spec import Side
from handmap_qp.human.sample import LANDMARK_COUNT, HumanSample
from handmap_qp.live.mediapipe_environment import environment_python

_PROGRAM = Path(__file__).with_name("mediapipe_process.py")
_END = 5.0
"""Longest wait for the process to end [s]."""
_UNSEEN = np.full((LANDMARK_COUNT, 3), np.nan)


class MediapipeSource:
    """Tracks one hand with MediaPipe, in the environment of `mediapipe_environment`.

    Landmarks are in metres in upright axes of the camera: x right in the picture, y up, z towards
    the camera, which is the origin.

    Args:
        camera: Number of the camera; without effect with `video`.
        video: A video file in place of a camera.
        side: The hand to track.
        fov: Horizontal field of view of the camera [deg]; the hand's distance follows from it.
        is_mirrored: Whether pictures are mirrored, as a selfie's are.
        is_paced: Whether a video is played at its own speed, instead of as fast as possible.

    Raises:
        InvalidInputError: If MediaPipe is not installed, there is no such file, or the field of
            view is out of its range.
    """

    def __init__(
        self,
        *,
        camera: int = 0,
        video: Path | None = None,
        side: Side = "right",
        fov: float = 65.0,
        is_mirrored: bool = False,
        is_paced: bool = True,
    ) -> None:
        if video is not None and not video.is_file():
            raise InvalidInputError(
                argument="--video", problem=f"there is no file {video}", value=str(video)
            )
        if camera < 0:
            raise InvalidInputError(argument="--camera", expected="0 or more", value=camera)
        if not 1.0 <= fov <= 170.0:
            raise InvalidInputError(argument="--fov", expected="1 to 170 degrees", value=fov)
        self._side: Side = side
        self.name = f"camera {camera}" if video is None else video.stem
        self._argument = "--camera" if video is None else "--video"
        source = ["--camera", str(camera)] if video is None else ["--video", str(video)]
        choices = [*(["--mirrored"] if is_mirrored else []), *(["--paced"] if is_paced else [])]
        options = ["--side", side, "--fov", str(fov)]
        program = [str(environment_python()), "-u", str(_PROGRAM)]
        self._command = [*program, *source, *options, *choices]

    @property
    def side(self) -> Side:
        """The hand that is tracked."""
        return self._side

    @property
    def rate(self) -> float:
        """0: the camera or the file decides."""
        return 0.0

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield a sample for each picture.

        Raises:
            InvalidInputError: If the camera or the file cannot be read, or MediaPipe fails.
        """
        with tempfile.TemporaryFile(mode="w+") as complaints:
            process = subprocess.Popen(
                self._command, stdout=subprocess.PIPE, stderr=complaints, text=True
            )
            try:
                if process.stdout is not None:
                    yield from map(self._sample, process.stdout)
                code = process.wait()
            finally:
                _end(process)
            if code:
                raise self._error(complaints)

    def _sample(self, line: str) -> HumanSample:
        given = json.loads(line)
        if not given["valid"]:
            return HumanSample(given["time"], self._side, _UNSEEN, valid=False, confidence=0.0)
        landmarks = np.array(given["landmarks"])
        return HumanSample(given["time"], self._side, landmarks, confidence=given["confidence"])

    def _error(self, complaints: IO[str]) -> InvalidInputError:
        """Return the process's own last line as an error."""
        complaints.seek(0)
        lines = [line.strip() for line in complaints if line.strip()]
        own = [line for line in lines if line.startswith("mediapipe_process: ")]
        text = (own or lines or ["MediaPipe ended without a message"])[-1]
        return InvalidInputError(
            argument=self._argument, problem=text.removeprefix("mediapipe_process: ")
        )


def _end(process: subprocess.Popen[str]) -> None:
    """End the process, also where its samples are no longer read."""
    if process.stdout is not None:
        process.stdout.close()
    process.terminate()
    try:
        process.wait(_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
