"""Hands on arms against the same hands without: fingers, and how far the arm is off.

    python benchmarks bench_arms
    python benchmarks bench_arms --arms ur5_allegro --json arms.json

Every recording is mapped by `teleoperation` on each arm and on its bare hand, at two scales of
the palm's way, in a world with +z up and in one with +y up (`alignment="y-up"`). `d` columns are
the arm's figures minus the bare hand's: correlation of the extensions, direction of the fingers
[deg], closed pinches. `off` is how far the wrist is from its target (median and 95th percentile),
`held by` what holds it there, as shares of the samples in which it is 20 mm off.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import shared_hands

from handmap_core.human.recording import mirrored
from handmap_core.mapping.alignment import rotation_of
from handmap_core.mapping.step import arm_held_by
from handmap_qp import Hand, HandMapper, Recording, read_recording
from handmap_qp.apps.offline.comparison import Take, prepare_take
from handmap_qp.apps.offline.fidelity import assess_fidelity
from handmap_qp.apps.offline.hand_trace import trace_robot
from handmap_qp.apps.offline.trajectory import Trajectory, map_recording
from handmap_qp.mapping.presets import preset_choice
from handmap_qp.se3 import affine

BARE = {
    "ur5_allegro": "allegro_right",
    "g1_arm_left": "g1_left",
    "tiago_arm": "hey5",
}
SCALES = (1.0, 0.4)
_OFF = 0.02
_FIGURES = (
    ("extension", "extension_correlation"),
    ("direction", "finger_direction_deg"),
    ("pinches", "pinch_closed"),
)


def in_z_up(recording: Recording) -> Recording:
    """Turn a recording of a headset, with +y up, so that +z is up and +x forward."""
    turn = affine(rotation_of("y-up"), np.zeros(3))
    landmarks = recording.landmarks @ turn[:3, :3].T
    wrist = None if recording.wrist is None else turn @ recording.wrist
    return replace(recording, landmarks=landmarks, wrist=wrist)


def follow(
    robot: Hand, take: Take, scale: float = 1.0, alignment: str = "world"
) -> tuple[Trajectory, dict[str, Any]]:
    """Map a take, and measure what the fingers show."""
    _, method, ik = preset_choice("teleoperation", take.human)
    method = method.replaced(scale=scale, alignment=alignment)
    mapper = HandMapper(take.human, robot, method, ik=ik)
    recording = take.recording
    found = map_recording(mapper, recording, wrist_poses=take.wrist, is_guarded=False)
    fidelity = assess_fidelity(
        take.trace,
        trace_robot(robot, found.q, found.wrist if robot.is_floating else None),
        recording.time,
        recording.valid,
        replace(found, robot=robot),
        take.q,
    )
    return found, fidelity.values


def measure(name: str, recording: Recording) -> list[dict[str, Any]]:
    """Measure an arm on one recording; return a row for each scale and world."""
    arm, bare = (shared_hands.load(one) for one in (name, BARE[name]))
    if recording.side != arm.spec.side:
        # In the headset's world, whose x is to the side.
        recording = mirrored(recording)
    takes = {
        up: prepare_take(seen, arm.spec.side)
        for up, seen in {"y": recording, "z": in_z_up(recording)}.items()
    }
    _, alone = follow(bare, takes["y"])
    rows = []
    for (up, take), scale in product(takes.items(), SCALES):
        found, values = follow(arm, take, scale, "y-up" if up == "y" else "world")
        seen = take.recording.valid
        off = found.wrist_error[seen]
        reasons = arm_held_by(arm, found.at_speed_limit, found.at_limit)[seen]
        late = Counter(reasons[off > _OFF].tolist())
        row = {"arm": name, "recording": recording.name, "up": up, "scale": scale}
        row |= {f"d {short}": values[key] - alone[key] for short, key in _FIGURES}
        row["off_mm"], row["off p95_mm"] = 1e3 * np.percentile(off, [50, 95])
        row["held by"] = ", ".join(
            f"{reason} {100 * count / late.total():.0f} %"
            for reason, count in late.most_common()
        )
        rows.append(row)
    return rows


def draw(rows: list[dict[str, Any]]) -> Any:
    """Draw how far each arm is off its target."""
    from matplotlib.figure import Figure

    figure = Figure((7.0, 1.0 + 0.14 * len(rows)), layout="constrained")
    axes = figure.subplots()
    names = ["{arm}, {recording}, {scale:g}, +{up}".format(**row) for row in rows][::-1]
    axes.barh(names, [row["off p95_mm"] for row in rows][::-1], color=common.PALETTE[1])
    axes.tick_params(axis="y", labelsize=6)
    axes.set(title="wrist off its target, 95th percentile", xlabel="mm")
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser("Hands on arms against the same hands without.")
    parser.add_argument("--arms", nargs="+", default=[*BARE], metavar="HAND")
    arguments: argparse.Namespace = common.parse_arguments(parser, words)
    recordings = [
        read_recording(file) for file in common.find_recordings(arguments.recordings)
    ]
    if arguments.quick:
        recordings = [recordings[0].part(slice(200))]
        arguments.arms = arguments.arms[:1]
    rows = [
        row
        for name in arguments.arms
        for recording in recordings
        for row in measure(name, recording)
    ]
    common.print_table("Hands on arms", rows, to_stderr=arguments.json == "-")
    common.save_picture(arguments.picture, lambda: draw(rows))
    common.write_json(arguments.json, "bench_arms", {"rows": rows})


if __name__ == "__main__":
    main()
