"""Columns, the score, and the order of mappings on a hand: `score_hand`."""

from collections import Counter
from dataclasses import dataclass
from itertools import combinations
from statistics import fmean

import numpy as np
from scipy.stats import kendalltau

from handmap_qp.apps.drawing.contact_sheet import SheetRow
from handmap_qp.apps.offline.comparison import (
    ComparedMethod,
    Progress,
    Run,
    Take,
    compare_methods,
)
from handmap_qp.apps.offline.hand_trace import trace_robot
from handmap_qp.apps.offline.metrics import mean_values
from handmap_qp.hands import FINGERS, Hand, Names, Values, find_fingers
from handmap_qp.se3 import Array
from .gestures import SOURCES, Performance, perform
from .reader import Reader

FORMULA = (
    "score = 100 · (D + C + R) / 3 · (P + M + L) / 3, where "
    "D = 1 - direction / 45 deg, C = closed · (1 - 10 · false), "
    "R = (read - chance) / (people's - chance), P = 1 - penetration, "
    "M = 1 / max(1, jerk, speed), L = (1 - outside limits) · (1 - |lag| / 150 ms), "
    "each at least 0. What does not arise is left out of its mean."
)
"""How the columns are combined: what the hand meant, times how the robot moves."""
PARTS = "DCRPML"
"""Letters of the parts: three of what the hand meant, and three of how the robot moves."""
READ = ("read", "people", "chance")
"""Columns beside those of `handmap compare`: share of gestures that the reader names right of the
robot's, of the person's in the same samples, and without looking."""


@dataclass(frozen=True)
class Scored:
    """A mapping on one hand.

    Attributes:
        method: Name of the mapping.
        score: Mean of the scores.
        scores: Its score, by seed.
        values: Means over the seeds: the columns of `handmap compare`, `READ`, the parts of the
            score by their letters (`FORMULA`), and errors of direction by finger [deg].
        confused: How often in all seeds one gesture was taken for another, most often first.
    """

    method: str
    score: float
    scores: list[float]
    values: Values
    confused: dict[str, int]


@dataclass(frozen=True, eq=False)
class HandScore:
    """All mappings on one hand.

    Attributes:
        robot: The hand.
        mappings: Those that did not fail, best first.
        notes: What the others did not do.
        same_order: In how many of the seeds the mappings come in this order.
        kendall_tau: Rank correlation between two seeds, mean over all pairs of them.
        alike: Gestures that count as one, because the hand's fingers would not tell them apart.
        sheet: The end of every gesture in the first seed, with the joints of every mapping.
    """

    robot: Hand
    mappings: list[Scored]
    notes: list[str]
    same_order: int
    kendall_tau: float
    alike: list[Names]
    sheet: list[SheetRow]


def parts_of(values: Values) -> Array:
    """Return the parts of a score in the order of `PARTS`, shape (2, 3); see `FORMULA`."""
    read, people, chance = (values[key] for key in READ)
    no_false = max(0.0, 1.0 - 10.0 * values["pinch_false"])
    # A hand that stands still has no lag: it never comes.
    lag = np.nan_to_num(values["latency_ms"], nan=np.inf)
    no_lag = max(0.0, 1.0 - abs(lag) / 150.0)
    meant = [
        1.0 - values["finger_direction_deg"] / 45.0,
        values["pinch_closed"] * no_false,
        (read - chance) / (people - chance),
    ]
    moves = [
        1.0 - values["self_penetration"],
        1.0 / np.nanmax([1.0, values["jerk_ratio"], values["speed_ratio"]]),
        (1.0 - values["outside_limits"]) * no_lag,
    ]
    return np.maximum(0.0, [meant, moves])


def score_of(parts: Array) -> float:
    """Return the score of its parts."""
    return 100.0 * np.nanmean(parts, axis=1).prod()


def score_hand(
    robot: Hand,
    methods: list[ComparedMethod],
    takes: list[Take],
    seeds: tuple[int, ...],
    rate: float,
    progress: Progress = lambda *_: None,
) -> HandScore:
    """Run mappings on a hand over all gestures, once a seed, and over further recordings.

    Args:
        robot: The robot hand.
        methods: The mappings.
        takes: Further recordings: they count in all columns but `READ`.
        seeds: Seeds of the performances.
        rate: Samples per second of the performances.
        progress: As of `compare_methods`.
    """
    fingers = tuple(find_fingers(robot))
    readers = [Reader(source, robot.side, fingers) for source in SOURCES]
    shows = [
        [perform(source, seed, rate, robot.side) for source in SOURCES]
        for seed in seeds
    ]
    shown = [show.take for each in shows for show in each]
    compared = compare_methods([*shown, *takes], robot, methods, progress)
    runs = {name: compared.of_method(name) for name in compared.methods}
    mappings = [
        _scored(name, own, shows, readers)
        for name, own in runs.items()
        if all(run.motion for run in own)
    ]
    mappings.sort(key=lambda mapping: mapping.score, reverse=True)
    by_seed = np.array([mapping.scores for mapping in mappings]).T
    # One mapping has no order.
    pairs = combinations(by_seed, 2) if len(mappings) > 1 else ()
    taus = [kendalltau(*pair).statistic for pair in pairs]
    sheet = []
    for i, show in enumerate(shows[0]):
        motions = [runs[mapping.method][i].motion for mapping in mappings]
        sheet += show.sheet([motion.q for motion in motions if motion])
    return HandScore(
        robot,
        mappings,
        compared.notes(),
        same_order=sum(all(np.diff(scores) <= 0.0) for scores in by_seed),
        kendall_tau=fmean(taus) if taus else np.nan,
        alike=[group for reader in readers for group in reader.alike],
        sheet=sheet,
    )


def _scored(
    method: str,
    runs: list[Run],
    shows: list[list[Performance]],
    readers: list[Reader],
) -> Scored:
    """Score a mapping by its runs: on the performances of each seed, then on other recordings."""
    count = len(readers)
    others = runs[count * len(shows) :]
    seeds, scores, mistakes = [], [], []
    for i, each in enumerate(shows):
        own = runs[count * i :][:count]
        motions = [run.motion for run in own if run.motion]
        reads = []
        for motion, show, reader in zip(motions, each, readers, strict=True):
            robot = trace_robot(motion.robot, motion.q[show.samples])
            person = show.take.trace.part(show.samples, FINGERS)
            is_right, wrong = reader.read(robot)
            is_own, _ = reader.read(person)
            reads.append([is_right, is_own, reader.same.mean(axis=0)])
            mistakes += wrong
        values = _columns([*own, *others])
        values |= zip(READ, np.hstack(reads).mean(axis=1), strict=True)
        parts = parts_of(values)
        values |= zip(PARTS, parts.flat, strict=True)
        seeds.append(values)
        scores.append(score_of(parts))
    means = {key: fmean(values[key] for values in seeds) for key in seeds[0]}
    confused = dict(Counter(mistakes).most_common())
    return Scored(method, fmean(scores), scores, means, confused)


def _columns(runs: list[Run]) -> Values:
    """Return means over runs: the columns of `handmap compare`, and directions by finger."""
    values = mean_values([run.values for run in runs])
    fingers = [run.fingers for run in runs if run.fingers]
    for name in fingers[0]:
        values[name] = fmean(each[name]["direction_deg"] for each in fingers)
    return values
