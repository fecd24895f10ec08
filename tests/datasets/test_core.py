"""The core reads, measures and packs an episode as the Python reference does."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from handmap_qp import read_recording
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.datasets import measures
from handmap_qp.apps.offline.look_ahead import map_hand
from handmap_qp.human import contact_gap, sample
from handmap_qp.human.contact_gap import smallest_gap
from handmap_qp.human.recording import Recording, mirrored
from handmap_qp.human.sample import check_length
from handmap_qp.ik import core as core_module
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats import hdf5, write_recordings

core: Any = core_module.core
if core is None:
    pytest.skip(core_module.description, allow_module_level=True)

DEMO = read_recording("demo", "right").part(slice(0, 90))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "hands.hdf5"
    write_recordings((DEMO, mirrored(DEMO)), path, hdf5.EgoDexFormat())
    return path


def read_both(path: Path, side: Any, count: int) -> tuple[Any, Any]:
    names = hdf5.joint_names(side)
    found = core.read_poses(bytes(path), names, count)
    return found, hdf5._poses(path, names, count)


@pytest.mark.parametrize("side", ["left", "right"])
def test_poses_are_read_as_by_h5py(file: Path, side: Any) -> None:
    found, expected = read_both(file, side, len(DEMO))
    for array, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(array, other)


def test_parts_that_a_file_lacks_are_none(file: Path) -> None:
    with h5py.File(file, "a") as opened:
        del opened["confidences"], opened["time"]
    found, expected = read_both(file, "left", len(DEMO))
    assert found[2:] == expected[2:] == (None, None)
    np.testing.assert_array_equal(found[0], expected[0])


def test_single_precision_is_read(file: Path) -> None:
    with h5py.File(file, "a") as opened:
        for name in hdf5.joint_names("left"):
            values = opened[f"transforms/{name}"][()]
            del opened[f"transforms/{name}"]
            opened[f"transforms/{name}"] = values.astype(np.float32)
    found, expected = read_both(file, "left", len(DEMO))
    np.testing.assert_array_equal(found[0], expected[0])


@pytest.mark.parametrize(
    "options", [{"chunks": True}, {"compression": "gzip"}, {"dtype": ">f8"}]
)
def test_other_arrays_are_left_to_h5py(file: Path, options: dict[str, Any]) -> None:
    with h5py.File(file, "a") as opened:
        values = opened["transforms/leftHand"][()]
        del opened["transforms/leftHand"]
        opened["transforms"].create_dataset("leftHand", data=values, **options)
    assert core.read_poses(bytes(file), hdf5.joint_names("left"), len(DEMO)) is None
    read = read_recording(f"{file}::left")
    np.testing.assert_array_equal(read.landmarks, mirrored(DEMO).landmarks)


@pytest.mark.parametrize("count", [0, 1, len(DEMO) - 1, len(DEMO) + 1, 1 << 60])
def test_another_number_of_samples_is_left_to_h5py(file: Path, count: int) -> None:
    names = hdf5.joint_names("left")
    if count > len(DEMO) + 1:
        with pytest.raises((MemoryError, ValueError, RuntimeError)):
            core.read_poses(bytes(file), names, count)
    else:
        assert core.read_poses(bytes(file), names, count) is None


def test_newer_and_missing_files_are_left_to_h5py(tmp_path: Path) -> None:
    path = tmp_path / "new.hdf5"
    with h5py.File(path, "w", libver="latest") as opened:
        opened["transforms/leftHand"] = np.zeros((3, 4, 4))
    for each in (path, tmp_path, tmp_path / "none.hdf5", Path("/dev/null")):
        assert core.read_poses(bytes(each), ["leftHand"], 3) is None


def test_damaged_files_are_read_as_by_h5py_or_left_to_it(file: Path) -> None:
    rng = np.random.default_rng(5)
    whole = bytearray(file.read_bytes())
    damaged = file.with_name("damaged.hdf5")
    names = hdf5.joint_names("left")
    taken = 0
    for trial in range(300):
        content = bytearray(whole)
        # The tables are near the front, and between the arrays.
        where = rng.integers(0, 20_000 if trial % 2 else len(content), 8)
        for place in where:
            content[place] = rng.integers(256)
        damaged.write_bytes(
            content[: rng.integers(len(content))] if trial % 5 == 0 else content
        )
        found = core.read_poses(bytes(damaged), names, len(DEMO))
        taken += found is not None
    assert 0 < taken < 300


def test_an_episode_is_measured_as_in_python() -> None:
    robot = MappingArguments().load_robot("allegro_right")
    person = measure_person(DEMO)
    arguments = MappingArguments()
    for recording in (DEMO, with_gaps(DEMO), DEMO.part(slice(0, 2))):
        recording, trajectory = map_hand(recording, robot, person, arguments)
        found = core.measure_episode(recording, trajectory)
        expected = measures._measured(recording, trajectory)
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            np.testing.assert_allclose(
                found[key], value, rtol=1e-9, atol=1e-12, err_msg=key
            )


def with_gaps(recording: Recording) -> Recording:
    valid = recording.valid.copy()
    valid[[0, 1, 20, 40, 41, 42, -1]] = False
    return Recording(
        recording.name, recording.time, recording.landmarks, valid, recording.side
    )


def test_people_are_measured_as_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    cases = [(DEMO.time[:n], DEMO.landmarks[:n]) for n in (1, 2, 3, 8, 89, 90)]
    found = [(smallest_gap(*case), check_length(case[1])) for case in cases]
    for module in (contact_gap, sample):
        monkeypatch.setattr(module, "core", None)
    for case, (gap, segments) in zip(cases, found, strict=True):
        assert gap == pytest.approx(smallest_gap(*case), abs=1e-12)
        np.testing.assert_allclose(segments, check_length(case[1]), atol=1e-12)


def test_archives_are_read_by_numpy() -> None:
    arrays = {
        "time": np.arange(5.0),
        "points": np.random.default_rng(0).normal(size=(7, 3, 2)),
        "names": np.array(["x", "yyy", "\u00e9"]),
        "side": np.array("right"),
        "none": np.zeros((3, 0), dtype=bool),
        "long" * 40: np.zeros((1,) * 20),
    }
    content = io.BytesIO(core.pack(arrays))
    with zipfile.ZipFile(content) as archive:
        assert archive.testzip() is None
    content.seek(0)
    with np.load(content) as found:
        assert found.files == list(arrays)
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)
