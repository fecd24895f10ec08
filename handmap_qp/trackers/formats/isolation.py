"""Read files in a process of their own, so that a crash or an endless loop ends only the read.

libhdf5 trusts its files: a damaged one can make it crash, or walk in circles. The reading process
has limits of time and memory, and is kept for all files of the process that asks.
"""

from __future__ import annotations

import atexit
import importlib
import math
import multiprocessing
import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from handmap_qp.errors import RecordingError
from handmap_qp.trackers.formats.base import Entry, RecordingFormat
from handmap_qp.trackers.recording import Recording

LONGEST_READ = 4.0
"""CPU time that reading a file may take [s], besides that of its size: twenty MB/s."""
_BYTES_PER_SECOND = 20e6
LARGEST_READ = 3 << 30
"""Memory that reading a file may take [bytes]; arrays are at most a third of it."""


class IsolatedFormat:
    """A format whose files are read in the reading process; writing stays here.

    Args:
        form: The format.
    """

    def __init__(self, form: RecordingFormat) -> None:
        self._form = form
        self.name, self.suffixes, self.about = form.name, form.suffixes, form.about

    def recognises(self, path: Path) -> bool:
        """See `RecordingFormat.recognises`."""
        return _READER.ask(self._form, "recognises", path)

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """See `RecordingFormat.entries`."""
        return _READER.ask(self._form, "entries", path)

    def read(self, path: Path, entry: Entry) -> Recording:
        """See `RecordingFormat.read`."""
        return _READER.ask(self._form, "read", path, entry)

    def unread(self, path: Path) -> tuple[str, ...]:
        """See `RecordingFormat.unread`."""
        return _READER.ask(self._form, "unread", path)

    def losses(self, recordings: Sequence[Recording]) -> tuple[str, ...]:
        """See `RecordingFormat.losses`."""
        return self._form.losses(recordings)

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """See `RecordingFormat.write`."""
        self._form.write(recordings, path)


class ReadingProcess:
    """The reading process, started when it is first asked. Threads may share it.

    Args:
        longest: CPU time that reading a file may take [s], besides that of its size.
    """

    def __init__(self, longest: float = LONGEST_READ) -> None:
        self._longest = longest
        self._lock = threading.Lock()
        self._connection: Connection | None = None
        self._process: subprocess.Popen[bytes] | None = None
        # A forked process must not share the reading process of its parent.
        os.register_at_fork(after_in_child=self._forget)
        atexit.register(self.close)

    def ask(self, form: RecordingFormat, method: str, path: Path, *rest: Any) -> Any:
        """Call a method of a format in the reading process.

        Args:
            form: The format.
            method: Name of a method whose first argument is a path.
            path: The file.
            *rest: Further arguments.

        Raises:
            RecordingError: If the reading process crashed, or reached a limit.
            HandmapError: As of the method.
        """
        with self._lock:
            try:
                connection = self._started()
                # The process is kept while this one may change its folder.
                folder = "/" if path.is_absolute() else os.getcwd()
                connection.send((form, method, self._longest, folder, (path, *rest)))
                is_error, answer = connection.recv()
            except (EOFError, ConnectionError) as error:
                raise RecordingError(self._end(), file=path) from error
            except BaseException:
                # The answer would be taken for that of the next question.
                self.close()
                raise
        if is_error:
            raise answer
        return answer

    def close(self) -> None:
        """End the reading process."""
        process, self._process = self._process, None
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if process is not None:
            process.kill()
            process.wait()

    def _started(self) -> Connection:
        """Return the connection to the process."""
        if self._connection is None:
            ours, theirs = multiprocessing.Pipe()
            code = (
                f"import sys; sys.path[:] = {sys.path!r}\n"
                f"from {__name__} import answer_questions; answer_questions({theirs.fileno()})"
            )
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-c", code],
                    stdin=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno()],
                )
            self._connection = ours
        return self._connection

    def _end(self) -> str:
        """Forget the process, and return in words how it ended."""
        process, self._process = self._process, None
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        status = 0 if process is None else process.wait()
        if status == -signal.SIGXCPU:
            return f"cannot be read: takes more than {self._longest:g} s"
        ended = signal.Signals(-status).name if status < 0 else f"status {status}"
        return f"cannot be read: is damaged so that reading it ends in {ended}"

    def _forget(self) -> None:
        """Leave the process to the parent of this one."""
        self._lock = threading.Lock()
        if self._connection is not None:
            self._connection.close()
        self._connection = self._process = None


class ReadingHere:
    """Reads in this process, which ends where a reading process would.

    Args:
        longest: CPU time that reading a file may take [s], besides that of its size.
    """

    def __init__(self, longest: float = LONGEST_READ) -> None:
        self._longest = longest

    def ask(self, form: RecordingFormat, method: str, path: Path, *rest: Any) -> Any:
        """Call a method of a format; see `ReadingProcess.ask`."""
        limits = resource.getrlimit(resource.RLIMIT_CPU)
        _limit_time(path, self._longest)
        try:
            return getattr(form, method)(path, *rest)
        finally:
            resource.setrlimit(resource.RLIMIT_CPU, limits)


def read_in_this_process() -> None:
    """Read files here from now on: in a worker, whose end its parent notices and survives."""
    global _READER
    _READER = ReadingHere()


_READER: ReadingProcess | ReadingHere = ReadingProcess()


def answer_questions(descriptor: int) -> None:
    """Answer the questions of `ReadingProcess.ask` until the other process has ended.

    Args:
        descriptor: The connection's.
    """
    # The terminal sends it to all processes; only the asking one decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    importlib.import_module("handmap_qp.trackers.formats")
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    _lower(resource.RLIMIT_AS, used + LARGEST_READ)
    _lower(resource.RLIMIT_CORE, 0)
    with Connection(descriptor) as connection, suppress(EOFError, ConnectionError):
        while True:
            connection.send_bytes(_answer(*connection.recv()))


def _answer(
    form: RecordingFormat, method: str, longest: float, folder: str, rest: tuple[Any, ...]
) -> bytes:
    """Return the pickled answer: whether it is an error, and the value or the error."""
    path = rest[0]
    try:
        os.chdir(folder)
        _limit_time(path, longest)
        return pickle.dumps((False, getattr(form, method)(*rest)))
    except MemoryError:
        problem = f"cannot be read: takes more than {LARGEST_READ >> 20} MB of memory"
        return pickle.dumps((True, RecordingError(problem, file=path)))
    except Exception as error:
        return pickle.dumps((True, error))


def _limit_time(path: Path, longest: float) -> None:
    """End this process if reading a file takes too much CPU time."""
    size = path.stat().st_size if path.is_file() else 0
    time = sum(os.times()[:2]) + longest + size / _BYTES_PER_SECOND
    _lower(resource.RLIMIT_CPU, math.ceil(time))


def _lower(kind: int, limit: int) -> None:
    """Set the limit of a resource, at most to the one that this process was given."""
    hard = resource.getrlimit(kind)[1]
    soft = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    resource.setrlimit(kind, (soft, hard))
