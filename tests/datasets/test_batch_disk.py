"""`handmap batch` on disks that lose, damage or refuse files, and folders with links in circles."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import msgspec
import numpy as np
import pytest
from batch_cases import OPTIONS, batch, episodes, write_pieces

from handmap_qp import InvalidInputError
from handmap_qp.apps.datasets.batch import Batch, plan_batch
from handmap_qp.apps.datasets.episodes import is_intact, open_episode, run_group
from handmap_qp.apps.datasets.manifest import open_manifest, read_manifests
from handmap_qp.apps.datasets.sources import find_files
from handmap_qp.cli import main
from handmap_qp.errors import DiskFullError

# Whole hands, and disks that are made for a test: not for the fast suite.
pytestmark = pytest.mark.slow

WORDS = ("--robot", "three_finger", "--workers", "0")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_pieces(folder, 3)
    return folder


@pytest.fixture(scope="module")
def whole(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A batch to copy, in which nothing went wrong."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert len(batch(inputs, out).done) == 3
    return out


@pytest.fixture
def out(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "out")


def run(inputs: Path, out: Path, *words: str) -> int:
    """Return the exit code of `handmap batch`."""
    try:
        return main(["batch", str(inputs), "--out", str(out), *WORDS, *words])
    except SystemExit as end:
        return int(str(end.code))


def flip(file: Path, place: int = -1) -> None:
    """Flip one bit, in the middle of the file if no place is given."""
    data = bytearray(file.read_bytes())
    place = len(data) // 2 if place < 0 else place
    data[place] ^= 1 << place % 8
    file.write_bytes(data)


def without_digests(out: Path) -> None:
    """Make the manifest one of version 0.2."""
    lines = read_manifests(out).values()
    texts = [
        msgspec.json.encode(msgspec.structs.replace(line, sha256="")) for line in lines
    ]
    assert not any(b"sha256" in text for text in texts)
    (out / "manifest.jsonl").write_bytes(b"".join(text + b"\n" for text in texts))


DAMAGES: dict[str, Callable[[Path], object]] = {
    "emptied": lambda file: file.write_bytes(b""),
    "cut": lambda file: file.write_bytes(file.read_bytes()[:-100]),
    "flipped": flip,
    "deleted": Path.unlink,
    "another's": lambda file: shutil.copy(file.with_name("take2.npz.npz"), file),
}


@pytest.mark.parametrize("is_old", [False, True], ids=["now", "0.2"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_episode_is_mapped_again(
    damage: str,
    is_old: bool,
    inputs: Path,
    whole: Path,
    out: Path,
    capsys: pytest.CaptureFixture,
) -> None:
    if is_old:
        without_digests(out)
    DAMAGES[damage](out / "episodes/take1.npz.npz")
    assert run(inputs, out, "--json") == 0
    said = capsys.readouterr()
    counts = json.loads(said.out)
    assert (counts["done"], counts["skipped"], counts["failed"]) == (1, 2, 0)
    line = (
        "handmap: 1 episodes are damaged or missing, and are mapped again: take1.npz\n"
    )
    assert said.err == line
    assert episodes(out) == episodes(whole)
    assert run(inputs, out, "--json") == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["skipped"] == 3
    assert not said.err


def test_every_flipped_bit_is_found(out: Path) -> None:
    line = read_manifests(out)["take0.npz::"]
    file = out / line.out
    good, (arrays,) = file.read_bytes(), open_episode(out, line).pieces()
    old = msgspec.structs.replace(line, sha256="")
    found = 0
    for place in random.Random(0).sample(range(len(good)), 200):
        flip(file, place)
        assert not is_intact(out, line)
        # Without a digest, only what changes nothing that is used may pass: fields of the archive
        # that are not read, such as times of change.
        if is_intact(out, old):
            (read,) = open_episode(out, old).pieces()
            assert all(np.array_equal(read[name], arrays[name]) for name in arrays)
        else:
            found += 1
        file.write_bytes(good)
    assert is_intact(out, line)
    assert is_intact(out, old)
    assert found > 150


def test_a_manifest_without_digests_is_believed_as_far_as_its_archives(
    inputs: Path, out: Path
) -> None:
    without_digests(out)
    plan = plan_batch([inputs], out, OPTIONS)
    assert [len(plan.done), len(plan.jobs), len(plan.damaged)] == [3, 0, 0]


@pytest.mark.parametrize("form", ["lerobot", "robomimic"])
def test_an_episode_that_is_damaged_before_the_data_set_is_mapped_again(
    form: str,
    inputs: Path,
    out: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    pytest.importorskip("pyarrow")
    pytest.importorskip("h5py")
    assert run(inputs, out, "--format", form) == 0
    made = out / ("lerobot" if form == "lerobot" else "episodes.hdf5")
    files = (
        [made] if made.is_file() else sorted(f for f in made.rglob("*") if f.is_file())
    )
    before = [file.read_bytes() for file in files]
    capsys.readouterr()
    assemble, left = Batch._assemble, ["take0", "take2"]

    def damaged(*values: object) -> object:
        if left:
            flip(out / f"episodes/{left.pop()}.npz.npz")
        return assemble(*values)  # ty: ignore[invalid-argument-type]

    monkeypatch.setattr(Batch, "_assemble", damaged)
    # Twice in one run is a disk that must not be trusted: an error, and the data set as it was.
    assert run(inputs, out, "--format", form) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].endswith("mapped again: take2.npz")
    assert lines[1].endswith(
        "take0.npz.npz: is not what was written: its digest differs"
    )
    assert len(lines) == 2
    assert [file.read_bytes() for file in files] == before
    left.append("take1")
    assert run(inputs, out, "--format", form) == 0
    assert capsys.readouterr().err.endswith("mapped again: take1.npz\n")
    assert [file.read_bytes() for file in files] == before


class Disk:
    """What a power failure leaves: contents and names, as they were when they were synchronised.

    Args:
        root: A folder whose own name is on the disk.
        manifest: File after each of whose synchronisations the power fails.
    """

    def __init__(self, root: Path, manifest: Path, patch: pytest.MonkeyPatch) -> None:
        self.contents: dict[int, bytes] = {}
        self.names: dict[int, dict[str, int]] = {}
        self.failures = 0
        self._root, self._manifest, self._sync = root, manifest, os.fsync
        patch.setattr(os, "fsync", self.fsync)

    def fsync(self, handle: int) -> None:
        self._sync(handle)
        path = Path(f"/proc/self/fd/{handle}").readlink()
        if path.is_dir():
            self.names[path.stat().st_ino] = {
                f.name: f.stat().st_ino for f in path.iterdir()
            }
        else:
            self.contents[path.stat().st_ino] = path.read_bytes()
        if path == self._manifest:
            self.check()

    def read(self, file: Path) -> bytes:
        place = self._root.stat().st_ino
        for name in file.relative_to(self._root).parts:
            place = self.names[place][name]
        return self.contents[place]

    def check(self) -> None:
        self.failures += 1
        for text in self.read(self._manifest).splitlines():
            line = json.loads(text)
            episode = self.read(self._manifest.parent / line["out"])
            assert sha256(episode).hexdigest() == line["sha256"]


@pytest.mark.parametrize("form", ["lerobot", "robomimic"])
def test_what_the_manifest_says_is_on_the_disk_before_it(
    form: str, inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    pytest.importorskip("h5py")
    shutil.copytree(inputs, tmp_path / "in/a/b")
    out = tmp_path / "new" / "out"
    disk = Disk(tmp_path, out / "manifest.jsonl", monkeypatch)
    assert run(tmp_path / "in", out, "--format", form) == 0
    assert disk.failures == 3
    assert len(read_manifests(out)) == 3
    made = [f for f in out.rglob("*") if f.is_file() and f.name != "manifest.jsonl"]
    assert len(made) > 3
    for file in made:
        assert disk.read(file) == file.read_bytes()


def test_a_group_of_a_worker_is_on_the_disk_before_its_lines(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(tmp_path, tmp_path / "out" / "manifest.jsonl", monkeypatch)
    jobs = plan_batch([inputs], tmp_path / "out", OPTIONS).jobs
    with open_manifest(tmp_path / "out") as append:
        for line in run_group(jobs):
            append(line)
    assert disk.failures == 3


def test_failed_recordings_are_counted_in_the_exit_code(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    own = shutil.copytree(inputs, tmp_path / "in")
    for i in range(3):
        # The more fail, the more are named; the reasons are in the manifest.
        (own / f"take{i}.npz").write_bytes(b"torn")
        assert run(own, tmp_path / "out", *["--json"] * (i == 2)) == 1
        said = capsys.readouterr()
        names = ", ".join(f"take{k}.npz" for k in range(i + 1))
        end = f"failed; the reasons are in {tmp_path}/out/manifest*.jsonl: {names}\n"
        assert said.err == f"handmap: {i + 1} recordings {end}"
    assert json.loads(said.out)["failed"] == 3
    reasons = [line.error for line in read_manifests(tmp_path / "out").values()]
    assert all("is not an .npz file" in reason for reason in reasons)


def test_a_recording_that_is_left_alone_has_failed(
    inputs: Path, out: Path, capsys: pytest.CaptureFixture
) -> None:
    line = read_manifests(out)["take1.npz::"]
    with open_manifest(out) as append:
        append(
            msgspec.structs.replace(line, status="failed", kills=3, error="given up")
        )
    assert run(inputs, out) == 1
    assert "handmap: 1 recordings failed" in capsys.readouterr().err


def test_a_disk_may_be_full_at_any_moment(
    inputs: Path,
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    sync, calls = os.fsync, [0]
    at, two = 0, tmp_path / "in"
    shutil.copytree(inputs, two, ignore=shutil.ignore_patterns("take2*"))
    expected = {
        file: data for file, data in episodes(whole).items() if "take2" not in file
    }
    while True:
        at, calls[0] = at + 1, 0

        def full(handle: int, at: int = at) -> None:
            calls[0] += 1
            if calls[0] >= at:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            sync(handle)

        monkeypatch.setattr(os, "fsync", full)
        out = tmp_path / f"{at}"
        code = run(two, out)
        monkeypatch.setattr(os, "fsync", sync)
        error = capsys.readouterr().err
        if not code:
            break
        assert code == 1
        assert error.startswith("handmap: --out: ")
        assert (
            "No space left on device: make room, and run the same command again\n"
            in error
        )
        assert error.count("\n") == 1
        assert not list(out.rglob("*.part"))
        assert run(two, out) == 0
        assert not capsys.readouterr().err
        assert episodes(out) == expected
    assert at > 9, (
        "each episode has three moments of its own, and the manifest one for each"
    )


def test_a_manifest_on_a_full_disk_is_one_error(tmp_path: Path, out: Path) -> None:
    line = read_manifests(out)["take1.npz::"]
    (tmp_path / "manifest.jsonl").symlink_to("/dev/full")
    with (
        pytest.raises(DiskFullError, match="No space left"),
        open_manifest(tmp_path) as append,
    ):
        append(line)


def test_room_for_hdf5_is_checked_before_each_episode(
    inputs: Path,
    out: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    pytest.importorskip("h5py")
    assert run(inputs, out, "--format", "robomimic") == 0
    before = (out / "episodes.hdf5").read_bytes()
    sizes: list[int] = []

    def full(handle: int, start: int, size: int) -> None:
        sizes.append(size)
        if len(sizes) == 3:
            raise OSError(errno.ENOSPC, "")

    monkeypatch.setattr(os, "posix_fallocate", full)
    assert run(inputs, out, "--format", "robomimic") == 1
    assert "episodes.hdf5: cannot be written: No space left" in capsys.readouterr().err
    assert (out / "episodes.hdf5").read_bytes() == before
    assert not list(out.glob(".*.part"))
    sizes[:] = [0] * 3
    assert run(inputs, out, "--format", "robomimic") == 0
    assert len(sizes) == 6
    assert sum(sizes) > len(before)


FULL = {
    "pool": ("--workers", "1"),
    "lerobot": ("--workers", "0", "--format", "lerobot"),
    "robomimic": ("--workers", "0", "--format", "robomimic"),
}
"""Batches on a full disk."""
FILL = """
import contextlib, io, json, shutil, subprocess, sys
from pathlib import Path
from handmap_qp.cli import main

def said(words):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as end:
            code = end.code
    return code, out.getvalue(), err.getvalue()

if __name__ == "__main__":
    for name, (room, words) in json.loads(sys.argv[1]).items():
        disk = Path(name)
        disk.mkdir()
        if subprocess.call(["mount", "-t", "tmpfs", "-o", f"size={room}", "none", name]):
            sys.exit(99)
        first = said([*words, "--out", f"{name}/out"])
        subprocess.check_call(["mount", "-o", "remount,size=64m", name])
        second = said([*words, "--out", f"{name}/out"])
        shutil.copytree(disk / "out", f"{name}_out")
        Path(f"{name}.json").write_text(json.dumps([first, second]))
"""
"""Runs each batch twice, on a disk of its own: first with little room, then with enough."""


@pytest.fixture(scope="module")
def full(whole: Path, inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of batches on full disks, which are run in one process."""
    pytest.importorskip("pyarrow")
    pytest.importorskip("h5py")
    folder, size = (
        tmp_path_factory.mktemp("full"),
        sum(map(len, episodes(whole).values())),
    )
    (folder / "fill.py").write_text(FILL)
    command = ["batch", str(inputs), "--robot", "three_finger", "--json"]
    # Room for the episodes but not for the data set, or for two episodes of three.
    cases = {
        name: (size + (40_000 if "--format" in words else -8_000), [*command, *words])
        for name, words in FULL.items()
    }
    done = subprocess.run(
        ["unshare", "-rm", sys.executable, "fill.py", json.dumps(cases)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    if not (folder / "pool.json").exists():
        pytest.skip(f"no disk of its own: {done.stderr}")
    return folder


@pytest.mark.parametrize("name", FULL)
def test_a_full_disk_is_one_line_and_no_episode_is_believed(
    name: str, full: Path, whole: Path
) -> None:
    first, second = json.loads((full / f"{name}.json").read_text())
    code, out, error = first
    assert (code, out) == (1, "")
    assert error.startswith(f"handmap: --out: {name}/out")
    assert "No space left on device" in error
    assert error.count("\n") == 1
    code, out, error = second
    assert (code, error) == (0, "")
    counts = json.loads(out)
    assert counts["done"] + counts["skipped"] == 3
    assert episodes(full / f"{name}_out") == episodes(whole)


def test_every_file_is_listed_once(inputs: Path, tmp_path: Path) -> None:
    own = shutil.copytree(inputs, tmp_path / "in")
    (own / "deep").mkdir()
    (own / "deep" / "circle").symlink_to(own)
    (own / "a circle").symlink_to(own / "a circle")
    (own / "a first.npz").symlink_to(own / "take0.npz")
    (own / "hard.npz").hardlink_to(own / "take1.npz")
    (own / "lost.npz").symlink_to(tmp_path / "absent.npz")
    files, repeated = find_files([own, own / "take2.npz", own / ".." / "in"])
    # A link that leads nowhere is a file that cannot be read.
    assert list(files) == [
        "hard.npz",
        "lost.npz",
        "take0.npz",
        "take2.npz",
    ]
    assert {path.name for path in repeated} == {
        *("circle", "a first.npz", "take1.npz", "take2.npz", "in")
    }
    assert len(repeated) == 5
    assert find_files([own / "take0.npz"] * 2)[1] == (own / "take0.npz",)


def test_a_batch_does_not_map_its_own_episodes(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    own = write_pieces(tmp_path / "in", 3)[0].parent
    for done in (3, 0):
        assert run(own, own / "mapped", "--json") == 0
        said = capsys.readouterr()
        assert json.loads(said.out)["done"] == done
        assert not said.err
    assert episodes(own / "mapped") == episodes(whole)


def test_files_that_differ_need_different_names(inputs: Path, tmp_path: Path) -> None:
    own = shutil.copytree(inputs, tmp_path / "in")
    with pytest.raises(
        InvalidInputError, match=r"files of different names, got take\d\.npz twice"
    ):
        find_files([own, inputs])


def test_links_in_circles_are_one_episode_each(
    inputs: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    own = shutil.copytree(inputs, tmp_path / "in")
    (own / "again").symlink_to(own)
    assert run(own, tmp_path / "out") == 0
    said = capsys.readouterr().err
    assert said == (
        "handmap: 1 paths lead to files that are listed already, and are left out: "
        f"{own / 'again'}\n"
    )
    assert episodes(tmp_path / "out") == episodes(whole)
