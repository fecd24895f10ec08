"""Second judges of tasks on a table: they recount outcomes from states, without the tasks' code.

Lengths, angles and times are written down again here, so that an error in one of the two places
shows. States are laid out as the model's joints: the hand's wrist (7 numbers) and fingers, the
object (7), then what the task adds.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from .task import Record

_FREE = 7


def recount_lift(record: Record) -> bool:
    """Return whether the object was 50 mm above its place for a second."""
    height = record.qpos[:, -_FREE + 2]
    return _longest(height - height[0] > 0.05) >= 60


def recount_peg(record: Record) -> bool:
    """Return whether the peg stood in the hole, upright, after fingers had opened."""
    state = record.qpos[:, -_FREE:]
    fingers = record.qpos[:, _FREE:-_FREE]
    hole = record.body_pos[-1]
    highest = int(np.argmax(state[:, 2]))
    from_hole = np.hypot(state[:, 0] - hole[0], state[:, 1] - hole[1])
    # Of a quaternion wxyz, the cosine of the angle of z to the vertical.
    level = 1.0 - 2.0 * (state[:, 4] ** 2 + state[:, 5] ** 2)
    is_in = (from_hole < 0.01) & (state[:, 2] - state[0, 2] < 0.02)
    change = np.abs(fingers - fingers[highest]).max(axis=1)
    is_done = is_in & (np.abs(level) > 0.985) & (change > 0.1)
    is_done[: highest + 1] = False
    return state[highest, 2] - state[0, 2] > 0.01 and _longest(is_done) >= 15


def recount_cap(record: Record) -> bool:
    """Return whether the thread was at a right angle or beyond, for a quarter of a second."""
    return _longest(record.qpos[:, -1] >= np.pi / 2.0) >= 15


def recount_button(record: Record) -> bool:
    """Return whether the button was down by 4 mm and its frame by less than 2 mm, for 0.1 s."""
    button, frame = record.qpos[:, -2:].T
    return _longest((button <= -0.004) & (frame > -0.002)) >= 6


def recount_pour(record: Record) -> bool:
    """Return whether six of the seven balls lay in the bowl for a quarter of a second."""
    balls = record.qpos[:, -7 * _FREE :].reshape(len(record.qpos), 7, _FREE)[:, :, :3]
    bowl = record.body_pos[-8]
    way = balls - bowl
    is_in = (np.hypot(way[..., 0], way[..., 1]) < 0.1) & (way[..., 2] < 0.05)
    return _longest(is_in.sum(axis=1) >= 6) >= 15


def recount_hand_over(record: Record) -> bool:
    """Return whether the bar stayed in the air with the left hand after the right one had left.

    For half a second it must be 50 mm above its place and 60 mm from where the right wrist had it,
    and rest in the left wrist's frame within 20 mm. Its lower end must be in the air: a bar that
    leans between hand and table is not held. Both hands have as many joints.
    """
    states = record.qpos
    fingers = (states.shape[1] - 3 * _FREE) // 2
    right = states[:, :_FREE]
    bar = states[:, _FREE + fingers :][:, :_FREE]
    left = states[:, _FREE + fingers + _FREE :][:, :_FREE]
    height = bar[:, 2] - bar[0, 2]
    if height.max() < 0.01:
        return False
    in_right = _relative(right, bar)
    in_left = _relative(left, bar)
    lifted = int(np.argmax(height > 0.01))
    has_left = np.linalg.norm(in_right - in_right[lifted], axis=1) > 0.06
    # The z component of the bar's y axis, along which it is 200 mm long.
    slope = 2.0 * (bar[:, 5] * bar[:, 6] + bar[:, 3] * bar[:, 4])
    is_in_air = height - 0.1 * np.abs(slope) > 0.005
    is_done = has_left & (height > 0.05) & is_in_air
    is_done[: lifted + 1] = False
    for end in range(30, len(states)):
        span = slice(end - 29, end + 1)
        moved = np.linalg.norm(in_left[span] - in_left[end], axis=1).max()
        if is_done[span].all() and moved < 0.02:
            return True
    return False


def _relative(frame: np.ndarray, bar: np.ndarray) -> np.ndarray:
    """Return places of the bar in frames given by position and quaternion wxyz, (T, 3)."""
    turns = Rotation.from_quat(np.roll(frame[:, 3:], -1, axis=1))
    return turns.inv().apply(bar[:, :3] - frame[:, :3])


def _longest(flags: np.ndarray) -> int:
    """Return the length of the longest run of true flags after the initial state."""
    longest = run = 0
    for flag in flags[1:].tolist():
        run = run + 1 if flag else 0
        longest = max(longest, run)
    return longest
