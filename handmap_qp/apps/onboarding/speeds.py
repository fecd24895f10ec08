"""Speeds of joints where a URDF has placeholders: what the makers say (`speeds.yaml`)."""

import re
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace

from handmap_core.se3 import Array
from handmap_qp.hands import HandSpec, LimitSpec

MAKERS = msgspec.yaml.decode(
    Path(__file__).with_suffix(".yaml").read_bytes(), type=dict[str, tuple[float, str]]
)
"""Makers' speeds and where they say them, by a pattern of names."""


def maker_speed(spec: HandSpec) -> tuple[float, str] | None:
    """Return what a hand's maker says, by the name of the hand or of its model."""
    name = f"{spec.name} {Path(spec.urdf).name}".lower()
    return next(
        (speed for names, speed in MAKERS.items() if re.search(names, name)), None
    )


def with_origin(spec: HandSpec, *, is_given: bool) -> HandSpec:
    """Say where speeds are from: `limits`, where it has any, or a URDF in which they are given."""
    speeds = {limit.velocity for limit in spec.limits.values()} - {None}
    maker = maker_speed(spec)
    if maker and speeds == {maker[0]}:
        return replace(spec, speeds="maker")
    return replace(spec, speeds="urdf" if is_given and not speeds else "assumed")


def with_speed(spec: HandSpec, speed: float | Array) -> HandSpec:
    """Return a description in which all joints have a speed limit, or one each [rad/s or m/s]."""
    speeds = np.full(len(spec.joints), speed).tolist()
    limits = {
        joint: replace(spec.limits.get(joint, LimitSpec()), velocity=own)
        for joint, own in zip(spec.joints, speeds, strict=True)
    }
    return replace(spec, limits=spec.limits | limits)
