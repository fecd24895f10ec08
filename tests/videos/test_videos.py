"""Videos beside recordings become those of a LeRobot data set."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from batch_cases import piece
from lerobot_runs import run_lerobot

from handmap_qp.cli import main
from handmap_qp.trackers import FORMATS
from handmap_qp.trackers.formats import write_recordings

av = pytest.importorskip("av", reason="needs packages/videos and what it installs")
pytest.importorskip("h5py")
parquet = pytest.importorskip("pyarrow.parquet")
from handmap_videos import KEY, Videos  # noqa: E402

PYTHON = os.environ.get("HANDMAP_LEROBOT_PYTHON", "")
COUNTS = (12, 20)
READ = """
import sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("local/set", root=sys.argv[1], video_backend="pyav")
print([float(data[i][sys.argv[2]].mean()) for i in range(len(data))], data[0]["task"])
"""


def brightness(frames: int) -> np.ndarray:
    """Grey of each frame, from 0 to 1; each is another one."""
    return np.round(np.linspace(40, 200, frames)) / 255.0


def write_video(file: Path, frames: int, fps: int = 30) -> None:
    with av.open(str(file), "w") as opened:
        stream = opened.add_stream("mpeg4", rate=fps)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.gop_size = 4
        stream.bit_rate = 4_000_000
        for grey in brightness(frames):
            image = np.full((48, 64, 3), round(255 * grey), np.uint8)
            opened.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        opened.mux(stream.encode())


@pytest.fixture
def mapped(tmp_path: Path) -> Path:
    """A batch of two files of EgoDex with their videos."""
    inputs = tmp_path / "egodex"
    inputs.mkdir()
    for i, count in enumerate(COUNTS):
        file = inputs / f"{i}.hdf5"
        write_recordings([piece(0, count)], file, FORMATS["egodex"])
        with pytest.importorskip("h5py").File(file, "a") as opened:
            # As EgoDex has it: frames of a video.
            del opened["time"]
            opened.attrs["llm_description"] = f"task {i}"
        write_video(file.with_suffix(".mp4"), count)
    words = ["--robot", "three_finger", "--workers", "0", "--format", "lerobot"]
    assert main(["batch", str(inputs), *words, "--out", str(tmp_path / "mapped")]) == 0
    return tmp_path / "mapped"


def test_each_episode_has_its_video(mapped: Path, tmp_path: Path) -> None:
    Videos(mapped).run()
    root = mapped / "lerobot"
    info = json.loads((root / "meta/info.json").read_text())
    assert info["features"][KEY]["shape"] == [48, 64, 3]
    episodes = parquet.read_table(root / "meta/episodes").to_pylist()
    assert [row["tasks"] for row in episodes] == [["task 0"], ["task 1"]]
    for i, (row, count) in enumerate(zip(episodes, COUNTS, strict=True)):
        places = {
            "video_key": KEY,
            "chunk_index": row[f"videos/{KEY}/chunk_index"],
            "file_index": row[f"videos/{KEY}/file_index"],
        }
        file = root / info["video_path"].format(**places)
        assert file.read_bytes() == (tmp_path / f"egodex/{i}.mp4").read_bytes()
        assert row[f"videos/{KEY}/to_timestamp"] == pytest.approx(count / 30.0)
        mean = np.ravel(row[f"stats/{KEY}/mean"])
        np.testing.assert_allclose(mean, brightness(count).mean(), atol=0.12)
    stats = json.loads((root / "meta/stats.json").read_text())[KEY]
    assert np.shape(stats["std"]) == (3, 1, 1)
    if PYTHON:
        printed = run_lerobot(tmp_path, PYTHON, "-c", READ, str(root), KEY)
        greys, _, task = printed.rpartition("] ")
        expected = np.concatenate([brightness(count) for count in COUNTS])
        np.testing.assert_allclose(json.loads(greys + "]"), expected, atol=0.02)
        assert task.strip() == "task 0"


def test_what_does_not_fit_is_refused_and_changes_nothing(
    mapped: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    root, video = mapped / "lerobot", tmp_path / "egodex/1.mp4"
    before = {file: file.read_bytes() for file in root.rglob("*") if file.is_file()}

    def refused() -> str:
        with pytest.raises(ValueError, match="DIR") as caught:
            Videos(mapped).run()
        return str(caught.value)

    video.unlink()
    assert "no " in refused()
    write_video(video, 20, fps=25)
    assert "--fps 25" in refused()
    write_video(video, 19)
    assert "expected 20 frames" in refused()
    now = {file: file.read_bytes() for file in root.rglob("*") if file.is_file()}
    assert now == before
    write_video(video, 20)
    Videos(mapped).run()
    assert "a data set without videos" in refused()
    # As after a run that was cut off before its end.
    whole = {file: file.read_bytes() for file in root.rglob("*") if file.is_file()}
    for name in ("info", "stats"):
        file = root / f"meta/{name}.json"
        file.write_bytes(before[file])
    Videos(mapped).run()
    for file, content in whole.items():
        assert file.read_bytes() == content
