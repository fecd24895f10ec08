"""The reading process: what ends it ends one read, in one line."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from damaged_formats import DamagedFormat

from handmap_qp.errors import RecordingError
from handmap_qp.trackers.formats import IsolatedFormat, NpzFormat, read_one, write_recordings
from handmap_qp.trackers.formats.isolation import ReadingProcess

FILE = Path(str(os.getpid()))


def test_a_crash_or_a_limit_ends_one_read_in_one_line() -> None:
    form, process = DamagedFormat(), ReadingProcess(longest=0.3)
    try:
        for method, problem in {
            "losses": r"takes more than \d+ MB",
            "entries": "is damaged so that reading it ends in SIGSEGV",
            "unread": r"takes more than 0\.3 s",
        }.items():
            # Each is asked of a process that answers, or of a new one after the one that ended.
            assert process.ask(form, "recognises", FILE)
            with pytest.raises(RecordingError, match=problem) as raised:
                process.ask(form, method, FILE)
            assert raised.value.file == FILE
            assert "\n" not in str(raised.value)
    finally:
        process.close()


def test_the_process_reads_the_same_recording_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = read_one("demo", "right").part(slice(0, 40))
    form = IsolatedFormat(NpzFormat())
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_recordings([recording], tmp_path / name / f"{name}.npz")
        monkeypatch.chdir(tmp_path / name)
        file = Path(f"{name}.npz")
        (entry,) = form.entries(file)
        read = form.read(file, entry)
        assert (read.landmarks == recording.landmarks).all()
        assert not read.landmarks.flags.writeable
    with pytest.raises(RecordingError, match=r"a\.npz") as raised:
        form.entries(Path("a.npz"))
    assert raised.value.file == Path("a.npz")
