"""Further terms of the QP's cost for one sample of a stream."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from handmap_core.hands import Hand
from handmap_core.ik import Task
from handmap_core.mapping.bound_method import BoundMethod
from handmap_core.mapping.target_source import TargetSource


class TaskedMapper(Protocol):
    """What moves a hand: a `HandMapper`, or one hand of a `RobotMapper`."""

    @property
    def source(self) -> TargetSource[Hand, BoundMethod]:
        """The human's side of the hand."""

    def set_tasks(self, tasks: Sequence[Task]) -> None:
        """Change the further terms of the QP's cost."""


@contextmanager
def further_terms(
    mappers: Sequence[TaskedMapper], terms: Sequence[Sequence[Task]]
) -> Iterator[None]:
    """Give mappers further terms of the QP's cost for a while.

    The caller has their `WorkLock`: another thread could have it when the terms are taken back.

    Args:
        mappers: The mappers.
        terms: The terms of each. A mapper without any is left as it is.
    """
    pairs = zip(mappers, terms, strict=True)
    changed = [(mapper, mapper.source.tasks, added) for mapper, added in pairs if added]
    try:
        for mapper, tasks, added in changed:
            mapper.set_tasks((*tasks, *added))
        yield
    finally:
        for mapper, tasks, _ in changed:
            mapper.set_tasks(tasks)
