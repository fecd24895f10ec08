"""One attempt: the loop of operator, mapping and task, and its outcome."""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from .mapping import Mapping, SensingMapping
from .operator import Operator
from .task import Record, Task

_AFTERWARDS = 2.0
"""Time for which an attempt goes on when the operator has finished [s]; things settle."""
_SEPARATE = 0.1
"""Pause from which a touch or grip counts as another one [s]; contacts flicker."""


class Attempt(NamedTuple):
    """What came of one attempt.

    Attributes:
        seed: Seed of task and operator.
        is_success: Whether the goal held for long enough.
        time: When it had, or when the attempt was given up [s].
        tries: How often the hand began to touch the object.
        drops: How often it lost the object after gripping it.
        force: Largest normal force between hand and object [N].
        cause: Why it failed; empty after a success.
        steps: Steps that were made.
        record: Physics of the attempt; None if it was not kept.
    """

    seed: int
    is_success: bool
    time: float
    tries: int
    drops: int
    force: float
    cause: str
    steps: int
    record: Record | None


def attempt(task: Task, operator: Operator, mapping: Mapping, seed: int) -> Attempt:
    """Let an operator try a task through a mapping.

    The loop is closed: each step, the operator sees what the robot did with the command before. It
    ends when the goal has held for `task.hold` steps in a row, a while after the operator has
    finished, or at the time limit.

    Raises:
        HandmapError: If the mapping cannot map a hand.
    """
    scene = task.reset(seed)
    operator.reset(seed)
    mapping.reset()
    sensing = mapping if isinstance(mapping, SensingMapping) else None
    if sensing:
        sensing.draw_errors(seed)
    body_pos = task.model.body_pos.copy()
    site_pos = task.model.site_pos.copy()
    times = [scene.time]
    positions = [task.data.qpos.copy()]
    course = [scene.signals]
    held = 0
    idle = 0
    for _ in range(round(task.time_limit / task.time_step)):
        hand = operator.see(scene)
        if sensing:
            sensing.sense(scene)
        scene = task.step(hand, mapping.map(hand, task.time_step))
        times.append(scene.time)
        positions.append(task.data.qpos.copy())
        course.append(scene.signals)
        held = held + 1 if scene.signals.is_reached else 0
        idle = idle + 1 if operator.has_finished else 0
        if held == task.hold or idle * task.time_step > _AFTERWARDS:
            break
    is_success = held == task.hold
    pause = max(1, round(_SEPARATE / task.time_step))
    touches = count_runs([bool(one.touching) for one in course], pause)
    grips = count_runs([one.is_gripped for one in course], pause)
    is_lost = not any(one.is_gripped for one in course[-pause:])
    return Attempt(
        seed=seed,
        is_success=is_success,
        time=scene.time,
        tries=touches,
        drops=count_drops(grips, is_lost=is_lost, is_success=is_success),
        force=max(one.force for one in course),
        cause="" if is_success else task.cause(course),
        steps=len(course) - 1,
        record=Record(seed, np.array(times), np.array(positions), body_pos, site_pos),
    )


def count_runs(flags: Sequence[bool], pause: int) -> int:
    """Return how many runs of true flags there are, apart by at least `pause` false ones."""
    runs = 0
    gap = pause
    for flag, group in groupby(flags):
        length = sum(1 for _ in group)
        if not flag:
            gap = gap + length if runs == 0 else length
        elif gap >= pause:
            runs += 1
            gap = 0
    return runs


def count_drops(grips: int, *, is_lost: bool, is_success: bool) -> int:
    """Return how many grips ended by a loss.

    All but the last one did. The last one did if the object is not gripped at the end, unless the
    task was done by then.
    """
    if grips == 0:
        return 0
    return grips if is_lost and not is_success else grips - 1
