"""A recording as a live tracker with faults: into a running service, into a file, or both.

It is `handmap track replay` with faults put into the samples (`injection.py`): the same targets,
the same summary.

    python tests/judges faulty_replay demo::right --faults dropout@2+0.5 --record spoilt.npz
    python tests/judges faulty_replay demo::right --faults dropout@2+0.5,jump@4+1:0.3 \
        --to 127.0.0.1 --robot allegro_right
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import common
from injection import FAULT_KINDS, FORM, Fault, inject, parse_faults

from handmap_core.human.sample import HumanSample
from handmap_qp import HandmapError, Recording, read_recording
from handmap_qp.apps.live.cli import Target
from handmap_qp.apps.live.source import Replay


class FaultyReplay(Replay):
    """A recording that arrives as if it were live, with faults.

    Args:
        recording: The recording.
        faults: The faults; their times count from the first sample of the replay.
        speed: Factor on the speed of time, as of `Replay`.
        loop: Start again at the end, until interrupted.
        seed: Seed of the faults' random numbers.
    """

    def __init__(
        self,
        recording: Recording,
        faults: Sequence[Fault],
        *,
        speed: float = 1.0,
        loop: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__(recording, speed=speed, loop=loop)
        self._faults = faults
        self._seed = seed

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield each sample at its time, with the faults that are active."""
        return inject(super().__iter__(), self._faults, self._seed)


def describe_faults() -> str:
    """Return how faults are written, and a line for each kind."""
    lines = [f"A fault is {FORM}, in seconds from the first sample;"]
    lines += ["separate several by commas. Kinds, with usual duration and size:", ""]
    for name, kind in FAULT_KINDS.items():
        end = "to the end" if math.isinf(kind.duration) else f"{kind.duration} s"
        size = f", {kind.size} {kind.unit}" if kind.unit else ""
        lines.append(f"  {name:<10} {kind.about} ({end}{size})")
    return "\n".join(lines)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; the options of the target are named as the fields of `Target`."""
    parser = argparse.ArgumentParser(
        description="Play a recording as if it were live, with faults of trackers.",
        epilog=describe_faults(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    option = parser.add_argument
    option("recording", type=Path, help="recording, as for `handmap retarget`")
    option("--faults", required=True, help="such as dropout@2+0.5,jump@4+1:0.3")
    option("--seed", type=int, default=0, help="of random numbers (default: 0)")
    option("--speed", type=float, default=1.0, help="of time, 0.01 to 100 (default: 1)")
    option("--loop", action="store_true", help="start again at the end, until Ctrl-C")
    target = parser.add_argument_group("target", "As of `handmap track replay`.")
    option = target.add_argument
    option("--to", metavar="HOST[:PORT]", help="address of the service's requests")
    option("--robot", metavar="HAND", help="robot hand that the service moves")
    option("--record", metavar="FILE", type=Path, help="file to write (.npz or .csv)")
    option("--session", metavar="NAME", help="public name of the session")
    option("--preset", help="what the mapping is for, as in `handmap retarget`")
    option("--person", metavar="PERSON.yaml", type=Path, help="of `handmap calibrate`")
    option("--keys", metavar=("SECRET", "SERVER"), type=Path, nargs=2, help="key files")
    option("--json", action="store_true", help="print the summary as JSON")
    return parser


def main(words: Sequence[str] | None = None) -> None:
    arguments = vars(make_parser().parse_args(words))
    faults, recording = arguments.pop("faults"), arguments.pop("recording")
    replay = {name: arguments.pop(name) for name in ("speed", "loop", "seed")}
    target = Target(**arguments)
    try:
        target.check()
        source = FaultyReplay(read_recording(recording), parse_faults(faults), **replay)
        target.send(source)
    except HandmapError as error:
        common.stop(" ".join(str(error).split()))


if __name__ == "__main__":
    main()
