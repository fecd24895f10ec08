"""Hands as an HTML file that plays without a server: `make_page`."""

import base64
import gzip
import json
from collections.abc import Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

from handmap_qp.hands import Hand
from handmap_qp.version import __version__
from .gauges import SCENE_LEGEND, InstantGauges, error_plot
from .sample import Variant, ViewSample
from .scene import Display, HandScene
from .serving import serving

# Most samples per second in a page, and most gauges [1/s].
_RATE = 30.0
_GAUGES_RATE = 10.0
_Instants = list[tuple[ViewSample, ...]]
"""A sample of each robot, instant after instant."""


def make_page(
    title: str,
    human: Hand | None,
    variants: Sequence[Variant],
    *,
    display: Display = Display(),
) -> bytes:
    """Return one HTML file that plays samples in real time, without a server or the network.

    The page has the title, the hands, the gauges and the options.

    Args:
        title: Title of the page.
        human: The human hand; None for robots alone.
        variants: The robots, with as many samples as each other at the same times; at most 30
            samples of each second are written.
        display: What the page shows, and how.

    Returns:
        The file's content.
    """
    instants = list(zip(*(variant.samples for variant in variants), strict=True))
    with serving() as server:
        scene = HandScene(server, human, variants)
        scene.draw(instants[0], display)
        serializer = server.get_scene_serializer()
        for before, samples in pairwise(_at_rate(instants, _RATE)):
            serializer.insert_sleep(samples[0].time - before[0].time)
            scene.draw(samples, display)
        page = serializer.as_html()
    gauges = InstantGauges(variants[0].robot, human)
    start, end = (instants[i][0].time for i in (0, -1))
    count = len(instants)
    rate = f", {(count - 1) / (end - start):.0f} per second" if end > start else ""
    labels = [variant.label for variant in variants]
    gauged = _at_rate(instants, _GAUGES_RATE)
    numbers = {
        "time": [round(samples[0].time - start, 3) for samples in gauged],
        "table": [gauges.table(samples, labels) for samples in gauged],
        "bars": list(map(gauges.bars, gauged)),
    }
    # Instants are much alike, so they are small when compressed.
    packed = base64.b64encode(gzip.compress(json.dumps(numbers).encode()))
    parts = {
        "<title>Viser</title>": f"<title>{escape(title)} - handmap view</title>",
        "</head>": f"{_part('page_head.html')}</head>",
        "<body>": f"<body>{_part('page_body.html')}",
        "__VIEW__": json.dumps(scene.cameras.view),
        "__TITLE__": escape(title),
        "__FACTS__": f"{end - start:.1f} s, {count} samples{rate}, handmap_qp {__version__}",
        "__LEGEND__": SCENE_LEGEND,
        "__ERRORS__": error_plot(variants, 0),
        "__OPTIONS__": "".join(map(_option_table, variants)),
        "__GAUGES__": packed.decode(),
    }
    # Each part is put where its mark comes first.
    for mark, text in parts.items():
        page = page.replace(mark, text, 1)
    return page.encode()


def _option_table(variant: Variant) -> str:
    """Return the options of a robot's method as HTML; those that are no defaults are marked."""
    if not variant.choice:
        return ""
    rows = "".join(
        f"<tr{' class=changed' if name in type(part)().changes_to(part) else ''}>"
        f"<td>{escape(name.replace('_', ' '))}</td><td>{escape(_text(value))}</td></tr>"
        for part in (variant.choice.method, variant.choice.ik)
        for name, value in part.values.items()
    )
    return (
        f"<details open><summary>options: {escape(variant.label)}</summary>"
        f'<table class="options">{rows}</table></details>'
    )


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value or "none")


def _at_rate(instants: _Instants, rate: float) -> _Instants:
    """Return the first instant, the last one, and at most `rate` a second between them."""
    chosen = [instants[0]]
    for samples in instants[1:]:
        # Tolerance of half a millisecond: the jitter of a 30 Hz recording must not drop every other
        # sample.
        is_due = samples[0].time - chosen[-1][0].time >= 1.0 / rate - 5e-4
        if is_due or samples is instants[-1]:
            chosen.append(samples)
    return chosen


def _part(name: str) -> str:
    return Path(__file__).with_name(name).read_text("utf-8")
