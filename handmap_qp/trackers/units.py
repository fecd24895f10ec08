"""Units of time and length, told from the numbers."""

from __future__ import annotations

import numpy as np

from handmap_qp.human.landmarks import HAND_LENGTHS
from handmap_qp.trackers.hand_geometry import MIDDLE_FINGER, Distances, median

STEPS = (4e-4, 0.5)
"""Shortest and longest median time between samples [s]: from 2500 Hz to 2 Hz."""
_TIME_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_LENGTH_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
_PIXELS = 30.0  # a hand that is longer in any unit


def find_time_unit(times: np.ndarray) -> tuple[str, str] | None:
    """Tell whether instants are not in seconds.

    Args:
        times: Instants in the order of the samples [s], shape (T,).

    Returns:
        Problem and advice; None if the median step is one of a tracker in seconds.
    """
    if len(times) < 2:
        return None
    step = median(times[1:] - times[:-1])
    low, high = STEPS
    if step <= 0.0 or low <= step <= high:
        return None
    found = f"the time between samples is {step:.6g} s"
    if step < low:
        return (
            found,
            "give time in seconds; this looks like seconds divided by a power of 1000",
        )
    if step == 1.0:
        return f"{found}, so it counts samples or milliseconds", "give time in seconds"
    for name, unit in _TIME_UNITS.items():
        if low <= step * unit <= 0.5:
            return f"{found}, so it is in {name}", f"multiply it by {unit:g}"
    return found, f"give time in seconds, with steps from {low:g} to {high:g} s"


def find_length_unit(
    landmarks: np.ndarray, distances: Distances, *, is_hand: bool
) -> tuple[str, str] | None:
    """Tell whether landmarks are not in metres.

    Args:
        landmarks: Some samples, shape (T, 21, 3).
        distances: Of `own_distances`.
        is_hand: Whether their proportions are those of a hand in our order.

    Returns:
        Problem and advice; None if they are in metres, or if they are no hand at all.
    """
    low, high = HAND_LENGTHS
    wrist, nearly = landmarks[:, 0], 1e-4 * distances.length(MIDDLE_FINGER)
    if np.abs(wrist[:, 2]).max() < nearly < np.ptp(wrist[:, :2], axis=0).max():
        # The z of MediaPipe's image landmarks is relative to the wrist's.
        return (
            "the wrist's z is always 0, so these are image coordinates (in pixels or of 0 to 1)",
            "give MediaPipe's world landmarks, in metres",
        )
    length = distances.length(MIDDLE_FINGER)
    if low <= length <= high:
        return None
    extent = float(np.median(np.ptp(landmarks, axis=1).max(axis=1)))
    if not is_hand and low / 2.0 < extent < high:
        return None  # of the size of a hand, in another order
    found = f"the hand is {length:.3g} m long"
    for name, unit in _LENGTH_UNITS.items():
        if 0.12 <= length * unit <= 0.26:
            other = " (or pixels)" if name == "millimetres" else ""
            return (
                f"{found}, so the landmarks are in {name}{other}",
                f"multiply them by {unit:g}",
            )
        if 0.12 <= length / unit <= 0.26:
            problem = f"{found}, as if metres had been taken for {name}"
            return problem, f"multiply the landmarks by {1.0 / unit:g}"
    if length > _PIXELS:
        found += ", as if the landmarks were pixels"
    return found, f"give landmarks in metres, of a hand of {low} to {high} m"
