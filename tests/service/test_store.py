"""The file of last postures: kills, a second server, other files."""

from __future__ import annotations

import asyncio
import errno
import os
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from service_tools import LOCAL

from handmap_qp.errors import InvalidInputError, RefusedError
from handmap_qp.service.server import Server
from handmap_qp.service.store import PostureStore, Record

Q = np.array([0.1, -0.2, 0.3])
WRIST = np.arange(16.0).reshape(4, 4)


def record(name: str, q: np.ndarray, wrist: np.ndarray | None) -> Record:
    return Record(
        name, "hand", tuple(q.tolist()), None if wrist is None else tuple(wrist.ravel().tolist()), 7
    )


def test_postures_survive_the_process(tmp_path: Path) -> None:
    with PostureStore(tmp_path / "state") as store:
        store.note(record("left", Q, WRIST))
        store.note(record("right", -Q, None))
    with PostureStore(tmp_path / "state") as store:
        found = store.find("left", "hand", 3)
        assert found is not None
        assert found.epoch == 7
        q, wrist = found.posture
        assert np.array_equal(q, Q)
        assert wrist is not None
        assert np.array_equal(wrist, WRIST)
        other = store.find("right", "hand", 3)
        assert other is not None
        assert np.array_equal(other.q, -Q)
        assert other.posture[1] is None
        assert store.find("middle", "hand", 3) is None


def test_a_write_is_in_the_file_at_once(tmp_path: Path) -> None:
    # A killed process closes nothing, so read the file while the store is open.
    with PostureStore(tmp_path / "state") as store:
        store.note(record("left", Q, WRIST))
        (tmp_path / "copy").write_bytes((tmp_path / "state").read_bytes())
    with PostureStore(tmp_path / "copy") as store:
        assert store.find("left", "hand", 3) is not None


def test_a_torn_write_leaves_the_posture_before_it(tmp_path: Path) -> None:
    with PostureStore(tmp_path / "state") as store:
        store.note(record("left", Q, None))
        store.note(record("left", 2 * Q, None))
    whole = (tmp_path / "state").read_bytes()
    newest = whole.index(struct.pack(">d", 0.2))
    (tmp_path / "state").write_bytes(whole[:newest] + b"torn" + whole[newest + 4 :])
    with PostureStore(tmp_path / "state") as store:
        found = store.find("left", "hand", 3)
        assert found is not None
        assert np.array_equal(found.q, Q)


@pytest.mark.parametrize("file", ["state", None])
def test_the_name_unheard_of_for_the_longest_time_gives_way(
    tmp_path: Path, file: str | None
) -> None:
    with PostureStore(tmp_path / file if file else None) as store:
        for i in range(140):
            store.note(record(f"session-{i}", Q * i, None))
        assert store.find("session-0", "hand", 3) is None
        assert store.find("session-139", "hand", 3) is not None


def test_a_name_that_gave_way_and_came_back_is_found_where_it_was_last(tmp_path: Path) -> None:
    with PostureStore(tmp_path / "state") as store:
        for name in ("a", "b", "c", "back", "back", "back"):
            store.note(record(name, Q, None))
        # Each is written once, so that its slot still holds an older copy of another name: that of
        # `back` in the fourth slot.
        for i in range(252):
            store.note(record(f"session-{i}", Q * i, None))
        assert store.find("back", "hand", 3) is None
        # Now in the first slot.
        store.note(record("back", 5.0 * Q, None))
    with PostureStore(tmp_path / "state") as store:
        back = store.find("back", "hand", 3)
        assert back is not None
        np.testing.assert_array_equal(back.q, 5.0 * Q)


def test_another_robots_posture_is_refused(tmp_path: Path) -> None:
    with PostureStore(tmp_path / "state") as store:
        store.note(record("left", Q, None))
        with pytest.raises(RefusedError) as raised:
            store.find("left", "other", 3)
        assert raised.value.field == "restore"


def test_one_server_at_a_time(tmp_path: Path) -> None:
    with PostureStore(tmp_path / "state"), pytest.raises(InvalidInputError, match="another server"):
        PostureStore(tmp_path / "state")


def test_another_file_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("something else", encoding="utf-8")
    with pytest.raises(InvalidInputError, match="expected a state file"):
        PostureStore(tmp_path / "state")
    assert (tmp_path / "state").read_text(encoding="utf-8") == "something else"


def test_a_file_of_the_right_size_that_is_none_is_left_alone(tmp_path: Path) -> None:
    with PostureStore(tmp_path / "state"):
        pass
    noise = np.random.default_rng(1).bytes((tmp_path / "state").stat().st_size)
    (tmp_path / "noise").write_bytes(noise)
    with pytest.raises(InvalidInputError, match=r"noise: expected a state file of handmap"):
        PostureStore(tmp_path / "noise")
    assert (tmp_path / "noise").read_bytes() == noise


def test_room_is_reserved_at_the_start(tmp_path: Path) -> None:
    with PostureStore(tmp_path / "state"):
        status = (tmp_path / "state").stat()
        assert status.st_blocks * 512 >= status.st_size


def test_without_room_nothing_is_left_that_a_later_start_would_refuse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill_up(file: int, offset: int, length: int) -> None:
        # Some file systems allocate the space that is left.
        os.ftruncate(file, length // 2)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as full:
        full.setattr(os, "posix_fallocate", fill_up)
        with pytest.raises(
            InvalidInputError, match=r"state: expected room for \d+ bytes: No space left on device$"
        ):
            PostureStore(tmp_path / "state")
    assert (tmp_path / "state").stat().st_size == 0
    with PostureStore(tmp_path / "state") as store:
        store.note(record("left", Q, None))


def test_a_start_after_a_killed_start_succeeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as killed:
        killed.setattr(os, "posix_fallocate", lambda *_: sys.exit("killed"))
        with pytest.raises(SystemExit):
            PostureStore(tmp_path / "state")
    # The end of a process would have released the file.
    (tmp_path / "copy").write_bytes((tmp_path / "state").read_bytes())
    with PostureStore(tmp_path / "copy") as store:
        store.note(record("left", Q, None))


def test_lost_postures_are_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[dict[str, object]] = []
    monkeypatch.setattr(
        "handmap_qp.service.store.report",
        lambda level, event, **data: logged.append({"event": event, **data}),
    )
    state = tmp_path / "state"
    with PostureStore(state) as store:
        for name in ("left", "right", "right"):
            store.note(record(name, Q, None))
    whole = state.read_bytes()
    with PostureStore(state):
        assert logged == []
    state.write_bytes(whole.replace(b"left", b"lift"))
    with PostureStore(state) as store:
        assert store.find("right", "hand", 3) is not None
        assert store.find("left", "hand", 3) is None
    assert logged == [{"event": "state_damaged", "file": str(state), "postures_lost": 1}]


def test_a_server_that_cannot_be_made_leaves_the_file_to_others(tmp_path: Path) -> None:
    settings = replace(LOCAL, state=tmp_path / "state")
    with pytest.raises(ValueError, match=r"missing\.yaml"):
        Server(replace(settings, hands=(Path("missing.yaml"),)))
    asyncio.run(Server(settings).stop())
