"""Measure `handmap calibrate-actuators` on simulated hands: the table of docs/measurements.md.

Each hand is tuned in simulated time; then it follows recordings, mapped by the default
teleoperation, as told and compensated. Gain .8 to 1.1, zero 1 degree, delay 20 to 120 ms, backlash
2 to 4 degrees, stretch .1 to .4 rad by the largest torque, friction .03 to .08 of it, encoders
1.4 degrees wrong, stops up to 5 % of the range inside or outside the limits.

    python benchmarks tune_hands
    python benchmarks tune_hands --hands leap_right --seeds 20 21 --effects gravity

Effects are what the fitted model does not have: `gravity` is that of the links of a hand that lies
on its back while it is tuned, and has its palm down while it is driven, with `--down`; `untold` is
that of one that stays on its back, without `--down`; `stiction` is more friction at rest; `tendon`
is longer by a power of the torque; `lag` is that of motors; `jitter` is that of the delay.
"""

from __future__ import annotations

import argparse
import os
import warnings
from functools import lru_cache, partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from handmap_drive.gate import Gate
from handmap_drive.joint_map import Direct, JointMap
from handmap_drive.motion import Motion
from handmap_drive.pinches import map_recording
from handmap_drive.ritual import find_tuning
from handmap_drive.simulated import Simulated
from handmap_drive.space import ON_ITS_BACK, Space, Vector
from handmap_drive.tuning import Compensated, Tuning, tuned

from handmap_qp import Hand, load_hand
from handmap_qp.apps.offline.fidelity import CLOSED
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.tables import markdown_table
from handmap_qp.hands import Names

FLOORS = {
    "gain": 0.0,
    "zero": 0.005,
    "delay": 0.005,
    "backlash": 0.005,
    "stretch": 0.005 / 0.3,
    "friction": 0.005,
}
"""Errors that are small enough in any case: .3 degrees, at a torque of .3, 5 ms, .5 %."""
LAG = 0.3
"""Longest delay of a hand that is looked for [s]."""
WEIGHTS = "gravity", "untold"
EFFECTS = *WEIGHTS, "stiction", "tendon", "lag", "jitter"
PALM_DOWN = 0.0, 0.0, -1.0
STRONGEST = 0.6
"""Largest torque of a motor, for the weights of links [N m]."""
STICKS = 1.4
"""Friction at rest by that in motion."""
SOFT = 0.7
"""Power of the torque by which tendons are longer."""
LATE = 0.2
"""Share of commands that come a turn late."""
LAGS = 0.01, 0.03
"""Time constants of motors, least and largest [s]."""
SETTLED = 4.0
"""Time in which a hand comes to the recording [s]."""
RECORDINGS = ("leap_pinch_move_right", "leap_hmd_right")


class Motors(Simulated):
    """A simulated hand that knows how far it was told to leave its limits, at most [rad].

    Its joints are not those that are fitted, where there are `effects`.
    """

    effects: Names = ()
    told = -np.inf

    def __init__(self, port: str, joints: Names, down: Vector = ON_ITS_BACK) -> None:
        super().__init__(port, joints)
        self.space = Space(self._hand, self, down)
        self._chance = np.random.default_rng([1, int(port.rpartition(":")[2])])
        lag = self._chance.uniform(*LAGS, len(self.q)) * self.rate
        self._lag = lag * ("lag" in self.effects)
        self._drive = self._last = self.q
        self.sticks = STICKS if "stiction" in self.effects else 1.0
        self.exponent = SOFT if "tendon" in self.effects else 1.0

    def write(self, q: np.ndarray, effort: float) -> None:
        """See `Driver`."""
        self.told = max(self.told, beyond(self, q))
        super().write(q, effort)

    def turned(self, q: np.ndarray) -> np.ndarray:
        """See `Simulated`."""
        now = super().turned(q)
        is_late = "jitter" in self.effects and self._chance.random() < LATE
        goal, self._last = self._last if is_late else now, now
        self._drive = self._drive + (goal - self._drive) / (1.0 + self._lag)
        return self._drive

    def load(self) -> np.ndarray:
        """See `Simulated`."""
        if {*WEIGHTS}.isdisjoint(self.effects):
            return super().load()
        return self.space.weights(self.q + self.encoder) / STRONGEST


@lru_cache(maxsize=6)
def motion_of(hand: Hand, recording: str) -> np.ndarray:
    """Return a recording as it is mapped to a hand, by the turns of a loop [rad], shape (T, n)."""
    file = Path(os.environ["HANDMAP_RECORDINGS"]) / f"{recording}.npz"
    time, q = map_recording(hand, str(file))
    turns = np.arange(time[0], time[-1], 1.0 / Simulated.rate)
    return np.apply_along_axis(partial(np.interp, turns, time), 0, q)


def follow(
    joints: JointMap, motors: Simulated, q: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Tell motors a motion; return where joints are in truth, and as encoders tell it."""
    gate = Gate(motors)
    gate.read()
    joints.restart(motors.q)
    approach = np.linspace(motors.q, q[0], round(SETTLED * motors.rate))
    rows = []
    for k, goal in enumerate((*approach, *q)):
        gate.write(joints.command(goal), motors.effort, k / motors.rate)
        gate.read()
        rows.append((motors.posture, motors.q))
    true, seen = map(np.array, zip(*rows, strict=True))
    return true[len(approach) :], seen


def pinches(
    meter: GapMeter, asked: np.ndarray, told: np.ndarray, true: np.ndarray
) -> float:
    """Return the share of samples with a pinch that the hand closes.

    Pinches are those of the hand as it is described, `asked`. The hand is compared at the one delay
    at which it is nearest to what it was told.
    """
    T = len(asked)

    def error(d: int) -> float:
        return float(np.mean((true[d:] - told[: T - d]) ** 2))

    delay = min(range(round(LAG * Simulated.rate)), key=error)
    wanted, got = (
        np.array([*meter.pinches(q).values()]) < CLOSED
        for q in (asked[: T - delay], true[delay:])
    )
    return float(got[wanted].mean())


def right(tuning: Tuning, motors: Simulated) -> dict[str, float]:
    """Return the share of joints of which each parameter is right within 10 %."""
    shares = {}
    joints = tuning.arrays(motors.joint_names)
    for name, floor in FLOORS.items():
        true = getattr(motors, name)
        found = getattr(joints, name)
        allowed = np.maximum(0.1 * np.abs(true), floor)
        shares[f"{name} right"] = float(np.mean(np.abs(found - true) <= allowed))
    # The range in which it can be used: up to its stops, its limits, and what can be told.
    reached = motors.gain * motors.range + motors.zero
    true = np.clip(np.clip(reached, *motors.range), *motors.stops)
    width = np.ptp(motors.range, axis=0)
    shares["range right"] = float(np.mean(np.abs(joints.range - true) <= 0.1 * width))
    return shares


def beyond(motors: Simulated, seen: np.ndarray) -> float:
    """Return how far encoders were outside the limits of the hand at most [rad]."""
    low, high = motors.range
    return float(np.maximum(seen - high, low - seen).max())


def measure(hand: Hand, seed: int) -> dict[str, Any]:
    """Return a row about a hand with hidden parameters."""
    port = f"{hand.name}:{seed}"
    motors = Motors(port, hand.joint_names)
    motion = Motion(motors, motors.effort, (k / motors.rate for k in count()))
    tuning = find_tuning(motion, hand)
    meter = GapMeter(hand)
    told = [motors.told]
    row: dict[str, Any] = {"hand": hand.name, "seed": seed}
    row["ritual [s]"] = motion.count / motors.rate
    row |= right(tuning, motors)
    row["fingers met"] = len(tuning.pinches)
    over = [beyond(motors, motion.log().q)]
    found = Hand(tuned(hand.spec, tuning), mount="fixed")
    is_down = "gravity" in motors.effects
    down = PALM_DOWN if is_down else ON_ITS_BACK
    for recording in RECORDINGS:
        asked = motion_of(hand, recording)
        for when, mapped in (("before", hand), ("after", found)):
            motors = Motors(port, hand.joint_names, down)
            joints: JointMap = Direct(motors)
            if mapped is found:
                weights = motors.space.weights if is_down else np.zeros_like
                joints = Compensated(motors, tuning, weights)
            q = motion_of(mapped, recording)
            true, seen = follow(joints, motors, q)
            row[f"{recording}: {when}"] = pinches(meter, asked, q, true)
            over.append(beyond(motors, seen))
            told.append(motors.told)
    row["told beyond limits"] = max(told)
    row["joints beyond: ritual"] = over[0]
    row["as told"] = max(over[1::2])
    row["compensated"] = max(over[2::2])
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description="Tuning of simulated hands.")
    hands = ["leap_right", "allegro_right", "shadow_right", "orca_right"]
    parser.add_argument("--hands", nargs="+", default=hands)
    parser.add_argument("--seeds", nargs="+", type=int, default=[*range(20, 25)])
    help_ = "what joints have besides the fitted model"
    parser.add_argument("--effects", nargs="+", default=[], choices=EFFECTS, help=help_)
    given = parser.parse_args()
    Motors.effects = tuple(given.effects)
    warnings.simplefilter("ignore")
    rows = []
    for name in given.hands:
        hand = load_hand(name, mount="fixed")
        for seed in given.seeds:
            rows.append(measure(hand, seed))
            print(rows[-1], flush=True)
    print(markdown_table(rows))
    before, after = (
        np.array([row[f"{r}: {when}"] for row in rows for r in RECORDINGS])
        for when in ("before", "after")
    )
    print(f"closed in the mean: {before.mean():.2f} before, {after.mean():.2f} after")
    print(f"under .20 before: {(before < 0.2).sum()} of {before.size}")
    print(f"from .95 after: {(after >= 0.95).sum()} of {after.size}")


if __name__ == "__main__":
    main()
