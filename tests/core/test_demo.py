"""The demo: the robot's limits and errors, and atomic output of its files."""

from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from coarse_drawing import draw_coarsely

from handmap_qp.apps.offline import demo
from handmap_qp.apps.offline.demo import FILES, Demo
from handmap_qp.apps.offline.trajectory import Trajectory
from handmap_qp.errors import InvalidInputError
from handmap_qp.trackers.formats import DEMO, read_recording

pytest.importorskip("matplotlib")
pytest.importorskip("trimesh")

HAND = "three_finger"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo") / "new" / "folder"


@pytest.fixture(scope="module")
def trajectory(folder: Path) -> Trajectory:
    seen: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        draw_coarsely(patch)
        done = Demo(HAND, folder).write(seen.append)
    # The core maps many samples before it tells.
    assert seen == sorted(seen)
    assert seen[-1] == len(done.time)
    return done


@pytest.mark.slow
def test_the_robot_never_leaves_its_limits(trajectory: Trajectory) -> None:
    assert trajectory.limit_violation == 0.0
    steps = np.diff(trajectory.time)[:, None]
    speed = np.abs(np.diff(trajectory.q, axis=0)) / steps
    assert (speed <= trajectory.robot.velocity_limits + 1e-6).all()


@pytest.mark.slow
def test_the_robot_follows(trajectory: Trajectory) -> None:
    assert np.median(trajectory.wrist_error) < 3e-3
    assert np.median(trajectory.point_error) < 0.02
    assert np.ptp(trajectory.q, axis=0).max() > 0.3, "the fingers move"


@pytest.mark.slow
def test_the_trajectory_file_is_the_motion(
    trajectory: Trajectory, folder: Path
) -> None:
    robot, samples = trajectory.robot, len(read_recording(DEMO, "right"))
    n, m = len(robot.joint_names), len(robot.reference_points)
    shapes = {
        "time": (samples,),
        "q": (samples, n),
        "wrist": (samples, 4, 4),
        "targets": (samples, m, 3),
        "points": (samples, m, 3),
        "point_error": (samples, m),
        "valid": (samples,),
        "at_limit": (samples, n),
    }
    with np.load(folder / "trajectory.npz", allow_pickle=False) as saved:
        columns = dict(saved)
    assert {name: columns[name].shape for name in shapes} == shapes
    assert tuple(columns["joint_names"]) == robot.joint_names
    assert any(version("handmap-qp") in str(line) for line in columns["versions"])
    np.testing.assert_array_equal(columns["q"], trajectory.q)
    for i in (0, samples // 2):
        np.testing.assert_allclose(
            columns["points"][i],
            robot.points(columns["q"][i], columns["wrist"][i]),
            atol=1e-9,
        )


@pytest.mark.slow
@pytest.mark.usefixtures("trajectory")
def test_the_pictures_show_something(folder: Path) -> None:
    from matplotlib.image import imread

    assert sorted(file.name for file in folder.iterdir()) == list(FILES)
    for file in folder.glob("*.png"):
        image = imread(file)
        assert min(image.shape[:2]) > 400
        assert 0.02 < (image[..., :3].min(axis=2) < 0.9).mean() < 0.5, file.name


@pytest.fixture
def light_demo(trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace mapping and pictures, for tests of files."""
    from matplotlib.figure import Figure

    monkeypatch.setattr(demo, "map_hands", lambda *_: (trajectory, None, None))
    monkeypatch.setattr(
        demo, "save_contact_sheet", lambda file, *_: Figure().savefig(file)
    )
    for name in ("errors_figure", "joints_figure"):
        monkeypatch.setattr(demo, name, lambda *_: Figure())


@pytest.mark.slow
@pytest.mark.usefixtures("light_demo")
def test_a_failure_keeps_earlier_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "demo"
    folder.mkdir()
    (folder / "trajectory.npz").write_text("old")

    def fail(*_: object) -> None:
        raise RuntimeError("no picture")

    monkeypatch.setattr(demo, "joints_figure", fail)
    with pytest.raises(RuntimeError, match="no picture"):
        Demo(HAND, folder).write()
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]
    assert [path.name for path in folder.iterdir()] == ["trajectory.npz"]
    assert (folder / "trajectory.npz").read_text() == "old"


@pytest.mark.slow
@pytest.mark.usefixtures("light_demo")
def test_files_of_the_user_stay(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    Demo(HAND, tmp_path).write()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted([*FILES, "notes.txt"])
    assert all(file.stat().st_size > 0 for file in tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("light_demo")
def test_a_file_in_the_way_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "demo").write_text("a file")
    with pytest.raises(InvalidInputError, match="expected a folder"):
        Demo(HAND, tmp_path / "demo").write()
    with pytest.raises(InvalidInputError, match="cannot be written"):
        Demo(HAND, tmp_path / "demo" / "inside").write()


def test_motors_are_the_demo_of_another_package(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def drive(*words: object) -> None:
        asked.append(words)

    asked: list[tuple[object, ...]] = []
    point = SimpleNamespace(load=lambda: drive)
    monkeypatch.setattr(demo, "entry_points", lambda **_: {"drive": point})
    Demo(drive=True).run()
    Demo(HAND, Path("here"), drive=True).run()
    assert asked == [(None, Path("demo")), (HAND, Path("here"))]
    monkeypatch.setattr(demo, "entry_points", lambda **_: {})
    with pytest.raises(InvalidInputError, match="pip install packages/drive") as raised:
        Demo(drive=True).run()
    assert raised.value.argument == "--drive"
