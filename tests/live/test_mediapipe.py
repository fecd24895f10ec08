"""MediaPipe as a source: its process with a stand-in for MediaPipe, and the geometry behind it."""

from __future__ import annotations

import itertools
import json
import math
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_cases import moving_hand

from handmap_qp import InvalidInputError, cli
from handmap_qp.apps.live import mediapipe_process
from handmap_qp.apps.live.mediapipe_process import position_in_camera
from handmap_qp.apps.live.mediapipe_source import (
    REQUIREMENTS,
    VARIABLE,
    MediapipeSource,
    environment_folder,
    install_environment,
)
from handmap_qp.trackers.formats import read_recording

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

WIDTH, HEIGHT, FOV = 640, 480, 65.0
FOCAL = 0.5 * WIDTH / math.tan(math.radians(0.5 * FOV))
# A stand-in reads from a file what the real one would see in each picture.
CV2 = """
CAP_PROP_FPS, COLOR_BGR2RGB = 5, 4
import json, numpy as np
class VideoCapture:
    def __init__(self, source):
        try:
            self.left = len(json.load(open(source))) if isinstance(source, str) else 0
        except (OSError, ValueError):
            self.left = -1
    def isOpened(self):
        return self.left >= 0
    def get(self, name):
        return 50.0
    def read(self):
        self.left -= 1
        return self.left >= 0, np.full((480, 640, 3), max(0, self.left), dtype=np.uint8)
    def release(self):
        pass
def cvtColor(picture, code):
    return picture
def flip(picture, axis):
    return picture + 100
"""
HANDS = """
import json, os
import matplotlib.pyplot as plt
# Its environment has no Matplotlib.
assert not hasattr(plt, "plot")
from types import SimpleNamespace as Thing
class Hands:
    def __init__(self, **choices):
        assert choices == {"max_num_hands": 2, "model_complexity": 1}
    def process(self, pixels):
        self.seen = json.load(open(os.environ["STAND_IN"]))
        number = int(pixels[0, 0, 0])
        seen = self.seen[len(self.seen) - 1 - number % 100]
        self.is_flipped = number >= 100
        def listed(rows):
            return Thing(landmark=[Thing(x=x, y=y, z=z) for x, y, z in rows])
        hands = [hand for hand in seen if hand["mirrored"] == self.is_flipped]
        return Thing(
            multi_handedness=[
                Thing(classification=[Thing(label=hand["label"], score=hand["score"])])
                for hand in hands
            ],
            multi_hand_landmarks=[listed(hand["image"]) for hand in hands],
            multi_hand_world_landmarks=[listed(hand["world"]) for hand in hands],
        )
"""


def project(landmarks: np.ndarray) -> np.ndarray:
    """Return places in the picture [pixel] of landmarks in camera axes, shape (n, 2)."""
    return FOCAL * landmarks[:, :2] / landmarks[:, 2:] + (0.5 * WIDTH, 0.5 * HEIGHT)


@given(
    seed=st.integers(0, 2**32 - 1),
    place=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.2, 2.0)),
)
def test_the_place_of_a_hand_follows_from_its_picture(
    seed: int, place: tuple[float, float, float]
) -> None:
    shape = np.random.default_rng(seed).uniform(-0.08, 0.08, size=(21, 3))
    found = position_in_camera(
        shape, project(shape + place), FOCAL, (0.5 * WIDTH, 0.5 * HEIGHT)
    )
    np.testing.assert_allclose(found, place, atol=1e-9)


def seen_hand(landmarks: np.ndarray, label: str, *, mirrored: bool = False) -> dict:
    """Return what MediaPipe tells of a hand in camera axes [m]."""
    centre = landmarks.mean(axis=0)
    places = project(landmarks) / (WIDTH, HEIGHT)
    image = np.column_stack([places, landmarks[:, 2] - landmarks[0, 2]])
    return {
        "label": label,
        "score": 0.9,
        "mirrored": mirrored,
        "world": (landmarks - centre).tolist(),
        "image": image.tolist(),
    }


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An environment with the stand-in; returns the video that is to be written."""
    modules = tmp_path / "modules"
    solutions = modules / "mediapipe" / "python" / "solutions"
    solutions.mkdir(parents=True)
    (solutions / "hands.py").write_text(HANDS)
    (modules / "cv2.py").write_text(CV2)
    program = tmp_path / "environment" / "bin" / "python"
    program.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nPYTHONPATH={modules} exec {sys.executable} "$@"\n')
    program.chmod(0o755)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "environment"))
    video = tmp_path / "video.json"
    monkeypatch.setenv("STAND_IN", str(video))
    return video


def camera_hands() -> np.ndarray:
    """Return hands before the camera, in its axes [m], shape (20, 21, 3)."""
    recording = moving_hand()
    return recording.landmarks[recording.valid][:20] + np.array([-0.05, -0.2, 0.5])


def test_samples_are_the_hands_of_the_pictures(stand_in: Path) -> None:
    hands = camera_hands()
    other = hands + np.array([0.2, 0.0, 0.0])
    video = [
        [seen_hand(b, "Right"), seen_hand(a, "Left")]
        for a, b in zip(hands, other, strict=True)
    ]
    video[7], video[8] = [], [seen_hand(other[8], "Right")]
    stand_in.write_text(json.dumps(video))
    # MediaPipe's names are those of a mirrored picture.
    samples = list(MediapipeSource(video=stand_in, side="right", is_paced=False))
    assert [sample.valid for sample in samples] == [i not in (7, 8) for i in range(20)]
    for sample, hand in zip(samples, hands, strict=True):
        if sample.valid:
            np.testing.assert_allclose(
                sample.landmarks, hand * (1.0, -1.0, -1.0), atol=1e-9
            )
            assert sample.confidence == 0.9
        assert sample.side == "right"
    np.testing.assert_allclose(
        np.diff([sample.time for sample in samples]), 0.02, atol=1e-9
    )
    left = list(MediapipeSource(video=stand_in, side="left", is_paced=False))
    assert [sample.valid for sample in left] == [i != 7 for i in range(20)]
    np.testing.assert_allclose(
        left[0].landmarks, other[0] * (1.0, -1.0, -1.0), atol=1e-9
    )


def test_mirrored_pictures_are_turned_back(stand_in: Path) -> None:
    video = [[seen_hand(hand, "Left", mirrored=True)] for hand in camera_hands()]
    stand_in.write_text(json.dumps(video))
    plain = MediapipeSource(video=stand_in, is_paced=False)
    turned = MediapipeSource(video=stand_in, is_paced=False, is_mirrored=True)
    assert not any(sample.valid for sample in plain)
    assert all(sample.valid for sample in turned)


def test_the_program_and_the_client_run_alone_on_python_3_10() -> None:
    code = """
import runpy, sys, typing
import msgspec, numpy.typing, zmq.asyncio, zmq.auth
sys.modules["handmap_core"] = sys.modules["handmap_qp"] = None
for name in ("assert_never", "assert_type", "dataclass_transform", "reveal_type"):
    delattr(typing, name)
runpy.run_path(sys.argv[1])["_client_module"]()
"""
    program = Path(mediapipe_process.__file__)
    subprocess.run([sys.executable, "-c", code, program], check=True)


def test_the_process_ends_with_its_reader(stand_in: Path) -> None:
    stand_in.write_text(
        json.dumps([[seen_hand(hand, "Left")] for hand in camera_hands()])
    )
    source = iter(MediapipeSource(video=stand_in))
    assert len(list(itertools.islice(source, 3))) == 3
    source.close()  # ty: ignore[missing-attribute]


def test_the_command_records_a_video(stand_in: Path, tmp_path: Path) -> None:
    stand_in.write_text(
        json.dumps([[seen_hand(hand, "Left")] for hand in camera_hands()])
    )
    out = tmp_path / "hand.npz"
    assert (
        cli.main(["track", "mediapipe", "--video", str(stand_in), "--record", str(out)])
        == 0
    )
    copy = read_recording(out)
    assert copy.side == "right"
    np.testing.assert_allclose(
        copy.landmarks, camera_hands() * (1.0, -1.0, -1.0), atol=1e-9
    )


@pytest.mark.parametrize(
    ("words", "content", "complaint"),
    [
        (["--video", "VIDEO"], "not a video", "cannot be read"),
        (["--video", "VIDEO"], "[]", "holds no pictures"),
        (["--video", "missing.mp4"], "[]", "missing.mp4 cannot be read"),
        (["--camera", "3"], "[]", "3 holds no pictures"),
        (["--camera", "-1"], "[]", "--camera"),
        (["--fov", "0"], "[]", "--fov"),
        (["--fov", "nan"], "[]", "--fov"),
    ],
)
def test_every_mistake_is_one_line(
    stand_in: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    content: str,
    complaint: str,
) -> None:
    stand_in.write_text(content)
    words = [str(stand_in) if word == "VIDEO" else word for word in words]
    out = tmp_path / "out.npz"
    assert cli.main(["track", "mediapipe", *words, "--record", str(out)]) == 2
    message = capsys.readouterr().err
    assert complaint in message
    assert message.count("\n") == 1
    assert not out.exists()


def test_a_missing_or_broken_environment_is_named(
    stand_in: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stand_in.write_text("[[]]")
    command = [
        "track",
        "mediapipe",
        "--video",
        str(stand_in),
        "--record",
        str(tmp_path / "a.npz"),
    ]
    (tmp_path / "modules" / "mediapipe" / "python" / "solutions" / "hands.py").unlink()
    assert cli.main(command) == 2
    assert "mediapipe cannot be imported" in capsys.readouterr().err
    monkeypatch.setenv(VARIABLE, str(tmp_path / "nothing"))
    assert cli.main(command) == 2
    assert "--install" in capsys.readouterr().err


def test_the_environment_is_the_users(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert environment_folder() == tmp_path / "handmap" / "mediapipe"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the environment will be: its Python runs `pip.sh`, in place of pip."""
    folder = tmp_path / "data" / "environment"
    monkeypatch.setenv(VARIABLE, str(folder))
    program = tmp_path / "python"
    program.write_text(
        '#!/bin/sh\nmkdir -p "$4/bin"\n'
        f'cp "{tmp_path}/pip.sh" "$4/bin/python"\n'
        'chmod +x "$4/bin/python"\n'
    )
    program.chmod(0o755)
    module = "handmap_qp.apps.live.mediapipe_source"
    monkeypatch.setattr(f"{module}._find_python", lambda: str(program))
    return folder


def test_a_failed_installation_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    script = "#!/bin/sh\necho ERROR: no network >&2\nexit 1\n"
    (tmp_path / "pip.sh").write_text(script)
    told: list[str] = []
    with pytest.raises(InvalidInputError, match="ERROR: no network"):
        install_environment(told.append)
    assert len(told) == 2
    assert not folder.exists()


def test_an_environment_holds_no_more_than_it_needs_and_its_size_is_told(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Each call adds 3 MB.
    line = f'echo "$@" >> {tmp_path}/calls; head -c 3000000 /dev/zero >> {folder}/big'
    (tmp_path / "pip.sh").write_text(f"#!/bin/sh\n{line}\n")
    assert cli.main(["track", "mediapipe", "--install"]) == 0
    install, remove = (tmp_path / "calls").read_text().splitlines()
    assert " install --no-deps mediapipe==0.10.21 numpy<2 " in install
    # A machine without handmap gets the same by hand, and what the client needs.
    page = Path(__file__, "../../../docs/live.md").resolve().read_text()
    by_hand = page.partition("    pip install --no-deps mediapipe")[2].partition(
        "    python "
    )
    words = shlex.split(f"mediapipe{by_hand[0]}".replace("\\\n", ""))
    assert words == [*REQUIREMENTS, "msgspec", "pyzmq"]
    assert remove.endswith(" uninstall -y pip setuptools")
    assert capsys.readouterr().out.endswith(f"ready in {folder} (6 MB)\n")
