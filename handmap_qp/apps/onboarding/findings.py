"""What checks of a hand find: findings with advice, tables of what was measured, and a report."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, NamedTuple, get_args

from handmap_core.errors import HandError, HandmapError
from handmap_qp.hands import Hand, Values

MOST_NAMES = 3
"""Names in one finding."""
Level = Literal["error", "warning", "advice", "fine"]
LEVELS = get_args(Level)
"""All levels, the worst first."""
Rows = list[Values]
"""Rows of a table: values by column."""


class HandFinding(NamedTuple):
    """One finding about a description.

    Attributes:
        level: `error`: cannot be used; `warning`: probably wrong; `advice`: could be better;
            `fine`: no problem.
        key: Key of the `hand.yaml`.
        text: What was found, a sentence without a full stop.
        change: What to change; empty if nothing.
    """

    level: Level
    key: str
    text: str
    change: str = ""


Found = Iterator[HandFinding | tuple[str, Rows]]
"""What a check yields: findings, and tables as title and rows."""
warning, advice, fine = (partial(HandFinding, level) for level in LEVELS[1:])


@dataclass(eq=False)
class HandReport:
    """What a check found about a hand or a robot.

    Attributes:
        name: Its name.
        hand: The hand; None if it cannot be built.
        error: Why it cannot be built; None if it can.
        findings: All findings, the worst first.
        measured: Tables of what was measured: rows by title.
    """

    name: str
    hand: Hand | None = None
    error: HandError | None = None
    findings: list[HandFinding] = field(default_factory=list)
    measured: dict[str, Rows] = field(default_factory=dict)

    @property
    def worst(self) -> Level:
        """Level of the worst finding; `fine` if there is none."""
        return self.findings[0].level if self.findings else "fine"

    @property
    def is_usable(self) -> bool:
        """Whether the hand can be built, and nothing in its description is probably wrong."""
        return self.worst in ("advice", "fine")

    def add(self, found: Iterable[HandFinding | tuple[str, Rows]]) -> None:
        """Add what a check yields; a finding instead if it cannot be made."""
        try:
            for each in found:
                if isinstance(each, HandFinding):
                    self.findings.append(each)
                elif each[1]:
                    self.measured |= [each]
        except HandmapError as error:
            key = getattr(error, "key", None) or "hand"
            self.findings.append(advice(key, f"not checked: {error}"))
        self.findings.sort(key=lambda finding: LEVELS.index(finding.level))
