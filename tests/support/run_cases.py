"""Cases that saved hands and `handmap_qp` follow alike."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from faulty_recordings import DEMO
from injection import inject, parse_faults

from handmap_core.human.recording import Recording, sample_columns
from handmap_qp import Follower, HandMapper, HumanSample, load_hand
from handmap_qp.apps.saving import saved_bytes
from handmap_qp.errors import HandmapError, InvalidOptionsError
from handmap_qp.hands import Hand, Side, hand_files, load_robot, robot_files
from handmap_qp.human import PALM, landmarks_at_rest, scaled_human
from handmap_qp.mapping import RobotMapper
from handmap_qp.se3 import (
    affine,
    quat_wxyz_from_rotation,
    rigid_fit,
    rotation_from_quat_wxyz,
)
from handmap_qp.stream import GripFollower, RobotFollower
from handmap_qp.trackers import LAYOUTS, read_hands, read_recording

ROOT = Path(__file__).parents[2]
ALONE = ROOT / "tests" / "run" / "alone.py"

FAULTS = (
    "",
    "flip@0.6+0.2,dropout@1.5+0.1",
    "zero@0.3+0.2,jump@1.2+0.3:0.2",
    "outlier@0.5+0.1:0.1,silence@1.3+0.5",
    "frozen@0.5+0.8",
    "clock@1,noise@1.5",
    # The core proves none of these to be right, and Python examines them.
    "mirror@0.4+2",
    "millimetres",
    "order",
    "quaternion",
)


def module_of(file: Path) -> ModuleType:
    """Import a file that is in no package."""
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def write_case(
    folder: Path,
    name: str,
    mapper: HandMapper | RobotMapper,
    *recordings: Recording,
) -> None:
    """Write a hand or a robot, and samples of each hand, for `alone.py`."""
    (folder / f"{name}.hand").write_bytes(saved_bytes(mapper))
    for each in recordings:
        count = len(each)
        shares = each.confidence
        np.savez(
            folder / f"{name}.{each.side}.npz",
            time=each.time,
            landmarks=each.landmarks,
            wrist=np.zeros((count, 4, 4)) if each.wrist is None else each.wrist,
            has_wrist=each.wrist is not None,
            valid=each.valid,
            confidence=np.ones(count) if shares is None else shares,
        )


def expected_columns(
    folder: Path,
    name: str,
    mapper: HandMapper | RobotMapper,
    kind: Callable[..., HumanSample] = HumanSample,
) -> dict[str, np.ndarray]:
    """Return what `handmap_qp` commands for a case, whose samples `kind` makes."""
    alone = module_of(ALONE)
    samples = alone.samples_of(folder / f"{name}.hand", kind)
    measured = alone.measured_of(folder / f"{name}.hand")
    if isinstance(mapper, RobotMapper):
        follow = RobotFollower(mapper).map_samples
    elif isinstance(measured, list):
        follow = GripFollower(Follower(mapper)).map_sample
    else:
        follow = Follower(mapper).map_sample
    return alone.columns_of(follow, samples, measured)


def difference(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> float:
    """Return the largest difference of commands, targets, margins and torques.

    Infinite if other things are said, or only one keeps shapes apart.
    """
    columns = ("q", "wrist", "targets", "margins", "effort")
    is_alike = all(one[name].shape == other[name].shape for name in columns)
    if not is_alike or not np.array_equal(one["said"], other["said"]):
        return np.inf
    return max(
        float(np.abs(one[name] - other[name]).max(initial=0.0)) for name in columns
    )


def recording_with(fault: str) -> Recording:
    """Return 2.5 s of the demo with a fault."""
    columns = sample_columns(DEMO.part(slice(0, 150)))
    plain = [columns.sample(i) for i in range(150)]
    is_wrong = "@" not in fault
    samples = list(inject(plain, parse_faults(fault))) if not is_wrong else plain
    time, landmarks, valid, confidence = (
        np.array([getattr(sample, name) for sample in samples])
        for name in ("time", "landmarks", "valid", "confidence")
    )
    wrist = None
    if fault == "millimetres":
        landmarks *= 1e3
    elif fault == "order":
        landmarks = landmarks[:, np.argsort(np.array(LAYOUTS["rhd21"].order("right")))]
    elif fault == "quaternion":
        poses = rigid_fit(
            landmarks_at_rest(load_hand("human"))[PALM], landmarks[:, PALM]
        )
        quats = np.array([quat_wxyz_from_rotation(pose[:3, :3]) for pose in poses])
        wrist = affine(
            rotation_from_quat_wxyz(np.roll(quats, -1, axis=1)), poses[:, :3, 3]
        )
    return Recording(
        name="demo",
        time=time,
        landmarks=landmarks,
        valid=valid,
        side="right",
        wrist=wrist,
        confidence=confidence,
    )


def mapper_of(robot: str, preset: str) -> HandMapper:
    """Return the demo's person with a robot."""
    human = scaled_human(DEMO, points="landmarks")
    return HandMapper(human, load_hand(robot), preset)


def robot_mapper_of(
    robot: str, preset: str, hands: dict[Side, Recording], **options: Any
) -> RobotMapper:
    """Return the person of recordings of both hands with a robot."""
    humans: dict[Side, Hand] = {
        side: scaled_human(each, points="landmarks") for side, each in hands.items()
    }
    return RobotMapper(load_robot(robot), humans, preset, **options)


def recordings() -> Iterator[Recording]:
    """Return the demo with every fault, and the beginning of each recording that is here."""
    for fault in FAULTS:
        yield replace(recording_with(fault), name=f"demo {fault}")
    for file in shared_files():
        yield beginning(read_recording(str(file)))


def shared_files() -> list[Path]:
    """Return the recordings that are here."""
    folder = os.environ.get("HANDMAP_RECORDINGS", "")
    return sorted(Path(folder).glob("*.npz")) if folder else []


def beginning(whole: Recording) -> Recording:
    """Return the first 200 samples of a recording, as columns."""
    recording = whole.part(slice(0, min(200, len(whole))))
    samples = [recording.sample(i) for i in range(len(recording))]
    poses = None
    if samples[0].wrist is not None:
        poses = np.array([sample.wrist for sample in samples])
    return sample_columns(recording, poses)


def both_hands() -> Iterator[dict[Side, Recording]]:
    """Return the beginning of each recording of both hands that is here."""
    quest = [file for file in shared_files() if file.name.startswith("quest3_webxr_")]
    for files in ([Path("pinch")], [Path("demo")], quest):
        if files:
            yield {side: beginning(each) for side, each in read_hands(files).items()}


def cases() -> Iterator[tuple[str, HandMapper | RobotMapper, tuple[Recording, ...]]]:
    """Return every hand with every recording of its side, and every robot with those of both.

    Hands and robots that are not installed are left out, and presets that one cannot have.
    """
    known = [*recordings()]
    demo = scaled_human(DEMO)
    humans = [
        demo if each.name.startswith("demo") else scaled_human(each) for each in known
    ]
    for robot in hand_files():
        with suppress(HandmapError):
            hand = load_hand(robot)
            for k, (recording, human) in enumerate(zip(known, humans, strict=True)):
                if hand.side != recording.side:
                    continue
                # Other methods with the first fault and the last recording alone: it takes long.
                others = ("object", "paper") if k in (1, len(known) - 1) else ()
                for preset in ("teleoperation", *others):
                    with suppress(InvalidOptionsError):
                        mapper = HandMapper(human, hand, preset)
                        yield f"{robot}-{preset}-{k}", mapper, (recording,)
    for robot in robot_files():
        for k, hands in enumerate(both_hands()):
            for preset in ("teleoperation", "object", "paper"):
                with suppress(HandmapError):
                    both = robot_mapper_of(robot, preset, hands)
                    yield f"{robot}-{preset}-{k}", both, tuple(hands.values())


def write_all(folder: Path) -> None:
    """Write all cases; `CASE.expected.npz` is what `handmap_qp` commands.

    Its `own` is how far a robot's commands are from that where landmarks are 1e-14 m off: where
    rounding decides.
    """
    random = np.random.default_rng(0)

    def shaken(time: float, side: Side, landmarks: Any, *others: Any) -> HumanSample:
        off = 1e-14 * random.standard_normal(landmarks.shape)
        return HumanSample(time, side, landmarks + off, *others)

    for name, mapper, recordings in cases():
        write_case(folder, name, mapper, *recordings)
        expected: dict[str, Any] = expected_columns(folder, name, deepcopy(mapper))
        own = 0.0
        if isinstance(mapper, RobotMapper):
            found = expected_columns(folder, name, mapper, shaken)
            own = difference(found, expected)
        np.savez(folder / f"{name}.expected.npz", own=own, **expected)
