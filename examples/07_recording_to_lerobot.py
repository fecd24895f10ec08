"""A recording of a person becomes a LeRobot v3 data set of two robot hands, read back with pyarrow.

python examples/07_recording_to_lerobot.py [RECORDING]
"""

import sys
import tempfile
from pathlib import Path

import pyarrow.parquet as pq

from handmap_qp import cli
from handmap_qp.trackers.formats import DEMO_FILE


def main(recording: str) -> None:
    """Map the recording, write the data set, and open it."""
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "batch",
            recording,
            "--robot",
            "allegro_left",
            "allegro_right",
            "--out",
            folder,
        ]
        assert cli.main([*words, "--format", "lerobot", "--workers", "0"]) == 0
        chunks = sorted((Path(folder) / "lerobot" / "data").rglob("*.parquet"))
        table = pq.read_table(chunks[0])
        print(
            f"{table.num_rows} frames with the columns {', '.join(table.column_names)}"
        )


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else str(DEMO_FILE))
