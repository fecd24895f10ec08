"""Noise, lost samples and slow trackers: the guarded path beside the bare one.

Every recording is disturbed and mapped to several robot hands in teleoperation: *bare* follows
every valid sample without guard and without smoothing, *guarded* is a `Follower` as it is by
default. Both are measured against the landmarks of the clean recording, by the metrics of `handmap
compare`.

Disturbances are white noise on every coordinate, white noise in depth (the z axis of the tracker's
world), samples that are lost at random, and a tracker at 30 Hz that is polled at the rate of the
recording, so that its samples repeat exactly.

    python benchmarks bench_noise --robots allegro_right leap_right --json noise.json
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import common
import numpy as np

from handmap_core.human.recording import Recording
from handmap_qp import Follower, HandMapper, load_hand, read_recording
from handmap_qp.apps.offline.comparison import Take, prepare_take
from handmap_qp.apps.offline.fidelity import SETTLING, assess_fidelity
from handmap_qp.apps.offline.hand_trace import TIP, trace_robot
from handmap_qp.apps.offline.trajectory import Trajectory, map_recording, trajectory_of
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.presets import preset_choice

HELD_OUT = ("rgb_mediapipe_right", "quest3_webxr_left")
"""Recordings that no threshold was chosen by."""
SLOW_RATE = 30.0
"""Rate of the slow tracker [Hz]."""


def white(size: float, axes: Sequence[float], recording: Recording) -> Recording:
    """Add white noise of a standard deviation [m], times a factor for each axis."""
    random = np.random.default_rng(7)
    noise = random.normal(scale=size, size=recording.landmarks.shape) * axes
    return replace(recording, landmarks=recording.landmarks + noise)


def lossy(share: float, recording: Recording) -> Recording:
    """Lose a share of the samples, at random and not the first."""
    is_lost = np.random.default_rng(8).random(len(recording)) < share
    is_lost[0] = False
    return replace(recording, valid=recording.valid & ~is_lost)


def repeated(rate: float, recording: Recording) -> Recording:
    """Repeat the samples of a slower tracker until its next one is due."""
    slots = np.floor((recording.time - recording.time[0]) * rate + 1e-6)
    first = np.searchsorted(slots, slots)
    return replace(
        recording, landmarks=recording.landmarks[first], valid=recording.valid[first]
    )


DISTURBANCES = {
    "clean": lambda recording: recording,
    "2 mm": partial(white, 0.002, (1.0, 1.0, 1.0)),
    "5 mm": partial(white, 0.005, (1.0, 1.0, 1.0)),
    "depth 10 mm": partial(white, 0.010, (0.0, 0.0, 1.0)),
    "20 % lost": partial(lossy, 0.2),
    "20 % lost, 2 mm": lambda recording: lossy(0.2, DISTURBANCES["2 mm"](recording)),
    "30 Hz polled": partial(repeated, SLOW_RATE),
    "30 Hz polled, 2 mm": lambda recording: repeated(
        SLOW_RATE, DISTURBANCES["2 mm"](recording)
    ),
}
"""What is done to a recording, by name."""


def map_disturbed(
    take: Take, robot: Hand, disturbed: Recording, *, is_guarded: bool
) -> Trajectory:
    """Map a disturbed recording, by the palm that its landmarks show."""
    _, method, ik = preset_choice("teleoperation", take.human)
    mapper = HandMapper(take.human, robot, method, ik=ik)
    if is_guarded:
        return map_recording(mapper, disturbed)
    follower = Follower(mapper, smoothing=None)
    steps = (
        follower.map(mapper.landmarks.read(points, None)[0], float(dt))
        if seen
        else None
        for points, dt, seen in zip(
            disturbed.landmarks, disturbed.steps, disturbed.valid, strict=True
        )
    )
    return trajectory_of(mapper.robot, disturbed.time, steps)


def measured(take: Take, robot: Hand, trajectory: Trajectory) -> dict[str, float]:
    """Measure a trajectory against the clean recording."""
    time = take.recording.time
    motion = replace(trajectory, robot=robot)
    trace = trace_robot(robot, motion.q, motion.wrist)
    seen = take.recording.valid
    found = assess_fidelity(take.trace, trace, time, seen, motion, take.q)
    counts = seen & (time >= time[0] + SETTLING)
    names = [name for name in take.trace.names if name in trace.names]
    human, own = (hand.part(counts, names) for hand in (take.trace, trace))
    own_tips = own.local[:, :, TIP] * (human.size / own.size)
    tips = 1e3 * np.linalg.norm(own_tips - human.local[:, :, TIP], axis=-1)
    keys = ("palm_deg", "jerk_ratio", "latency_ms", "extension_correlation")
    return {
        "tip_p95_mm": float(np.percentile(tips, 95)),
        **{key: found.values[key] for key in keys},
    }


def held_by_rule(take: Take, disturbed: Recording, run: Trajectory) -> dict[str, float]:
    """Return the share of the valid samples that were held, by rule [%]."""
    is_held = ~run.valid & disturbed.valid
    counts = Counter(run.rule[is_held].tolist())
    total = int(disturbed.valid.sum())
    return {rule: 100.0 * count / total for rule, count in counts.most_common()}


def row_of(take: Take, robot: Hand, name: str) -> dict[str, Any]:
    """Map and measure a recording with a disturbance, guarded and bare."""
    disturbed = DISTURBANCES[name](take.recording)
    runs = {
        kind: map_disturbed(take, robot, disturbed, is_guarded=kind == "guarded")
        for kind in ("bare", "guarded")
    }
    row: dict[str, Any] = {
        "recording": take.name,
        "robot": robot.name,
        "disturbance": name,
        "held": held_by_rule(take, disturbed, runs["guarded"]),
    }
    for kind, run in runs.items():
        for key, value in measured(take, robot, run).items():
            row[f"{key}_{kind}"] = value
    row["tip_ratio"] = row["tip_p95_mm_guarded"] / row["tip_p95_mm_bare"]
    return row


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each disturbance, of the recordings for tuning and of those held out."""
    table = []
    for name in DISTURBANCES:
        for label in ("tuned on", "held out"):
            of = [
                row
                for row in rows
                if row["disturbance"] == name
                and (row["recording"] in HELD_OUT) == (label == "held out")
            ]
            if not of:
                continue
            held: Counter[str] = Counter()
            for row in of:
                held.update(
                    {rule: share / len(of) for rule, share in row["held"].items()}
                )
            entry: dict[str, Any] = {
                "disturbance": name,
                "recordings": label,
                "tip p95 [mm]": pair(of, "tip_p95_mm", 1),
                "ratio": f"{np.mean([row['tip_ratio'] for row in of]):.2f}",
                "worst": f"{max(row['tip_ratio'] for row in of):.2f}",
                "palm [deg]": pair(of, "palm_deg", 1),
                "jerk": pair(of, "jerk_ratio", 2),
                "lag [ms]": pair(of, "latency_ms", 1),
                "extension": pair(of, "extension_correlation", 3),
                "held [%]": f"{sum(held.values()):.2f}",
                "by rule": ", ".join(
                    f"{rule} {share:.2f}" for rule, share in held.most_common()
                ),
            }
            table.append(entry)
    return table


def pair(rows: Sequence[dict[str, Any]], key: str, digits: int) -> str:
    """Return the means of a metric, bare and guarded."""
    means = [
        np.nanmean([row[f"{key}_{kind}"] for row in rows])
        for kind in ("bare", "guarded")
    ]
    return " / ".join(f"{mean:.{digits}f}" for mean in means)


def draw(rows: Sequence[dict[str, Any]]) -> Any:
    """Draw errors of the fingertips and jerk, for each disturbance."""
    import matplotlib.pyplot as plt

    names = list(dict.fromkeys(row["disturbance"] for row in rows))
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), sharey=True)
    titles = {"tip_p95_mm": "tips, p95 [mm]", "jerk_ratio": "jerk over the human's"}
    for axis, (key, title) in zip(axes, titles.items(), strict=True):
        for k, kind in enumerate(("bare", "guarded")):
            means = [
                np.nanmean(
                    [row[f"{key}_{kind}"] for row in rows if row["disturbance"] == name]
                )
                for name in names
            ]
            places = np.arange(len(names)) + 0.4 * k - 0.2
            axis.barh(places, means, 0.36, label=kind, color=common.PALETTE[k])
        axis.set_title(title)
    axes[0].set_yticks(np.arange(len(names)), names)
    axes[0].invert_yaxis()
    axes[-1].legend(loc="lower right")
    figure.tight_layout()
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = common.make_parser(
        "The guarded path beside the bare one, with noise, lost and repeated samples."
    )
    robots = ["allegro_right", "leap_right", "shadow_right"]
    parser.add_argument("--robots", nargs="+", default=robots, metavar="HAND")
    parser.add_argument(
        "--disturbances", nargs="+", default=list(DISTURBANCES), choices=DISTURBANCES
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names of recordings")
    arguments = common.parse_arguments(parser)
    files: list[Path] = common.find_recordings(arguments.recordings)
    if arguments.only:
        files = [file for file in files if file.stem in arguments.only]
    names = arguments.robots
    if arguments.quick:
        files = [min(files, key=lambda file: file.stat().st_size)]
        names = names[:1]
    few = slice(200 if arguments.quick else None)
    takes = [prepare_take(read_recording(file).part(few)) for file in files]
    rows = []
    total = len(takes) * len(names) * len(arguments.disturbances)
    with common.progress("noise", total) as advance:
        for robot in map(load_hand, names):
            for take in takes:
                for name in arguments.disturbances:
                    rows.append(row_of(take, robot, name))
                    advance()
    table = summary(rows)
    common.print_table(
        "bare / guarded, mean over recordings and robots",
        table,
        to_stderr=arguments.json == "-",
        caption="held: share of the samples that the tracker gave.",
    )
    common.write_json(arguments.json, "noise", {"table": table, "rows": rows})
    common.save_picture(arguments.picture, lambda: draw(rows))


if __name__ == "__main__":
    main()
