"""The demo: the paper's arc, the robot's limits and errors, and atomic output of its files."""

from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

import handmap_qp.apps.experiments.demo as demo
from handmap_qp.apps.experiments.demo import (
    DemoResult,
    arc_motion,
    human_points,
    run_demo,
)
from handmap_qp.errors import InvalidInputError

pytest.importorskip("matplotlib")
pytest.importorskip("trimesh")

FILES = ("errors.png", "hands.png", "joints.png", "trajectory.npz")
SAMPLES = 121


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> DemoResult:
    seen: list[int] = []
    done = run_demo(
        tmp_path_factory.mktemp("demo") / "new" / "folder",
        samples=SAMPLES,
        progress=seen.append,
    )
    assert seen == list(range(1, SAMPLES + 1))
    return done


def test_the_arc_has_the_papers_length_and_height() -> None:
    motion = arc_motion(241)
    x, y, z = motion.wrist[:, :3, 3].T
    assert x[-1] - x[0] == pytest.approx(0.470)
    assert z.max() - z[0] == pytest.approx(0.150)
    assert z[-1] == pytest.approx(z[0])
    assert np.ptp(y) == 0.0
    assert (np.diff(x) >= 0.0).all()
    np.testing.assert_allclose(
        z - z[0], 0.150 * np.cos(np.pi * (x / 0.470 - 0.5)), atol=1e-12
    )
    assert motion.time[-1] == pytest.approx(4.0)


def test_the_wrist_starts_and_stops_smoothly_and_does_not_turn() -> None:
    motion = arc_motion(241)
    speed = np.linalg.norm(np.diff(motion.wrist[:, :3, 3], axis=0), axis=1) * demo.RATE
    assert speed[[0, -1]].max() < 1e-3 * speed.max()
    assert (motion.wrist[:, :3, :3] == motion.wrist[0, :3, :3]).all()


def test_the_human_closes_and_opens_within_its_limits() -> None:
    motion = arc_motion(241)
    assert (motion.q >= motion.human.lower_limits).all()
    assert (motion.q <= motion.human.upper_limits).all()
    np.testing.assert_allclose(motion.q[0], motion.q[-1])
    spread = np.linalg.norm(
        human_points(motion) - human_points(motion).mean(axis=1, keepdims=True), axis=2
    ).mean(axis=1)
    assert spread[120] < 0.75 * spread[0]


def test_too_few_samples_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"samples: expected an integer >= 3"):
        arc_motion(2)


@pytest.mark.slow
def test_the_robot_never_leaves_its_limits(result: DemoResult) -> None:
    trajectory = result.trajectory
    assert trajectory.limit_violation == 0.0
    speed = np.abs(np.diff(trajectory.q, axis=0)) * demo.RATE
    assert (speed <= trajectory.robot.velocity_limits + 1e-6).all()


@pytest.mark.slow
def test_the_robot_follows_and_comes_home(result: DemoResult) -> None:
    trajectory = result.trajectory
    assert trajectory.wrist_error.max() < 3e-3
    assert trajectory.point_error.mean() < 4e-3
    assert np.ptp(trajectory.q, axis=0).max() > 0.3, "the fingers move"
    assert trajectory.point_error[-1].max() < 2e-3
    np.testing.assert_allclose(trajectory.q[-1], trajectory.q[0], atol=0.02)
    moved = trajectory.wrist[-1, :3, 3] - trajectory.wrist[0, :3, 3]
    np.testing.assert_allclose(moved, [0.470, 0.0, 0.0], atol=2e-3)
    np.testing.assert_allclose(
        trajectory.wrist[-1, :3, :3], trajectory.wrist[0, :3, :3], atol=0.02
    )


@pytest.mark.slow
def test_the_trajectory_file_holds_both_hands(result: DemoResult) -> None:
    robot, human = result.trajectory.robot, arc_motion(SAMPLES).human
    n, m, n_h, m_h = (
        len(robot.joint_names),
        len(robot.reference_points),
        len(human.joint_names),
        len(human.reference_points),
    )
    shapes = {
        "time": (SAMPLES,),
        "q": (SAMPLES, n),
        "wrist": (SAMPLES, 4, 4),
        "targets": (SAMPLES, m, 3),
        "points": (SAMPLES, m, 3),
        "point_error": (SAMPLES, m),
        "valid": (SAMPLES,),
        "at_limit": (SAMPLES, n),
        "human_q": (SAMPLES, n_h),
        "human_wrist": (SAMPLES, 4, 4),
        "human_points": (SAMPLES, m_h, 3),
    }
    with np.load(
        result.files[FILES.index("trajectory.npz")], allow_pickle=False
    ) as saved:
        columns = dict(saved)
    assert {name: columns[name].shape for name in shapes} == shapes
    assert tuple(columns["joint_names"]) == robot.joint_names
    assert any(version("handmap-qp") in str(line) for line in columns["versions"])
    np.testing.assert_array_equal(columns["q"], result.trajectory.q)
    for i in (0, SAMPLES // 2):
        np.testing.assert_allclose(
            columns["points"][i],
            robot.points(columns["q"][i], columns["wrist"][i]),
            atol=1e-9,
        )
        np.testing.assert_allclose(
            columns["human_points"][i],
            human.points(columns["human_q"][i], columns["human_wrist"][i]),
        )


@pytest.mark.slow
def test_the_pictures_show_something(result: DemoResult) -> None:
    from matplotlib.image import imread

    assert tuple(file.name for file in result.files) == FILES
    for file in result.files:
        if file.suffix == ".png":
            image = imread(file)
            assert min(image.shape[:2]) > 500
            assert 0.02 < (image[..., :3].min(axis=2) < 0.9).mean() < 0.5, file.name
    left, right = np.split(imread(result.files[1])[..., :3], 2, axis=1)
    blue, red = left[..., 2] - left[..., 0] > 0.3, right[..., 0] - right[..., 2] > 0.3
    assert blue.sum() > 2000, "the human's points and paths"
    assert red.sum() > 2000, "the robot's"


@pytest.fixture
def light_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the pictures by empty ones, for tests of files."""
    from matplotlib.figure import Figure

    for name in ("hands_figure", "errors_figure", "joints_figure"):
        monkeypatch.setattr(demo, name, lambda *_: Figure())


@pytest.mark.slow
@pytest.mark.usefixtures("light_figures")
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
        run_demo(folder, samples=3)
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]
    assert [path.name for path in folder.iterdir()] == ["trajectory.npz"]
    assert (folder / "trajectory.npz").read_text() == "old"


@pytest.mark.usefixtures("light_figures")
def test_files_of_the_user_stay(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    files = run_demo(tmp_path, samples=3).files
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [*FILES, "notes.txt"]
    )
    assert all(file.stat().st_size > 0 for file in files)


@pytest.mark.usefixtures("light_figures")
def test_a_file_in_the_way_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "demo").write_text("a file")
    with pytest.raises(InvalidInputError, match="expected a folder"):
        run_demo(tmp_path / "demo", samples=3)
    with pytest.raises(InvalidInputError, match="cannot be written"):
        run_demo(tmp_path / "demo" / "inside", samples=3)
