"""A second judge: it recounts outcomes from recorded states and shares no code with the tasks.

It loads the maker's file itself, puts bodies and sites where the record says, computes where things
are, and counts for itself how long the goal held. Goals and times are written down again here, from
the environments' documentation, so that an error in one of the two places shows.
"""

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from .task import Record

Recount = Callable[[Record], bool]
"""Returns whether a recorded attempt succeeded."""


def recount_door(record: Record, scene: Path) -> bool:
    """Return whether the door was at least 1.35 rad open for a quarter of a second.

    Args:
        record: The attempt.
        scene: The maker's MuJoCo file.
    """
    model = mujoco.MjModel.from_xml_path(str(scene))
    hinge = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "door_hinge")
    angles = record.qpos[:, model.jnt_qposadr[hinge]]
    return _longest(angles >= 1.35) >= 25


def recount_relocate(record: Record, scene: Path) -> bool:
    """Return whether the ball was nearer to the target than 0.1 m for a quarter of a second."""
    model = mujoco.MjModel.from_xml_path(str(scene))
    model.body_pos[:] = record.body_pos
    model.site_pos[:] = record.site_pos
    data = mujoco.MjData(model)
    ball = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "Object")
    target = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "target")
    is_near = np.zeros(len(record.qpos), dtype=bool)
    for i, state in enumerate(record.qpos):
        data.qpos[:] = state
        mujoco.mj_fwdPosition(model, data)
        way = data.xpos[ball] - data.site_xpos[target]
        is_near[i] = way @ way < 0.01
    return _longest(is_near) >= 25


def _longest(flags: np.ndarray) -> int:
    """Return the length of the longest run of true flags after the initial state."""
    ends = np.flatnonzero(np.diff(np.concatenate(([0], flags[1:].astype(int), [0]))))
    return int(np.diff(ends)[::2].max(initial=0))
