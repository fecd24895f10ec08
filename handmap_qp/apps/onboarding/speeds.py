"""Speeds of joints that a file does not know: what makers say (`speeds.yaml`), and estimates."""

import re
from collections.abc import Mapping
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


def with_origin(spec: HandSpec, estimated: Mapping[str, float] | None) -> HandSpec:
    """Say where speeds are from, and write those that are estimated.

    Args:
        spec: A description that was found; its `limits` have speeds that its URDF lacks, or the
            given one (`speeds` is `given`).
        estimated: Top speeds by joint that an MJCF file's actuators tell [rad/s or m/s]; None for a
            URDF.
    """
    speeds = {limit.velocity for limit in spec.limits.values()} - {None}
    maker = maker_speed(spec)
    if maker and speeds == {maker[0]}:
        return replace(spec, speeds="maker")
    if spec.speeds:
        return spec
    if estimated is None:
        return replace(spec, speeds="assumed" if speeds else "urdf")
    if not estimated.keys() >= {*spec.joints}:
        return replace(spec, speeds="assumed")
    # Three digits are more than is known.
    rounded = [float(f"{estimated[joint]:.3g}") for joint in spec.joints]
    return replace(with_speed(spec, np.array(rounded)), speeds="estimated")


def with_speed(spec: HandSpec, speed: float | Array) -> HandSpec:
    """Return a description in which all joints have a speed limit, or one each [rad/s or m/s]."""
    speeds = np.full(len(spec.joints), speed).tolist()
    limits = {
        joint: replace(spec.limits.get(joint, LimitSpec()), velocity=own)
        for joint, own in zip(spec.joints, speeds, strict=True)
    }
    return replace(spec, limits=spec.limits | limits)
