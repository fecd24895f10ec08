"""Columns, the score, and the order of mappings on a hand: `score_hand`."""

from collections import Counter
from dataclasses import dataclass
from statistics import fmean

import numpy as np
from scipy.stats import t

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
from handmap_qp.hands import Hand, Names, Values, find_fingers
from handmap_qp.se3 import Array
from .gestures import SOURCES, Performance, perform
from .reader import Reader, constant_thumb_error

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
THUMB_ERROR = "thumb_constant_deg"
"""Column of the error of the thumb's last bone that all gestures have in common [deg]."""
LEVEL = 0.01
"""Mappings have places of their own if chance makes differences as theirs less often than this."""


@dataclass(frozen=True)
class Scored:
    """A mapping on one hand.

    Attributes:
        method: Name of the mapping.
        score: Mean of the scores.
        scores: Its score, by seed.
        values: Means over the seeds: the columns of `handmap compare`, `READ`, `THUMB_ERROR`, the
            parts of the score by their letters (`FORMULA`), and errors of direction by finger
            [deg].
        confused: How often in all seeds one gesture was taken for another, most often first.
    """

    method: str
    score: float
    scores: list[float]
    values: Values
    confused: dict[str, int]


@dataclass(frozen=True)
class Ranking:
    """An order with ties.

    Attributes:
        places: Place of each mapping: the number of those above its own place, plus 1.
        apart: Pairs of mappings that have different places without a seed, added up over the seeds.
        agreeing: How many of these pairs do not score the other way round in the seed left out.
    """

    places: list[int]
    apart: int
    agreeing: int


@dataclass(frozen=True, eq=False)
class HandScore:
    """All mappings on one hand.

    Attributes:
        robot: The hand.
        mappings: Those that did not fail, best first.
        notes: What the others did not do.
        surfaces: Whose shapes pinches and penetration are measured with.
        ranking: Their places.
        alike: Gestures that count as one, because the hand's fingers would not tell them apart.
        sheet: The end of every gesture in the first seed, with the joints of every mapping.
    """

    robot: Hand
    mappings: list[Scored]
    notes: list[str]
    surfaces: str
    ranking: Ranking
    alike: list[Names]
    sheet: list[SheetRow]


def rank(scores: Array) -> Ranking:
    """Rank mappings by their scores in the same seeds, shape (mappings, seeds)."""
    held = []
    for i, left_out in enumerate(scores.T):
        places = _places(np.delete(scores, i, axis=1))
        above, below = np.nonzero(np.less.outer(places, places))
        held += (left_out[above] >= left_out[below]).tolist()
    return Ranking(_places(scores).tolist(), len(held), sum(held))


def _places(scores: Array) -> Array:
    """Return the places of mappings by their scores, shape (mappings, seeds).

    Neighbours in the order of means share a place unless the upper one is better by a paired t-test
    over the seeds (Student 1908), one-sided at `LEVEL`. One seed tells none apart.
    """
    count, seeds = scores.shape
    if seeds < 2:
        return np.ones(count, int)
    order = np.argsort(-scores.mean(axis=1), stable=True)
    gaps = -np.diff(scores[order], axis=0)
    bound = t.isf(LEVEL, seeds - 1) * gaps.std(axis=1)
    is_apart = gaps.mean(axis=1) * np.sqrt(seeds - 1) > bound
    places = np.arange(1, count + 1)
    places[1:][~is_apart] = 1
    return np.maximum.accumulate(places)[order.argsort()]


def parts_of(values: Values) -> Array:
    """Return the parts of a score in the order of `PARTS`, shape (2, 3); see `FORMULA`."""
    read, people, chance = (values[key] for key in READ)
    # A hand that stands still has no lag: it never comes.
    in_time = np.nan_to_num(1.0 - abs(values["latency_ms"]) / 150.0)
    meant = [
        1.0 - values["finger_direction_deg"] / 45.0,
        values["pinch_closed"] * (1.0 - 10.0 * values["pinch_false"]),
        (read - chance) / (people - chance),
    ]
    moves = [
        1.0 - values["self_penetration"],
        1.0 / np.nanmax([1.0, values["jerk_ratio"], values["speed_ratio"]]),
        in_time * (1.0 - values["outside_limits"]),
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
    shapes: Hand | None = None,
) -> HandScore:
    """Run mappings on a hand over all gestures, once a seed, and over further recordings.

    Args:
        robot: The robot hand.
        methods: The mappings.
        takes: Further recordings: they count in all columns but `READ`.
        seeds: Seeds of the performances.
        rate: Samples per second of the performances.
        progress: As of `compare_methods`.
        shapes: As of `compare_methods`.
    """
    fingers = tuple(find_fingers(robot))
    readers = [Reader(source, robot.side, fingers) for source in SOURCES]
    shows = [
        [perform(source, seed, rate, robot.side) for source in SOURCES]
        for seed in seeds
    ]
    shown = [show.take for each in shows for show in each]
    compared = compare_methods([*shown, *takes], robot, methods, progress, shapes)
    runs = {name: compared.of_method(name) for name in compared.methods}
    mappings = [
        _scored(name, own, shows, readers)
        for name, own in runs.items()
        if all(run.motion for run in own)
    ]
    mappings.sort(key=lambda mapping: mapping.score, reverse=True)
    scores = np.array([mapping.scores for mapping in mappings])
    sheet = []
    for i, show in enumerate(shows[0]):
        motions = [runs[mapping.method][i].motion for mapping in mappings]
        sheet += show.sheet([motion.q for motion in motions if motion])
    return HandScore(
        robot,
        mappings,
        compared.notes(),
        compared.whose_shapes,
        ranking=rank(scores.reshape(-1, len(seeds))),
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
    seeds, scores, named = [], [], Counter()
    for i, each in enumerate(shows):
        own = runs[count * i :][:count]
        motions = [run.motion for run in own if run.motion]
        shown, read, people, chance, thumbs = [], [], [], [], []
        for motion, show, reader in zip(motions, each, readers, strict=True):
            robot = trace_robot(motion.robot, motion.q[show.samples])
            person = show.take.trace.part(show.samples, robot.names)
            shown += show.shown
            read += reader.read(robot, show.shown)
            people += reader.read(person, show.shown)
            thumbs.append(constant_thumb_error(person, robot))
            chance += reader.same.mean(axis=0).tolist()
        named.update(zip(shown, read, strict=True))
        is_right = np.equal([read, people], shown).mean(axis=1)
        values = _columns([*own, *others])
        values |= zip(READ, [*is_right, fmean(chance)], strict=True)
        values[THUMB_ERROR] = fmean(thumbs)
        parts = parts_of(values)
        values |= zip(PARTS, parts.flat, strict=True)
        seeds.append(values)
        scores.append(score_of(parts))
    means = {key: fmean(values[key] for values in seeds) for key in seeds[0]}
    confused = {f"{a} for {b}": n for (a, b), n in named.most_common() if a != b}
    return Scored(method, fmean(scores), scores, means, confused)


def _columns(runs: list[Run]) -> Values:
    """Return means over runs: the columns of `handmap compare`, and directions by finger."""
    values = mean_values([run.values for run in runs])
    fingers = [run.fingers or {} for run in runs]
    for name in fingers[0]:
        values[name] = fmean(each[name]["direction_deg"] for each in fingers)
    return values
