"""Output files are replaced only by complete ones."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from handmap_qp import InvalidInputError
from handmap_qp.output_files import remove_torn, replaced_file, sync


def test_a_complete_file_takes_the_place_of_an_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")
    with replaced_file(path, "--out") as file:
        file.write(b"new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_a_failure_keeps_the_earlier_file(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")
    with pytest.raises(error), replaced_file(path, "--out") as file:  # noqa: PT012
        file.write(b"half")
        raise error
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_cannot_be_synchronised_is_no_failure_but_a_broken_disk_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = errno.EINVAL

    def fail(handle: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", fail)
    sync(tmp_path)
    code = errno.EIO
    with pytest.raises(OSError, match="Input/output"):
        sync(tmp_path)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    path = tmp_path / "absent" / "out.txt"
    with pytest.raises(InvalidInputError) as caught, replaced_file(path, "--out"):
        pass
    assert caught.value.argument == "--out"
    assert str(path) in str(caught.value)


def test_what_a_killed_process_leaves_is_hidden_and_removed(tmp_path: Path) -> None:
    path, other = tmp_path / "take[1].npz", tmp_path / "take[1].npz.npz"
    with replaced_file(path, "--out"), replaced_file(other, "--out"):
        torn = list(tmp_path.iterdir())
        assert [file.name[0] for file in torn] == [".", "."]
        assert not any(file.suffix == ".npz" for file in torn)
        names = {file.name for file in torn}
    for name in names:
        (tmp_path / name).write_bytes(b"torn")
    remove_torn(path)
    left = {file.name for file in tmp_path.iterdir() if file.name.startswith(".")}
    assert len(left) == 1
    assert next(iter(left)).startswith(f".{other.name}.")
    assert {path.name, other.name} < {file.name for file in tmp_path.iterdir()}
