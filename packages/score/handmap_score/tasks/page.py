"""The page of the tasks: one file with tables, soundness, and films."""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape

from .report import Check, Row

_STYLE = """
body { font: 14px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 90rem; padding: 0 1rem }
h1, h2 { line-height: 1.2 }
h2 { margin-top: 2.5rem }
table { border-collapse: collapse; font-size: 12.5px; font-variant-numeric: tabular-nums }
th, td { padding: .25rem .6rem; text-align: left; border-bottom: 1px solid #e4e7eb }
th, td { vertical-align: top; white-space: nowrap }
th:last-child, td:last-child { white-space: normal }
.number { text-align: right }
.unmet { background: #fbe3df }
figure { display: inline-block; margin: .3rem; width: 20rem; vertical-align: top }
figcaption { font-size: 12px }
"""
_INTRODUCTION = """An operator sees the scene and shows a hand, a mapping commands the robot's
fingers, and the operator sees what the robot did: the loop is closed. Shares of successes have 95 %
intervals by Wilson's score, over all attempts. <b>by block</b>: successes in each block of seeds; a
block has its own calibration of the person. <b>time</b>: median over the successes. <b>tries</b>:
how often the hand began to touch the object, <b>drops</b>: how often it lost it, means over the
attempts. <b>force</b>: median of the largest normal force between hand and object."""


def tasks_page(
    rows: Sequence[Row],
    by_object: Sequence[Row],
    pairs: Sequence[Row],
    checks: Sequence[Check],
    notes: Sequence[str],
    films: Mapping[str, bytes],
    about: Mapping[str, str],
) -> str:
    """Return the page, which needs no other file.

    Args:
        rows: Of `rows_of_results`.
        by_object: Of `object_rows`.
        pairs: Of `pair_rows`.
        checks: Of `checks_of`.
        notes: What was left out, and why.
        films: WebP files by their captions.
        about: Command, seeds and versions, by their labels.
    """
    unmet = [check for check in checks if not check.is_met]
    verdict = (
        f"{len(unmet)} of {len(checks)} conditions are not met: see below, before the figures."
        if unmet
        else f"All {len(checks)} conditions below are met."
    )
    parts = [
        "<h1>Tasks in closed loop</h1>",
        f"<p>{_INTRODUCTION}</p>",
        f"<p><b>Is the judge sound?</b> {escape(verdict)}</p>",
        _table(rows),
        _list(notes),
        "<h2>Whether the judge is sound</h2>",
        _checks(checks),
        "<h2>Neighbours over the same scenes</h2>",
        "<p>Scenes in which one of the two alone succeeds, and McNemar's exact probability of so "
        "uneven a split by chance. Pairs are told apart below 5 %.</p>",
        _table(pairs),
        "<h2>By object</h2>" if by_object else "",
        _table(by_object),
        "<h2>Films</h2>" if films else "",
        "<p>The first scene, at half its speed.</p>" if films else "",
        *(_figure(caption, film) for caption, film in films.items()),
        "<h2>About</h2>",
        _table([{"what": label, "value": text} for label, text in about.items()]),
    ]
    body = "\n".join(part for part in parts if part)
    return (
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
        f"<title>Tasks in closed loop</title>\n<style>{_STYLE}</style>\n{body}\n</html>\n"
    )


def _table(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    heads = "".join(f"<th>{escape(name)}</th>" for name in rows[0])
    lines = ["".join(map(_cell, row.values())) for row in rows]
    body = "\n".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table>\n<tr>{heads}</tr>\n{body}\n</table>"


def _cell(value: str | float) -> str:
    kind = "" if isinstance(value, str) else ' class="number"'
    return f"<td{kind}>{escape(str(value))}</td>"


def _checks(checks: Sequence[Check]) -> str:
    lines = []
    for check in checks:
        kind = "" if check.is_met else ' class="unmet"'
        cells = (check.what, check.where, "yes" if check.is_met else "no", check.text)
        line = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
        lines.append(f"<tr{kind}>{line}</tr>")
    heads = "<tr><th>condition</th><th>of</th><th>met</th><th>measured</th></tr>"
    return "\n".join(["<table>", heads, *lines, "</table>"])


def _list(notes: Sequence[str]) -> str:
    if not notes:
        return ""
    items = "\n".join(f"<li>{escape(note)}</li>" for note in notes)
    return f"<ul>\n{items}\n</ul>"


def _figure(caption: str, film: bytes) -> str:
    source = f"data:image/webp;base64,{b64encode(film).decode()}"
    text = escape(caption)
    return (
        f'<figure><img src="{source}" alt="{text}" loading="lazy">'
        f"<figcaption>{text}</figcaption></figure>"
    )
