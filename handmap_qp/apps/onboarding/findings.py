"""What checks of a hand find: findings with advice, tables of what was measured, and a report."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from handmap_qp.apps.tables import print_result
from handmap_qp.errors import HandError, HandmapError
from handmap_qp.hands import Hand, Values

MOST_NAMES = 3
"""Names in one finding."""
Level = Literal["error", "warning", "advice", "fine"]
LEVELS = get_args(Level)
"""All levels, the worst first."""
Rows = list[Values]
"""Rows of a table: values by column."""


class Finding(NamedTuple):
    """One finding about a description.

    Attributes:
        level: `error`: cannot be used; `warning`: probably wrong; `advice`: could be better;
            `fine`: no problem.
        key: Key of the `hand.yaml`.
        found: What was found.
        change: What to change; empty if nothing.
    """

    level: Level
    key: str
    found: str
    change: str = ""


Found = Iterator[Finding | tuple[str, Rows]]
"""What a check yields: findings, and tables as title and rows."""
warning, advice, fine = (partial(Finding, level) for level in LEVELS[1:])


@dataclass(eq=False)
class Report:
    """All findings about a hand.

    Attributes:
        name: Name of the hand.
        hand: The hand; None if it cannot be built.
        error: Why it cannot be built.
        findings: All findings, the worst first.
        measured: Tables of what was measured: rows by title.
    """

    name: str
    hand: Hand | None = None
    error: HandError | None = None
    findings: list[Finding] = field(default_factory=list)
    measured: dict[str, Rows] = field(default_factory=dict)

    def add(self, found: Iterable[Finding | tuple[str, Rows]]) -> None:
        """Add what a check yields; a finding instead if it cannot be made."""
        try:
            for each in found:
                if isinstance(each, Finding):
                    self.findings.append(each)
                elif each[1]:
                    self.measured |= [each]
        except HandmapError as error:
            key = getattr(error, "key", None) or "hand"
            self.findings.append(advice(key, f"not checked: {error}"))
        self.findings.sort(key=lambda finding: LEVELS.index(finding.level))

    def print(self, picture: Path | None, *, as_json: bool) -> None:
        """Print all findings and tables, and the name of a picture that was drawn.

        Raises:
            HandError: If the hand cannot be built.
            SystemExit: With the code 1 if there is a warning.
        """
        rows = [finding._asdict() for finding in self.findings]
        said = {
            "name": self.name,
            **self.measured,
            "findings": rows,
            "picture": picture and str(picture),
        }
        tables = {f"{self.name}: findings": rows, **self.measured}
        # A table of one error would say it twice.
        if as_json or not self.error:
            files = filter(None, [picture])
            print_result(said, tables, files, as_json=as_json)
        if self.error:
            raise self.error
        # The worst is first.
        if self.findings[0].level == "warning":
            raise SystemExit(1)
