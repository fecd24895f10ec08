"""The file of last postures: kills, a second server, other files."""

from __future__ import annotations

import asyncio
import contextlib
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE
from service_tools import LOCAL

from handmap_qp.apps.service.server import Server
from handmap_qp.apps.service.settings import MOST_SESSIONS
from handmap_qp.apps.service.store import PostureStore, Record
from handmap_qp.errors import InvalidInputError, RefusedError

Q = np.array([0.1, -0.2, 0.3])
WRIST = np.arange(16.0).reshape(4, 4)


def record(name: str, q: np.ndarray, wrist: np.ndarray | None) -> Record:
    return Record(
        name,
        "hand",
        tuple(q.tolist()),
        None if wrist is None else tuple(wrist.ravel().tolist()),
        7,
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


def test_a_write_survives_a_kill(tmp_path: Path) -> None:
    code = (
        "import os, signal\nfrom pathlib import Path\n"
        "from handmap_qp.apps.service.store import PostureStore, Record\n"
        "store = PostureStore(Path('state'))\n"
        "for epoch in range(500):\n"
        "    store.note(Record('left', 'hand', (0.1, -0.2, 0.3), None, epoch))\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, timeout=PATIENCE)
    with PostureStore(tmp_path / "state") as store:
        found = store.find("left", "hand", 3)
        assert found is not None
        assert found.epoch == 499
        np.testing.assert_array_equal(found.q, Q)


@pytest.mark.parametrize("file", ["state", None])
def test_the_name_unheard_of_for_the_longest_time_gives_way(
    tmp_path: Path, file: str | None
) -> None:
    with PostureStore(tmp_path / file if file else None) as store:
        for i in range(140):
            store.note(record(f"session-{i}", Q * i, None))
        assert store.find("session-0", "hand", 3) is None
        assert store.find("session-139", "hand", 3) is not None


def test_the_order_of_updates_outlives_the_process(tmp_path: Path) -> None:
    with PostureStore(tmp_path / "state") as store:
        for i in range(MOST_SESSIONS):
            store.note(record(f"session-{i}", Q, None))
        store.note(record("session-0", 5.0 * Q, None))
    with PostureStore(tmp_path / "state") as store:
        store.note(record("other", Q, None))
    with PostureStore(tmp_path / "state") as store:
        assert len(store.records) == MOST_SESSIONS
        assert store.find("session-1", "hand", 3) is None
        back = store.find("session-0", "hand", 3)
        assert back is not None
        np.testing.assert_array_equal(back.q, 5.0 * Q)


def test_another_robots_posture_is_refused(tmp_path: Path) -> None:
    with PostureStore(tmp_path / "state") as store:
        store.note(record("left", Q, None))
        with pytest.raises(RefusedError) as raised:
            store.find("left", "other", 3)
        assert raised.value.field == "restore"


def test_one_server_at_a_time(tmp_path: Path) -> None:
    with (
        PostureStore(tmp_path / "state"),
        pytest.raises(InvalidInputError, match="another server"),
    ):
        PostureStore(tmp_path / "state")


def test_another_file_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("something else", encoding="utf-8")
    with pytest.raises(InvalidInputError, match="expected a state file"):
        PostureStore(tmp_path / "state")
    assert (tmp_path / "state").read_text(encoding="utf-8") == "something else"


def test_another_database_is_left_alone(tmp_path: Path) -> None:
    with contextlib.closing(sqlite3.connect(tmp_path / "state")) as other:
        other.execute("CREATE TABLE postures (something)")
    before = (tmp_path / "state").read_bytes()
    with pytest.raises(InvalidInputError, match="expected a state file"):
        PostureStore(tmp_path / "state")
    assert (tmp_path / "state").read_bytes() == before


def test_a_file_of_a_former_version_is_named_as_such_and_left_alone(
    tmp_path: Path,
) -> None:
    former = b"handmap_qp postures 1\n" + bytes(1000)
    (tmp_path / "state").write_bytes(former)
    with pytest.raises(InvalidInputError, match=r"former one.*stop again"):
        PostureStore(tmp_path / "state")
    assert (tmp_path / "state").read_bytes() == former


def test_only_the_owner_may_read_it(tmp_path: Path) -> None:
    with PostureStore(tmp_path / "state") as store:
        store.note(record("left", Q, None))
        for file in tmp_path.iterdir():
            assert file.stat().st_mode & 0o077 == 0


def test_room_is_reserved_at_the_start(tmp_path: Path) -> None:
    def size() -> int:
        return sum(file.stat().st_size for file in tmp_path.iterdir())

    with PostureStore(tmp_path / "state") as store:
        before = size()
        for i in range(20 * MOST_SESSIONS):
            store.note(record(f"session-{i % MOST_SESSIONS}", np.arange(100.0), WRIST))
        assert size() <= before


def test_without_room_it_is_said_and_nothing_is_left_that_a_later_start_would_refuse(
    tmp_path: Path,
) -> None:
    code = (
        "import resource, signal\nfrom pathlib import Path\n"
        "from handmap_qp.apps.service.store import PostureStore\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try: PostureStore(Path('state'))\n"
        "except ValueError as error: print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        timeout=PATIENCE,
        capture_output=True,
        text=True,
    )
    assert done.stdout.startswith("state: cannot be used"), done.stderr
    with PostureStore(tmp_path / "state") as store:
        store.note(record("left", Q, None))


def test_lost_postures_are_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logged: list[dict[str, object]] = []
    monkeypatch.setattr(
        "handmap_qp.apps.service.store.report",
        lambda level, event, **data: logged.append({"event": event, **data}),
    )
    state = tmp_path / "state"
    with PostureStore(state) as store:
        for name in ("left", "right"):
            store.note(record(name, Q, None))
    with contextlib.closing(sqlite3.connect(state)) as damaged, damaged:
        damaged.execute("UPDATE postures SET record = x'c1' WHERE name = 'left'")
    with PostureStore(state) as store:
        assert store.find("right", "hand", 3) is not None
        assert store.find("left", "hand", 3) is None
        # Nobody knows whether its robot was stopped.
        assert store.records["left"].stop > 0
        assert store.records["right"].stop == 0
    assert logged == [
        {"event": "state_damaged", "file": str(state), "postures_lost": 1}
    ]


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    state = tmp_path / "state"
    with PostureStore(state) as store:
        store.note(record("left", Q, None))
    whole = state.read_bytes()
    state.write_bytes(whole[:200] + bytes(len(whole) - 200))
    with pytest.raises(InvalidInputError, match="a damaged or a former"):
        PostureStore(state)


def test_a_server_that_cannot_be_made_leaves_the_file_to_others(tmp_path: Path) -> None:
    settings = replace(LOCAL, state=tmp_path / "state")
    with pytest.raises(ValueError, match=r"missing\.yaml"):
        Server(replace(settings, hand=(Path("missing.yaml"),)))
    asyncio.run(Server(settings).stop())
