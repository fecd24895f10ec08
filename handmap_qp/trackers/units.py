"""Units of time and length, told from the numbers."""

from __future__ import annotations

import numpy as np

from handmap_qp.human.landmarks import HAND_LENGTHS
from handmap_qp.human.verdict import Finding
from handmap_qp.trackers.hand_geometry import Distances, median

STEPS = (4e-4, 0.5)
"""Shortest and longest median time between samples [s]: from 2500 Hz to 2 Hz."""
_TIME_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_LENGTH_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
_PIXELS = 30.0  # a hand that is longer in any unit


def find_time_unit(times: np.ndarray) -> Finding | None:
    """Tell whether instants are not in seconds.

    Args:
        times: Instants in the order of the samples [s], shape (T,).

    Returns:
        What is wrong; None if the median step is one of a tracker in seconds.
    """
    step = median(np.diff(times)) if len(times) > 1 else 0.0
    low, high = STEPS
    if step <= 0.0 or low <= step <= high:
        return None
    found = f"the time between samples is {step:.6g} s"
    advice = f"give time in seconds, with steps from {low:g} to {high:g} s"
    fitting = [name for name, unit in _TIME_UNITS.items() if low <= step * unit <= high]
    if step < low:
        advice = (
            "give time in seconds; this looks like seconds divided by a power of 1000"
        )
    elif step == 1.0:
        found += ", so it counts samples or milliseconds"
        advice = "give time in seconds"
    elif fitting:
        found += f", so it is in {fitting[0]}"
        advice = f"multiply it by {_TIME_UNITS[fitting[0]]:g}"
    return Finding("time", found, advice)


def find_length_unit(
    landmarks: np.ndarray,
    distances: Distances,
    *,
    is_hand: bool,
) -> Finding | None:
    """Tell whether landmarks are not in metres.

    Args:
        landmarks: Some samples, shape (T, 21, 3).
        distances: Of `own_distances`.
        is_hand: Whether their proportions are those of a hand in our order.

    Returns:
        What is wrong; None if they are in metres, or if they are no hand at all.
    """
    low, high = HAND_LENGTHS
    wrist = landmarks[:, 0]
    length = distances.hand_length
    if np.abs(wrist[:, 2]).max() < 1e-4 * length < np.ptp(wrist[:, :2], axis=0).max():
        # The z of MediaPipe's image landmarks is relative to the wrist's.
        return Finding(
            "unit",
            "the wrist's z is always 0, so these are image coordinates (in pixels or of 0 to 1)",
            "give MediaPipe's world landmarks, in metres",
        )
    extent = float(np.median(np.ptp(landmarks, axis=1).max(axis=1)))
    # Landmarks of the size of a hand may be in another order.
    is_other_order = not is_hand and low / 2.0 < extent < high
    if low <= length <= high or is_other_order:
        return None
    found = f"the hand is {length:.3g} m long"
    for name, unit in _LENGTH_UNITS.items():
        if _is_usual(length * unit):
            also = " (or pixels)" if name == "millimetres" else ""
            problem = f"{found}, so the landmarks are in {name}{also}"
            return Finding("unit", problem, f"multiply them by {unit:g}")
        if _is_usual(length / unit):
            problem = f"{found}, as if metres had been taken for {name}"
            return Finding("unit", problem, f"multiply the landmarks by {1.0 / unit:g}")
    if length > _PIXELS:
        found += ", as if the landmarks were pixels"
    advice = f"give landmarks in metres, of a hand of {low} to {high} m"
    return Finding("unit", found, advice)


def _is_usual(length: float) -> bool:
    """Tell whether a length is that of an adult's hand in metres."""
    return 0.12 <= length <= 0.26
