"""Hands that HaMeR and WiLoR predict: every form of the arrays gives the hands that were seen."""

from __future__ import annotations

import os
import pickle
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmap_hamer import FORMAT
from mano_model import write_mano_model

from handmap_core.human.recording import finite_samples
from handmap_qp import InvalidInputError, RecordingError, read_recording
from handmap_qp.cli import main
from handmap_qp.trackers import FORMATS, SIDES, read_hands

DEMO = {side: read_recording("demo", side).part(slice(60, 150)) for side in SIDES}
MIRROR = np.array([-1.0, 1.0, 1.0])
FPS = 25.0


@pytest.fixture(autouse=True)
def _installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the package be found as one that is installed."""
    point = EntryPoint("hamer", "handmap_hamer:FORMAT", "handmap_qp.formats")
    monkeypatch.setattr(FORMATS, "_others", {"hamer": point})


def predicted(*, is_raw: bool, seed: int = 0) -> dict[str, Any]:
    """Both hands of the demo as the network sees them, in any order, with some frames lost."""
    rng = np.random.default_rng(seed)
    points = np.stack([DEMO[side].landmarks for side in SIDES], axis=1)
    lost = np.stack([~DEMO[side].valid for side in SIDES], axis=1)
    lost[rng.integers(0, len(points), 5), 0] = True
    shifts = points[:, :, 0].copy()
    own = points - shifts[:, :, None]
    own[lost] = np.nan
    if is_raw:
        own[:, 0] *= MIRROR
    right = np.tile([0.0, 1.0], (len(points), 1))
    order = np.argsort(rng.random(right.shape), axis=1)
    return {
        "pred_keypoints_3d": np.take_along_axis(own, order[..., None, None], 1),
        "right": np.take_along_axis(right, order, 1),
        "pred_cam_t_full": np.take_along_axis(shifts, order[..., None], 1),
        "fps": FPS,
    }


def write(path: Path, arrays: dict[str, Any]) -> Path:
    """Write arrays as a user would."""
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    elif path.suffix == ".npy":
        np.save(path, arrays["pred_keypoints_3d"])
    elif path.suffix == ".pkl":
        path.write_bytes(pickle.dumps(arrays, protocol=5))
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            for name, array in arrays.items():
                file[name] = array
    return path


@pytest.mark.parametrize("is_raw", [True, False], ids=["HaMeR", "mirrored already"])
@pytest.mark.parametrize("suffix", [".npz", ".pkl", ".h5"])
def test_both_hands_are_found_where_they_were(
    tmp_path: Path, suffix: str, is_raw: bool
) -> None:
    path = write(tmp_path / f"video{suffix}", predicted(is_raw=is_raw))
    for side, found in read_hands([path]).items():
        given = DEMO[side]
        assert len(found) == len(given)
        assert given.valid[found.valid].all()
        assert found.valid.mean() > 0.9
        assert found.valid.all() == (side == "right")
        np.testing.assert_allclose(
            found.landmarks[found.valid], given.landmarks[found.valid], atol=1e-12
        )
        np.testing.assert_allclose(found.time, np.arange(len(given)) / FPS)


@pytest.mark.parametrize("side", SIDES)
def test_one_array_becomes_a_hand_by_its_side_and_rate(
    tmp_path: Path, side: Any, capsys: pytest.CaptureFixture
) -> None:
    arrays = {"pred_keypoints_3d": DEMO[side].landmarks}
    path, out = write(tmp_path / "hand.npy", arrays), tmp_path / "hand.csv"
    # The array does not say which hand it is of, nor when.
    with pytest.raises(RecordingError, match="it has 2 recordings"):
        read_recording(path)
    words = ["convert", f"{path}::{side}", str(out)]
    assert main(words) == 0
    assert "the time, which the file does not have" in capsys.readouterr().out
    robot = ["--robot", "three_finger", "--out", str(tmp_path / "mapped.npz")]
    assert main(["map", str(out), *robot]) == 2
    assert "counts samples" in capsys.readouterr().err
    assert main([*words, "--fps", "25"]) == 0
    found = read_recording(out)
    assert found.side == side
    seen = found.valid
    np.testing.assert_array_equal(found.landmarks[seen], DEMO[side].landmarks[seen])
    np.testing.assert_allclose(found.time, np.arange(len(found)) / 25.0)
    words = ["map", str(path), "--side", side, "--fps", "25", "--mirror"]
    is_right = side == "right"
    assert main([*words[: -1 if is_right else None], *robot]) == 0


def test_without_the_package_its_files_name_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FORMATS, "_others", {})
    for suffix in (".npz", ".npy", ".pkl"):
        file = write(tmp_path / f"video{suffix}", predicted(is_raw=True))
        with pytest.raises(RecordingError, match="install packages/hamer"):
            read_recording(file)
    with pytest.raises(RecordingError, match=r"of HaMeR or WiLoR: .* give --fps"):
        read_recording(tmp_path / "video.npz")


def test_a_hand_that_is_found_again_as_another_track_goes_on(tmp_path: Path) -> None:
    points = DEMO["right"].landmarks[:60].copy()
    points[~DEMO["right"].valid[:60]] = np.nan
    tracks = np.stack([points, points], axis=1)
    tracks[20:, 0] = tracks[:30, 1] = np.nan
    lost = ~finite_samples(points)
    lost[20:30] = True
    arrays = {"pred_keypoints_3d": tracks, "fps": FPS}
    says: dict[str, dict[str, Any]] = {"a.npz": {"right": 1}, "b.h5": {"side": "right"}}
    for name, side in says.items():
        found = read_recording(write(tmp_path / name, arrays | side))
        np.testing.assert_array_equal(found.valid, ~lost)
        np.testing.assert_array_equal(found.landmarks[~lost], points[~lost])


def test_flags_and_places_of_another_shape_are_refused(tmp_path: Path) -> None:
    arrays = predicted(is_raw=True) | {"right": np.ones(3)}
    with pytest.raises(RecordingError, match="right: expected a value for each of 2"):
        read_hands([write(tmp_path / "a.npz", arrays)])
    arrays["right"] = np.full((90, 2), 0.5)
    with pytest.raises(RecordingError, match="right: expected 1 for each right hand"):
        read_hands([write(tmp_path / "b.npz", arrays)])
    arrays = predicted(is_raw=True)
    arrays["pred_cam_t_full"] = np.moveaxis(arrays["pred_cam_t_full"], 2, 0)
    with pytest.raises(RecordingError, match=r"pred_cam_t_full: .* shape \(3, 90, 2\)"):
        read_hands([write(tmp_path / "c.npz", arrays)])


def test_a_pickle_runs_no_code(tmp_path: Path) -> None:
    out = tmp_path / "run"

    class Harmful:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.mkdir, (str(out),)

    for content in (Harmful(), {"pred_keypoints_3d": Harmful()}, [Harmful()]):
        path = tmp_path / "video.pkl"
        path.write_bytes(pickle.dumps(content))
        with pytest.raises(
            RecordingError, match=r"holds posix.mkdir, which is not read"
        ):
            read_recording(path)
        assert not out.exists()


def test_rotation_matrices_are_rotation_vectors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(2)
    turns = rng.normal(0.0, 0.3, (5, 16, 3))
    betas = rng.normal(size=(5, 10))
    common = {"side": "right", "fps": 30.0}
    vectors = common | {
        "global_orient": turns[:, 0],
        "hand_pose": turns[:, 1:].reshape(5, 45),
        "betas": betas.mean(axis=0),
        "flat_hand_mean": True,
    }
    matrices = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
    matrices = matrices.reshape(5, 16, 3, 3)
    given = common | {
        "global_orient": matrices[:, :1],
        "hand_pose": matrices[:, 1:],
        "betas": betas,
    }
    write_mano_model(tmp_path / "MANO_RIGHT.pkl")
    monkeypatch.setenv("HANDMAP_MANO", str(tmp_path))
    expected = read_recording(write(tmp_path / "vectors.npz", vectors))
    for name in ("matrices.pkl", "matrices.h5"):
        arrays = {key: given[key] for key in given if key != "side"}
        found = read_recording(write(tmp_path / name, arrays), "right")
        np.testing.assert_allclose(found.landmarks, expected.landmarks, atol=1e-9)


def test_the_form_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="hamer: is read and not written"):
        FORMAT.write([DEMO["right"]], tmp_path / "a.npz")
