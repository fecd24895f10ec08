"""A loop on a robot's computer: samples of a tracker in, commands of a saved hand out.

    handmap hands save three_finger --out my.hand          # on your own computer
    python 12_robot_computer.py my.hand samples.npz        # on the robot's, with handmap-core alone

Samples are those of a file here, by `time` [s] and `landmarks` [m] of the right hand. Put your
tracker in the place of `samples`, and your driver in the place of `print`. If it reads encoders,
give their joints as `measured_q` too: the hand then holds what it meets. Without files, both are
made first, which takes `handmap_qp`.
"""

import sys
from tempfile import TemporaryDirectory

import numpy as np

from handmap_core.run import HumanSample, load


def samples(file):
    """Yield the samples of a file as they would come."""
    with np.load(file) as archive:
        yield from zip(archive["time"], archive["landmarks"], strict=True)


def main(hand, file):
    """Follow the samples, and print how every second begins."""
    follower = load(hand)
    last = -1
    for time, landmarks in samples(file):
        step = follower.map_sample(HumanSample(time, "right", landmarks))
        command = step.command  # joint_names, q [rad] and the pose of the wrist
        if int(time) > last:
            last = int(time)
            q = ", ".join(f"{angle:.2f}" for angle in command.q)
            # `held`: the sample makes no sense, `rule` says why, and the robot brakes.
            print(f"{time:5.2f} s  {step.status} {step.rule or '-'}  {q}")


def make_files(folder):
    """Save a hand, and the samples of the demo; return both files."""
    from handmap_qp import cli, read_recording

    hand, file = f"{folder}/my.hand", f"{folder}/samples.npz"
    assert cli.main(["hands", "save", "three_finger", "--out", hand]) == 0
    demo = read_recording("demo::right")
    np.savez(file, time=demo.time, landmarks=demo.landmarks)
    return hand, file


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        main(*(sys.argv[1:] or make_files(folder)))
