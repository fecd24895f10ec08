"""What slow joints cost, what helps, and how far ahead one would have to know a pinch.

    python benchmarks bench_slow --hand svh_right

Every recording is mapped to one hand within its speed limits, in several ways:

- as it is, and with the pinch before the rest (`pinch_weight` 15 in place of 5);
- *together*: straight to the posture without speed limits, all joints of a pinch in one time;
- *predicted*: fingers go on at their speed of the last 80 ms, but those that pinch;
- *future known*: what the person does that much later, which no prediction can better;
- *pinch known*: thumb and finger go to a pinch that begins within that time.

Only the input differs, or the weight; limits, mapping and metrics are those of `handmap compare`.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from handmap_qp import HandMapper, load_hand
from handmap_qp.apps.offline.comparison import (
    ComparedMethod,
    Take,
    compare_methods,
    prepare_take,
)
from handmap_qp.apps.offline.fidelity import PINCH
from handmap_qp.apps.offline.metrics import METRICS
from handmap_qp.apps.offline.trajectory import RobotMotion, Trajectory, map_recording
from handmap_qp.hands.fingers import find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.human import tip_gaps
from handmap_qp.se3 import Array, inverse_pose, lengths, transform_points
from handmap_qp.trackers.formats import read_recording

_SHOWN = (
    "extension_correlation",
    "latency_ms",
    "pinch_closed",
    "pinch_gap_p95_mm",
    "pinch_false",
    "tip_error_knuckles_mm",
    "jerk_ratio",
)
# Speeds of landmarks are slopes over this time [s].
_WINDOW = 0.08
# Nothing is predicted where the gap of thumb and finger is smaller, and all beyond the sum [m].
_NEAR = 0.015
_OVER = 0.03
# A pinch is one of fingers that are this near [m].
_COMING = 0.07


def main(words: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Run the benchmark, and return the rows of the table."""
    parser = common.make_parser("What slow joints cost, and what helps.")
    parser.add_argument("--hand", default="hey5", help="name, or path of a hand.yaml")
    arguments = common.parse_arguments(parser, words)
    files = common.find_recordings(arguments.recordings)
    recordings = [read_recording(file) for file in files]
    if arguments.quick:
        recordings = [recordings[0].part(slice(200))]
    hand = load_hand(arguments.hand)
    takes = [prepare_take(recording, hand.side) for recording in recordings]
    methods = compared(is_quick=arguments.quick)
    with common.progress("mapping", len(methods) * len(takes)) as advance:
        comparison = compare_methods(takes, hand, methods, lambda *_: advance())
    rows = [
        {"way": name}
        | {m.label: m.text(comparison.overall[name][m.key]) for m in _metrics()}
        for name in comparison.methods
    ]
    title = f"{hand.name}, means over {len(takes)} recordings"
    common.print_table(title, rows, to_stderr=arguments.json == "-")
    common.write_json(arguments.json, "bench_slow", {"hand": hand.name, "ways": rows})
    common.save_picture(arguments.picture, lambda: draw(rows))
    return rows


def _metrics() -> list[Any]:
    return [next(metric for metric in METRICS if metric.key == key) for key in _SHOWN]


def compared(*, is_quick: bool) -> list[ComparedMethod]:
    """Return the ways to compare."""
    ways: dict[str, Callable[[Take, Hand], RobotMotion]] = {
        "as it is": mapped,
        "pinch first": partial(mapped, pinch_weight=15.0),
        "together": together,
    }
    changes = (
        ("predicted", predicted, (0.1, 0.2)),
        ("future known", ahead, (0.1, 0.2)),
    )
    for name, change, times in (
        *changes,
        ("pinch known", intended, (0.2, 0.4, 0.6, 1.0)),
    ):
        for time in times[: 1 if is_quick else None]:
            ways[f"{name}, {time:g} s"] = partial(mapped, change=partial(change, time))
    return [ComparedMethod(name, way) for name, way in ways.items()]


def mapped(
    take: Take,
    hand: Hand,
    change: Callable[[Take], Array] | None = None,
    **options: Any,
) -> RobotMotion:
    """Map a take, or other landmarks in the palm in their place, shape (T, 21, 3)."""
    if change:
        landmarks = transform_points(take.trace.palm, change(take))
        seen = take.recording.valid[:, None, None]
        landmarks = np.where(seen, landmarks, take.recording.landmarks)
        take = replace(take, recording=replace(take.recording, landmarks=landmarks))
    return _trajectory(take, hand, **options)


def _trajectory(
    take: Take, hand: Hand, *, has_limits: bool = True, **options: Any
) -> Trajectory:
    """Map a take as `handmap compare` does."""
    mapper = HandMapper(take.human, hand)
    method: Any = mapper.method
    ik = mapper.ik.replaced(has_velocity_limits=has_limits)
    mapper.configure(method.replaced(**options), ik=ik)
    wrist = take.wrist
    found = map_recording(mapper, take.recording, wrist_poses=wrist, is_guarded=False)
    return replace(found, robot=hand)


def together(take: Take, hand: Hand) -> RobotMotion:
    """Go straight to the posture without speed limits; joints of a pinch arrive together."""
    goal = _trajectory(take, hand, has_limits=False)
    chains = find_fingers(hand)
    local = _local(take)
    gaps = tip_gaps(local)
    pairs = [
        (i, np.union1d(chains["thumb"].columns, chains[name].columns))
        for i, name in enumerate(("index", "middle", "ring", "little"))
        if {"thumb", name} <= chains.keys()
    ]
    q = goal.q.copy()
    for k, dt in enumerate(np.diff(take.recording.time), start=1):
        most = hand.velocity_limits * dt
        way = goal.q[k] - q[k - 1]
        near = [(gaps[k, i], columns) for i, columns in pairs if gaps[k, i] < _COMING]
        if near:
            _, columns = min(near, key=lambda pair: pair[0])
            way[columns] /= max(1.0, (np.abs(way) / most)[columns].max())
        q[k] = q[k - 1] + np.clip(way, -most, most)
    return replace(goal, q=q)


def _local(take: Take) -> Array:
    """Return the landmarks in the palm, shape (T, 21, 3)."""
    return transform_points(inverse_pose(take.trace.palm), take.recording.landmarks)


def predicted(horizon: float, take: Take) -> Array:
    """Let the fingers go on at their speed, with bones as long as they are."""
    local = _local(take)
    time = take.recording.time
    shares = _opening(local)
    moved = local.copy()
    for i in range(len(time)):
        window = np.arange(np.searchsorted(time, time[i] - _WINDOW), i + 1)
        window = window[take.recording.valid[window]]
        if len(window) < 3:
            continue
        since = time[window] - time[window].mean()
        speed = np.tensordot(since, local[window], 1) / since.dot(since)
        later = (
            local[i] + horizon * shares[i].repeat([1, 4, 4, 4, 4, 4])[:, None] * speed
        )
        for joint in set(range(1, 21)) - {1, 5, 9, 13, 17}:
            bone = later[joint] - later[joint - 1]
            length = lengths(local[i, joint] - local[i, joint - 1])
            moved[i, joint] = moved[i, joint - 1] + length * bone / lengths(bone)
    return moved


def _opening(local: Array) -> Array:
    """Return the share of its prediction that the wrist and each finger have, shape (T, 6)."""
    gaps = tip_gaps(local)
    share = np.clip((gaps - _NEAR) / _OVER, 0.0, 1.0)
    share = share * share * (3.0 - 2.0 * share)
    return np.column_stack([np.zeros(len(gaps)), share.min(axis=1), share])


def ahead(horizon: float, take: Take) -> Array:
    """Return what the person does that much later."""
    seen = np.flatnonzero(take.recording.valid)
    time = take.recording.time[seen]
    later = np.searchsorted(time, take.recording.time + horizon)
    return _local(take)[seen[later.clip(0, len(seen) - 1)]]


def intended(horizon: float, take: Take) -> Array:
    """Bring thumb and finger to the next pinch within that time; the others stay."""
    local = _local(take)
    time = take.recording.time
    gaps = tip_gaps(local)
    pinches = (gaps < PINCH) & take.recording.valid[:, None]
    moved = local.copy()
    for i in np.flatnonzero(take.recording.valid):
        coming = np.argwhere(pinches[i : np.searchsorted(time, time[i] + horizon)])
        if len(coming):
            later, finger = coming[0]
            for first in (1, 5 + 4 * finger):
                moved[i, first : first + 4] = local[i + later, first : first + 4]
    return moved


def draw(rows: list[dict[str, Any]]) -> Any:
    """Draw the share of pinches that close, a bar each way."""
    label = next(m.label for m in _metrics() if m.key == "pinch_closed")
    shares = {row["way"]: row[label] for row in rows}
    return common.draw_shares(shares, "share of pinches that close")


if __name__ == "__main__":
    main()
