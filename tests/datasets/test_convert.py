"""`handmap convert`: between any two formats, with one line about what is lost."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handmap_qp import Recording, load_hand, read_recording
from handmap_qp.cli import main
from handmap_qp.trackers.formats import FORMATS, write_recordings

pytest.importorskip("h5py")
pytest.importorskip("pyarrow")
pytest.importorskip("rosbags")

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

ONE_WAY = ("lerobot", "npy", "dexycb", "arctic", "grab", "hot3d")
NAMES = [name for name in FORMATS.own if name not in ONE_WAY]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same short recording in every format."""
    folder = tmp_path_factory.mktemp("formats")
    human = load_hand("human", points="landmarks")
    landmarks = np.array(
        [human.points(share * human.rest) for share in (0.2, 0.6, 1.0)]
    )
    given = Recording(
        "take", np.array([1.0, 1.5, 1.75]), landmarks, np.ones(3), "right"
    )
    paths = {}
    for form in map(FORMATS.__getitem__, NAMES):
        paths[form.name] = (
            folder / f"{form.name}{form.suffixes[0] if form.suffixes else ''}"
        )
        write_recordings([given], paths[form.name], form)
    return paths


@pytest.mark.parametrize(("start", "end"), list(itertools.permutations(NAMES, 2)))
def test_from_each_to_each(
    start: str,
    end: str,
    files: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
) -> None:
    out = tmp_path / f"out{files[end].suffix}"
    assert main(["convert", str(files[start]), str(out), "--format", end]) == 0
    printed = capsys.readouterr().out
    assert "1 recordings, 3 samples" in printed
    assert f"wrote {out}" in printed
    found, given = read_recording(out), read_recording(files["npz"])
    np.testing.assert_array_equal(found.landmarks, given.landmarks)
    np.testing.assert_allclose(found.time, given.time, rtol=0, atol=1e-9)
    is_lossless = end in ("npz", "robomimic") and start in ("npz", "csv", "mano")
    assert not is_lossless or "nothing was lost" in printed


def test_a_set_becomes_files(
    files: dict[str, Path], tmp_path: Path, capsys: object
) -> None:
    both = [str(files["npz"]), str(files["csv"])]
    file, each = tmp_path / "set.hdf5", tmp_path / "each"
    assert main(["convert", *both, str(file)]) == 0
    assert main(["convert", str(file), str(each), "--format", "npz"]) == 0
    assert sorted(p.name for p in each.iterdir()) == [
        "set_demo_0.npz",
        "set_demo_1.npz",
    ]


def test_a_lerobot_set_is_written_and_not_read(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder = tmp_path / "set"
    assert main(["convert", str(files["npz"]), str(folder)]) == 0
    assert "nothing was lost" in capsys.readouterr().out
    assert main(["convert", str(folder), str(tmp_path / "a.npz")]) == 2
    error = capsys.readouterr().err
    assert "is a LeRobot data set, which is written and not read" in error
    assert error.count("\n") == 1


def test_bad_calls_are_one_line(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    npz = str(files["npz"])
    calls = {
        ("convert", npz): "IN OUT: expected a file to read and one to write",
        (
            "convert",
            npz,
            str(tmp_path / "a.txt"),
        ): "OUT: expected a file that ends in one of",
        ("convert", npz, str(tmp_path / "no" / "a.npz")): "OUT: there is no folder",
        (
            "convert",
            str(tmp_path / "absent.npz"),
            str(tmp_path / "a.csv"),
        ): "absent.npz: cannot be",
        ("convert", npz, npz, str(tmp_path / "a.csv")): "one recording of each hand",
        ("convert", npz, str(tmp_path / "a"), "--format", "zip"): "--format",
    }
    for call, line in calls.items():
        assert main(call) == 2, call
        error = capsys.readouterr().err
        assert line in error
        assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_json_says_the_same(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert (
        main(["convert", str(files["egodex"]), str(tmp_path / "a.mcap"), "--json"]) == 0
    )
    result = json.loads(capsys.readouterr().out)
    assert (result["recordings"], result["samples"]) == (1, 3)
    assert "orientations of the fingers' joints" in result["not_read"]
    assert "instants beyond whole nanoseconds" in result["lost"]


def test_recordings_of_two_rates_are_not_one_lerobot_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The time stamp of LeRobot counts frames: it would be wrong for at least one of them.
    left, right = (read_recording("demo", side) for side in ("left", "right"))
    fast = replace(right, time=right.time / 3.0)
    for name, recording in (("left", left), ("right", fast)):
        write_recordings([recording], tmp_path / f"{name}.npz")
    inputs = [str(tmp_path / f"{name}.npz") for name in ("left", "right")]
    assert main(["convert", *inputs, str(tmp_path / "set"), "--format", "lerobot"]) == 2
    told = capsys.readouterr().err
    assert "expected recordings of one rate" in told
    assert "a set for each rate" in told
    assert not (tmp_path / "set").exists()
    # At the same rate but for jitter, they are one set.
    write_recordings([left, right], tmp_path / "set", FORMATS["lerobot"])
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["fps"] == 30


@pytest.mark.parametrize("form", [name for name in NAMES if name != "hamer"])
def test_a_file_says_that_its_time_is_a_rate_or_that_this_is_lost(
    form: str, tmp_path: Path
) -> None:
    recording = read_recording("demo", "right").part(slice(30)).at_rate(25.0)
    suffix = FORMATS[form].suffixes[0]
    path = tmp_path / f"take{suffix}"
    lost = write_recordings([recording], path, FORMATS[form])
    is_kept = read_recording(path).time_source == recording.time_source
    assert is_kept == ("that the instants are those of a rate" not in lost)
    assert is_kept == (form in ("npz", "robomimic"))
