"""Which objects robots hold that follow a person who picks: mappings and peers, over a dozen picks.

    python benchmarks bench_grips --seed 1 --json grips.json --picture grips.png
    python benchmarks bench_grips --objects household --robots allegro_right --trials 12

Every robot follows every recording of `picks.py` by every mapping, and tries objects of
`random_trials` (`varied`: cubes, balls and cylinders, 20 to 45 mm) or of `HOUSEHOLD`, each at a
random place. All mappings and robots get the same objects and displacements. Torques are those
of the makers. Shares of the objects that are held have intervals (95 %, Wilson).

`teleoperation+grip` is the mapping with `GripFollower`: the robot's measured joints go back to it,
and what thumb and finger have met is held with 5 N. It knows nothing else of the object;
`teleoperation+grip+place` knows where the object's middle is. `+place5` and `+place10` know a place
that is wrong by 5 and 10 mm (standard deviation along each axis), and how wrong it may be.

A trial that cannot start, because the open hand overlaps the object or its pads are less than 15 mm
clear of it, is refused: it counts in no share, but beside it. A mapping that holds few and has many
refused is no better for it. The results are written after each recording, so that a run that is
stopped leaves what it has found.

Two of the twelve recordings are closings of a fist, which `handmap simulate` refuses. They are kept
so that figures stay comparable; --no-fists leaves them out.

Seeds 0 to 99 are for work. The tables of docs/simulation_results.md have seeds that were looked at
once.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from peers import build
from picks import HOUSEHOLD, picks

from handmap_qp import Recording, load_hand
from handmap_qp.apps.offline.comparison import prepare_take
from handmap_qp.apps.simulation.commands import (
    GripName,
    chosen_methods,
    find_pinch,
)
from handmap_qp.apps.simulation.gripping import GripScene
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.pinch import PinchScene, PinchTrial, random_trials
from handmap_qp.apps.simulation.pinch_rows import success_rate
from handmap_qp.apps.simulation.tried import REFUSED
from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.mapping import PRESETS

PEERS = common.ROOT / "benchmarks" / "peers"
OWN = ("teleoperation", "fingertip-vectors")
GRIPS = (
    "teleoperation+grip",
    "teleoperation+grip+place",
    "teleoperation+grip+place5",
    "teleoperation+grip+place10",
)
"""Mappings with a grip that run by default; `GripName` says what they know of the place."""
OTHERS = ("dex-dexpilot", "dexi-dexpilot", "dex-vector", "dexi-vector", "dex-position")
# Gravity points against y, as in the worlds of all recordings.
_GRAVITY = (0.0, -9.81, 0.0)


def draw(objects: str, count: int, seed: int) -> list[tuple[str, PinchTrial]]:
    """Draw objects and places, with the kind of each."""
    if objects == "varied":
        trials = random_trials(count, seed)
        return [(type(trial.shape).__name__.lower(), trial) for trial in trials]
    # Each recording goes on in the list, so that a few trials of each see all objects.
    names = [list(HOUSEHOLD)[(seed + k) % len(HOUSEHOLD)] for k in range(count)]
    places = random_trials(count, seed, "nominal")
    return [
        (
            name,
            HOUSEHOLD[name]._replace(
                offset=place.offset, yaw=place.yaw, place_error=place.place_error
            ),
        )
        for name, place in zip(names, places, strict=True)
    ]


def held_cells(
    name: str, found: Sequence[dict[str, Any]]
) -> tuple[dict[str, Any], list[dict[str, Any]], list[dict[str, Any]]]:
    """Summarise how many are held; `held` of a refused trial is None.

    Returns:
        The first cells of a row, the trials that were tried, and those that held.
    """
    tried = [each for each in found if each["held"] is not None]
    held = [each for each in tried if each["held"]]
    shown = "-"
    if tried:
        rate, low, high = success_rate(len(held), len(tried))
        shown = f"{100.0 * rate:.0f} ({100.0 * low:.0f}-{100.0 * high:.0f})"
    refused = len(found) - len(tried)
    cells = {"": name, "held %": shown, "trials": len(tried), "refused": refused}
    return cells, tried, held


def medians(found: Sequence[dict[str, Any]], keys: Sequence[str]) -> dict[str, str]:
    """Return the median of each of some values, or a dash without any."""
    return {
        key: f"{np.median([each[key] for each in found]):.3g}" if found else "-"
        for key in keys
    }


def row(name: str, found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Summarise trials in a row of a table."""
    cells, _, held = held_cells(name, found)
    return cells | medians(held, ("slip mm", "slide mm", "force N", "torque N m"))


def tables(found: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return tables by titles: by mapping, with robot, recording, and object, and causes."""
    shown = {"By mapping": common.rows_by(found, ("mapping",), row)}
    shown |= {
        f"By {key} and mapping": common.rows_by(found, (key, "mapping"), row)
        for key in ("robot", "recording", "object")
    }
    if rows := losses(found):
        shown["Why objects were not held"] = rows
    return shown


def losses(
    found: Sequence[dict[str, Any]], key: str = "mapping"
) -> list[dict[str, Any]]:
    """Return how many objects were lost by each cause, the most frequent cause first.

    Args:
        found: The trials.
        key: What the columns of the table are of.
    """
    lost = Counter(
        (each.get("loss") or REFUSED, each[key]) for each in found if not each["held"]
    )
    causes: Counter[str] = Counter()
    for (cause, _), count in lost.items():
        causes[cause] += count
    names = dict.fromkeys(each[key] for each in found)
    return [
        {"why": cause} | {name: lost[cause, name] for name in names}
        for cause, _ in causes.most_common()
    ]


def draw_shares(found: Sequence[dict[str, Any]], title: str) -> Any:
    """Draw the share that each mapping holds on each robot, with its 95 % interval."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.5), layout="constrained")
    axes = figure.subplots()
    robots = list(dict.fromkeys(each["robot"] for each in found))
    names = list(dict.fromkeys(each["mapping"] for each in found))
    for k, name in enumerate(names):
        for place, robot in enumerate(robots):
            held = [
                each["held"]
                for each in found
                if (each["mapping"], each["robot"]) == (name, robot)
                and each["held"] is not None
            ]
            if held:
                rate, low, high = 100.0 * np.array(success_rate(sum(held), len(held)))
                axes.errorbar(
                    place + 0.1 * (k - (len(names) - 1) / 2.0),
                    rate,
                    [[rate - low], [high - rate]],
                    fmt="o",
                    color=common.PALETTE[k % len(common.PALETTE)],
                    label=name if place == 0 else None,
                )
    axes.set_xticks(range(len(robots)), robots)
    axes.set(ylabel="held [%]", ylim=(0.0, 103.0), title=title)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def is_fist(recording: Recording) -> bool:
    """Return whether thumb and index finger close without facing each other."""
    try:
        find_pinch(recording)
    except InvalidInputError:
        return True
    return False


def tried(scene: PinchScene, trial: PinchTrial) -> dict[str, Any]:
    """Return what became of an object."""
    try:
        outcome = scene.run(trial)
    except InvalidInputError as refusal:
        return {"held": None, "refused": str(refusal)}
    return {
        "held": outcome.is_held,
        "slip mm": 1e3 * outcome.slip,
        "slide mm": 1e3 * outcome.slide,
        "force N": float(outcome.force),
        "torque N m": float(outcome.torque),
        "held s": float(outcome.held_time),
        "of s": float(outcome.pinch_time),
        "loss": outcome.loss or "",
    }


def grip_of(name: str) -> GripName | None:
    """Return what a name says of a grip with the default preset, the one of `GripScene`."""
    grip = GripName.parse(name)
    return grip if grip and grip.preset == OWN[0] else None


def scenes(
    robot: str, recording: Recording, methods: Sequence[str], problems: list[str]
) -> Iterator[tuple[str, PinchScene]]:
    """Yield what each mapping makes of a recording; note those that cannot map it."""
    window = find_pinch(recording, takes_fists=True)
    hand = load_hand(robot)
    take = prepare_take(recording, hand.side)
    physics = Physics(gravity=_GRAVITY)
    for name in methods:
        if grip := grip_of(name):
            deviation = grip.deviation or 0.0
            yield name, GripScene(take, hand, window, physics, grip.sees, deviation)
    plain = tuple(name for name in methods if grip_of(name) is None)
    if not plain:
        return
    are_ours = {name.partition("+")[0] for name in plain} <= PRESETS.keys()
    for method in chosen_methods(plain, None if are_ours else PEERS, robot):
        try:
            commands = method.map_take(take, hand)
        except HandmapError as error:
            where = f"{robot}, {method.name}, {recording.name}"
            problems.append(f"{where}: {error}")
        else:
            yield method.name, PinchScene(commands, window, physics)


def main(words: Sequence[str] | None = None) -> None:
    """Simulate all trials, print the tables, and write them."""
    parser = common.make_parser((__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", nargs="+", default=list(common.ROBOTS))
    parser.add_argument("--methods", nargs="+", default=None)
    parser.add_argument("--objects", choices=("varied", "household"), default="varied")
    parser.add_argument("--trials", type=int, default=5, help="for each recording")
    parser.add_argument("--picks", type=int, default=None, help="only the first ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--no-fists", action="store_true", help="leave out closings of a fist"
    )
    arguments = common.parse_arguments(parser, words)
    is_built = not build.missing_peers()
    methods = arguments.methods or [*OWN, *GRIPS, *(OTHERS if is_built else ())]
    if arguments.quick:
        arguments.robots, arguments.trials, arguments.picks = ["allegro_right"], 1, 1
        methods = ["teleoperation"]
    every = list(picks(common.find_recordings(arguments.recordings)))
    if arguments.no_fists:
        every = [recording for recording in every if not is_fist(recording)]
    recordings = every[: arguments.picks]
    found: list[dict[str, Any]] = []
    problems: list[str] = []
    results: dict[str, Any] = {}
    with common.progress("picking", len(recordings) * len(arguments.robots)) as done:
        for k, recording in enumerate(recordings):
            # Other places and objects for each recording.
            trials = draw(
                arguments.objects, arguments.trials, 1000 * arguments.seed + k
            )
            for robot in arguments.robots:
                for name, scene in scenes(robot, recording, methods, problems):
                    where = {"robot": robot, "mapping": name}
                    where["recording"] = recording.name
                    found += [
                        where | {"object": kind} | tried(scene, trial)
                        for kind, trial in trials
                    ]
                done()
            results = {"seed": arguments.seed, "trials": found, "problems": problems}
            if arguments.json != "-":
                common.write_json(arguments.json, "bench_grips", results)
    to_stderr = arguments.json == "-"
    for title, rows in tables(found).items():
        common.print_table(
            f"{title}: {arguments.objects} objects, seed {arguments.seed}",
            rows,
            to_stderr=to_stderr,
        )
    for problem in problems:
        print(problem, file=sys.stderr if to_stderr else sys.stdout)
    title = f"{arguments.objects} objects, seed {arguments.seed}"
    common.save_picture(arguments.picture, lambda: draw_shares(found, title))
    if to_stderr:
        common.write_json("-", "bench_grips", results)


if __name__ == "__main__":
    main()
