"""Tell wrong input from a human hand, in the first second and at every sample after it.

Landmarks in another order, the other hand, a mirrored world, millimetres, milliseconds, fingers
that bend backwards or a wrist quaternion in another order map without an error, to nonsense.
`InputCheck` measures what a human hand cannot do (`hand_geometry`) in small batches of samples,
asks which mistake explains it, and names it. `check_recording` does the same for a file.

    check = InputCheck("right")
    finding = check.update(time, landmarks, wrist)      # at every valid sample; None if plausible
"""

import math
from functools import cache
from itertools import permutations
from typing import NamedTuple

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands import FINGERS, OTHER_SIDE, Side
from handmap_qp.human import (
    HAND_LENGTHS,
    LANDMARK_COUNT,
    Finding,
    Recording,
    check_side,
)
from handmap_qp.ik import Compiled, in_core
from handmap_qp.se3 import Array, lengths
from .hand_geometry import (
    Distances,
    carried_fingers,
    change_rate,
    log_sizes,
    median,
    misfit,
    noise_of,
    own_distances,
    palmar_evidence,
    stuck_fingers,
)
from .layouts import LAYOUTS
from .wrist_axes import WristCheck


class _Batch(NamedTuple):
    """When a batch is complete: at `most` samples, or at `least` ones after `time` [s]."""

    most: int
    least: int
    time: float


_NEW = _Batch(16, 8, 0.25)  # while the finding is new
_CALM = _Batch(32, 16, 0.5)
# After `alert`: two such batches are shorter than the guard's hold after a flip.
_ALERT = _Batch(16, 6, 0.19)
_CALM_BATCHES = 2  # after which the finding is no longer new
_SURE_SIDE = 0.6  # of 5 (`PalmarEvidence.total`)
# Of 2 (`PalmarEvidence.fingers`): beyond the hyperextension of people.
_BACKWARDS = -0.95
_OTHERWISE_RIGHT = 0.25  # of 3: what palm and thumb must say for backward fingers
_SAME_MISFIT = 0.12  # a misfit that rises by less needs no new search for orders
_CARRIED_BATCHES = 4  # 2 s or more: what tells a finger at rest from one that is stuck
_FIRST_SIZES = 8  # batches at the start that say how large the hand is
_RESIZED = 1.35  # times as large as at the start, or as small; 0.86 to 1.25 in people
_REFUSED_SHARE = 0.25  # of a recording's valid samples
_SHORT = 1.0  # s; of a recording that is judged by its last batches


class InputCheck(Compiled):
    """Checks one hand's samples as they come.

    Samples are collected into batches of 16, or of a quarter of a second for a slow tracker, and
    of twice as many once nothing changes any more. Two batches in a row must agree before the
    finding changes, so one bad sample changes nothing.

    Args:
        side: The hand that the samples are said to be of.

    Raises:
        InvalidInputError: If the side is neither `right` nor `left`.
    """

    def __init__(self, side: Side) -> None:
        check_side(side)
        # Now, so that the first sample of a session does not wait.
        _known_orders()
        self.side: Side = side
        self._sign = 1.0 if side == "right" else -1.0
        self._batch: list[tuple[float, Array, Array | None]] = []
        self._last_time: tuple[float, ...] = ()
        self._guess: Finding | None = None
        self._batches = 0
        self._calm = 0
        self._finding: Finding | None = None
        self._wrist = WristCheck(self._sign)
        self._misfit = np.nan
        self._has_curled = False
        self._sizes: list[float] = []
        self._past: list[Array] = []

    @property
    @in_core
    def finding(self) -> Finding | None:
        """What is wrong with the input; None if it is plausible, or if too little was seen."""
        return self._finding

    @property
    @in_core
    def is_wrist_proven(self) -> bool:
        """Whether the wrist has followed a palm that turned (`WristCheck.is_proven`)."""
        return self._wrist.is_proven

    @in_core
    def update(
        self, time: float, landmarks: Array, wrist: Array | None = None
    ) -> Finding | None:
        """Take one sample in which the tracker saw the hand.

        Args:
            time: Its instant [s].
            landmarks: Its landmarks as they came, finite, shape (21, 3); they must not change.
            wrist: The tracker's own wrist pose, shape (4, 4), if it has one.

        Returns:
            The finding so far (`finding`).
        """
        self._batch.append((time, landmarks, wrist))
        if self._is_complete():
            self._judge()
        return self._finding

    @in_core
    def alert(self) -> None:
        """Judge the next samples by themselves and soon: something has changed."""
        self._batch.clear()
        self._calm = -_CALM_BATCHES

    def _is_complete(self) -> bool:
        """Tell whether a batch is complete."""
        if self._calm < 0 or self._finding is not None:
            size = _ALERT
        else:
            lacks_wrist = any(wrist is None for _, _, wrist in self._batch)
            is_calm = self._wrist.is_proven or lacks_wrist
            size = _CALM if is_calm and self._calm >= _CALM_BATCHES else _NEW
        count = len(self._batch)
        duration = self._batch[-1][0] - self._batch[0][0]
        # A batch that began with wrists may have grown beyond the number of one without.
        return count >= size.most or (count >= size.least and duration >= size.time)

    @in_core
    def finish(self) -> Finding | None:
        """Judge what is left at the end of a recording, by one batch if there was no other."""
        if self._batch and (len(self._batch) >= _NEW.least or not self._batches):
            self._judge()
        self._batch.clear()
        return self._guess if self._batches == 1 else self._finding

    @in_core
    def examine(self, recording: Recording) -> Finding | None:
        """Take a whole recording; see `examine_recording`."""
        seen = [*recording.part(recording.valid)]
        found = 0
        for sample in seen:
            finding = self.update(sample.time, sample.landmarks, sample.wrist)
            if finding is not None:
                found += 1
                if finding.kind == "time" or found >= _REFUSED_SHARE * len(seen):
                    return finding
        last = self.finish()
        return last if seen[-1].time - seen[0].time <= _SHORT else None

    def _judge(self) -> None:
        """Examine the collected samples, and change the finding if two batches agree."""
        times, points, poses = zip(*self._batch, strict=True)
        self._batch.clear()
        self._batches += 1
        has_wrists = all(pose is not None for pose in poses)
        landmarks = np.array(points)
        # Where trackers lost the hand, they send one point 21 times: that has rules of its own.
        is_hand = lengths(landmarks[:, 9] - landmarks[:, 0]) > 1e-9
        guess = _find_time_unit(np.array(self._last_time + times))
        self._last_time = times[-1:]
        if guess is None and is_hand.any():
            wrists = np.array(poses)[is_hand, :3] if has_wrists else None
            guess = self._examine(landmarks[is_hand], wrists)
        # Two batches in a row must agree that something is wrong, or that nothing is.
        is_same = (guess is None) == (self._guess is None) and self._batches > 1
        self._calm = self._calm + 1 if is_same or self._calm < 0 else 0
        if is_same:
            self._finding = guess
        self._guess = guess

    def _examine(self, landmarks: Array, wrists: Array | None) -> Finding | None:
        """Return what is wrong in one batch."""
        distances = own_distances(landmarks)
        evidence = palmar_evidence(landmarks)
        own = misfit(distances)
        total = median(self._sign * evidence.total)
        fingers = median(self._sign * evidence.fingers)
        is_known = own < self._misfit + _SAME_MISFIT and total > _SURE_SIDE
        order = None if is_known else _find_order(landmarks, self._sign, total)
        finding = (
            _find_length_unit(landmarks, distances, is_hand=order is None)
            or order
            or self._wrong_side(total, fingers, landmarks, wrists)
        )
        if finding is not None:
            return finding
        if not is_known:
            self._misfit = own
        self._has_curled |= fingers >= -_BACKWARDS
        finding = self._stuck(landmarks) or self._resized(float(log_sizes(distances)))
        if finding is not None or wrists is None:
            return finding
        return self._wrist.examine(landmarks, wrists)

    def _wrong_side(
        self, total: float, fingers: float, landmarks: Array, wrists: Array | None
    ) -> Finding | None:
        """Tell whether the hand, or its fingers alone, bend to the other side of the palm."""
        # Fingers that were seen to curl are bent backwards by the person.
        is_back = fingers <= _BACKWARDS and not self._has_curled
        if is_back and total - fingers > _OTHERWISE_RIGHT:
            return _BENT_BACK
        return self._other_side(landmarks, wrists) if total < -_SURE_SIDE else None

    def _stuck(self, landmarks: Array) -> Finding | None:
        """Tell whether a finger repeats, by this batch or by the last ones together."""
        self._past = [*self._past, landmarks][-_CARRIED_BATCHES:]
        is_stuck = stuck_fingers(landmarks)
        if len(self._past) == _CARRIED_BATCHES:
            is_stuck |= carried_fingers(np.concatenate(self._past))
        if not is_stuck.any():
            return None
        finger = FINGERS[is_stuck.argmax()]
        return Finding(
            "frozen",
            f"the {finger} finger repeats exactly while the others do not",
            "check the tracker's sensor or model of that finger",
        )

    def _resized(self, size: float) -> Finding | None:
        """Compare the logarithm of the hand's size with that of the first batches."""
        if len(self._sizes) < _FIRST_SIZES:
            self._sizes.append(size)
        ratio = math.exp(size - median(np.array(self._sizes)))
        if 1.0 / _RESIZED < ratio < _RESIZED:
            return None
        return Finding(
            "size",
            f"the hand is {ratio:.3g} times as large as it was at first",
            "measure the person again, and open a session for each person",
        )

    def _other_side(self, landmarks: Array, wrists: Array | None) -> Finding:
        """Tell the other hand from a mirrored world, which only the wrist's orientation can."""
        other = OTHER_SIDE[self.side]
        say = f"say that the hand is the {other} one (--side {other}; side= in Python)"
        negate = "negate one axis of the data if its coordinates are left-handed"
        if wrists is None:
            what = f"a {other} hand, or of a mirrored world"
            advice = f"{say}, or {negate}"
        elif WristCheck(-self._sign).examine(landmarks, wrists) is None:
            what = f"a {other} hand, and so is the wrist's pose"
            advice = say
        else:
            what = f"a mirrored {self.side} hand; the wrist's pose is not"
            advice = negate
        problem = (
            f"the landmarks are taken for a {self.side} hand's, and are those of {what}"
        )
        return Finding("side", problem, advice)


def _other_order(name: str) -> Finding:
    found = (
        f"their order is {name}" if name else "they are no hand in any order known here"
    )
    return Finding(
        "order",
        f"the landmarks are not in the order wrist, thumb, ..., little finger; {found}",
        "name the layout of the data (handmap layouts), or reorder them",
    )


_BENT_BACK = Finding(
    "flexion",
    "the fingers bend backwards, to the back of the hand",
    "turn the sign of the flexion angles, or of the axis that points out of the palm",
)


def check_recording(recording: Recording, *, name: str = "") -> None:
    """Reject a recording that cannot be what it says.

    Args:
        recording: The recording.
        name: What to call the recording in an error; its own name if omitted.

    Raises:
        InvalidInputError: If something is wrong in a quarter of it or more.
    """
    finding = examine_recording(recording)
    if finding is not None:
        raise InvalidInputError(
            finding.problem, argument=name or recording.name, advice=finding.advice
        )


def examine_recording(recording: Recording) -> Finding | None:
    """Tell what is wrong with a recording.

    Args:
        recording: The recording; its wrist poses are examined too.

    Returns:
        What is wrong in a quarter of its valid samples or more; None if it is plausible. A tracker
        that confuses the hand for a moment is left to the guard (`stream.guard`).
    """
    return InputCheck(recording.side).examine(recording)


# A misfit that no hand has (`hand_geometry.misfit`): at most 1.2 in recordings.
_NO_HAND = 1.45
# An order must fit better than ours by this much. Real recordings fit no other order better.
_BETTER_BY = 0.12
_NOISY = 15.0  # what noise adds to both [1/m]
# Evidence of `palmar_evidence`, from -5 to 5, that the order or the side cannot be right.
_CONTRADICTION = 0.6


def _find_order(landmarks: Array, sign: float, own_evidence: float) -> Finding | None:
    """Look for an order that explains landmarks much better than ours, of evidence -5 to 5."""
    names, orders = _known_orders()
    distances = own_distances(landmarks[:, orders])
    misfits = misfit(distances)
    own = misfits[0]
    changes = lengths(np.diff(landmarks - landmarks[:, :1], 2, axis=0)).ravel()
    slack = _NOISY * noise_of(changes, change_rate(1.0, 1.0)) if len(changes) else 0.0
    # The other hand is an explanation too, so an order of fingers must beat it only where our own
    # order contradicts the side.
    needed = own - slack - _BETTER_BY * (own_evidence > -_CONTRADICTION)
    better = np.argsort(misfits)
    for k in better[misfits[better] < needed]:
        total = palmar_evidence(landmarks[:, orders[k]]).total
        if sign * np.median(total) > min(-_CONTRADICTION, own_evidence):
            return _other_order(names[k] if misfits[k] < _NO_HAND else "")
    shape = Distances(distances.medians[0], np.zeros(1))
    if misfit(shape) <= _NO_HAND + slack:
        return None
    best = misfits.argmin()
    is_hand = misfits[best] < min(_NO_HAND, own - 3.0 * _BETTER_BY)
    return _other_order(names[best] if is_hand else "")


@cache
def _known_orders() -> tuple[list[str], Array]:
    """Return names and indices of our own order, of the named ones, and of all finger orders."""
    own = np.arange(LANDMARK_COUNT)
    known = {"": own}
    for name, layout in LAYOUTS.items():
        order = layout.order("right") if layout.shapes[0][0] == len(own) else None
        if order is not None and (order != own).any():
            known[f"that of the layout {name}"] = order
    known["one with the wrist last"] = np.roll(own, 1)
    # The first one is our own again, which is never better.
    for fingers in permutations(FINGERS):
        chains = own[1:].reshape(-1, 4)[[*map(fingers.index, FINGERS)]]
        name = f"one with the fingers {', '.join(fingers)}"
        known[name] = np.array([0, *chains.ravel()])
    return list(known), np.array(list(known.values()))


_STEPS = (4e-4, 0.5)
"""Shortest and longest median time between samples [s]: from 2500 Hz to 2 Hz."""
_TIME_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_ADULT = (0.12, 0.26)
"""Usual lengths of an adult's hand [m]."""
_LENGTH_UNITS = {
    1e-3: "so the landmarks are in millimetres (or pixels)",
    1e3: "as if metres had been taken for millimetres",
    1e-2: "so the landmarks are in centimetres",
    1e2: "as if metres had been taken for centimetres",
    0.0254: "so the landmarks are in inches",
    1.0 / 0.0254: "as if metres had been taken for inches",
}
"""Factors that make metres of landmarks in other units, and what they mean."""
_PIXELS = 30.0  # a hand that is longer in any unit


def _find_time_unit(times: Array) -> Finding | None:
    """Tell whether the median step of instants (T,) is not one of a tracker in seconds."""
    step = median(np.diff(times)) if len(times) > 1 else 0.0
    low, high = _STEPS
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
        advice = "give time in seconds, or the rate by --fps"
    elif fitting:
        found += f", so it is in {fitting[0]}"
        advice = f"multiply it by {_TIME_UNITS[fitting[0]]:g}"
    return Finding("time", found, advice)


def _find_length_unit(
    landmarks: Array, distances: Distances, *, is_hand: bool
) -> Finding | None:
    """Tell whether landmarks, which are a hand or in another order, are not in metres."""
    low, high = HAND_LENGTHS
    wrist = landmarks[:, 0]
    length = distances.hand_length
    depth = np.abs(wrist[:, 2]).max()
    width, height = np.ptp(wrist[:, :2], axis=0)
    if depth < 1e-4 * length < max(width, height):
        # The z of MediaPipe's image landmarks is relative to the wrist's.
        return Finding(
            "unit",
            "the wrist's z is always 0, so these are image coordinates (in pixels or of 0 to 1)",
            "give MediaPipe's world landmarks, in metres",
        )
    extent = np.median(np.ptp(landmarks, axis=1).max(axis=1))
    # Landmarks of the size of a hand may be in another order.
    is_other_order = not is_hand and low / 2.0 < extent < high
    if low <= length <= high or is_other_order:
        return None
    found = f"the hand is {length:.3g} m long"
    for factor, meaning in _LENGTH_UNITS.items():
        if _ADULT[0] <= length * factor <= _ADULT[1]:
            advice = f"multiply the landmarks by {factor:g}"
            return Finding("unit", f"{found}, {meaning}", advice)
    if length > _PIXELS:
        found += ", as if the landmarks were pixels"
    advice = f"give landmarks in metres, of a hand of {low} to {high} m"
    return Finding("unit", found, advice)
