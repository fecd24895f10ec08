"""Map a whole motion of joint angles, as a recording of landmarks is mapped."""

from __future__ import annotations

from collections.abc import Callable

from handmap_qp import HandMapper
from handmap_qp.apps.offline.trajectory import Trajectory, trajectory_of
from handmap_qp.human import HumanMotion


def map_motion(
    mapper: HandMapper,
    motion: HumanMotion,
    progress: Callable[[int], None] | None = None,
) -> Trajectory:
    """Map a whole human motion.

    The robot holds its last posture in samples that are not valid.

    Args:
        mapper: The mapper; its human hand must have the joints of `motion.human`.
        motion: The human motion.
        progress: Called after each sample with the number of samples done.

    Returns:
        The robot's trajectory, with one entry per sample of `motion`.

    Raises:
        InvalidInputError: If no sample of `motion` is valid, or a sample cannot be mapped.
    """
    columns = zip(motion.q, motion.wrist, motion.dt, motion.valid, strict=True)
    steps = (
        mapper.map_step(q, wrist, dt=dt) if is_valid else None
        for q, wrist, dt, is_valid in columns
    )
    return trajectory_of(mapper.robot, motion.time, steps, progress)
