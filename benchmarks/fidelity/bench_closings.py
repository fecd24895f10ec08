"""How quickly people close their fingers, and which robot hands can follow.

    python benchmarks bench_closings

*People*: the time of each closing of a finger in the recordings, and in the one that comes with the
package (`handmap_qp.apps.offline.closings`). *Robots*: the time from a flat hand to a fist at the
speed limits of the joints (`handmap_qp.mapping.fist_time`), its slowest joint, and whether it is
slower than nearly all closings of people (`PERSON_FIST_TIME`).
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
from collections.abc import Sequence
from typing import Any

import numpy as np

from handmap_qp import HandmapError, Recording, load_hand, read_recording
from handmap_qp.apps.offline.closings import closing_times
from handmap_qp.hands import HUMAN_HANDS, hand_names, joined, load_whole, robot_files
from handmap_qp.human import human_name
from handmap_qp.mapping import PERSON_FIST_TIME, fist_time
from handmap_qp.trackers import DEMO, SIDES

_SHARES = (5, 50, 95)
_FIST = "fist, s"


def main(words: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Run the benchmark, and return the rows of the robots."""
    parser = common.make_parser("How quickly people close their fingers, and robots.")
    parser.add_argument("--hands", nargs="+", help="names, or paths of hand.yaml files")
    arguments = common.parse_arguments(parser, words)
    files = common.find_recordings(arguments.recordings)
    recordings = [read_recording(DEMO, "right")]
    if not arguments.quick:
        recordings += map(read_recording, files)
    people = measure_people(recordings)
    own = [name for name in hand_names() if name not in HUMAN_HANDS]
    names = arguments.hands or [*own, *robot_files()][: 2 if arguments.quick else None]
    robots = []
    with common.progress("robots", len(names)) as advance:
        for name in names:
            robots.append(measure_robot(name))
            advance()
    is_json = arguments.json == "-"
    common.print_table("People: time of a closing", people, to_stderr=is_json)
    title = f"Robots: flat hand to fist; slow above {PERSON_FIST_TIME:g} s"
    common.print_table(title, robots, to_stderr=is_json)
    found = {"people": people, "robots": robots}
    common.write_json(arguments.json, "bench_closings", found)
    common.save_picture(arguments.picture, lambda: draw(robots))
    return robots


def measure_people(recordings: Sequence[Recording]) -> list[dict[str, Any]]:
    """Return a row for each recording in which fingers close, and one for all of them."""
    times = {recording.name: closing_times(recording) for recording in recordings}
    times["all"] = np.concatenate([*times.values()])
    rows = []
    for name, found in times.items():
        if len(found):
            shares = zip(_SHARES, np.percentile(found, _SHARES), strict=True)
            texts = {f"p{share}, s": f"{time:.2f}" for share, time in shares}
            rows.append({"recording": name, "closings": len(found), **texts})
    return rows


def measure_robot(name: str) -> dict[str, Any]:
    """Return the row of a robot hand, or of a robot with two."""
    row = {"robot": name, _FIST: "-", "slowest joint": "", "slow": "", "speeds": ""}
    human = joined("human", *(load_hand(human_name(side)) for side in SIDES))
    try:
        found = fist_time(human, load_whole(name))
    except HandmapError as error:
        # A hand whose package is not installed, for example.
        return row | {"slowest joint": str(error)}
    return row | {
        _FIST: f"{found.time:.2f}",
        "slowest joint": found.joint,
        "slow": "yes" if found.is_slow else "",
        "speeds": "assumed" if found.is_assumed else "",
    }


def draw(robots: Sequence[dict[str, Any]]) -> Any:
    """Draw the time of each robot as a bar, and that above which a robot is slow."""
    from matplotlib.figure import Figure

    known = [row for row in robots if row[_FIST] != "-"]
    figure = Figure(figsize=(7, 0.25 * len(known) + 1.2), layout="constrained")
    axes = figure.subplots()
    axes.barh(
        [row["robot"] for row in known],
        [float(row[_FIST]) for row in known],
        color="0.4",
    )
    axes.axvline(PERSON_FIST_TIME, color=common.PALETTE[0])
    axes.invert_yaxis()
    axes.set_xlabel("time from a flat hand to a fist [s]")
    return figure


if __name__ == "__main__":
    main()
