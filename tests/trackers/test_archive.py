"""The reader of `.npz` archives: every damage is one line, and no header makes it fill memory."""

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handmap_qp import RecordingError
from handmap_qp.trackers.formats.archive import read_archive

ARRAYS = {
    "a": np.arange(12.0).reshape(3, 4),
    "f": np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
    "text": np.array("right"),
    "empty": np.zeros((0, 3)),
}


def packed(compressed: bool = True) -> bytes:
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **ARRAYS)  # ty: ignore[invalid-argument-type]
    return stream.getvalue()


def refused(path: Path, content: bytes) -> str:
    path.write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        read_archive(path)
    assert "\n" not in str(caught.value)
    assert caught.value.file == path
    return str(caught.value)


@pytest.mark.parametrize("compressed", [True, False])
def test_reads_what_numpy_wrote(tmp_path: Path, compressed: bool) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(packed(compressed))
    found = read_archive(path)
    assert found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
    assert read_archive(path, {"a", "absent"}).keys() == {"a"}


def test_a_header_that_asks_for_more_than_there_is_allocates_nothing(
    tmp_path: Path,
) -> None:
    header = {"descr": "<f8", "fortran_order": False, "shape": (1 << 40, 1 << 10)}
    stream, member = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(member, header)
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.npy", member.getvalue())
    assert "a: is not a plain array: Unable to allocate" in refused(
        tmp_path / "a.npz", stream.getvalue()
    )


def test_a_decompression_bomb_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("handmap_qp.trackers.formats.archive.LARGEST_ARCHIVE", 1 << 20)
    stream = io.BytesIO()
    np.savez_compressed(stream, a=np.zeros(1 << 18))
    assert len(stream.getvalue()) < 1 << 13
    assert "more than the 1 MB" in refused(tmp_path / "a.npz", stream.getvalue())


def test_encrypted_and_unknown_members_are_named(tmp_path: Path) -> None:
    content = bytearray(packed())
    central = content.index(b"PK\x01\x02")
    for offset, value, word in (
        (8, 1, "encrypted"),
        (10, 99, "compression method is not supported"),
    ):
        broken = content.copy()
        struct.pack_into("<H", broken, central + offset, value)
        assert word in refused(tmp_path / "a.npz", bytes(broken))


def test_objects_are_not_unpickled(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.savez(stream, a=np.array([print], dtype=object))
    assert "Object arrays cannot be loaded" in refused(
        tmp_path / "a.npz", stream.getvalue()
    )


@given(st.data(), st.booleans())
def test_a_damaged_archive_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, compressed: bool
) -> None:
    content = bytearray(packed(compressed))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(
            st.integers(0, 255)
        )
    del content[data.draw(st.integers(len(content) // 2, len(content))) :]
    path = tmp_path_factory.mktemp("damaged") / "a.npz"
    path.write_bytes(bytes(content))
    problems = []
    try:
        read_archive(path)
    except RecordingError as error:
        problems.append(str(error))
    assert not any("\n" in problem for problem in problems)
