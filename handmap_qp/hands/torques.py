"""The torques that a hand's motors have: `torque_limits`."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array
from .hand import Hand

DATA_SHEETS: Mapping[str, float] = MappingProxyType(
    {"allegro": 0.7, "leap": 0.95, "shadow": 2.0}
)
"""Largest torque of a finger's joint by the maker [N m], by a word in the hand's or URDF's name.

Allegro's data sheet, and the URDFs of LEAP and Shadow by their makers.
"""
# From here on, a limit of a finger's joint is a placeholder; of revolute and prismatic joints.
_PLACEHOLDERS = (10.0, 1000.0)  # N m, N
# What is assumed instead.
_ASSUMED = (1.0, 50.0)  # N m, N


class TorqueLimits(NamedTuple):
    """The largest torques of a hand's actuators.

    Attributes:
        values: Of each of `hand.joint_names` [N m, N], shape (n,); infinite where the joint of an
            arm has no limit.
        source: Where those of the fingers are from, in words.
    """

    values: Array
    source: str


def torque_limits(hand: Hand, limit: float | None = None) -> TorqueLimits:
    """Return the largest torques of a hand's actuators.

    Args:
        hand: The hand.
        limit: Largest torque of a finger's joint, beside the effort limits of the URDF, where 0
            stands for none [N m, N]. If omitted, the maker's: those of a data sheet that is known,
            else those of the URDF. A limit of 0, or of 10 N m or 1000 N and more, is a placeholder;
            1 N m or 50 N are assumed in its place.
    """
    efforts = hand.model.effortLimit[hand.v_indices]
    efforts[efforts == 0.0] = np.inf
    is_finger = ~hand.moves_wrist
    if limit is not None:
        values = np.where(is_finger, np.minimum(efforts, limit), efforts)
        return TorqueLimits(values, f"at most {limit:g} N m, as asked for")
    if family := _family(hand):
        sheet = DATA_SHEETS[family]
        values = np.where(is_finger, np.minimum(efforts, sheet), efforts)
        return TorqueLimits(
            values, f"at most {sheet:g} N m, by the maker of {family} hands"
        )
    is_prismatic = are_prismatic(hand)
    is_placeholder = efforts >= np.where(is_prismatic, *reversed(_PLACEHOLDERS))
    is_assumed = is_finger & is_placeholder
    assumed = np.where(is_prismatic, *reversed(_ASSUMED))
    values = np.where(is_assumed, assumed, efforts)
    return TorqueLimits(values, _describe(values, is_finger, is_assumed, is_prismatic))


def _family(hand: Hand) -> str:
    """Return the word of `DATA_SHEETS` in the names of a hand; empty if there is none."""
    parts = hand.parts or (hand,)
    names = " ".join(f"{part.name} {_urdf_name(part)}" for part in parts).lower()
    return next((word for word in DATA_SHEETS if word in names), "")


def _urdf_name(hand: Hand) -> str:
    """Return the name of a hand's URDF: within a package, its whole path, which has the maker's.

    Folders of a user may have any names.
    """
    urdf = hand.spec.urdf
    return urdf if "://" in urdf else Path(urdf).name


def are_prismatic(hand: Hand) -> Array:
    """Return which of `hand.joint_names` are prismatic, shape (n,)."""
    model = hand.model
    kinds = [model.joints[model.getJointId(name)] for name in hand.joint_names]
    return np.array([kind.shortname().startswith("JointModelP") for kind in kinds])


def _describe(
    values: Array, is_finger: Array, is_assumed: Array, is_prismatic: Array
) -> str:
    """Say where the limits of the fingers are from."""
    texts = []
    if (known := values[is_finger & ~is_assumed]).size:
        low, high = known.min(), known.max()
        span = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        unit = "N" if is_prismatic[is_finger].all() else "N m"
        texts.append(f"{span} {unit}, by the URDF")
    if is_assumed.any():
        amounts = sorted({f"{value:g}" for value in values[is_assumed]})
        unit = "N" if is_prismatic[is_assumed].all() else "N m"
        texts.append(
            f"{' and '.join(amounts)} {unit} assumed for {is_assumed.sum()} of "
            f"{is_finger.sum()} joints, of which the URDF gives no limit of a maker"
        )
    return "; ".join(texts)
