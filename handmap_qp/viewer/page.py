"""Hands as an HTML file that plays without a server: `make_page`, `write_page`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

from handmap_qp.hands.hand import Hand
from handmap_qp.output_files import check_output, replaced_file
from handmap_qp.viewer.gauges import SCENE_COLOURS, InstantGauges
from handmap_qp.viewer.html_film import html_film
from handmap_qp.viewer.markup import css, legend
from handmap_qp.viewer.option_table import option_table
from handmap_qp.viewer.replay import Replay
from handmap_qp.viewer.sample import Variant, ViewSample
from handmap_qp.viewer.scene import HandScene, Solid
from handmap_qp.viewer.serving import serving
from handmap_qp.viewer.time_plot import error_plot

# Most samples per second in a page, and most gauges [1/s].
_RATE, _GAUGES_RATE = 30.0, 10.0


def check_page(path: Path) -> Path:
    """Check that a page can be written there, before any work is done.

    Raises:
        InvalidInputError: If it does not end in .html, is a folder, or its folder does not exist.
    """
    return check_output("--html", path, (".html", ".htm"))


def write_page(path: Path, page: bytes) -> None:
    """Write a page to a file.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    with replaced_file(path, "--html") as file:
        file.write(page)


def replay_page(replay: Replay) -> bytes:
    """Return a recording as a page, with the mapping that it is compared with."""
    methods = " against ".join(variant.label for variant in replay.variants)
    return make_page(
        f"{replay.name} on {replay.robot.name}, {methods}",
        replay.human,
        replay.variants,
        contact_gap=replay.contact_gap,
    )


def make_page(
    title: str,
    human: Hand | None,
    variants: Sequence[Variant],
    *,
    solid: Solid | None = None,
    contact_gap: float | None = None,
) -> bytes:
    """Return one HTML file that plays samples in real time, without a server or the network.

    The page has the title, the hands, the gauges and the options (`Variant.options`).

    Args:
        title: Title of the page.
        human: The human hand; None for robots alone.
        variants: The robots, one or two, with as many samples as each other at the same times; at
            most 30 samples of each second are written.
        solid: An object that moves with `ViewSample.object_pose` of the first robot's samples.
        contact_gap: What the tracker measures between two tips where the skin touches [m].

    Returns:
        The file's content.
    """
    instants = list(zip(*(variant.samples for variant in variants), strict=True))
    with serving() as server:
        scene = HandScene(server, human, variants, solid)
        scene.draw(instants[0])
        serializer = server.get_scene_serializer()
        shown = instants[0][0].time
        for samples in _at_rate(instants, _RATE)[1:]:
            serializer.insert_sleep(samples[0].time - shown)
            scene.draw(samples)
            shown = samples[0].time
        page = serializer.as_html()
        view = scene.cameras.view
    page = page.replace("<title>Viser</title>", f"<title>{escape(title)} - handmap view</title>", 1)
    head = _part("page_head.html").replace("__VIEW__", json.dumps(view))
    page = page.replace("</head>", head + "</head>", 1)
    body = _body(title, variants, _at_rate(instants, _GAUGES_RATE), contact_gap)
    start = page.index(">", page.index("<body")) + 1
    return (page[:start] + body + page[start:]).encode()


def _body(
    title: str,
    variants: Sequence[Variant],
    instants: Sequence[tuple[ViewSample, ...]],
    contact_gap: float | None,
) -> str:
    """Return title, gauges and options."""
    gauges = InstantGauges(variants, contact_gap)
    start, end = instants[0][0].time, instants[-1][0].time
    count = len(variants[0].samples)
    rate = f", {(count - 1) / (end - start):.0f} per second" if end > start else ""
    film = {
        "time": [round(samples[0].time - start, 3) for samples in instants],
        "table": html_film([gauges.table(samples) for samples in instants]),
        "bars": html_film([gauges.bars(samples) for samples in instants]),
    }
    parts = {
        "__TITLE__": escape(title),
        "__FACTS__": f"{end - start:.1f} s, {count} samples{rate}",
        "__LEGEND__": legend([(name, css(colour)) for name, colour in SCENE_COLOURS]),
        "__PLOT__": error_plot(variants),
        "__OPTIONS__": "".join(option_table(variant) for variant in variants),
        # A text that ends the script must not do so here.
        "__GAUGES__": json.dumps(film, separators=(",", ":")).replace("</", "<\\/"),
    }
    body = _part("page_body.html")
    for name, text in parts.items():
        body = body.replace(name, text, 1)
    return body


def _at_rate(
    instants: Sequence[tuple[ViewSample, ...]], rate: float
) -> list[tuple[ViewSample, ...]]:
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
    return files("handmap_qp.viewer").joinpath(name).read_text(encoding="utf-8")
