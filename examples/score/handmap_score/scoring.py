"""Columns, the score, and the order of mappings on a hand: `score_hand`."""

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import combinations
from statistics import fmean
from typing import NamedTuple

import numpy as np
from scipy.stats import kendalltau

from handmap_qp.apps.offline.comparison import (
    ComparedMethod,
    Run,
    Take,
    compare_methods,
)
from handmap_qp.apps.offline.hand_trace import HandTrace, trace_robot
from handmap_qp.apps.offline.metrics import mean_values
from handmap_qp.apps.offline.trajectory import RobotMotion
from handmap_qp.hands import Hand, Names, Values, find_fingers
from .gestures import SOURCES, Performance, Source, people, perform, read_gestures
from .reader import Reader

FORMULA = (
    "score = 100 · (D + C + R) / 3 · (P + M + L) / 3, where "
    "D = 1 - direction / 45 deg, C = closed · (1 - 10 · false), "
    "R = (read - chance) / (people's - chance), P = 1 - penetration, "
    "M = 1 / max(1, jerk, speed), L = (1 - outside limits) · (1 - |lag| / 150 ms), "
    "each at least 0. What does not arise is left out of its mean."
)
"""How the columns are combined: what the hand meant, times how the robot moves."""
HALVES = "DCR", "PML"
"""Letters of the parts of both factors."""
READ = ("read", "people", "chance")
"""Columns beside those of `handmap compare`: share of gestures that the reader names right of the
robot's, of the person's in the same samples, and without looking."""


class Scored(NamedTuple):
    """A mapping on one hand.

    Attributes:
        method: Name of the mapping.
        scores: Its score, by seed; NaN where it failed.
        values: Means over the seeds: the columns of `handmap compare`, `READ`, the parts of the
            score by their letters (`FORMULA`), and errors of direction by finger [deg].
        confused: Gestures shown, what they were taken for, and how often in all seeds.
        problem: Why it failed in a seed; empty if it did not.
    """

    method: str
    scores: tuple[float, ...]
    values: Values
    confused: list[tuple[tuple[str, str], int]]
    problem: str

    @property
    def score(self) -> float:
        """Mean of the scores."""
        return fmean(self.scores)


class HandScore(NamedTuple):
    """All mappings on one hand.

    Attributes:
        robot: The hand.
        rows: The mappings, best first; those that failed come last.
        same_order: In how many of the seeds they come in this order.
        tau: Kendall's rank correlation between two seeds, mean over all pairs of them.
        alike: Gestures that count as one, because the hand's fingers would not tell them apart.
        shows: The first seed's performances, one of each source.
        runs: What every mapping made of them, by its name.
    """

    robot: Hand
    rows: list[Scored]
    same_order: int
    tau: float
    alike: list[Names]
    shows: list[Performance]
    runs: dict[str, list[Run]]

    @property
    def ran(self) -> list[Scored]:
        """The mappings that did not fail."""
        return [row for row in self.rows if not row.problem]


def parts_of(values: Values) -> Values:
    """Return the parts of a score by their letters; see `FORMULA`."""
    read, best, chance = (values[key] for key in READ)
    # A hand that stands still has no lag: it never comes.
    lag = np.nan_to_num(values["latency_ms"], nan=np.inf)
    parts = {
        "D": 1.0 - values["finger_direction_deg"] / 45.0,
        "C": values["pinch_closed"] * max(0.0, 1.0 - 10.0 * values["pinch_false"]),
        "R": (read - chance) / (best - chance),
        "P": 1.0 - values["self_penetration"],
        "M": 1.0 / np.nanmax([1.0, values["jerk_ratio"], values["speed_ratio"]]),
        "L": (1.0 - values["outside_limits"]) * max(0.0, 1.0 - abs(lag) / 150.0),
    }
    return {letter: np.maximum(0.0, part) for letter, part in parts.items()}


def score_of(values: Values) -> float:
    """Return the score of its parts."""
    meant, moves = (np.nanmean([values[key] for key in half]) for half in HALVES)
    return 100.0 * meant * moves


def score_hand(
    robot: Hand,
    methods: Sequence[ComparedMethod],
    takes: Sequence[Take],
    seeds: Sequence[int],
    rate: float,
    say: Callable[[str], None] = lambda _: None,
) -> HandScore:
    """Run mappings on a hand over all gestures, once a seed, and over further recordings.

    Args:
        robot: The robot hand.
        methods: The mappings.
        takes: Further recordings: they count in all columns but `READ`.
        seeds: Seeds of the performances.
        rate: Samples per second of the performances.
        say: Called before each seed with what comes next.
    """
    fingers = tuple(find_fingers(robot))
    readers = {
        source: Reader(
            people(source, robot.side).trace, read_gestures(source).labels, fingers
        )
        for source in SOURCES
    }
    others = compare_methods(takes, robot, methods) if takes else None
    found: dict[str, list[_Seed]] = {method.name: [] for method in methods}
    first: Values = {}
    for seed in seeds:
        say(f"{robot.name}, seed {seed}")
        shows = [perform(source, seed, rate, robot.side) for source in SOURCES]
        compared = compare_methods([show.take for show in shows], robot, methods)
        runs = {name: compared.of_method(name) for name in found}
        first = first or {"shows": shows, "runs": runs}
        for name, own in runs.items():
            more = others.of_method(name) if others else []
            found[name].append(_measure(own, more, shows, readers))
    rows = [_scored(name, measured) for name, measured in found.items()]
    rows.sort(key=lambda row: np.nan_to_num(row.score, nan=-1.0), reverse=True)
    by_seed = np.array([row.scores for row in rows if not row.problem]).T
    taus = [kendalltau(*pair).statistic for pair in combinations(by_seed, 2)]
    return HandScore(
        robot=robot,
        rows=rows,
        same_order=sum(bool((np.diff(each) <= 0.0).all()) for each in by_seed),
        tau=fmean(taus) if taus else np.nan,
        alike=[group for item in readers.items() for group in _alike(*item)],
        **first,
    )


class _Seed(NamedTuple):
    """A mapping on one hand in one seed; as of `Scored`."""

    values: Values
    confused: Counter[tuple[str, str]]
    score: float = np.nan
    problem: str = ""


def _measure(
    runs: Sequence[Run],
    others: Sequence[Run],
    shows: Sequence[Performance],
    readers: dict[Source, Reader],
) -> _Seed:
    """Measure one seed: its runs, one of each source, and those of further recordings."""
    every = [*runs, *others]
    values = mean_values([run.values for run in every])
    confused: Counter[tuple[str, str]] = Counter()
    read = []
    for run, show, (source, reader) in zip(runs, shows, readers.items(), strict=True):
        if not run.motion:
            values |= dict.fromkeys((*READ, *"".join(HALVES)), np.nan)
            return _Seed(values, confused, problem=run.problem)
        traces = _trace(run.motion), show.take.trace
        named, own = (reader.read(trace, show.samples) for trace in traces)
        same = reader.same[show.shown]
        is_right, is_own = same[np.arange(len(same)), [named, own]]
        read.append([is_right, is_own, same.mean(axis=1)])
        names = read_gestures(source).names
        wrong = zip(show.shown[~is_right], named[~is_right], strict=True)
        confused.update((names[a], names[b]) for a, b in wrong)
    values |= zip(READ, np.hstack(read).mean(axis=1), strict=True)
    fingers = [run.fingers for run in every if run.fingers]
    for name in fingers[0]:
        values[name] = np.mean([each[name]["direction_deg"] for each in fingers])
    values |= parts_of(values)
    return _Seed(values, confused, score_of(values))


def _trace(motion: RobotMotion) -> HandTrace:
    """Return what a robot's hand did."""
    wrist = motion.wrist if motion.robot.is_floating else None
    return trace_robot(motion.robot, motion.q, wrist)


def _scored(name: str, seeds: Sequence[_Seed]) -> Scored:
    """Return the means over the seeds."""
    return Scored(
        name,
        tuple(seed.score for seed in seeds),
        {
            key: fmean(seed.values.get(key, np.nan) for seed in seeds)
            for key in seeds[0].values
        },
        sum((seed.confused for seed in seeds), Counter()).most_common(),
        max((seed.problem for seed in seeds), key=len),
    )


def _alike(source: Source, reader: Reader) -> list[Names]:
    """Return the groups of gestures that count as one."""
    names = np.array(read_gestures(source).names)
    groups = {tuple(names[same].tolist()) for same in reader.same}
    return sorted(group for group in groups if len(group) > 1)
