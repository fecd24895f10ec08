"""Memory of a batch: that of one process over many recordings.

    python benchmarks batch_memory --count 10000

Maps recordings made from real ones in one process, as a worker of `handmap batch` does, and prints
its resident memory after every tenth of them, and the growth by each recording from the second
tenth on.
"""

from __future__ import annotations

import argparse
import gc
import os
import tempfile
from pathlib import Path

import numpy as np
from common import ROOT, find_recordings, print_table
from made_recordings import make_recordings

from handmap_qp.apps.datasets.batch import plan_batch
from handmap_qp.apps.datasets.episodes import run_job
from handmap_qp.apps.datasets.sources import JobOptions


def main() -> None:
    """Map, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    usual = Path(
        os.environ.get("HANDMAP_RECORDINGS") or ROOT.parent / "shared" / "recordings"
    )
    parser.add_argument(
        "--recordings", type=Path, default=usual, help="real recordings"
    )
    parser.add_argument("--count", type=int, default=10_000, help="recordings to map")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        different = min(given.count, 100)
        make_recordings(
            find_recordings(given.recordings), folder / "in", different, frames=44
        )
        options = JobOptions({"left": "allegro_left", "right": "allegro_right"})
        jobs = plan_batch([folder / "in"], folder / "out", options).jobs
        rows, sizes = [], []
        for i in range(given.count):
            run_job(jobs[i % len(jobs)])
            if (i + 1) % (given.count // 10) == 0:
                gc.collect()
                sizes.append((i + 1, resident()))
                rows.append(
                    {"recordings": i + 1, "resident [MB]": sizes[-1][1] / 2**20}
                )
    print_table("Resident memory of one process", rows)
    counts, bytes_ = np.array(sizes[1:], dtype=float).T
    growth = float(np.polyfit(counts, bytes_, 1)[0])
    print(f"growth: {growth / 1024.0:.2f} kB a recording")


def resident() -> int:
    """Return the resident memory of this process [bytes]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    main()
