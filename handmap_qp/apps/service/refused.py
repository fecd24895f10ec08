"""Refusals: the errors that clients are answered with, counted and logged."""

from logging import INFO

from handmap_core.client.messages import Error
from handmap_core.errors import RefusedError
from .logs import Metrics, Throttle


class Refusals:
    """Makes the errors that are answered.

    Args:
        metrics: Counts them by their codes.
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._log = Throttle()

    def answer(self, seq: int, error: RefusedError) -> Error:
        """Return the answer to a request that is refused, counted and logged.

        Args:
            seq: Number of the request.
            error: Why.
        """
        return self.counted(
            Error(seq=seq, code=error.code, message=str(error), field=error.field)
        )

    def counted(self, error: Error) -> Error:
        """Return an answer, counted and logged."""
        self._metrics.refusals[error.code] += 1
        self._log.report(
            INFO, "refused", code=error.code, field=error.field, message=error.message
        )
        return error
