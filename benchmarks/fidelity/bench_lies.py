"""Which mistakes in recordings are found within a second, and how often a good one is refused.

Every mistake of `lies.py` is put into every recording, and into motions of the human model. Windows
of one second that start every quarter of a second are given to the check that `handmap retarget`
and the service use, sample by sample. A mistake counts as found if the check reports anything, and
as named if it reports the right kind. Windows that a mistake hardly changes are left out
(`lies.is_visible`).

Mistakes that show only in the course of a stream go through the guard with the tracker's own wrist
in our axes, from the first sample to the last. False alarms are counted on takes as they are, with
Wilson's intervals at 95 %.

A file has no time of arrival. What `handmap retarget` finds in whole ones, by
`trackers.file_evidence`, has a table of its own: time at another rate, wrists that were
not measured, hands that slowly grow.
"""

from __future__ import annotations

import common

# isort: split

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import lies
import numpy as np

from handmap_core.core import core
from handmap_core.human.recording import Recording
from handmap_core.human.sample import HumanSample, Verdict, human_name
from handmap_core.trackers.hand_geometry import log_size, palmar_evidence
from handmap_qp import InvalidInputError, load_hand, read_recording
from handmap_qp.hands import Side
from handmap_qp.human.measure import measure_hand
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.trackers.file_evidence import hints, recording_facts
from handmap_qp.trackers.layouts.tables import load_layout
from handmap_qp.trackers.plausibility import InputCheck, examine_recording

WINDOW = 1.0  # s
EVERY = 0.25  # s
NOISES = (0.0, 0.002, 0.005)  # m, of every coordinate
_PART = 4.0  # s; of parts of recordings that count as whole ones
LEAST_SAMPLES = 12  # of a window, so that it is none of a tracker that lost the hand


def read_takes(files: Sequence[Path]) -> list[lies.Take]:
    """Read the valid samples of recordings."""
    takes = []
    for file in files:
        recording = read_recording(file)
        seen = recording.valid
        wrist = recording.wrist
        poses = np.tile(np.eye(4), (len(recording), 1, 1)) if wrist is None else wrist
        takes.append(
            lies.Take(
                recording.name,
                recording.time[seen],
                recording.landmarks[seen],
                poses[seen],
                recording.side,
            )
        )
    return takes


def windows(take: lies.Take, every: float) -> list[lies.Take]:
    """Return the windows of a take that have enough samples."""
    starts = np.arange(take.time[0], take.time[-1] - WINDOW + 1e-9, every)
    parts = [take.part(float(start), WINDOW) for start in starts]
    return [part for part in parts if len(part.time) >= LEAST_SAMPLES]


def judge(take: lies.Take) -> str:
    """Return the kind of mistake that the check reports within a window; empty for none."""
    check = InputCheck(take.side)
    for time, landmarks, wrist in zip(
        take.time, take.landmarks, take.wrist, strict=True
    ):
        if finding := check.update(time, landmarks, wrist):
            return finding.kind
    finding = check.finish()
    return "" if finding is None else finding.kind


def measure(
    takes: Sequence[lies.Take], every: float, advance: Callable[[], None]
) -> list[dict[str, Any]]:
    """Return a row for no mistake and for each mistake, with a share for every take [%]."""
    truth = lies.Lie("none (false alarms)", "", lambda take: take)
    parts = {take.name: windows(take, every) for take in takes}
    rows = []
    for lie in (truth, *lies.all_lies()):
        row: dict[str, Any] = {"mistake": lie.name}
        found = named = total = 0
        for name, own in parts.items():
            told = [judge(lie.tell(part)) for part in own if lies.is_visible(lie, part)]
            row[name] = (
                100.0 * np.mean([bool(kind) for kind in told]) if told else float("nan")
            )
            found += sum(bool(kind) for kind in told)
            named += sum(kind == lie.kind for kind in told)
            total += len(told)
            advance()
        row |= {"windows": total, "found %": 100.0 * found / max(total, 1)}
        row["named %"] = float("nan") if lie is truth else 100.0 * named / max(total, 1)
        rows.append(row)
    return rows


def run_guard(take: lies.Take, arrival: np.ndarray, of: lies.Take) -> list[Verdict]:
    """Judge a take as a live stream, for the person of another one."""
    valid = np.ones(len(of.time), dtype=bool)
    lengths = measure_hand(Recording(of.name, of.time, of.landmarks, valid, of.side))
    guard = StreamGuard(
        load_hand(human_name(of.side), points="landmarks", lengths=lengths)
    )
    return [
        guard.check(HumanSample(time, take.side, landmarks, wrist), arrival=now)
        for time, landmarks, wrist, now in zip(
            take.time.tolist(),
            take.landmarks,
            take.wrist,
            arrival.tolist(),
            strict=True,
        )
    ]


def measure_live(takes: Sequence[lies.Take]) -> list[dict[str, Any]]:
    """Return for each mistake how often and how soon it is found in a stream.

    `full speed before` is the share of a stream's samples that are followed at full speed until the
    mistake is named, or to the end.
    """
    rows, takes = [], [lies.with_our_axes(take) for take in takes]
    for lie in (lies.Lie("none", "", lambda take: take), *lies.live_lies()):
        delays, before, slow, held = [], [], [], []
        for take in takes:
            verdicts = run_guard(lie.tell(take), take.time, take)
            found = [
                i for i, verdict in enumerate(verdicts) if verdict.finding is not None
            ]
            first = found[0] if found else len(verdicts)
            delays += [take.time[first] - take.time[0]] if found else []
            follows = np.array([not verdict.is_held for verdict in verdicts])
            is_slow = np.array([verdict.speed < 1.0 for verdict in verdicts])
            before.append(100.0 * (follows & ~is_slow)[:first].sum() / len(verdicts))
            slow.append(100.0 * (follows & is_slow).mean())
            held.append(100.0 * (~follows).mean())
        rows.append(
            {
                "mistake in a stream": lie.name,
                "found": f"{len(delays)} of {len(takes)}",
                "median [s]": float(np.median(delays)) if delays else float("nan"),
                "latest [s]": max(delays, default=float("nan")),
                "full speed before [%]": float(np.mean(before)),
                "most of one [%]": max(before),
                "slow [%]": float(np.mean(slow)),
                "held [%]": float(np.mean(held)),
            }
        )
    return rows


def measure_false_alarms(
    groups: dict[str, Sequence[lies.Take]],
) -> list[dict[str, Any]]:
    """Return how often takes as they are are held or refused, by the rules of mistakes."""
    rows = []
    for name, takes in groups.items():
        verdicts = [v for take in takes for v in run_guard(take, take.time, take)]
        apart = [part for take in takes for part in windows(take, WINDOW)]
        counts = {
            "samples": (sum(v.finding is not None for v in verdicts), len(verdicts)),
            "windows of 1 s": (sum(bool(judge(part)) for part in apart), len(apart)),
            "takes": (sum(bool(judge(take)) for take in takes), len(takes)),
        }
        row: dict[str, Any] = {"people": name}
        for unit, (wrong, total) in counts.items():
            low, high = wilson(wrong, total)
            row[unit] = f"{wrong} of {total} ({100 * low:.2g} to {100 * high:.2g} %)"
        rows.append(row)
    return rows


def measure_left_out(people: dict[str, Sequence[lies.Take]]) -> list[dict[str, Any]]:
    """Return how often a person is refused by limits that were set without this person.

    Today's limits lie at some distance from the extreme of all people. For each person, a limit is
    set at that distance from the extreme of all others, in batches of 16 samples.
    """
    limits = {
        "bends back": -core.BACKWARDS,
        "other side": core.SURE_SIDE,
    }
    limits["size"] = np.log(core.RESIZED)
    found: dict[str, dict[str, np.ndarray]] = {}
    for name, takes in people.items():
        sides = [
            (-1.0 if take.side == "right" else 1.0)
            * np.median([evidence.total, evidence.fingers], axis=1)
            for take in takes
            for evidence in map(palmar_evidence, batches(take))
        ]
        found[name] = {
            "bends back": np.array(sides)[:, 1],
            "other side": np.array(sides)[:, 0],
            "size": np.concatenate([batch_sizes(take) for take in takes]),
        }
    rows = []
    for name in people:
        row: dict[str, Any] = {"person left out": name}
        for rule, limit in limits.items():
            worst = {other: values[rule].max() for other, values in found.items()}
            without = max(value for other, value in worst.items() if other != name)
            own = without + limit - max(worst.values())
            wrong, total = int((found[name][rule] > own).sum()), len(found[name][rule])
            low, high = wilson(wrong, total)
            row[rule] = f"{wrong} of {total} ({100 * low:.2g} to {100 * high:.2g} %)"
            row[f"{rule}: worst; limit"] = f"{worst[name]:.2f}; {own:.2f}"
        rows.append(row)
    return rows


def batches(take: lies.Take) -> list[np.ndarray]:
    """Return the landmarks of each batch of 16 samples, as the check takes them."""
    starts = range(0, len(take.time) - 15, 16)
    return [take.landmarks[start : start + 16] for start in starts]


def batch_sizes(take: lies.Take) -> np.ndarray:
    """Return how far sizes of batches are from that of the first ones, as logarithms."""
    sizes = [log_size(landmarks) for landmarks in batches(take)]
    return np.abs(np.array(sizes) - np.median(sizes[: core.FIRST_SIZES]))


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return Wilson's interval of a share at 95 %."""
    z2 = 1.96**2
    middle = (count + 0.5 * z2) / (total + z2)
    half = 1.96 / (total + z2) * np.sqrt(count * (total - count) / total + 0.25 * z2)
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def parts_of(take: lies.Take) -> list[lies.Take]:
    """Return parts of a take, each of which begins in the middle of the one before."""
    starts = np.arange(take.time[0], take.time[-1] - _PART + 0.1, 0.5 * _PART)
    parts = [take.part(float(start), _PART) for start in starts]
    return [part for part in parts if len(part.time) >= LEAST_SAMPLES] or [take]


def read_file(take: lies.Take) -> str:
    """Return what the commands say of a take as a file: `refused`, `named`, or nothing."""
    valid = np.ones(len(take.time), dtype=bool)
    recording = Recording(
        take.name, take.time, take.landmarks, valid, take.side, wrist=take.wrist
    )
    if examine_recording(recording) is not None:
        return "refused"
    return "named" if hints(recording_facts(recording)) else ""


def measure_files(
    groups: Mapping[str, Sequence[lies.Take]],
) -> list[dict[str, Any]]:
    """Return for each mistake in whole files how many are found, with intervals at 95 %."""
    rows = []
    for lie in (lies.Lie("none", "", lambda take: take), *lies.file_lies()):
        row: dict[str, Any] = {"mistake in a file": lie.name}
        for name, takes in groups.items():
            said = [read_file(lie.tell(take)) for take in takes]
            found = sum(map(bool, said))
            low, high = wilson(found, len(takes))
            row[name] = (
                f"{found} of {len(takes)} ({100 * low:.0f} to {100 * high:.0f} %), "
                f"{said.count('refused')} refused"
            )
        rows.append(row)
    return rows


def measure_facts(takes: Sequence[lies.Take]) -> list[dict[str, Any]]:
    """Return what takes as they are show of their time and the size of the hand."""
    rows = []
    for take in takes:
        valid = np.ones(len(take.time), dtype=bool)
        facts = recording_facts(
            Recording(take.name, take.time, take.landmarks, valid, take.side)
        )
        rows.append(
            {
                "take": take.name,
                "rate [1/s]": facts.rate,
                "fingers [Hz]": facts.frequency,
                "largest over smallest size": facts.growth,
                "palm turns [deg]": np.degrees(facts.palm_turn),
            }
        )
    return rows


def people_of(
    takes: Sequence[lies.Take], poses: Path
) -> dict[str, Sequence[lies.Take]]:
    """Return the takes of recordings and poses by person; both hands of a headset are of one."""
    people: dict[str, list[lies.Take]] = {}
    for take in takes:
        name = take.name.removesuffix("_left").removesuffix("_right")
        people.setdefault(name, []).append(take)
    apart = {
        name: own
        for name, own in other_takes(poses).items()
        if name.startswith("poses")
    }
    return people | apart


def other_takes(poses: Path) -> dict[str, Sequence[lies.Take]]:
    """Return takes for false alarms, apart from recordings: poses of people, and hyperextension."""
    hands: tuple[tuple[Side, float | None], ...]
    hands = (("right", None), ("left", 0.16), ("right", 0.18), ("left", 0.2))
    groups: dict[str, Sequence[lies.Take]] = {
        f"model, MCPs {-angle} deg": [
            lies.model_take(side, length, 10 + k, hyperextension=np.radians(angle))
            for k, (side, length) in enumerate(hands)
        ]
        for angle in (10, 20, 30)
    }
    if (poses / "xrblocks.npz").is_file():
        groups["poses handy_right"] = [
            lies.pose_take(poses / "handy_right.npz", "right")
        ]
        groups["poses xrblocks"] = [
            lies.pose_take(poses / "xrblocks.npz", side, [f"{side.upper()}_HAND"])
            for side in ("right", "left")
        ]
    return groups


def measure_angles(files: Sequence[Path], every: float) -> list[dict[str, Any]]:
    """Do the same with the joint angles that recordings hold, read by layouts of angles."""
    mistakes: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
        "none, radians": ("angles20", lambda q: q),
        "none, degrees": ("own in degrees", np.degrees),
        "degrees for radians": ("angles20", np.degrees),
        "radians for degrees": ("own in degrees", lambda q: q),
        "flexion with the other sign": ("angles20", lambda q: -q),
    }
    layouts = {
        "angles20": load_layout("angles20"),
        "own in degrees": lies.angles_in_degrees(),
    }
    rows = []
    for mistake, (name, tell) in mistakes.items():
        refused = total = 0
        for file in files:
            arrays = np.load(file)
            if "angles20" not in arrays:
                continue
            q, time = arrays["angles20"].astype(float), arrays["time"]
            seen = np.isfinite(q).all(axis=1)
            for start in np.arange(time[0], time[-1] - WINDOW, every):
                inside = seen & (time >= start) & (time < start + WINDOW)
                bent = np.degrees(q[inside][:, [6, 10, 14, 18]]).mean(axis=1)
                # A straight finger has no sign.
                if inside.sum() < LEAST_SAMPLES or (
                    mistake.startswith("flexion") and bent.max() < 25.0
                ):
                    continue
                total += 1
                try:
                    layouts[name].record(
                        "window", time[inside], tell(q[inside]), "right"
                    )
                except InvalidInputError:
                    refused += 1
        rows.append(
            {
                "angles": mistake,
                "windows": total,
                "refused %": 100.0 * refused / max(total, 1),
            }
        )
    return rows


def measure_noise(takes: Sequence[lies.Take]) -> list[dict[str, Any]]:
    """Return how often good takes are refused if noise is added, over their whole length [%]."""
    rng, rows = np.random.default_rng(0), []
    for take in takes:
        row: dict[str, Any] = {"take": take.name}
        for noise in NOISES:
            landmarks = take.landmarks + rng.normal(0.0, noise, take.landmarks.shape)
            check = InputCheck(take.side)
            samples = zip(take.time, landmarks, take.wrist, strict=True)
            refused = [check.update(*sample) is not None for sample in samples]
            row[f"{1e3 * noise:g} mm"] = 100.0 * float(np.mean(refused))
        rows.append(row)
    return rows


def cost(take: lies.Take) -> float:
    """Return the CPU time of the check per sample, over a whole take [us]."""
    check = InputCheck(take.side)
    samples = list(zip(take.time, take.landmarks, take.wrist, strict=True))
    return 1e6 * float(
        common.cpu_times(lambda i: check.update(*samples[i]), len(samples)).mean()
    )


def draw(rows: Sequence[dict[str, Any]], takes: Sequence[lies.Take]) -> Any:
    """Draw the table as a picture: a cell for each mistake and take."""
    from matplotlib.figure import Figure

    shares = np.array([[row[take.name] for take in takes] for row in rows])
    figure = Figure(
        figsize=(1.6 + 0.85 * len(takes), 1.2 + 0.3 * len(rows)), layout="constrained"
    )
    axes = figure.subplots()
    axes.imshow(shares, cmap="Greens", vmin=0.0, vmax=220.0, aspect="auto")
    axes.set_yticks(range(len(rows)), [row["mistake"] for row in rows])
    names = [take.name.replace("_", "\n").replace(" ", "\n") for take in takes]
    axes.set_xticks(range(len(takes)), names, fontsize=7)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.grid(visible=False)
    for (i, k), share in np.ndenumerate(shares):
        text = (
            ""
            if np.isnan(share)
            else f"{share:.0f}"
            if share in (0.0, 100.0)
            else f"{share:.1f}"
        )
        axes.text(k, i, text, ha="center", va="center", fontsize=7)
    axes.set_title("share of one-second windows in which a mistake is found [%]")
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser(
        "Which mistakes in recordings are found within a second."
    )
    arguments = common.parse_arguments(parser, words)
    files = common.find_recordings(arguments.recordings)[
        : 1 if arguments.quick else None
    ]
    takes = [
        *read_takes(files),
        *lies.synthetic_takes()[: 1 if arguments.quick else None],
    ]
    if arguments.quick:
        takes = [take.part(float(take.time[0]), 4.0) for take in takes]
    every = 8.0 * EVERY if arguments.quick else EVERY
    with common.progress(
        "mistakes", (1 + len(lies.all_lies())) * len(takes)
    ) as advance:
        rows = measure(takes, every, advance)
    angles = measure_angles(files, every)
    noises = measure_noise(takes)
    long = [take for take in takes if take.time[-1] - take.time[0] > 8.0] or takes
    live = measure_live(long[:1] if arguments.quick else long)
    seen = {
        f"recording {take.name}": [lies.with_our_axes(take)]
        for take in takes[: len(files)]
    }
    poses = files[0].parents[1] / "poses"
    alarms = measure_false_alarms(
        seen | ({} if arguments.quick else other_takes(poses))
    )
    left_out = measure_left_out(people_of(takes[: len(files)], poses))
    people, models = takes[: len(files)], takes[len(files) :]
    whole = {
        "recordings": people,
        f"parts of {_PART:g} s": [part for take in people for part in parts_of(take)],
        "human model": models,
    }
    in_files = measure_files(whole)
    facts = measure_facts(takes)
    costs = [{"take": take.name, "us per sample": cost(take)} for take in takes]
    to_stderr = arguments.json == "-"
    caption = f"windows of {WINDOW:g} s, one every {every:g} s; shares in %"
    common.print_table("Mistakes found", rows, to_stderr=to_stderr, caption=caption)
    caption = f"{len(long)} takes of more than 8 s; a frozen finger and a growing hand begin later"
    common.print_table(
        "Mistakes in streams", live, to_stderr=to_stderr, caption=caption
    )
    caption = "as they are, with intervals at 95 %"
    common.print_table("False alarms", alarms, to_stderr=to_stderr, caption=caption)
    caption = "limits set without the person; worst batch and limit; intervals at 95 %"
    common.print_table(
        "People left out", left_out, to_stderr=to_stderr, caption=caption
    )
    caption = "found: refused, or named by `handmap retarget` below its table; intervals at 95 %"
    common.print_table(
        "Mistakes in whole files", in_files, to_stderr=to_stderr, caption=caption
    )
    common.print_table("What files show", facts, to_stderr=to_stderr)
    common.print_table("Mistakes in joint angles", angles, to_stderr=to_stderr)
    common.print_table(
        "False alarms over whole recordings, with noise [% of samples]",
        noises,
        to_stderr=to_stderr,
    )
    common.print_table("CPU time of the check", costs, to_stderr=to_stderr)
    results = {"rows": rows, "angles": angles, "noise": noises, "costs": costs}
    results |= {"live": live, "alarms": alarms, "left out": left_out, "files": in_files}
    results |= {"what files show": facts}
    common.write_json(arguments.json, "bench_lies", results)
    common.save_picture(arguments.picture, lambda: draw(rows, takes))


if __name__ == "__main__":
    main()
