"""How exactly a robot hand with the person's own kinematics does what the person does.

    python benchmarks/identity.py                 # the human model as person and robot
    python benchmarks/identity.py --hand adroit --sizes .8 1 1.15    # of gymnasium-robotics

Random postures in which no links meet are reached slowly from an open hand; the hand's own points
are the landmarks of the person, who is measured in other postures. Printed are the differences of
joints and fingertips once the robot has come to rest.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from handmap_qp import Hand, HandMapper, load_hand
from handmap_qp.hands import FINGERS, all_pairs, find_fingers, pair_distances
from handmap_qp.hands.fingers import PalmKinematics
from handmap_qp.human import Recording
from handmap_qp.human.measure import scaled_human
from handmap_qp.se3 import Array

# Samples in which a posture is reached, and in which the robot comes to rest, of 20 ms each.
MOVING, RESTING = 40, 60
DT = 0.02
# Least distance between links [m]: at their margins they are kept apart.
APART = 2e-3


class OwnLandmarks:
    """The 21 landmarks of a five-fingered robot hand: the palm's origin, four points a finger."""

    def __init__(self, hand: Hand) -> None:
        self._view = PalmKinematics(hand)
        chains = find_fingers(hand)
        self._places = []
        for name in FINGERS:
            chain = chains[name]
            middle = chain.between if name == "thumb" else chain.middle
            self._places += [
                chain.knuckle,
                middle or chain.middle,
                chain.last,
                chain.tip,
            ]
        self._tips = np.arange(4, 21, 4)

    def at(self, q: Array) -> Array:
        """Return the landmarks in palm axes at joint positions (n,) [m], shape (21, 3)."""
        return np.vstack([np.zeros(3), self._view.points(q, self._places)])

    def tips_at(self, q: Array) -> Array:
        """Return the fingertips [m], shape (5, 3)."""
        return self.at(q)[self._tips]


def postures(hand: Hand, count: int, seed: int) -> list[Array]:
    """Return random postures in which no links of a hand meet, shape (n,) each."""
    geometry = all_pairs(hand).geometry
    random = np.random.default_rng(seed)
    found: list[Array] = []
    while len(found) < count:
        share = random.uniform(0.02, 0.98, len(hand.rest))
        q = hand.lower_limits + share * (hand.upper_limits - hand.lower_limits)
        if pair_distances(hand, geometry, q[None]).min() > APART:
            found.append(q)
    return found


def person_of(hand: Hand, points: OwnLandmarks, size: float, seed: int) -> Hand:
    """Measure the person whose hand this is, in a recording of other postures."""
    rows = []
    for q in postures(hand, 60, seed):
        # From half open to closed, as a person who is measured moves.
        rows += [
            points.at(hand.rest + share * (q - hand.rest)) for share in (0.3, 0.6, 1.0)
        ]
    time = np.arange(len(rows)) / 60.0
    valid = np.ones(len(rows), dtype=bool)
    return scaled_human(Recording("own", time, size * np.array(rows), valid, "right"))


def differences(hand: Hand, size: float, count: int, seed: int) -> tuple[Array, Array]:
    """Return differences of joints [deg], (count, n), and of fingertips [mm], (count, 5)."""
    points = OwnLandmarks(hand)
    mapper = HandMapper(person_of(hand, points, size, seed + 1), hand, "teleoperation")
    joints, tips = [], []
    for q in postures(hand, count, seed):
        mapper.reset()
        ways = np.append(np.linspace(0.0, 1.0, MOVING), np.ones(RESTING))
        reached = hand.rest
        for share in ways * ways * (3.0 - 2.0 * ways):
            landmarks = size * points.at(hand.rest + share * (q - hand.rest))
            reached = mapper.map_landmarks(landmarks, dt=DT).command.q
        joints.append(np.degrees(np.abs(reached - q)))
        missed = points.tips_at(reached) - points.tips_at(q)
        tips.append(1e3 * np.linalg.norm(missed, axis=1))
    return np.array(joints), np.array(tips)


def load(name: str) -> Hand:
    """Load a hand by its name, or the Adroit hand of gymnasium-robotics."""
    if name != "adroit":
        return load_hand(name)
    from handmap_score.tasks.adroit import describe_hand

    return load_hand(describe_hand("adroit", Path(tempfile.mkdtemp())))


def main() -> None:
    """Print medians and 95th percentiles for a hand at three sizes of the person."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--hand", default="human")
    parser.add_argument("--postures", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sizes", type=float, nargs="+", default=[0.8, 1.0, 1.25])
    given = parser.parse_args()
    hand = load(given.hand)
    print(f"{hand.name}: {given.postures} postures, seed {given.seed}")
    for size in given.sizes:
        joints, tips = differences(hand, size, given.postures, given.seed)
        print(
            f"size {size:.2f}: joints {np.median(joints):.2f} deg in the median, "
            f"{np.percentile(joints, 95):.1f} at p95; "
            f"tips {np.median(tips):.2f} mm, {np.percentile(tips, 95):.1f} at p95"
        )


if __name__ == "__main__":
    main()
