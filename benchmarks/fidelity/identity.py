"""How exactly a robot hand with the person's own kinematics does what the person does.

    python benchmarks identity                 # the human model as person and robot
    python benchmarks identity --hand adroit --sizes .8 1 1.15    # of gymnasium-robotics
    python benchmarks identity --morph leap_right --draw morph.png

Random postures in which no links meet are reached slowly from an open hand; the hand's own points
are the landmarks of the person, who is measured in other postures. Printed are the differences of
joints and fingertips when the person stops, 0.1 and 0.3 s later, and once the robot has come to
rest.

With `--morph`, the human hand becomes a robot's step by step (`morphs.py`), and does the same
postures of the person in each step. Printed are likeness and errors, and how far tips and joints go
from one step to the next: a jump is another branch of the inverse kinematics.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from morphs import draw_morph, follow_morph, usual_postures

from handmap_qp import Hand, HandMapper, load_hand
from handmap_qp.hands import FINGERS, all_pairs, find_fingers, pair_distances
from handmap_qp.hands.fingers import PalmKinematics
from handmap_qp.human import Recording
from handmap_qp.human.measure import scaled_human
from handmap_qp.se3 import Array, lengths, smoothstep

# Samples in which a posture is reached, and in which the robot comes to rest, of 20 ms each.
MOVING, RESTING = 40, 60
DT = 0.02
# Samples after the person's stop in which the robot is looked at: the last is at rest.
AFTER = 0, 5, 15, RESTING
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
    """Return differences of joints [deg], (count, a, n), and of fingertips [mm], (count, a, 5).

    They are those `AFTER` the person's stop.
    """
    points = OwnLandmarks(hand)
    mapper = HandMapper(person_of(hand, points, size, seed + 1), hand, "teleoperation")
    joints, tips = [], []
    for q in postures(hand, count, seed):
        mapper.reset()
        commands = []
        for share in slowly():
            landmarks = size * points.at(hand.rest + share * (q - hand.rest))
            commands.append(mapper.map_landmarks(landmarks, dt=DT).command.q)
        reached = [commands[MOVING - 1 + k] for k in AFTER]
        joints.append(np.degrees(np.abs(np.array(reached) - q)))
        missed = [points.tips_at(each) - points.tips_at(q) for each in reached]
        tips.append(1e3 * lengths(np.array(missed)))
    return np.array(joints), np.array(tips)


def slowly() -> Array:
    """Return the share of the way of each sample: smoothly there, and at rest."""
    return np.append(smoothstep(np.linspace(0.0, 1.0, MOVING)), np.ones(RESTING))


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
    parser.add_argument("--morph", metavar="ROBOT", help="a robot hand to change to")
    parser.add_argument("--steps", type=int, default=20, help="of the morph")
    parser.add_argument("--draw", type=Path, help="draw the morph's errors to a file")
    given = parser.parse_args()
    if given.morph:
        morph_to(given.morph, given.postures, given.steps, given.seed, given.draw)
        return
    hand = load(given.hand)
    print(f"{hand.name}: {given.postures} postures, seed {given.seed}")
    for size in given.sizes:
        joints, tips = differences(hand, size, given.postures, given.seed)
        for k, after in enumerate(AFTER):
            print(
                f"size {size:.2f}, {DT * after:.1f} s after the stop: "
                f"joints {np.median(joints[:, k]):.2f} deg in the median, "
                f"{np.percentile(joints[:, k], 95):.1f} at p95; "
                f"tips {np.median(tips[:, k]):.2f} mm, "
                f"{np.percentile(tips[:, k], 95):.1f} at p95"
            )


def morph_to(
    robot: str, count: int, steps: int, seed: int, picture: Path | None
) -> None:
    """Print the errors of hands between a person's and a robot's, and draw them."""
    human = load_hand("human", points="landmarks", hand_length=0.185)
    shown = usual_postures(human, count, seed)
    found = list(follow_morph(human, load_hand(robot), shown, steps))
    print(f"from {human.name} to {robot}: {count} postures, seed {seed}")
    for k, each in enumerate(found):
        before = found[max(k - 1, 0)]
        moved = each.moved_since(before).max()
        turned = each.turned_since(before).max()
        print(
            f"{each.share:.2f}: palms alike {each.palms:.2f}, thumbs {each.fingers[0]:.2f}, "
            f"fingers {each.fingers[1:].min():.2f} and more; "
            f"directions {np.median(each.directions):.1f} deg in the median, "
            f"{np.percentile(each.directions, 95):.1f} at p95; tips "
            f"{np.median(each.tips):.1f} % of the reach off, "
            f"{np.percentile(each.tips, 95):.1f} at p95; "
            f"since the step before a tip moves by up to {moved:.1f} % about its place, "
            f"a joint turns by up to {turned:.1f} deg"
        )
    if picture:
        draw_morph(found, picture)


if __name__ == "__main__":
    main()
