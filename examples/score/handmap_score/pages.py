"""What `handmap score` writes: numbers as JSON, the page of the score, and the page for votes."""

import base64
import io
from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from handmap_qp.apps.drawing.contact_sheet import SheetRow, pose_pictures, sheet_rows
from handmap_qp.apps.offline.metrics import METRICS
from handmap_qp.apps.tables import Row
from handmap_qp.errors import require
from handmap_qp.hands import FINGERS, Hand, Values
from handmap_qp.se3 import Array
from .gestures import SOURCES, read_gestures
from .scoring import HALVES, READ, HandScore

_LABELS = {
    **{key: key for key in (*"".join(HALVES), *READ)},
    **{metric.key: metric.label for metric in METRICS if metric.in_short},
    **{finger: f"{finger} dir. [deg]" for finger in FINGERS},
}
"""Columns of the page, by the keys of their values."""


def overview(hands: Sequence[HandScore]) -> list[Row]:
    """Return a row for each mapping that ran on all hands, best first."""
    by_hand = {
        hand.robot.name: {row.method: row.scores for row in hand.ran} for hand in hands
    }
    rows = []
    for name in set.intersection(*map(set, by_hand.values())):
        scores = {hand: np.array(found[name]) for hand, found in by_hand.items()}
        seeds = np.mean([*scores.values()], axis=0)
        row = {"mapping": name, "score": seeds.mean(), "sd": seeds.std()}
        rows.append(row | {hand: each.mean() for hand, each in scores.items()})
    return sorted(rows, key=itemgetter("score"), reverse=True)


def results_of(hands: Sequence[HandScore], about: Values) -> Values:
    """Return all that was measured as plain values, with None for NaN."""
    found = {
        hand.robot.name: {
            "same_order": hand.same_order,
            "kendall_tau": hand.tau,
            "alike": hand.alike,
            "mappings": [row._asdict() | {"score": row.score} for row in hand.rows],
        }
        for hand in hands
    }
    document = {"about": about, "overview": overview(hands), "hands": found}
    return msgspec.json.decode(msgspec.json.encode(document, enc_hook=np.generic.item))


def score_page(hands: Sequence[HandScore], results: Values) -> str:
    """Return the page of the score: results, and gestures beside each hand's best mapping's."""
    ran = [hand for hand in hands if hand.ran]
    sheets = zip(*map(_sheet, ran), strict=True)
    rows = [rows[0]._replace(q=tuple(row.q[0] for row in rows)) for rows in sheets]
    titles = [f"{hand.robot.name}: {hand.ran[0].method}" for hand in ran]
    shown = _drawn([hand.robot for hand in ran], rows) if ran else []
    page = {"labels": _LABELS, "titles": titles, "gestures": shown}
    return _page("score.html", results | page)


def votes_page(hands: Sequence[HandScore], count: int) -> str:
    """Return the page that asks which of two robots shows a gesture better, `count` times a hand.

    Gestures, mappings and sides are random, and the same for the same results.
    """
    rng = np.random.default_rng(0)
    asked = []
    for hand in hands:
        ran, sheet = hand.ran, _sheet(hand)
        if len(ran) < 2:
            continue
        pairs = [rng.permutation(len(ran))[:2] for _ in range(count)]
        rows = [
            sheet[i]._replace(q=tuple(sheet[i].q[k] for k in pair))
            for i, pair in zip(rng.permutation(len(sheet)), pairs, strict=False)
        ]
        drawn = _drawn([hand.robot] * 2, rows)
        asked += [
            pictures
            | {
                "hand": hand.robot.name,
                "mappings": [ran[k].method for k in pair],
                "scores": [ran[k].score for k in pair],
            }
            for pictures, pair in zip(drawn, pairs, strict=True)
        ]
    rng.shuffle(asked)
    return _page("votes.html", asked)


def _sheet(hand: HandScore) -> list[SheetRow]:
    """Return the end of every gesture, with the joints of every mapping that ran."""
    rows = []
    for i, (source, show) in enumerate(zip(SOURCES, hand.shows, strict=True)):
        names = read_gestures(source).names
        ends = zip(show.shown.tolist(), show.samples.tolist(), strict=True)
        chosen = {names[k]: sample for k, sample in sorted(ends)}
        runs = [hand.runs[row.method][i] for row in hand.ran]
        motions = [run.motion.q for run in runs if run.motion]
        found = sheet_rows(show.take.recording, chosen, motions)
        rows += [row._replace(note=f"{source.name}, {source.licence}") for row in found]
    return rows


def _drawn(robots: Sequence[Hand], rows: Sequence[SheetRow]) -> list[Values]:
    """Return gestures with pictures of the person and of each robot."""
    columns = [("", robot) for robot in robots]
    pictures = pose_pictures(columns, rows, side=robots[0].side)
    return [
        {"gesture": row.label, "source": row.note, "pictures": [*map(_image, drawn)]}
        for row, drawn in zip(rows, pictures, strict=True)
    ]


def _image(views: Array) -> str:
    """Return pictures side by side, shape (views, height, width, 3), as the address of one."""
    pixels = np.uint8(255.0 * np.clip(np.concatenate([*views], axis=1), 0.0, 1.0))
    file = io.BytesIO()
    require("PIL.Image", "plot", "pillow").fromarray(pixels).save(file, "webp")
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()


def _page(name: str, shown: Any) -> str:
    """Return a page of this folder with what it shows, which no text in it can end."""
    text = Path(__file__).with_name(name).read_text(encoding="utf-8")
    data = msgspec.json.encode(shown, enc_hook=np.generic.item).decode()
    return text.replace("SHOWN", data.replace("<", "\\u003c"))
