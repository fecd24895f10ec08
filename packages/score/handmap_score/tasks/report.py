"""What is said of a run: rows of tables, comparisons, and whether the judge is sound."""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise
from statistics import median
from typing import NamedTuple

from handmap_qp.hands import Names
from .attempt import Attempt
from .benches import CellResult
from .catalogue import Entry
from .mapping import OPEN, STRAIGHT, UNMAPPED
from .shares import Order, Share, contradictions, mcnemar, order_of, wilson
from .table import object_of

LEAST_UNMAPPED = 0.95
"""Share of successes that an operator needs on its own hand."""

_CONTROLS = {
    UNMAPPED: "unmapped succeeds in at least 95 %",
    STRAIGHT: "straight fingers succeed in none",
    OPEN: "an open hand succeeds in none",
}
"""Conditions of mappings that always run."""

Value = str | int | float
Row = dict[str, Value]


class Check(NamedTuple):
    """One condition of soundness.

    Attributes:
        what: The condition.
        where: Task, hand and operator.
        is_met: Whether it holds.
        text: What was measured.
    """

    what: str
    where: str
    is_met: bool
    text: str


class Group(NamedTuple):
    """Cells that differ in their mappings only.

    Attributes:
        task: Name of the task.
        hand: Name of the hand.
        operator: Name of the operator.
        cells: Its cells that have attempts, in the order given.
    """

    task: str
    hand: str
    operator: str
    cells: Sequence[CellResult]

    @property
    def label(self) -> str:
        """Task, hand and operator in words."""
        return f"{self.task}, {self.hand}, {self.operator}"

    @property
    def order(self) -> Order:
        """The order of its mappings, over the blocks."""
        return order_of({one.cell.method: one.wins for one in self.cells})


def groups_of(results: Sequence[CellResult]) -> list[Group]:
    """Return the groups in the order of their first cells."""
    found: dict[tuple[str, str, str], list[CellResult]] = {}
    for result in results:
        members = found.setdefault(result.cell[:3], [])
        if not result.problem:
            members.append(result)
    return [Group(*key, cells) for key, cells in found.items()]


def rows_of_results(results: Sequence[CellResult]) -> list[Row]:
    """Return a row for each cell that has attempts."""
    return [_row(result) for result in results if not result.problem]


def object_rows(
    results: Sequence[CellResult], objects: Mapping[str, Names]
) -> list[Row]:
    """Return a row for each object of each cell that has several.

    Args:
        results: All cells.
        objects: Objects that were used, by task.
    """
    rows = []
    for result in results:
        cell = result.cell
        names = objects[cell.task]
        if len(names) < 2:
            continue
        by_object: dict[str, list[Attempt]] = {name: [] for name in names}
        for one in result.attempts:
            by_object[object_of(one.seed, names)].append(one)
        rows += [
            {
                "task": cell.task,
                "hand": cell.hand,
                "operator": cell.operator,
                "mapping": cell.method,
                "object": name,
                **_share_fields(wilson(sum(a.is_success for a in those), len(those))),
                "force [N]": round(median(a.force for a in those), 1),
                "causes of failure": _causes_text(those),
            }
            for name, those in by_object.items()
            if those
        ]
    return rows


def _share_fields(share: Share) -> Row:
    return {
        "success": f"{share.successes}/{share.attempts}",
        "share %": round(100.0 * share.mean, 1),
        "95 %": f"{100.0 * share.low:.0f} to {100.0 * share.high:.0f}",
    }


def _causes_text(attempts: Sequence[Attempt]) -> str:
    """Return why attempts failed, the most frequent cause first."""
    causes = Counter(one.cause for one in attempts if one.cause)
    return ", ".join(f"{n} {cause}" for cause, n in causes.most_common())


def _row(result: CellResult) -> Row:
    cell = result.cell
    attempts = result.attempts
    times = [one.time for one in attempts if one.is_success]
    blocks = " ".join(str(int(count)) for count in result.wins.sum(axis=1))
    return {
        "task": cell.task,
        "hand": cell.hand,
        "operator": cell.operator,
        "mapping": cell.method,
        **_share_fields(result.share),
        "by block": blocks,
        "time [s]": round(median(times), 2) if times else "-",
        "tries": round(sum(one.tries for one in attempts) / len(attempts), 2),
        "drops": round(sum(one.drops for one in attempts) / len(attempts), 2),
        "force [N]": round(median(one.force for one in attempts), 1),
        "causes of failure": _causes_text(attempts),
    }


def pair_rows(groups: Sequence[Group]) -> list[Row]:
    """Return comparisons of neighbours in the order of each group, over the same scenes."""
    rows = []
    for group in groups:
        wins = {one.cell.method: one.wins.ravel() for one in group.cells}
        for better, worse in pairwise(group.order.names):
            pair = mcnemar(better, worse, wins[better], wins[worse])
            rows.append(
                {
                    "task": group.task,
                    "hand": group.hand,
                    "operator": group.operator,
                    "better": better,
                    "worse": worse,
                    "better only": pair.first_only,
                    "worse only": pair.second_only,
                    "p": round(pair.p, 4),
                    "apart": "yes" if pair.is_apart else "no",
                }
            )
    return rows


def checks_of(
    results: Sequence[CellResult], entries: Mapping[str, Entry]
) -> list[Check]:
    """Return the conditions of soundness, each with what was measured.

    Args:
        results: All cells.
        entries: Tasks by name.
    """
    groups = groups_of(results)
    checks = []
    for group in groups:
        by_method = {one.cell.method: one for one in group.cells}
        for name in entries[group.task].controls(group.hand):
            control = by_method.get(name)
            checks.append(_control_check(name, group.label, control))
        checks.append(_order_check(group))
    checks += _operator_checks(groups)
    checks.append(_recount_check(results))
    return checks


def _control_check(name: str, label: str, control: CellResult | None) -> Check:
    """Return the condition of a mapping that always runs.

    Args:
        name: Its name.
        label: What it is of.
        control: What came of it; None if it could not be used, which shows nothing.
    """
    what = _CONTROLS[name]
    if control is None:
        return Check(what, label, False, "it did not run")
    share = control.share
    is_met = share.mean >= LEAST_UNMAPPED if name == UNMAPPED else share.successes == 0
    return Check(what, label, is_met, str(share))


def _order_check(group: Group) -> Check:
    order = group.order
    turned = "; ".join(
        f"{pair.second} is ahead of {pair.first} in {count} of {order.blocks} blocks"
        for pair, count in order.reversed
    )
    text = f"{len(order.apart)} pairs told apart over {order.blocks} blocks"
    what = "the order of mappings is stable over the blocks"
    return Check(
        what, group.label, order.is_stable, f"{text}; {turned or 'none turns round'}"
    )


def _operator_checks(groups: Sequence[Group]) -> list[Check]:
    """Compare the orders of two operators on one task and hand."""
    checks = []
    for one, other in combinations(groups, 2):
        if (one.task, one.hand) != (other.task, other.hand):
            continue
        against = contradictions(one.order, other.order)
        text = "; ".join(f"{first} and {second}" for first, second in against)
        checks.append(
            Check(
                "two operators do not contradict each other",
                f"{one.task}, {one.hand}: {one.operator}, {other.operator}",
                not against,
                text or "no pair is told apart in opposite ways",
            )
        )
    return checks


def _recount_check(results: Sequence[CellResult]) -> Check:
    blocks = [block for result in results for block in result.blocks]
    attempts = sum(len(block.attempts) for block in blocks)
    recounted = sum(block.recounted for block in blocks)
    contradicted = sum(len(block.contradicted) for block in blocks)
    return Check(
        "a second judge recounts at least 5 % of the outcomes alike",
        "all",
        recounted >= max(1.0, 0.05 * attempts) and contradicted == 0,
        f"{recounted} of {attempts} recounted, {contradicted} otherwise",
    )


def problems_of(results: Sequence[CellResult]) -> list[str]:
    """Return why cells have no attempts."""
    return [
        f"{', '.join(result.cell)}: {result.problem}"
        for result in results
        if result.problem
    ]
