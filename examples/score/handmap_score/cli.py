"""`handmap score`: mappings and peers on public gestures, as one page."""

import json
import shlex
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

from tyro.conf import arg

from handmap_qp.apps.arguments import check_names, hinted
from handmap_qp.apps.offline.compare import Compare, methods_of, takes_of
from handmap_qp.apps.offline.comparison import (
    ComparedMethod,
    OutsideError,
    Take,
)
from handmap_qp.apps.offline.trajectory import RobotMotion, package_versions
from handmap_qp.apps.tables import print_result, progress
from handmap_qp.errors import expect, require, warn
from handmap_qp.hands import Hand, Names, load_hand
from handmap_qp.output_files import make_folder, replaced_file
from .gestures import READERS_SEED, SOURCES
from .pages import results_of, score_page, votes_page
from .scoring import FORMULA, score_hand

HANDS = (
    "allegro_right",
    "leap_right",
    "shadow_right",
    "orca_right",
    "ability_right",
    "svh_right",
)
"""Hands with thumbs of different kinds."""


class Amount(NamedTuple):
    """How much is measured, unless options say otherwise.

    Attributes:
        hands: How many of `HANDS`.
        seeds: Seeds of the performances.
        rate: Samples per second of the performances.
        pairs: Pairs of pictures to vote on, of each hand.
    """

    hands: int
    seeds: tuple[int, ...]
    rate: float
    pairs: int


QUICK = Amount(4, (0, 1), 30.0, 6)
FULL = Amount(6, (0, 1, 2, 3, 4), 60.0, 24)


@dataclass(frozen=True)
class Score:
    """Score mappings on public gestures of people's hands, and write one page.

    Every mapping follows 71 labelled poses on every hand, in an order, with durations and noise of
    each seed. Columns are those of `handmap compare`; in addition, a reader who has seen people
    only names the robot's gestures. --out gets score.html, score.json and votes.html, which asks
    people which of two robots shows a gesture better. Hands that are not installed are left out.

    Quick by default: 4 hands, 2 seeds, 30 samples a second. --full takes 6 hands, 5 seeds, 60.

    Examples:
        handmap score
        handmap score --full --peers --out score
        handmap score --hands my_hand.yaml --methods teleoperation finger-vectors --seeds 7 8

    Attributes:
        out: Folder to write to; created if it does not exist.
        hands: Hands by name, or paths of their hand.yaml.
        methods: Mappings by name, as of `handmap compare`.
        seeds: Seeds of the performances.
        recordings: Further recordings for all columns but reading.
        peers: Run the peers too.
        full: Take all hands, five seeds, and twice as many samples a second.
        json: Print JSON instead of a table.
    """

    out: Annotated[Path, arg(metavar="FOLDER")] = Path("score")
    hands: Annotated[Names, hinted("HAND...", "(default: four, or six)")] = ()
    methods: Annotated[Names, arg(aliases=("--presets",), metavar="METHOD...")] = ()
    seeds: Annotated[tuple[int, ...], hinted("SEED...", "(default: 0 1)")] = ()
    recordings: Annotated[tuple[Path, ...], hinted("FILE...")] = ()
    peers: bool = False
    full: bool = False
    json: bool = False

    @property
    def amount(self) -> Amount:
        """How much is measured by default."""
        return FULL if self.full else QUICK

    def run(self) -> None:
        """Check everything, measure, print and write.

        Raises:
            HandmapError: If a hand, mapping, seed, recording or folder cannot be used.
        """
        require("PIL.Image", "plot", "pillow")
        amount = self.amount
        seeds = self.seeds or amount.seeds
        is_right = min(seeds) >= 0 and max(seeds) < READERS_SEED
        wanted = f"different numbers from 0 to {READERS_SEED - 1}"
        expect(is_right and len({*seeds}) == len(seeds), "--seeds", wanted, value=seeds)
        robots, missing = self._robots()
        # Of the package: the hand of the robot's side.
        files = Path("demo"), *self.recordings
        requests = [Compare(files, name, self.methods, self.peers) for name in robots]
        methods = [_methods(request) for request in requests]
        make_folder(self.out, "--out")
        scores, takes = [], []
        with progress("scoring", len(robots)) as say:
            every = zip(requests, robots.values(), methods, strict=True)
            for done, (request, robot, own) in enumerate(every):
                takes = takes_of(request, robot, say)
                told = partial(say, done)
                scores.append(score_hand(robot, own, takes, seeds, amount.rate, told))
            about = {
                "command": shlex.join(["handmap", *sys.argv[1:]]),
                "seeds": ", ".join(map(str, seeds)),
                "samples a second": amount.rate,
                "score": FORMULA,
                "versions": ", ".join(package_versions()),
            }
            about |= {
                f"poses: {one.name}": f"{one.licence}, {one.credit}" for one in SOURCES
            }
            about |= {
                f"recording: {take.name}": take.recording.source for take in takes
            }
            about |= {
                f"hand: {name}": f"left out: {why}" for name, why in missing.items()
            }
            results = results_of(scores, about)
            say(len(scores), "drawing, which takes a minute")
            pages = {
                "score.json": json.dumps(results, indent=1),
                "score.html": score_page(scores, results),
                "votes.html": votes_page(scores, amount.pairs),
            }
            for name, page in pages.items():
                with replaced_file(self.out / name, "--out") as file:
                    file.write(page.encode())
        written = [self.out / name for name in pages]
        tables = {"Score, mean over the seeds": results["overview"]}
        print_result(results, tables, written, as_json=self.json)

    def _robots(self) -> tuple[dict[str, Hand], dict[str, str]]:
        """Return the hands by name, and why hands of the default list are not there."""
        if self.hands:
            check_names("--hands", self.hands)
            return {name: load_hand(name) for name in self.hands}, {}
        robots, missing = {}, {}
        for name in HANDS[: self.amount.hands]:
            try:
                robots[name] = load_hand(name)
            except ImportError as error:
                missing[name] = str(error)
                warn(f"without {name}: {error}")
        expect(robots, "--hands", "a hand that is installed", got="none")
        return robots, missing


def _methods(request: Compare) -> list[ComparedMethod]:
    """Return the mappings of a hand; peers that cannot run have a row that says why."""
    problem = OutsideError("not run; `make peers` in a checkout, then --peers")
    if request.peers:
        try:
            return methods_of(request)
        except OutsideError as error:
            problem = error

    def fail(take: Take, robot: Hand) -> RobotMotion:
        raise problem

    return [*methods_of(replace(request, peers=False)), ComparedMethod("peers", fail)]
