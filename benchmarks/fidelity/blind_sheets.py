"""Contact sheets for a blind ranking: the person's gesture, and a hand's by three methods, mixed.

    python benchmarks blind_sheets draw sheets --robots allegro_right leap_right
    python benchmarks blind_sheets score sheets answers.json

`draw` maps all labelled poses after one another, in a random order, by `teleoperation`, and by
dex-retargeting's vector and DexPilot (`make peers`). Each row of a sheet shows the end of a pose,
the methods A, B and C in an order of its own; `key.json` has it. A judge who sees the sheets only
ranks each row: `{"allegro_right": {"0": "B>A=C", ...}}`. `score` counts how often each method is
first; a shared place counts in parts.

The peers know no speed limits. With `--pace wait` the person waits in each pose until the robot
rests: a slow hand is judged by what it shows, and not by how much later it shows it.
"""

from __future__ import annotations

# isort: split
import argparse
import json
import sys
from pathlib import Path

import numpy as np
import shared_hands
from gesture_tours import (
    PACES,
    RATE,
    Pace,
    Pose,
    map_tour,
    read_held_back,
    read_poses,
    stream,
)
from peers.results import run_peer

from handmap_qp import Recording
from handmap_qp.apps.drawing.contact_sheet import contact_sheet, sheet_rows

METHODS = ("teleoperation", "dex-vector", "dex-dexpilot")
_ROWS = 5


def draw(
    folder: Path, robots: list[str], seed: int, poses: list[Pose], pace: Pace
) -> None:
    """Write the sheets of every robot, and the key."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(poses)).tolist()
    landmarks = np.array(list(stream(poses, order)))
    seen = np.ones(len(landmarks), dtype=bool)
    tour = Recording("tour", np.arange(len(landmarks)) / RATE, landmarks, seen, "right")
    step = len(landmarks) // len(order)
    ends = tour.part(np.arange(step - 1, len(landmarks), step))
    key: dict[str, dict[str, list[str]]] = {}
    for name in robots:
        robot = shared_hands.load(name)
        joints = [map_tour(robot, poses, order, METHODS[0], pace).q]
        joints += [
            run_peer(method, tour, robot).q[step - 1 :: step] for method in METHODS[1:]
        ]
        places = np.array([rng.permutation(len(METHODS)) for _ in order])
        mixed = [
            np.array([joints[j][i] for i, j in enumerate(column)])
            for column in places.T
        ]
        rows = sheet_rows(ends, {str(i): i for i in range(len(order))}, mixed)
        rows = [row._replace(note="") for row in rows]
        for first in range(0, len(rows), _ROWS):
            columns = [(letter, robot) for letter in "ABC"]
            figure = contact_sheet(columns, rows[first : first + _ROWS])
            figure.savefig(folder / f"{name}_{first:02d}.png", dpi=100)
        key[name] = {
            str(i): [poses[order[i]].name, *(METHODS[j] for j in places[i])]
            for i in range(len(order))
        }
        # After each robot: a later one may not be installed.
        (folder / "key.json").write_text(json.dumps(key, indent=1), encoding="utf-8")
        print(f"{name}: {len(rows)} gestures", file=sys.stderr)


def score(folder: Path, answers: Path) -> None:
    """Print how often each method is first, and the gestures that the first one lost."""
    key = json.loads((folder / "key.json").read_text(encoding="utf-8"))
    for name, ranks in json.loads(answers.read_text(encoding="utf-8")).items():
        won = dict.fromkeys(METHODS, 0.0)
        lost = []
        for row, (gesture, *methods) in key[name].items():
            best = [
                methods["ABC".index(letter.strip())]
                for letter in ranks[row].split(">")[0].split("=")
            ]
            for method in best:
                won[method] += 1.0 / len(best)
            lost += [gesture] * (METHODS[0] not in best)
        counts = ", ".join(f"{method} {won[method]:.1f}" for method in METHODS)
        print(f"{name}: {counts} of {len(key[name])}; lost: {', '.join(lost)}")


def main() -> None:
    """Run a command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(required=True, dest="command")
    drawn = commands.add_parser("draw", help="write the sheets and the key")
    drawn.add_argument("folder", type=Path)
    drawn.add_argument("--robots", nargs="+", default=["allegro_right", "leap_right"])
    drawn.add_argument("--seed", type=int, default=7)
    drawn.add_argument(
        "--held-back", action="store_true", help="poses that nothing was tuned on"
    )
    drawn.add_argument("--pace", choices=[*PACES], default="half-second")
    scored = commands.add_parser("score", help="count the first places")
    scored.add_argument("folder", type=Path)
    scored.add_argument("answers", type=Path)
    given = parser.parse_args()
    if given.command == "draw":
        poses = read_held_back() if given.held_back else read_poses()
        draw(given.folder, given.robots, given.seed, poses, PACES[given.pace])
    else:
        score(given.folder, given.answers)


if __name__ == "__main__":
    main()
