"""Record the joints of every recording on every hand, and compare them with a record made before.

    python benchmarks joints --save build/joints.npz     # on the tree before a change
    python benchmarks joints --against build/joints.npz  # on the tree after it

Every hand follows by its default method, through the guard, as `handmap retarget` does. A
difference is the largest one of a joint [rad or m] or of an element of the wrist's pose.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from bench_hands import load_hands

from handmap_core.human.recording import mirrored
from handmap_qp import HandMapper, load_hand, read_recording
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.errors import HandmapError
from handmap_qp.stream.measurement import measure_person


def main(words: Sequence[str] | None = None) -> float:
    """Run the benchmark, and return the largest difference."""
    parser = common.make_parser("Joints of all recordings on all hands.", draws=False)
    parser.add_argument(
        "--save", type=Path, help="write the joints into this .npz file"
    )
    parser.add_argument(
        "--against", type=Path, help="compare with the joints in this file"
    )
    arguments = common.parse_arguments(parser, words)
    files = common.find_recordings(arguments.recordings)[
        : 1 if arguments.quick else None
    ]
    hands, notes = load_hands(2 if arguments.quick else None)
    found: dict[str, np.ndarray] = {}
    with common.progress("mapping", len(files) * len(hands)) as advance:
        for file in files:
            taken = read_recording(file)
            for side in ("left", "right"):
                recording = taken if taken.side == side else mirrored(taken)
                lengths = measure_person(recording).lengths
                human = "human" if side == "right" else "human_left"
                leader = load_hand(human, points="landmarks", lengths=lengths)
                for hand in hands:
                    if hand.side != side:
                        continue
                    key = f"{file.stem}/{hand.name}"
                    try:
                        motion = map_recording(HandMapper(leader, hand), recording)
                    except HandmapError as error:
                        notes.append(f"{key}: {error}")
                        continue
                    wrists = motion.wrist.reshape(len(motion.q), -1)
                    found[key] = np.hstack([motion.q, wrists])
                    advance()
    if arguments.save is not None:
        np.savez_compressed(arguments.save, allow_pickle=False, **found)
    before = found if arguments.against is None else np.load(arguments.against)
    apart = {key: _apart(before[key], found.get(key)) for key in before}
    worst = max(apart.values())
    title = f"{len(found)} motions; largest difference {worst:.2g}"
    order = sorted(apart, key=lambda key: -apart[key])
    rows = [{"motion": key, "largest difference": apart[key]} for key in order]
    common.print_table(
        title, rows[:20], to_stderr=arguments.json == "-", caption="\n".join(notes)
    )
    common.write_json(
        arguments.json, "joints", {"largest": worst, "motions": rows, "notes": notes}
    )
    return worst


def _apart(before: np.ndarray, now: np.ndarray | None) -> float:
    """Return the largest difference of two motions; infinite where one is missing."""
    if now is None or now.shape != before.shape:
        return float("inf")
    return float(np.abs(now - before).max())


if __name__ == "__main__":
    main()
