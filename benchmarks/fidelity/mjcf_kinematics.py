"""Compare converted MJCF files with MuJoCo: largest difference of any link's pose.

    python benchmarks mjcf_kinematics FOLDER_OR_FILE [...]

Folders are searched for MJCF files. Files that MuJoCo refuses, or in which nothing moves, are
counted and named with the reason.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

from handmap_qp.apps.tables import print_rows
from handmap_qp.errors import HandError
from handmap_qp.hands.mjcf import ConvertedMjcf, kinematics_difference
from handmap_qp.hands.sources import is_mjcf


def models(paths: list[str]) -> Iterator[Path]:
    """Yield all MJCF files among files and below folders."""
    for path in map(Path, paths):
        yield from filter(
            is_mjcf, sorted(path.rglob("*.xml")) if path.is_dir() else [path]
        )


def main(paths: list[str]) -> None:
    """Convert, compare and print a table."""
    rows, refused = [], []
    for file in models(paths):
        start = time.perf_counter()
        try:
            converted = ConvertedMjcf(file)
        except HandError as error:
            refused.append({"file": file.name, "reason": error.problem[:120]})
            continue
        rows.append(
            {
                "file": str(file)[-60:],
                "links": len(converted.links),
                "joints": len(converted.joints),
                "meshes": len(converted.meshes),
                "difference": f"{kinematics_difference(converted):.1e}",
                "seconds": round(time.perf_counter() - start, 2),
                "notes": len(converted.notes),
            }
        )
    print_rows(f"{len(rows)} files converted", rows)
    print_rows(f"{len(refused)} files refused", refused)


if __name__ == "__main__":
    main(sys.argv[1:])
