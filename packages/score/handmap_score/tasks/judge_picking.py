"""A second judge of picks: it recounts outcomes from recorded states, without the task's code.

It knows nothing of contacts. The states of the object and of the fingers alone must show that the
object was lifted, that it lay in the tray in the end, and that the fingers had opened by then.
Lengths and times are written down again here, so that an error in one of the two places shows.
"""

import numpy as np

from .task import Record

# The object's free joint is the last one, and the wrist's the first one, of 7 numbers each.
_FREE = 7
_RISES = 0.01  # m
_TRAY_AT = (0.2, 0.0)  # m, from the object's first place
_TRAY_RADIUS = 0.08  # m
_FLAT = 0.03  # m
_STEPS = 15
_OPENS = 0.1  # rad, the largest change of a joint since the object was highest


def recount_pick(record: Record) -> bool:
    """Return whether the object was lifted, lay in the tray for a quarter second, and was let go.

    A grip ends before the fingers have opened by much, so they need to have opened by the end of
    that time alone.
    """
    places = record.qpos[:, -_FREE : -_FREE + 3] - record.qpos[0, -_FREE : -_FREE + 3]
    fingers = record.qpos[:, _FREE:-_FREE]
    highest = int(np.argmax(places[:, 2]))
    if places[highest, 2] < _RISES:
        return False
    from_tray = np.hypot(places[:, 0] - _TRAY_AT[0], places[:, 1] - _TRAY_AT[1])
    lies = (from_tray < _TRAY_RADIUS) & (places[:, 2] < _FLAT)
    change = np.abs(fingers - fingers[highest]).max(axis=1)
    lies[: highest + 1] = False
    run = 0
    for has_lain, opened in zip(lies.tolist(), change.tolist(), strict=True):
        run = run + 1 if has_lain else 0
        if run >= _STEPS and opened > _OPENS:
            return True
    return False
