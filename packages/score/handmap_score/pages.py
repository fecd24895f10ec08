"""What `handmap score` writes: numbers as JSON, the page of the score, and the page for votes."""

import io
from operator import itemgetter, or_
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import numpy as np
from PIL import Image

from handmap_qp.apps.drawing.contact_sheet import SheetRow, pose_pictures
from handmap_qp.apps.offline.metrics import METRICS
from handmap_qp.apps.tables import Row, rows_of
from handmap_qp.hands import FINGERS, Hand, Values
from handmap_qp.se3 import Array
from .scoring import PARTS, READ, THUMB_ERROR, HandScore, Ranking, rank

_LABELS = {
    **{key: key for key in (*PARTS, *READ)},
    **{metric.key: metric.label for metric in METRICS if metric.in_short},
    **{finger: f"{finger} dir. [deg]" for finger in FINGERS},
    THUMB_ERROR: "thumb const. [deg]",
}
"""Columns of the page, by the keys of their values."""


def results_of(hands: list[HandScore], about: Values) -> Values:
    """Return all that was measured as plain values, with None for NaN."""
    found = {hand.robot.name: vars(hand).copy() for hand in hands}
    for hand in found.values():
        del hand["robot"], hand["sheet"]
    rows, ranking = overview(hands)
    document = {"about": about, "overview": rows, "ranking": ranking, "hands": found}
    return msgspec.json.decode(msgspec.json.encode(document, enc_hook=np.generic.item))


def overview(hands: list[HandScore]) -> tuple[list[Row], Ranking]:
    """Return a row for each mapping that ran on all hands, best first, and their ranking."""
    by_hand = [{one.method: one.scores for one in hand.mappings} for hand in hands]
    ran = [name for name in by_hand[0] if all(name in own for own in by_hand)]
    if not ran:
        return [], Ranking([], 0, 0)
    scores = np.array([[own[name] for name in ran] for own in by_hand])
    seeds = scores.mean(axis=0)
    ranking = rank(seeds)
    columns = {
        "place": ranking.places,
        "mapping": ran,
        "score": seeds.mean(axis=1),
        "sd": seeds.std(axis=1),
    }
    names = [hand.robot.name for hand in hands]
    columns |= zip(names, scores.mean(axis=2), strict=True)
    rows = rows_of(columns)
    rows.sort(key=itemgetter("score"), reverse=True)
    return rows, ranking


def score_page(hands: list[HandScore], results: Values, every: int) -> str:
    """Return the page of the score: results, and gestures beside each hand's best mapping's.

    Args:
        hands: The hands.
        results: Of `results_of`.
        every: Every so many-th gesture has pictures.
    """
    ran = [hand for hand in hands if hand.mappings]
    rows = [
        rows[0]._replace(q=tuple(row.q[0] for row in rows))
        for rows in zip(*(hand.sheet[::every] for hand in ran), strict=True)
    ]
    gestures = _drawn([hand.robot for hand in ran], rows) if ran else []
    page = {"labels": _LABELS, "gestures": gestures}
    return _page("score.html", results | page)


def votes_page(hands: list[HandScore], count: int) -> str:
    """Return the page that asks which of two robots shows a gesture better, `count` times a hand.

    Gestures, mappings and sides are random, and the same for the same results.
    """
    random = Random(0)
    asked = []
    for hand in hands:
        if len(hand.mappings) < 2:
            continue
        questions, rows = [], []
        for row in random.sample(hand.sheet, count):
            shown = [*zip(hand.mappings, row.q, strict=True)]
            (a, one), (b, other) = random.sample(shown, 2)
            rows.append(row._replace(q=(one, other)))
            questions.append(
                {
                    "hand": hand.robot.name,
                    "mappings": [a.method, b.method],
                    "scores": [a.score, b.score],
                }
            )
        drawn = _drawn([hand.robot] * 2, rows)
        asked += map(or_, drawn, questions)
    random.shuffle(asked)
    return _page("votes.html", asked)


def _drawn(robots: list[Hand], rows: list[SheetRow]) -> list[Values]:
    """Return gestures with pictures of the person and of each robot."""
    columns = [("", robot) for robot in robots]
    pictures = pose_pictures(columns, rows, side=robots[0].side)
    return [
        {"gesture": row.label, "source": row.note, "pictures": [*map(_webp, drawn)]}
        for row, drawn in zip(rows, pictures, strict=True)
    ]


def _webp(views: Array) -> bytes:
    """Return pictures side by side, shape (views, height, width, 3), as a file."""
    pixels = 255.0 * np.hstack([*views]).clip(0.0, 1.0)
    file = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(file, "webp")
    return file.getvalue()


def _page(name: str, shown: Any) -> str:
    """Return a page of this folder with what it shows, which no text in it can end."""
    text = Path(__file__).with_name(name).read_text(encoding="utf-8")
    data = msgspec.json.encode(shown).decode()
    return text.replace("SHOWN", data.replace("<", "\\u003c"))
