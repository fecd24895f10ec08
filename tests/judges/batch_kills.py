"""Batch under attack: workers and parents killed at random, resumed, and equal to the serial run.

    python tests/judges batch_kills --recordings FOLDER --count 1000

Makes recordings from real ones, maps them one after the other, then again with two workers while
workers and parents are killed by SIGKILL at random places and finished episodes are emptied, cut,
damaged or deleted, and compares every byte of all episodes. After `--starts` starts nothing is
attacked any more, so that the batch comes to its end.
With --ray, a third time under Ray.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from common import ROOT, find_recordings
from made_recordings import make_recordings

from handmap_qp.apps.datasets.manifest import read_manifests

SIDES = ("allegro_left", "allegro_right")


@dataclass
class Attack:
    """What was done to a batch.

    Attributes:
        workers: Workers killed.
        parents: Parents killed.
        starts: How often the batch was started.
        damaged: Episodes damaged between two starts.
        orphans: Workers that lived on 20 s after their parent was killed.
        cpu: Useful CPU time and all CPU time of the runs that ended by themselves [s].
    """

    workers: int = 0
    parents: int = 0
    starts: int = 0
    damaged: int = 0
    orphans: int = 0
    cpu: list[tuple[float, float]] = field(default_factory=list)


def main() -> None:
    """Run, print the table, and exit with 1 if anything differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    usual = Path(
        os.environ.get("HANDMAP_RECORDINGS") or ROOT.parent / "shared" / "recordings"
    )
    parser.add_argument(
        "--recordings", type=Path, default=usual, help="real recordings"
    )
    parser.add_argument("--count", type=int, default=1000, help="recordings to make")
    parser.add_argument("--frames", type=int, default=90, help="mean number of samples")
    parser.add_argument(
        "--every", type=float, default=8.0, help="mean time between kills [s]"
    )
    parser.add_argument(
        "--starts", type=int, default=12, help="starts that are attacked"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ray", action="store_true", help="map them under Ray too")
    parser.add_argument(
        "--folder", type=Path, help="folder to keep (default: a temporary one)"
    )
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        inputs = folder / "in"
        if not inputs.exists():
            make_recordings(
                find_recordings(given.recordings),
                inputs,
                given.count,
                frames=given.frames,
            )
        ok = run(inputs, folder, given)
    sys.exit(0 if ok else 1)


def run(inputs: Path, folder: Path, given: argparse.Namespace) -> bool:
    """Map in all ways, and compare."""
    count = len(list(inputs.iterdir()))
    result, seconds = mapped(inputs, folder / "serial", "--workers", "0")
    say(
        f"serial: {result['done']} episodes, {result['frames']} samples, {seconds:.0f} s"
    )
    attack = attacked(
        inputs, folder / "killed", random.Random(given.seed), given.every, given.starts
    )
    say(
        f"attacked: {attack.workers} workers and {attack.parents} parents killed, "
        f"{attack.damaged} episodes damaged, {attack.starts} starts, {attack.orphans} orphans"
    )
    for useful, everything in attack.cpu:
        say(
            f"  a run that ended by itself: {useful:.1f} of {everything:.1f} s CPU in the jobs"
        )
    same = compare(folder / "serial", folder / "killed", count)
    if given.ray:
        result, seconds = mapped(
            inputs, folder / "ray", "--engine", "ray", "--workers", "2"
        )
        say(f"ray: {result['done']} episodes, {seconds:.0f} s")
        same &= compare(folder / "serial", folder / "ray", count)
    return same and attack.orphans == 0


def mapped(inputs: Path, out: Path, *words: str) -> tuple[dict, float]:
    """Run a batch to its end; return its JSON and the time [s]."""
    started = time.monotonic()
    done = subprocess.run(
        [*command(inputs, out), *words], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1]), time.monotonic() - started


def attacked(
    inputs: Path, out: Path, rng: random.Random, every: float, starts: int
) -> Attack:
    """Run a batch with two workers until it has nothing to do, and kill in the first starts."""
    attack = Attack()
    while True:
        process = subprocess.Popen(
            [*command(inputs, out), "--workers", "2"], stdout=subprocess.PIPE, text=True
        )
        attack.starts += 1
        parents = attack.parents
        while attack.starts <= starts and process.poll() is None:
            try:
                process.wait(rng.expovariate(1.0 / every))
                continue
            except subprocess.TimeoutExpired:
                pass
            workers = [pid for pid in children(process.pid) if is_worker(pid)]
            if rng.random() < 0.3:
                process.kill()
                attack.parents += 1
                attack.orphans += count_orphans(workers)
            elif workers:
                kill(rng.choice(workers))
                attack.workers += 1
        output = process.communicate()[0]
        # 1 is the end of a batch with failed recordings, which `compare` counts.
        if process.returncode in (0, 1):
            result = json.loads(output.splitlines()[-1])
            if result["frames"]:
                attack.cpu.append((result["cpu_s"], result["all_cpu_s"]))
            if not result["done"]:
                return attack
        elif attack.parents > parents:
            attack.damaged += damage(sorted((out / "episodes").rglob("*.npz")), rng)


def damage(episodes: list[Path], rng: random.Random) -> int:
    """Empty, cut, delete or alter one episode; return how many."""
    left = [file for file in episodes if file.stat().st_size]
    if not left:
        return 0
    file = rng.choice(left)
    data = bytearray(file.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    how = rng.randrange(4)
    if how:
        file.write_bytes((data, b"", data[: len(data) // 2])[how - 1])
    else:
        file.unlink()
    return 1


def compare(serial: Path, other: Path, count: int) -> bool:
    """Compare all episodes of two batches, and say so."""
    ours, theirs = digests(serial), digests(other)
    lines = read_manifests(other)
    failed = [line.key for line in lines.values() if line.status != "done"]
    differ = sorted(
        name
        for name in ours.keys() | theirs.keys()
        if ours.get(name) != theirs.get(name)
    )
    ok = not differ and not failed and len(ours) == len(lines) == count
    left = list(other.rglob(".*.part"))
    say(
        f"  {other.name}: {len(theirs)} of {count} episodes, {len(differ)} differ in a byte, "
        f"{len(failed)} failed, {len(left)} torn files left: {'equal' if ok else 'NOT EQUAL'}"
    )
    for name in (*differ[:5], *failed[:5]):
        say(f"    {name}")
    return ok


def command(inputs: Path, out: Path) -> list[str]:
    """Return the command that maps all recordings."""
    words = ["batch", str(inputs), "--robot", *SIDES, "--out", str(out), "--json"]
    return [sys.executable, "-m", "handmap_qp.cli", *words]


def digests(out: Path) -> dict[str, str]:
    """Return the digest of every episode by its name."""
    files = (out / "episodes").rglob("*.npz")
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def children(pid: int) -> list[int]:
    """Return the processes that a process has started."""
    listing = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(pid)],
        capture_output=True,
        text=True,
        check=False,
    )
    return [int(word) for word in listing.stdout.split()]


def is_worker(pid: int) -> bool:
    """Tell a spawned worker from multiprocessing's resource tracker."""
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def kill(pid: int) -> None:
    """Kill a process, if it is still there."""
    try:
        os.kill(pid, 9)
    except ProcessLookupError:
        return


def count_orphans(workers: list[int]) -> int:
    """Return how many workers live on 20 s after their parent was killed."""
    end = time.monotonic() + 20.0
    alive = workers
    while alive and time.monotonic() < end:
        alive = [pid for pid in alive if is_worker(pid)]
        time.sleep(0.1)
    return len(alive)


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


if __name__ == "__main__":
    main()
