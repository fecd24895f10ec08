"""What the tests of batches share: small recordings, and formats that misbehave on purpose."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace
from pathlib import Path

from handmap_core.human.recording import Recording
from handmap_qp.apps.datasets.batch import Tally, plan_batch, run_batch
from handmap_qp.apps.datasets.engines import SERIAL, Engine
from handmap_qp.apps.datasets.sources import Job, JobOptions
from handmap_qp.apps.datasets.workers import time_limit
from handmap_qp.trackers.formats import (
    Source,
    list_sources,
    read_recording,
    write_recordings,
)
from handmap_qp.trackers.formats.archive import NpzFormat
from handmap_qp.trackers.formats.base import Entry

OPTIONS = JobOptions({"right": "three_finger"})


def batch(
    inputs: Path, out: Path, options: JobOptions = OPTIONS, engine: Engine | None = None
) -> Tally:
    """Map all recordings of a folder that are not done."""
    return run_batch(plan_batch([inputs], out, options), out, engine or SERIAL)


def episodes(out: Path) -> dict[str, bytes]:
    """Return the content of every episode by its name."""
    files = (out / "episodes").rglob("*.npz")
    return {file.relative_to(out).as_posix(): file.read_bytes() for file in files}


def piece(start: int, count: int, side: str = "right") -> Recording:
    """Return some samples of the recording that comes with the package."""
    whole = read_recording("demo", "left" if side == "left" else "right")
    part = slice(start, start + count)
    return Recording(
        name="piece",
        time=whole.time[part],
        landmarks=whole.landmarks[part],
        valid=whole.valid[part],
        side=whole.side,
    )


def write_pieces(folder: Path, count: int, frames: int = 12) -> list[Path]:
    """Write recordings of the right hand, each a little longer than the one before."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for i in range(count):
        files.append(folder / f"take{i}.npz")
        write_recordings([piece(8 * i, frames + i)], files[-1])
    return files


def die_at_once() -> None:
    """End a worker before it takes a job."""
    os._exit(1)


def list_or_die(path: Path) -> tuple[tuple[Source, ...], str]:
    """List a file, unless its name says to crash or to loop for ever."""
    if path.stem == "crash":
        os._exit(1)
    with time_limit(1.0):
        while path.stem == "hold":
            time.sleep(60.0)
    return list_sources(path), ""


class KillingFormat(NpzFormat):
    """Kills the process that reads a recording."""

    def read(self, path: Path, entry: Entry) -> Recording:
        """Die as by the kernel's out-of-memory killer."""
        os.kill(os.getpid(), signal.SIGKILL)
        return super().read(path, entry)


def with_format(job: Job, form: NpzFormat) -> Job:
    """Return the job with its recording read by another format."""
    source = job.source
    assert source is not None
    return replace(job, source=source._replace(format=form))
