"""Streams with every fault and mistake, and what the guard has said about each of them.

    python tests/verdict_cases.py    # write all of it anew, into tests/data/verdicts.json

Write it before a change of the guard or the input check, never to make a test pass. A change that
moves a verdict on purpose writes it anew in its own commit, which says what moved and why.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from injection import FAULT_KINDS, inject, parse_faults
from lies import Take, all_lies, live_lies, model_take
from pinocchio import exp3

from handmap_core.human.findings import Finding
from handmap_core.human.recording import sample_columns
from handmap_core.human.sample import HumanSample, Verdict, human_name
from handmap_qp import Hand, load_hand, read_recording
from handmap_qp.hands import Side
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.trackers.plausibility import InputCheck

FILE = Path(__file__).parent / "data" / "verdicts.json"
DEMO = read_recording("demo", "right")
_TURN = np.array([0.3, -0.5, 0.2])

Change = Callable[[HumanSample], HumanSample]


class Stream(NamedTuple):
    """Samples of one hand, and when they arrive.

    Attributes:
        samples: The samples.
        hand_length: Length of the person's hand [m]; that of the human model if it is None.
        arrivals: When each arrives [s]; empty if that is not known.
    """

    samples: Sequence[HumanSample]
    hand_length: float | None = None
    arrivals: Sequence[float | None] = ()


Run = tuple[int, str, bool, bool, str]
"""Number of samples in a row, and what was said of each: rule, held, return, and `text_of`."""


class Record(NamedTuple):
    """What was said about a stream.

    Attributes:
        runs: What was said of all samples, one after the other.
        granted: Sum of the times that the samples account for [s].
        consistency: Sum of `Verdict.consistency` of those that have landmarks [m].
        checked: What `InputCheck` says by itself, where that changes: the sample, then `text_of`.
    """

    runs: list[Run]
    granted: float
    consistency: float
    checked: list[tuple[int, str]]


def record(stream: Stream) -> Record:
    """Judge a stream."""
    guard = StreamGuard(_human(stream.samples[0].side, stream.hand_length))
    arrivals = stream.arrivals or [None] * len(stream.samples)
    # Numbers may be too large to be squared.
    with np.errstate(all="ignore"):
        verdicts = [
            guard.check(sample, arrival=arrival)
            for sample, arrival in zip(stream.samples, arrivals, strict=True)
        ]
        checked = _checked(stream.samples)
    return Record(
        _runs(verdicts),
        float(np.sum([verdict.dt for verdict in verdicts])),
        float(np.nansum([verdict.consistency for verdict in verdicts])),
        checked,
    )


@cache
def _human(side: Side, hand_length: float | None) -> Hand:
    """Return a person's hand, which no stream changes."""
    return load_hand(human_name(side), points="landmarks", hand_length=hand_length)


def text_of(finding: Finding | None) -> str:
    """Return a finding's mistake with its number or name; sentences may be worded anew."""
    if finding is None:
        return ""
    return f"{finding.mistake} {finding.number:.6g} {finding.which} {finding.order}"


def _runs(verdicts: Iterable[Verdict]) -> list[Run]:
    """Join equal verdicts that follow each other."""
    runs: list[Run] = []
    for verdict in verdicts:
        said = (
            verdict.rule,
            verdict.is_held,
            verdict.is_return,
            text_of(verdict.finding),
        )
        if runs and runs[-1][1:] == said:
            runs[-1] = (runs[-1][0] + 1, *said)
        else:
            runs.append((1, *said))
    return runs


def _checked(samples: Sequence[HumanSample]) -> list[tuple[int, str]]:
    """Return what an input check says, where that changes; and at the end, as of a file."""
    check = InputCheck(samples[0].side)
    found = [(0, "")]
    for i, sample in enumerate(samples):
        if not sample.valid:
            continue
        finding = check.update(sample.time, sample.landmarks, sample.wrist)
        if text_of(finding) != found[-1][1]:
            found.append((i, text_of(finding)))
    last = check.finish()
    return [*found, (len(samples), text_of(last))]


@cache
def streams() -> dict[str, Stream]:
    """Return all streams, by name."""
    plain = [*sample_columns(DEMO.part(slice(0, 260)))]
    tracked = [_with_turning_wrist(sample, i) for i, sample in enumerate(plain)]
    found = {"demo": Stream(plain), "demo with a wrist": Stream(tracked)}
    for kind in FAULT_KINDS:
        fault = parse_faults(f"{kind}@1+2")
        found[f"fault {kind}"] = Stream([*inject(plain, fault)])
        found[f"fault {kind}, wrist"] = Stream([*inject(tracked, fault)])
    for size in (0.002, 0.005, 0.02):
        found[f"noise {size}"] = Stream(_noisy(plain, size))
    for name, change in _MISTAKES.items():
        for also, samples in (("", plain), (", wrist", tracked)):
            changed = [change(sample) for sample in samples]
            part = [*samples[:100], *changed[100:200], *samples[200:]]
            found[f"{name}{also}"] = Stream(changed)
            found[f"{name} for a while{also}"] = Stream(part)
    for rate in (0.5, 1.0, 3.0):
        arrivals: list[float | None] = [
            5.0 + (sample.time - plain[0].time) / rate for sample in plain
        ]
        arrivals[40:44] = [None] * 4
        found[f"arrivals at {rate}"] = Stream(plain, None, arrivals)
    found["set back again and again"] = _set_back()
    found["ever smaller"] = Stream(_shrinking())
    for seed in range(12):
        found[f"hostile {seed}"] = Stream(_hostile(seed))
    for take, length in zip(_takes(), (None, 0.17), strict=True):
        whole = take.part(take.time[0], 6.0)
        for lie in [*all_lies(), *live_lies()]:
            told = lie.tell(whole)
            found[f"{take.name}: {lie.name}"] = Stream(_samples(told), length)
    return found


def _takes() -> tuple[Take, Take]:
    """Return motions of a left hand, and of a right one that is 170 mm long."""
    return model_take("left", None, 1), model_take("right", 0.17, 2)


def _samples(take: Take) -> list[HumanSample]:
    columns = zip(take.time.tolist(), take.landmarks, take.wrist, strict=True)
    return [
        HumanSample.of_checked(
            time=time,
            side=take.side,
            landmarks=np.ascontiguousarray(landmarks),
            wrist=np.ascontiguousarray(wrist),
            valid=True,
            confidence=1.0,
        )
        for time, landmarks, wrist in columns
    ]


def _with_turning_wrist(sample: HumanSample, i: int) -> HumanSample:
    """Turn a hand and its wrist, a little more at every sample."""
    wrist = np.eye(4)
    wrist[:3, :3] = exp3(0.004 * i * _TURN)
    landmarks = sample.landmarks @ wrist[:3, :3].T
    wrist[:3, 3] = landmarks[0]
    return replace(sample, landmarks=landmarks, wrist=wrist)


def _noisy(samples: Sequence[HumanSample], size: float) -> list[HumanSample]:
    random = np.random.default_rng(2)
    return [
        replace(
            sample,
            landmarks=sample.landmarks + random.normal(scale=size, size=(21, 3)),
            valid=bool(random.random() > 0.2),
        )
        for sample in samples
    ]


def _set_back() -> Stream:
    samples = [*sample_columns(DEMO.part(slice(0, 400)))]
    stamps = np.cumsum([-0.9 if i % 46 == 45 else 0.02 for i in range(len(samples))])
    set_back = [
        replace(sample, time=stamp)
        for sample, stamp in zip(samples, stamps.tolist(), strict=True)
    ]
    return Stream(set_back, None, [5.0 + 4e-3 * i for i in range(len(samples))])


def _shrinking() -> list[HumanSample]:
    """Return a hand that is another one after a second, and a little smaller at every sample."""
    samples = [*sample_columns(DEMO)]
    start = samples[0].time
    return [
        replace(sample, landmarks=(0.65 - 1e-5 * i) * sample.landmarks)
        if sample.time > start + 1.0
        else sample
        for i, sample in enumerate(samples)
    ]


def _hostile(seed: int) -> list[HumanSample]:
    """Return samples with everything at once: clocks, places, sizes, mirrors and wrists."""
    random = np.random.default_rng(seed)
    taken = [*sample_columns(DEMO)]
    time, i, scale = 0.0, 0, 1.0
    world = np.eye(3)
    samples = []
    for _ in range(500):
        event = random.random()
        time += random.choice([1 / 90, 1 / 60, 1 / 60, 1 / 60, 0.0, -0.01])
        if event < 0.03:
            time += random.choice([0.3, -0.5, -5.0, 50.0])
        i = int(random.integers(len(taken))) if event > 0.97 else (i + 1) % len(taken)
        if 0.03 < event < 0.05:
            sign = random.choice([1, -1])
            world = exp3(random.normal(size=3)) @ np.diag([1.0, 1.0, sign])
        if 0.05 < event < 0.07:
            scale = random.choice([1.0, 1.0, 1.0, 2.5, 1e3, 1e-3])
        points = scale * taken[i].landmarks @ world.T
        points += 10.0 ** random.uniform(-6, -2.5) * random.normal(size=(21, 3))
        if 0.07 < event < 0.09:
            points[random.integers(21)] += random.normal(size=3)
        if 0.09 < event < 0.1:
            points *= random.random((21, 1)) < 0.5
        wrist = np.eye(4)
        wrist[:3, :3], wrist[:3, 3] = exp3(0.1 * random.normal(size=3)), points[0]
        has_wrist = bool(seed % 3) or random.random() < 0.5
        share = random.choice([0.0, 0.5, 1.0], p=[0.01, 0.24, 0.75])
        samples.append(
            HumanSample(
                time,
                "right",
                points,
                wrist if has_wrist else None,
                bool(random.random() < 0.98),
                float(share),
            )
        )
    return samples


def _moved(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def moved(sample: HumanSample) -> HumanSample:
        if not sample.valid:
            return sample
        return replace(sample, landmarks=change(sample.landmarks))

    return moved


def _with_wrist(turn: np.ndarray, shift: float) -> Change:
    def turned(sample: HumanSample) -> HumanSample:
        if sample.wrist is None:
            return sample
        wrist = sample.wrist.copy()
        wrist[:3, :3] = wrist[:3, :3] @ turn
        wrist[0, 3] += shift
        return replace(sample, wrist=wrist)

    return turned


def _exchanged(points: np.ndarray) -> np.ndarray:
    found = points.copy()
    found[5:9], found[9:13] = points[9:13], points[5:9]
    return found


_MISTAKES: dict[str, Change] = {
    "mirrored": _moved(lambda p: p * (-1.0, 1.0, 1.0)),
    "millimetres": _moved(lambda p: 1000.0 * p),
    "inches": _moved(lambda p: p / 0.0254),
    "far": _moved(lambda p: p + 1e8),
    "huge": _moved(lambda p: 1e200 * p),
    "small": _moved(lambda p: 0.6 * p),
    "one place": _moved(lambda p: np.tile(p[:1], (21, 1))),
    "flat": _moved(lambda p: p * (1.0, 1.0, 0.0)),
    "other order": _moved(lambda p: p[[0, *range(20, 0, -1)]]),
    "no hand": _moved(lambda p: p[np.random.default_rng(5).permutation(21)]),
    "rounded": _moved(lambda p: np.round(p, 3)),
    "a bone without length": _moved(lambda p: p[[*range(20), 19]]),
    "fingers changed": _moved(_exchanged),
    "milliseconds": lambda sample: replace(sample, time=1e3 * sample.time),
    "kiloseconds": lambda sample: replace(sample, time=1e-3 * sample.time),
    "seconds as counts": lambda sample: replace(
        sample, time=float(round(60 * sample.time))
    ),
    "wrist elsewhere": _with_wrist(exp3(_TURN), 1.0),
    "wrist of another convention": _with_wrist(exp3(_TURN), 0.0),
    "wrist that stands still": lambda sample: replace(sample, wrist=np.eye(4)),
}


def read() -> dict[str, Record]:
    """Read what was said about each stream."""
    found = json.loads(FILE.read_text(encoding="utf-8"))
    words = found["words"]
    return {
        name: Record(
            [
                (count, rule, *flags, words[k])
                for count, rule, *flags, k in each["runs"]
            ],
            each["granted"],
            each["consistency"],
            [(i, words[k]) for i, k in each["checked"]],
        )
        for name, each in found["streams"].items()
    }


def write(records: dict[str, Record]) -> None:
    """Write what was said: a line for each sentence and stream, sentences by their numbers."""
    words: dict[str, int] = {}
    lines = []
    for name, each in records.items():
        runs = [[*run[:-1], words.setdefault(run[-1], len(words))] for run in each.runs]
        checked = [[i, words.setdefault(said, len(words))] for i, said in each.checked]
        values = each._asdict() | {"runs": runs, "checked": checked}
        text = json.dumps(values, separators=(",", ":"))
        lines.append(f"{json.dumps(name)}:{text}")
    sentences = ",\n".join(map(json.dumps, words))
    streams_text = ",\n".join(lines)
    text = f'{{"words":[\n{sentences}],\n"streams":{{\n{streams_text}\n}}}}\n'
    FILE.write_text(text, encoding="utf-8")
    print(f"{len(records)} streams in {FILE}")


if __name__ == "__main__":
    write({name: record(stream) for name, stream in streams().items()})
