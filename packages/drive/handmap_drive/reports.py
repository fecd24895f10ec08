"""What a driver says to its session in each turn, as long as the session takes it."""

from handmap_qp.client import Error
from handmap_qp.errors import warn

_REFUSED = 10.0
"""Time after which a session is told again what it refused [s]: the next one may take it."""


class Report:
    """One kind of report to a session.

    A session of another client takes reports only if it is shared. If it refuses, the user is
    warned once, and the report is made every `_REFUSED` seconds only.

    Args:
        subject: What is reported, for the warning.
    """

    def __init__(self, subject: str) -> None:
        self._subject = subject
        self._from = 0.0
        self._is_refused = False

    def is_due(self, now: float) -> bool:
        """Tell whether to report at a time [s, monotonic]."""
        return now >= self._from

    def note(self, refusal: Error | None, now: float) -> None:
        """Note the answer to an earlier report, which arrives late.

        Args:
            refusal: Why it was refused; None if it was not.
            now: The present [s, monotonic].
        """
        if refusal is None or refusal.code != "denied":
            return
        self._from = now + _REFUSED
        if not self._is_refused:
            self._is_refused = True
            warn(f"the session does not take {self._subject}: {refusal.message}")
