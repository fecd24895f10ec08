"""The picture of `handmap retarget`: which moments it has, its file, and what it refuses."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from coarse_drawing import draw_coarsely

from handmap_core.human.recording import Recording
from handmap_qp import HandMapper, cli, load_hand
from handmap_qp.apps.drawing.contact_sheet import CELL
from handmap_qp.apps.drawing.sheet import LEFT, TOP
from handmap_qp.apps.offline import moments
from handmap_qp.apps.offline.moments import MappedMotion, find_moments
from handmap_qp.apps.offline.trajectory import map_recording

HUMAN = load_hand("human", points="landmarks")
FIST = HUMAN.rest + 0.5 * (HUMAN.upper_limits - HUMAN.rest)
COUNT = 120


def mapped(fists: tuple[float, ...], gap: slice = slice(0)) -> MappedMotion:
    """Map two seconds of a hand at rest that makes a fist at some instants [s]."""
    time = np.arange(COUNT) / 60.0
    share = sum(np.exp(-(((time - at) / 0.1) ** 2)) for at in fists)
    # Landmarks that repeat exactly would be frozen data.
    share = share + 1e-6 * np.sin(50.0 * time)
    points = [HUMAN.points(HUMAN.rest + each * (FIST - HUMAN.rest)) for each in share]
    valid = np.ones(COUNT, dtype=bool)
    valid[gap] = False
    recording = Recording("fists", time, np.array(points), valid, "right")
    mapper = HandMapper(HUMAN, load_hand("three_finger"), "teleoperation")
    trajectory = map_recording(mapper, recording)
    return MappedMotion(
        trajectory, [recording], mapper.method, trajectory.valid[:, None]
    )


def test_each_stretch_shows_what_differs_most() -> None:
    motion = mapped((0.7, 1.6))
    time = motion.trajectory.time
    chosen = find_moments([motion], time, 3)
    assert chosen[0] == 0
    # Both stretches have a fist, and the first one shows it.
    assert time[chosen[1]] == pytest.approx(0.7, abs=0.04)
    assert time[-1] / 2 < time[chosen[2]] <= time[-1]
    for count in (1, 2, 6, 12):
        found = find_moments([motion], time, count)
        assert len(found) == count
        assert (np.diff(found) > 0).all()


def test_moments_are_those_in_which_hands_are_followed() -> None:
    gap = slice(30, 60)
    motion = mapped((0.7,), gap)
    found = find_moments([motion], motion.trajectory.time, 6)
    assert motion.trajectory.valid[found].all()
    assert motion.recordings[0].valid[found].all()
    # Where nothing is followed at the start, the first moment is later.
    late = mapped((1.6,), slice(0, 20))
    assert find_moments([late], late.trajectory.time, 4)[0] >= 20


def test_a_short_recording_has_fewer_moments() -> None:
    motion = mapped((0.7,))
    time = motion.trajectory.time[:3]
    found = find_moments([motion], time, 6)
    assert set(found.tolist()) <= {0, 1, 2}
    assert len({*found.tolist()}) == len(found)


def test_moments_of_several_motions_show_all_hands() -> None:
    one, other = mapped((0.7,), slice(30, 60)), mapped((1.6,), slice(80, 110))
    found = find_moments([one, other], one.trajectory.time, 6)
    for motion in (one, other):
        assert motion.followed[found].all()
    # If no instant shows all hands, those count that show most.
    lost = one._replace(followed=np.zeros((COUNT, 1), dtype=bool))
    found = find_moments([lost, other], one.trajectory.time, 6)
    assert other.followed[found].all()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    made = mapped((0.7,)).recordings[0]
    path = tmp_path / "fists.npz"
    np.savez(path, time=made.time, landmarks=made.landmarks, handedness="right")
    return path


@pytest.mark.slow
def test_retarget_draws_six_moments_and_names_the_file(
    recording: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from matplotlib.image import imread

    draw_coarsely(monkeypatch)
    monkeypatch.chdir(recording.parent)
    command = ["retarget", str(recording), "--robot", "three_finger"]
    assert cli.main([*command, "--picture", "fists.png"]) == 0
    assert "wrote fists.png" in capsys.readouterr().out
    picture = imread("fists.png")[..., :3]
    assert picture.shape[1] == LEFT + 4 * CELL[0]
    assert (picture.shape[0] - TOP) // CELL[1] == moments.MOMENTS
    for row in range(moments.MOMENTS):
        top = TOP + row * CELL[1]
        for view in range(4):
            left = LEFT + view * CELL[0]
            panel = picture[top + 1 : top + CELL[1] - 2, left + 2 : left + CELL[0] - 1]
            assert panel.std() > 0.02
    assert cli.main([*command, "--picture", "fists.svg", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["picture"] == "fists.svg"
    assert "<svg" in Path("fists.svg").read_text(encoding="utf-8")
    assert cli.main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["picture"] is None


@pytest.mark.slow
def test_one_picture_has_both_robots_of_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []
    figure = SimpleNamespace(savefig=lambda path: path.touch())
    monkeypatch.setattr(
        moments, "moments_sheet", lambda *given: drawn.append(given) or figure
    )
    picture = tmp_path / "both.png"
    words = ["retarget", "demo", "--robots", "allegro_left", "allegro_right"]
    out = str(tmp_path / "out")
    assert cli.main([*words, "--out", out, "--picture", str(picture)]) == 0
    assert picture.is_file()
    ((motions, times, footnote),) = drawn
    assert [motion.robot.name for motion in motions] == [
        "allegro_left",
        "allegro_right",
    ]
    assert [hand.side for motion in motions for hand in motion.hands] == [
        "left",
        "right",
    ]
    assert all(len(motion.q) == len(times) for motion in motions)
    assert "demo_left to allegro_left; demo_right to allegro_right" in footnote


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("fists.txt", "--picture: expected a file that ends in .png"),
        ("nowhere/fists.png", "there is no folder nowhere"),
        ("folder.png", "folder.png is a folder"),
        ("closed/fists.png", "the folder closed cannot be written"),
    ],
)
def test_a_picture_that_cannot_be_written_is_one_line_before_any_work(
    file: str,
    said: str,
    recording: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(recording.parent)
    Path("folder.png").mkdir()
    Path("closed").mkdir()
    # Root may write where nobody else may.
    monkeypatch.setattr(
        "handmap_qp.output_files.os.access", lambda path, _: path.name != "closed"
    )
    words = ["retarget", str(recording), "--robot", "three_finger", "--picture", file]
    assert cli.main(words) == 2
    printed = capsys.readouterr().err
    assert said in printed
    assert printed.count("\n") == 1
    assert [path.name for path in Path().glob("*.npz")] == ["fists.npz"]


@pytest.mark.parametrize("module", ["matplotlib", "trimesh"])
def test_a_missing_extra_is_one_line_before_any_work(
    module: str,
    recording: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(recording.parent)
    monkeypatch.setitem(sys.modules, module, None)
    words = ["retarget", str(recording), "--robot", "three_finger"]
    assert cli.main([*words, "--picture", "fists.png"]) == 2
    printed = capsys.readouterr().err
    assert "pip install" in printed
    assert "plot" in printed
    assert printed.count("\n") == 1
    assert [path.name for path in Path().glob("*.npz")] == ["fists.npz"]
