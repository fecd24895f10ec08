"""Where a step spends its time, function by function: cProfile over a mapped recording.

    python benchmarks/profile_step.py --robot three_finger --sort cumtime --lines 40

Profiling slows small functions most: read off it what is called and how often, and measure by `bench_step.py`.
"""

from __future__ import annotations

import cProfile
import pstats
import sys
from collections.abc import Sequence

import common
import synthetic

from handmap_qp import HandMapper, load_hand


def main(words: Sequence[str] | None = None) -> None:
    """Profile and print."""
    parser = common.make_parser("Profile map_step over a recording.")
    parser.add_argument("--robot", default="allegro_right", help="robot hand: a name or the path of a hand.yaml")
    parser.add_argument("--sort", default="tottime", choices=("tottime", "cumtime", "ncalls"), help="what to sort by")
    parser.add_argument("--lines", type=int, default=25, help="functions to print")
    parser.add_argument("--save", metavar="FILE", help="write the profile for a viewer such as snakeviz")
    arguments = common.parse_arguments(parser, words)
    motion = synthetic.motion_or_synergies(arguments.recordings, "quest3_webxr_right")
    if arguments.quick:
        motion = synthetic.shortened(motion, 60)
    mapper = HandMapper(motion.human, load_hand(arguments.robot))
    mapper.map_step(motion.q[0], motion.wrist[0])
    profile = cProfile.Profile()
    profile.enable()
    for i in range(len(motion.time)):
        mapper.map_step(motion.q[i], motion.wrist[i], dt=motion.dt[i])
    profile.disable()
    statistics = pstats.Stats(profile, stream=sys.stdout)
    statistics.strip_dirs().sort_stats(arguments.sort).print_stats(arguments.lines)
    if arguments.save:
        statistics.dump_stats(arguments.save)


if __name__ == "__main__":
    main()
