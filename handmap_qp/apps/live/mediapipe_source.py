"""MediaPipe as a source (`MediapipeSource`), in an environment of its own (`install_environment`).

MediaPipe 0.10.21 is the last version that brings its hand model, so that it works offline. It needs
numpy below 2, so it gets a virtual environment of its own, which `handmap track mediapipe
--install` makes once. Of the packages that it asks for (1 GB), those that no hand needs are left
out: JAX, SciPy, Matplotlib and those for sound and text.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Suppress, arg

from handmap_core.errors import InvalidInputError
from handmap_qp.apps.arguments import hinted
from handmap_qp.hands import Side
from handmap_qp.human import UNSEEN, HumanSample
from .processes import end_process
from .source import Source

VARIABLE = "HANDMAP_MEDIAPIPE"
"""Environment variable that names another folder."""
REQUIREMENTS = (
    "mediapipe==0.10.21",
    "numpy<2",
    "opencv-python-headless<4.12",
    "absl-py",
    "attrs>=19.1",
    "flatbuffers>=2",
    "protobuf>=4.25.3,<5",
)
"""All that the environment holds; later versions of OpenCV need numpy 2."""
PYTHONS = ("python3.12", "python3.11", "python3.10")
"""What MediaPipe 0.10.21 and our program run on."""
_PROGRAM = Path(__file__).with_name("mediapipe_process.py")
_NOT_FOUND = {"landmarks": UNSEEN, "confidence": 0.0}
"""Fields of a sample that the process leaves out where it does not find the hand."""


def environment_folder() -> Path:
    """Return the folder: of `HANDMAP_MEDIAPIPE`, or `handmap/mediapipe` in the user's data."""
    if named := os.environ.get(VARIABLE):
        return Path(named).resolve()
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share"
    return Path(data, "handmap/mediapipe")


def environment_python() -> Path:
    """Return the environment's interpreter.

    Raises:
        InvalidInputError: If the environment has not been made.
    """
    python = environment_folder() / "bin" / "python"
    if not python.exists():
        raise InvalidInputError(
            f"MediaPipe is not installed in {environment_folder()}",
            advice="install it once (0.3 GB) by handmap track mediapipe --install",
        )
    return python


def install_environment(report: Callable[[str], object]) -> Path:
    """Make the environment, or make it again.

    Args:
        report: Called with a line before each step.

    Returns:
        Its folder.

    Raises:
        InvalidInputError: If there is no Python that MediaPipe runs on, or pip fails.
    """
    folder = environment_folder()
    python = _find_python()
    report(f"making {folder}")
    _run([python, "-m", "venv", "--clear", folder], "the environment cannot be made")
    report(f"installing {' '.join(REQUIREMENTS)} (0.3 GB)")
    pip = [folder / "bin" / "python", "-m", "pip", "--disable-pip-version-check"]
    try:
        install = [*pip, "install", "--no-deps", *REQUIREMENTS]
        _run(install, "pip cannot install MediaPipe")
        remove = [*pip, "uninstall", "-y", "pip", "setuptools"]
        _run(remove, "pip cannot be removed")
    except InvalidInputError:
        # Half an environment would pass for a whole one.
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder


def _find_python() -> str:
    if "python{}.{}".format(*sys.version_info) in PYTHONS:
        return sys.executable
    if found := next(filter(None, map(shutil.which, PYTHONS)), None):
        return found
    raise InvalidInputError(
        argument="--install", expected=f"one of {', '.join(PYTHONS)}", got="none"
    )


def _run(command: list[Any], problem: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        line = _last_line(done.stderr.strip() or done.stdout.strip(), "ERROR:")
        raise InvalidInputError(f"{problem}: {line or problem}", argument="--install")


@dataclass(eq=False)
class MediapipeSource(Source):
    """Tracks one hand in a camera's picture or a video with MediaPipe, in its environment.

    Landmarks are in metres in upright axes of the camera: x right in the picture, y up, z towards
    the camera, which is the origin.

    Attributes:
        camera: Number of the camera.
        video: Video file in place of a camera.
        side: The hand to track.
        is_mirrored: The pictures are mirrored, as a selfie's are.
        fov: Horizontal field of view of the camera [deg].
        is_paced: Whether a video is played at its own speed, instead of as fast as possible.
        name: The camera, or the name of the video.
        rate: 0: the camera or the file decides.
        upright: Empty: it is not known how the camera stands.
    """

    camera: int = 0
    video: Annotated[Path | None, hinted("FILE", "(default: the camera)")] = None
    side: Side = "right"
    is_mirrored: Annotated[bool, arg(name="mirrored")] = False
    fov: float = 65.0
    is_paced: Suppress[bool] = True
    rate = 0.0
    upright = ""

    def __post_init__(self) -> None:
        self.name = self.video.stem if self.video else f"camera {self.camera}"

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield a sample for each picture.

        Raises:
            InvalidInputError: If MediaPipe is not installed or fails, the camera or the file cannot
                be read, or the field of view is out of its range.
        """
        option = "--video" if self.video else "--camera"
        source = str(self.video or self.camera)
        command = [environment_python(), "-u", _PROGRAM, option, source]
        command += ["--side", self.side, "--fov", str(self.fov)]
        command += ["--mirrored"] * self.is_mirrored + ["--paced"] * self.is_paced
        with (
            tempfile.TemporaryFile(mode="w+") as messages,
            subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=messages, text=True
            ) as process,
        ):
            try:
                for line in process.stdout or ():
                    yield HumanSample(side=self.side, **(_NOT_FOUND | json.loads(line)))
                code = process.wait()
            finally:
                # Also where the samples are no longer read.
                end_process(process)
            if code:
                messages.seek(0)
                name = f"{_PROGRAM.stem}: "
                line = _last_line(messages.read(), name).removeprefix(name)
                raise InvalidInputError(
                    line or "MediaPipe ended without a message", argument=option
                )


def _last_line(text: str, start: str) -> str:
    """Return the last line with this start, or else the last one; empty if there is none."""
    lines = ["", *text.splitlines()]
    return ([line for line in lines if line.startswith(start)] or lines)[-1].strip()
