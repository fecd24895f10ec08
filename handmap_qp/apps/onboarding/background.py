"""Compute in a thread while a page answers: one job at a time, whose result is taken later."""

from collections.abc import Callable
from threading import Thread
from typing import Generic, TypeVar

from handmap_core.errors import HandmapError

Result = TypeVar("Result")


class Background(Generic[Result]):
    """Runs one job at a time in a thread of its own, which does not keep the program from ending.

    Jobs share nothing with the page: they get descriptions, and load hands of their own.
    """

    def __init__(self) -> None:
        self._thread: Thread | None = None
        self._outcome: list[Result | Exception] = []

    @property
    def is_busy(self) -> bool:
        """Whether a job was started whose result was not taken."""
        return self._thread is not None

    def start(self, job: Callable[[], Result]) -> None:
        """Start a job; there must be no other."""

        def run() -> None:
            try:
                outcome.append(job())
            except Exception as error:  # raised again where the result is taken
                outcome.append(error)

        self._outcome = outcome = []
        self._thread = Thread(target=run, daemon=True)
        self._thread.start()

    def take(self) -> Result | HandmapError | None:
        """Return the result of the job, or why it is not possible; None while it runs.

        Raises:
            Exception: What the job raised, if it is no `HandmapError`.
        """
        if not self._outcome:
            return None
        self._thread = None
        outcome = self._outcome.pop()
        if isinstance(outcome, Exception) and not isinstance(outcome, HandmapError):
            raise outcome
        return outcome
