"""Damaged files of every kind that the package reads: each ends in one line, or is read.

Valid files are altered by bytes, by words, and in the records of zip archives. Reading one may
succeed or raise an error of the package whose text is one line. Other exceptions, crashes, reads of
more than two minutes and more than 1.5 GB of memory count as failures; the exit code is 1 then.
Files that failed are kept in the folder of `--keep`.

    nice python tests/judges file_fuzz --json file_fuzz.json
    nice python tests/judges file_fuzz --only npz person --count 1000 --keep failures
"""

from __future__ import annotations

import json
import logging
import mmap
import os
import resource
import shutil
import signal
import struct
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import common
import numpy as np
from file_kinds import KINDS, Kind

from handmap_qp.errors import HandmapError

MEMORY = 1_500_000_000
"""Memory that reading one file may take [bytes]."""
PATIENCE = 120
"""Time that reading one file may take, on a machine with other programs too [s]."""
_PROGRESS = struct.Struct("<qqq")
_WORDS = (
    b"nan", b"inf", b"-1", b"0", b"1e999", b"-1e-320", b"99999999999999999999", b"''", b'""',
    b"null", b"true", b"[]", b"{}", b"&x;", b"\x00", b"\xff\xfe", b"..", b"2026-13-45", b"!!binary",
    b"*a", b"<", b">", b":", b"\n", b"\r", "\u202e".encode(), b"%n", b"0x", b"1_0", b"~",
)  # fmt: skip


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return content with one to eight alterations."""
    kinds = [_bytes, _bytes, _piece, _word]
    if content[:2] == b"PK":
        kinds += [_zip_record, _zip_record, _zip_record]
    data = bytearray(content)
    for _ in range(int(rng.choice([1, 1, 2, 3, 8]))):
        if data:
            data = kinds[rng.integers(len(kinds))](data, rng)
    return bytes(data)


def _bytes(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Change single bytes; most often one bit."""
    for place in rng.integers(0, len(data), size=int(rng.choice([1, 2, 16]))):
        flip = (
            1 << int(rng.integers(8)) if rng.random() < 0.7 else int(rng.integers(256))
        )
        data[place] ^= flip
    return data


def _piece(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Truncate, or delete, double or swap a piece."""
    first, last = sorted(rng.integers(0, len(data) + 1, size=2).tolist())
    last = min(last, first + int(rng.choice([1, 8, 64, 4096])))
    piece, kind = data[first:last], rng.integers(4)
    if kind == 0:
        return data[:first]
    if kind == 1:
        return data[:first] + data[last:]
    if kind == 2:
        return data[:last] + piece + data[last:]
    place = int(rng.integers(0, len(data)))
    data[place : place + len(piece)] = piece
    return data


def _word(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Replace a word between separators, or insert one."""
    start = int(rng.integers(0, len(data)))
    end = start
    while (
        end < len(data)
        and end - start < 40
        and data[end : end + 1] not in b" \t\n\"'<>,:[]{}=/"
    ):
        end += 1
    return data[:start] + _WORDS[rng.integers(len(_WORDS))] + data[end:]


def _zip_record(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Change a field of a local header or of the central directory."""
    marks = [
        i
        for mark in (b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06")
        for i in _all(data, mark)
    ]
    if not marks:
        return data
    start = marks[rng.integers(len(marks))]
    # Offsets of version, flags, method, checksum, sizes and lengths in a central record; they are
    # two less in a local one.
    shift = 0 if data[start + 2] == 1 else -2
    offset = int(rng.choice([6, 8, 10, 16, 20, 24, 28, 30, 42])) + shift
    if rng.random() < 0.3:
        value = rng.choice([1, 8, 9, 12, 14, 93, 99, 0x41, 0xFFFF])
        replacement = struct.pack("<H", int(value))
    else:
        value = rng.choice(
            [0, 1, 0x7FFFFFFF, 0xFFFFFFFE, 0xFFFFFFFF, int(rng.integers(2**32))]
        )
        replacement = struct.pack("<I", int(value))
    place = start + offset
    if place + len(replacement) <= len(data):
        data[place : place + len(replacement)] = replacement
    return data


def _all(data: bytearray, mark: bytes) -> list[int]:
    found, place = [], data.find(mark)
    while place >= 0:
        found.append(place)
        place = data.find(mark, place + 1)
    return found


def fuzz(kind: Kind, count: int, seed: int, keep: Path | None) -> dict[str, Any]:
    """Read mutated files of one kind in processes of their own.

    Args:
        kind: The kind.
        count: Number of files.
        seed: Seed of the first one; the others follow.
        keep: Folder for files that failed; None keeps none.
    """
    # The seed that the child has come to, and the files read and refused so far: its end can then
    # be attributed.
    shared = mmap.mmap(-1, _PROGRESS.size)
    results, done, slowest = Counter[str](), 0, 0.0
    examples: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        kind.write(Path(folder) / "valid")
        kind.read(Path(folder) / "valid")
        while done < count:
            report = Path(folder) / "report.json"
            child = os.fork()
            if child == 0:
                _read_many(
                    kind, Path(folder), range(seed + done, seed + count), shared, report
                )
            status = os.waitpid(child, 0)[1]
            reached, results["read"], results["refused"] = _PROGRESS.unpack(shared)
            reached -= seed
            if report.exists():
                found = json.loads(report.read_text(encoding="utf-8"))
                results.update(found["results"])
                slowest = max(slowest, found["slowest"])
                examples += found["examples"]
                report.unlink()
            if status:
                ended = (
                    "too slow" if os.WTERMSIG(status) == signal.SIGALRM else "crashed"
                )
                results[ended] += 1
                examples.append(f"seed {seed + reached}: {ended} with status {status}")
            done = reached + 1
            if keep is not None and status:
                kept = keep / f"{kind.name}-{seed + reached}"
                shutil.copytree(Path(folder) / "altered", kept, dirs_exist_ok=True)
    failures = sum(
        number for name, number in results.items() if name not in ("read", "refused")
    )
    return {
        "files": kind.name,
        "read": results["read"],
        "refused": results["refused"],
        "failures": failures,
        "slowest [s]": slowest,
        "examples": examples[:5],
    }


def _read_many(
    kind: Kind, folder: Path, seeds: range, shared: mmap.mmap, report: Path
) -> None:
    """Read files until one fails hard; ends the process."""
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 2)
    results, examples, slowest = Counter[str](), [], 0.0

    def write() -> None:
        text = json.dumps(
            {"results": results, "examples": examples, "slowest": slowest}
        )
        report.write_text(text, encoding="utf-8")

    _, *counts = _PROGRESS.unpack(shared)
    for seed in seeds:
        _PROGRESS.pack_into(shared, 0, seed, *counts)
        altered = folder / "altered"
        _alter(folder / "valid", altered, seed, kind.altered)
        started = time.perf_counter()
        signal.alarm(PATIENCE)
        result = _read(kind, altered)
        signal.alarm(0)
        slowest = max(slowest, time.perf_counter() - started)
        if result in ("read", "refused"):
            counts[result == "refused"] += 1
        else:
            results[result.partition(":")[0]] += 1
            examples.append(f"seed {seed}: {result}")
        if seed % 100 == 0 or result not in ("read", "refused"):
            write()
    _PROGRESS.pack_into(shared, 0, seeds[-1], *counts)
    write()
    os._exit(0)


def _alter(valid: Path, altered: Path, seed: int, pattern: str) -> None:
    """Copy the valid files, and alter one of those whose names match."""
    shutil.rmtree(altered, ignore_errors=True)
    shutil.copytree(valid, altered)
    rng = np.random.default_rng(seed)
    files = sorted(file for file in altered.rglob(pattern) if file.is_file())
    file = files[rng.integers(len(files))]
    mode = file.stat().st_mode
    file.write_bytes(mutated(file.read_bytes(), rng))
    file.chmod(mode)


def _read(kind: Kind, folder: Path) -> str:
    """Return `read`, `refused`, or what failed."""
    try:
        kind.read(folder)
    except HandmapError as error:
        return (
            "refused"
            if "\n" not in str(error) and str(error)
            else f"lines: {str(error)!r}"
        )
    except MemoryError:
        return "memory"
    except BaseException as error:
        return f"{type(error).__name__}: {str(error)[:200]}"
    return "read"


def main(words: Sequence[str] | None = None) -> None:
    """Fuzz all kinds, print the table."""
    parser = common.make_parser(
        "Damaged files of every kind that the package reads.", draws=False
    )
    names = [kind.name for kind in KINDS]
    parser.add_argument(
        "--only", nargs="+", choices=names, default=names, help="kinds to read"
    )
    parser.add_argument("--count", type=int, default=10_000, help="files of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="keep files that crashed"
    )
    arguments = common.parse_arguments(parser, words)
    count = 50 if arguments.quick else arguments.count
    rows: list[dict[str, Any]] = []
    with common.progress("kinds", len(arguments.only)) as advance:
        for kind in KINDS:
            if kind.name in arguments.only:
                rows.append(fuzz(kind, count, arguments.seed, arguments.keep))
                advance()
    shown = [{key: row[key] for key in row if key != "examples"} for row in rows]
    common.print_table("Damaged files", shown, to_stderr=arguments.json == "-")
    with suppress(BrokenPipeError):
        for row in rows:
            for example in row["examples"]:
                print(f"{row['files']}: {example}")
    common.write_json(arguments.json, "file_fuzz", {"rows": rows})
    if any(row["failures"] for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
