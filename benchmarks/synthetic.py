"""Synthetic motions and robots, for benchmarks without recordings or with robots of any size."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import scenes

from handmap_qp import Hand, HandSpec, PointSpec, load_hand, load_synergies
from handmap_qp.hands.spec import PalmSpec, WristSpec
from handmap_qp.human import HumanMotion
from handmap_qp.se3 import affine

_RATE = 90.0


def synergy_motion(samples: int) -> HumanMotion:
    """Move the human hand along its first three synergies while its wrist swings."""
    human, synergies = load_hand("human"), load_synergies()
    time = np.arange(samples) / _RATE
    z = 0.6 * np.sin(2.0 * np.pi * np.outer(time, (0.5, 0.35, 0.2)))
    q = np.clip(
        [synergies.posture(row) for row in z], human.lower_limits, human.upper_limits
    )
    wrist = np.array(
        [
            affine(np.eye(3), np.array([0.2 * np.sin(t), 0.0, 0.1 * np.cos(t)]))
            for t in time
        ]
    )
    return HumanMotion(
        human,
        time,
        np.full(samples, 1.0 / _RATE),
        q,
        wrist,
        np.ones(samples, dtype=bool),
    )


def motion_or_synergies(folder: Path, name: str) -> HumanMotion:
    """Return the valid samples of a recording, or `synergy_motion` if the file is missing.

    Args:
        folder: Folder of recordings.
        name: Name of the recording, without suffix.

    Returns:
        The motion; all samples are valid.
    """
    file = folder / f"{name}.npz"
    if not file.is_file():
        return synergy_motion(750)
    motion = scenes.load_scene(file).motion
    seen = {key: getattr(motion, key)[motion.valid] for key in _columns()}
    return replace(motion, human=motion.human.with_points(None), **seen)


def shortened(motion: HumanMotion, samples: int) -> HumanMotion:
    """Return the first samples of a motion."""
    return replace(
        motion, **{key: getattr(motion, key)[:samples] for key in _columns()}
    )


def allegro_with_points(count: int) -> Hand:
    """Return the Allegro hand with random reference points on its links."""
    links = [f"link_{i}.0" for i in range(16)]
    rng = np.random.default_rng(count)
    points = [
        PointSpec(
            f"p{i}", links[-1 - i % 16], tuple(rng.uniform(0.0, 0.03, 3).tolist())
        )
        for i in range(count)
    ]
    return load_hand("allegro_right", points=tuple(points))


def comb_hand(fingers: int) -> Hand:
    """Return a hand of parallel fingers with four joints each.

    Args:
        fingers: Number of fingers.

    Returns:
        A floating hand of `4 * fingers` joints with a reference point at each tip.
    """
    parts = ['<robot name="comb"><link name="palm"/>']
    for finger in range(fingers):
        parent, origin, axis = (
            "palm",
            f"{0.02 * (finger - fingers / 2):.3f} 0.08 0",
            "0 0 1",
        )
        for joint in range(4):
            child = f"f{finger}_{joint}"
            parts.append(
                f'<link name="{child}"/><joint name="{child}" type="revolute">'
                f'<parent link="{parent}"/><child link="{child}"/>'
                f'<origin xyz="{origin}"/><axis xyz="{axis}"/>'
                '<limit lower="-0.5" upper="1.6" velocity="8" effort="1"/></joint>'
            )
            parent, origin, axis = child, "0 0.03 0" if joint else "0 0 0", "-1 0 0"
    joints = tuple(
        f"f{finger}_{joint}" for finger in range(fingers) for joint in range(4)
    )
    points = tuple(
        PointSpec(f"tip{finger}", f"f{finger}_3", (0.0, 0.03, 0.0))
        for finger in range(fingers)
    )
    spec = HandSpec(
        name=f"comb{fingers}",
        urdf="",
        side="right",
        palm=PalmSpec("palm", distal=(0.0, 1.0, 0.0), dorsal=(0.0, 0.0, 1.0)),
        wrist=WristSpec("palm"),
        joints=joints,
        rest={joint: 0.0 if joint.endswith("_0") else 0.5 for joint in joints},
        points=points,
        sets={"tips": tuple(point.name for point in points)},
        reference="tips",
    )
    return Hand(spec, urdf_text="".join([*parts, "</robot>"]))


def _columns() -> tuple[str, ...]:
    """Fields of a motion with one entry per sample."""
    return tuple(field.name for field in fields(HumanMotion) if field.name != "human")
