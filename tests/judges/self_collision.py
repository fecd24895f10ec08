"""Overlaps of links under self-collision avoidance, with and without acceleration limits.

Wild steps: random targets, sample times and options, which change on the way. Recordings: mapped
with acceleration limits. `checker.py` judges every step and the way there. The exit code is 1 if it
finds a violation.

    nice python tests/judges self_collision --json self_collision.json
    nice python tests/judges self_collision --steps 2000 --hands allegro_right
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import common
import numpy as np
import shared_hands
from checker import SHORTEST, Checker
from overlap import OverlapMeter

from handmap_core.human.recording import Recording, mirrored
from handmap_core.human.sample import human_name
from handmap_core.ik.motion import Motion
from handmap_qp import HandMapper, IkOptions, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs, all_pairs, named_pairs
from handmap_qp.human.measure import measure_hand
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.presets import get_preset
from handmap_qp.trackers.formats import read_recording

HANDS = ("allegro_right", "three_finger", *shared_hands.NAMES)
ACCELERATIONS = (None, 5.0, 20.0, 100.0, 1000.0)


class Tally:
    """Figures of one run.

    Args:
        hand: The hand.
        shapes: The pairs that are kept apart.

    Attributes:
        checker: Judges the steps.
    """

    def __init__(self, hand: Hand, shapes: ShapePairs) -> None:
        self.checker = Checker(hand, shapes)
        self.times: list[float] = []

    def take(self, q: np.ndarray, dt: float, most: float | None, spent: float) -> None:
        """Judge a step.

        Args:
            q: Configuration at its end.
            dt: Time since the step before [s].
            most: Its limit of acceleration; None for none.
            spent: CPU time [s].
        """
        self.times.append(spent)
        self.checker.take(q, self.checker.time + max(dt, SHORTEST), most)

    def row(self, **names: Any) -> dict[str, Any]:
        """Return the figures under their names."""
        times, worst = 1e3 * np.array(self.times), self.checker.worst
        return {
            **names,
            "steps": self.checker.commands,
            "violations": self.checker.violations.total(),
            "overlap [mm]": 1e3 * worst["overlap"],
            "beyond [rad]": worst["position"],
            "speed / limit": worst["speed"],
            "acceleration / limit": worst["acceleration"],
            "p50 [ms]": float(np.median(times)),
            "p99 [ms]": float(np.quantile(times, 0.99)),
        }


def wild(hand: Hand, shapes: ShapePairs, steps: int, seed: int) -> Tally:
    """Take random steps from collision-free postures."""
    rng, tally = np.random.default_rng(seed), Tally(hand, shapes)
    options = IkOptions(avoids_self_collision=False)
    ik = PointIk(hand, options, contacts=shapes)
    meter, elsewhere = OverlapMeter(hand, shapes), hand.configuration()
    ik.place(hand.configuration_vector(hand.rest))
    tally.checker.start(ik.configuration.q)
    targets, rest = ik.configuration.points.copy(), hand.rest
    for _ in range(steps):
        if rng.random() < 0.01:
            q = hand.configuration_vector(
                rng.uniform(hand.lower_limits, hand.upper_limits)
            )
            if meter.depth(q) == 0.0:
                ik.place(q)
                tally.checker.start(q)
        if rng.random() < 0.02:
            options = _wild_options(rng)
            ik = PointIk(hand, options, ik.gate.motion, contacts=shapes)
        if rng.random() < 0.1:
            q = rng.uniform(hand.lower_limits, hand.upper_limits)
            elsewhere.place(hand.configuration_vector(q))
            targets = elsewhere.points.copy()
            if rng.random() < 0.5:
                targets[:] = targets.mean(axis=0) + 0.01 * rng.normal(
                    size=targets.shape
                )
            rest = rng.uniform(hand.lower_limits, hand.upper_limits)
        dt, started = _wild_time(rng), time.process_time()
        ik.solve(targets, None, dt, rest=rest)
        spent = time.process_time() - started
        tally.take(ik.configuration.q, dt, options.max_acceleration, spent)
    return tally


def _wild_options(rng: np.random.Generator) -> IkOptions:
    """Draw options; every combination is valid."""
    most = ACCELERATIONS[rng.integers(len(ACCELERATIONS))]
    return IkOptions(
        point_weight=float(10.0 ** rng.uniform(-1, 2)),
        rest_weight=float(rng.choice([0.0, 0.2, 10.0, 1e3])),
        damping=float(10.0 ** rng.uniform(-3, 0)),
        error_damping=float(rng.choice([0.0, 0.7])),
        max_iterations=int(rng.integers(1, 6)),
        step_tolerance=float(rng.choice([0.0, 0.1])),
        acceleration_weight=float(rng.choice([0.0, 3.0])),
        max_acceleration=most,
    )


def _wild_time(rng: np.random.Generator) -> float:
    """Draw a sample time: mostly 5 to 30 ms, sometimes 0.1 ms to 10 s."""
    if rng.random() < 0.8:
        return float(rng.uniform(0.005, 0.03))
    return float(10.0 ** rng.uniform(-4, 1))


def mapped(
    hand: Hand, shapes: ShapePairs, recording: Recording, most: float | None
) -> Tally:
    """Map a recording by teleoperation with an acceleration limit."""
    if recording.side != hand.side:
        recording = mirrored(recording)
    human = load_hand(
        human_name(recording.side), points="landmarks", lengths=measure_hand(recording)
    )
    preset, tally = get_preset("teleoperation"), Tally(hand, shapes)
    mapper = HandMapper(
        human, hand, preset.method, ik=preset.ik.replaced(max_acceleration=most)
    )
    is_first = True
    for landmarks, is_valid, dt in zip(
        recording.landmarks, recording.valid, recording.steps, strict=True
    ):
        if not is_valid:
            continue
        started = time.process_time()
        step = mapper.map_landmarks(landmarks, dt=float(dt))
        spent = time.process_time() - started
        after = hand.configuration_vector(step.command.q)
        if is_first:
            mapper.motion = Motion.at_rest(after, mapper.point_ik.configuration.nv)
            tally.checker.start(after)
        else:
            tally.take(after, float(dt), most, spent)
        is_first = False
    return tally


def load(name: str) -> Hand:
    """Load one of `HANDS` with a fixed wrist."""
    spec = shared_hands.shared_hand_spec(name) if name in shared_hands.NAMES else name
    return load_hand(spec, mount="fixed")


def main(words: Sequence[str] | None = None) -> None:
    """Run both, print the table."""
    parser = common.make_parser(
        "Overlaps of links under self-collision avoidance.", draws=False
    )
    parser.add_argument("--hands", nargs="+", choices=HANDS, default=list(HANDS))
    parser.add_argument(
        "--steps", type=int, default=100_000, help="wild steps in total"
    )
    parser.add_argument("--seed", type=int, default=0)
    arguments = common.parse_arguments(parser, words)
    files = common.find_recordings(arguments.recordings)
    files = files[:1] if arguments.quick else files
    steps = 400 if arguments.quick else arguments.steps
    rows: list[dict[str, Any]] = []
    runs: list[tuple[Hand, str, ShapePairs]] = []
    for hand in map(load, arguments.hands):
        runs.append((hand, "all", all_pairs(hand)))
        if hand.spec.collision is not None:
            runs.append(
                (hand, "hand.yaml", named_pairs(hand, hand.spec.collision.pairs))
            )
    with common.progress("hands", len(runs)) as advance:
        for i, (hand, kind, shapes) in enumerate(runs):
            tally = wild(hand, shapes, steps // len(runs), arguments.seed + i)
            rows.append(
                tally.row(hand=hand.name, pairs=kind, motion="wild", limit="mixed")
            )
            for file in files if kind == "all" else ():
                for most in (None, 20.0, 100.0):
                    tally = mapped(hand, shapes, read_recording(file), most)
                    limit = "none" if most is None else f"a {most:g}"
                    name = {"hand": hand.name, "pairs": kind, "motion": file.stem}
                    rows.append(tally.row(**name, limit=limit))
            advance()
    common.print_table("Overlaps", rows, to_stderr=arguments.json == "-")
    common.write_json(arguments.json, "self_collision", {"rows": rows})
    if any(row["violations"] for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
